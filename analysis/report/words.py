"""Numbers as people write them: as many digits as their uncertainty allows, a true minus, grouped thousands."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

_GROUP = "\u202f"


def signed(value: float, digits: int = 1) -> str:
    """Write a number with its sign: ``signed(-0.04)`` is "0.0", not "−0.0"."""
    if not math.isfinite(value):
        return "unknown"
    text = f"{value:+.{digits}f}"
    if float(text) == 0:
        return text[1:]
    return text.replace("-", "−")


def number(value: float, digits: int = 1) -> str:
    """Write a number with a true minus; what is not finite is "unknown"."""
    return f"{value:.{digits}f}".replace("-", "−") if math.isfinite(value) else "unknown"


def decimals_for(sigma: float) -> int:
    """Decimals that show two digits of an uncertainty, at least none and at most six; one without an uncertainty."""
    if not math.isfinite(sigma) or sigma <= 0:
        return 1
    return min(max(0, 1 - math.floor(math.log10(sigma))), 6)


def plus_minus(value: float, sigma: float, unit: str) -> str:
    """Write value ± σ with two digits of σ: ``plus_minus(687.31, 38.4, "cm²")`` is "687 ± 38 cm²"."""
    digits = decimals_for(sigma)
    if not math.isfinite(sigma):
        return f"{number(value, digits)} {unit} (uncertainty unknown)"
    return f"{number(value, digits)} ± {number(sigma, digits)} {unit}"


def signed_with(value: float, sigma: float) -> str:
    """Write a signed value ± σ with one or two decimals: ``signed_with(6.098, 0.37)`` is "+6.1 ± 0.4"."""
    digits = 1 if sigma >= 0.1 else 2
    return f"{signed(value, digits)} ± {number(sigma, digits)}"


def percent(share: float, digits: int = 1) -> str:
    """Write a share in per cent."""
    return f"{number(100 * share, digits)} %"


def probability(value: float) -> str:
    """Write a probability in per cent with one decimal, never rounded to certainty or to impossibility."""
    if value > 0.999:
        return "more than 99.9 %"
    if value < 0.001:
        return "less than 0.1 %"
    return percent(value)


def count(number_of: int, one: str, many: str | None = None) -> str:
    """Write a count with its noun: ``count(1, "line")`` is "1 line", ``count(1200, "line")`` "1 200 lines"."""
    noun = one if number_of == 1 else (many or f"{one}s")
    return f"{number_of:,} {noun}".replace(",", _GROUP)


def p_value(value: float) -> str:
    """Write a p-value: three decimals, or "< 0.001"."""
    if not math.isfinite(value):
        return "unknown"
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def p_is(value: float) -> str:
    """Write what a p-value is: "p = 0.034" or "p < 0.001"."""
    said = p_value(value)
    return f"p {said}" if said.startswith("<") else f"p = {said}"


def typographic(text: str) -> str:
    """Set minus signs and powers of ten as in print: ``typographic("-0.3, 2e-05")`` is "−0.3, 2·10⁻⁵"."""
    powers = re.sub(r"(?<=\d)e([+-]?)0*(\d+)\b", lambda found: f"·10{_raised(found[1] + found[2])}", text)
    return re.sub(r"(?<![\w\d−-])-(?=\d)", "−", powers)


def _raised(digits: str) -> str:
    return digits.replace("+", "").translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def listed(names: Sequence[str], most: int = 5) -> str:
    """Write an enumeration: ``listed(["a", "b", "c"])`` is "a, b and c"; beyond ``most``, "a, b, … and 7 more"."""
    if len(names) > most:
        return f"{', '.join(names[:most])} and {len(names) - most} more"
    return " and ".join(part for part in (", ".join(names[:-1]), names[-1]) if part) if names else ""
