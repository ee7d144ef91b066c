"""Eq. 1 and the signed moments of a line: the one place in the analysis for them.

A straight line crosses a shape's boundary at positions that alternate in, out, in, out. Its signed moment

    𝓛_n = Σ_{in,out} ℓⁿ − Σ_{in,in} ℓⁿ − Σ_{out,out} ℓⁿ        (unordered pairs of crossings)

gives, over all lines (dG = dp dθ), ∫𝓛_1 dG = πA and ∫𝓛_3 dG = 3A² for any shape whatever: not convex, with
holes, in pieces. With ∫k dG = P (k = chords on the line) this makes

    A = (π/3) ⟨𝓛_3⟩/⟨𝓛_1⟩          P = π A ⟨k⟩/⟨𝓛_1⟩             (averages over the lines that hit)

Erratum: Hidalgo Caballero et al. print the first prefactor as 3/π (Eq. 1, captions of Figs. 1F and 2A). It is
inverted: the printed form gives 9/π² = 0.912 of the true area. On a convex shape ⟨ℓ⟩ = πA/P (Cauchy) and
⟨ℓ³⟩ = 3A²/P (Crofton) leave no doubt: ⟨ℓ³⟩/⟨ℓ⟩ = 3A/π.

Sources: S. Hidalgo Caballero, A. Cassinelli, E. Fort, M. Labousse, "Frugal random exploration strategy for
shape recognition using statistical geometry"; V. Vlasov, arXiv:0711.4734 and 0904.3646 (signed chord lengths).
"""

from __future__ import annotations

import logging

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from analysis.kernels import chord_invariants
from lab.base.errors import RequestError

Floats = NDArray[np.float64]

AREA_PREFACTOR = np.pi / 3

log = logging.getLogger(__name__)


class CrossingsError(RequestError):
    """The crossings of a line do not pair up into chords.

    Attributes:
        crossings_cm: the positions that were given.
    """

    def __init__(self, reason: str, crossings_cm: Floats) -> None:
        super().__init__(f"crossings do not pair up into chords: {reason}; leave this line out or close its last chord")
        self.crossings_cm = crossings_cm


def signed_moment(crossings_cm: ArrayLike, n: int) -> float:
    """Give 𝓛_n of one line in cmⁿ by its definition, over all pairs of crossings.

    ``crossings_cm`` (2k,) are positions along the line, in order, the first one entering. Meant as the
    reference: for n = 1 and 3 `line_invariants` is faster and does not cancel.

    >>> signed_moment([0.0, 2.0], 3)
    8.0
    >>> signed_moment([0.0, 1.0, 2.0, 3.0], 1)
    2.0
    """
    s = _paired(crossings_cm)
    sign = np.where(np.arange(s.size) % 2 == 0, 1.0, -1.0)
    upper = np.triu_indices(s.size, 1)
    lengths = np.abs(s[upper[1]] - s[upper[0]])
    return float(-np.sum(sign[upper[0]] * sign[upper[1]] * lengths**n))


def line_invariants(s_cm: ArrayLike, entering: ArrayLike | None = None) -> tuple[int, float, float]:
    """Give (k, 𝓛_1 in cm, 𝓛_3 in cm³) of one line.

    ``s_cm`` (2k,) are the crossings' positions along the line in the order of travel, ``entering`` (2k,)
    says which of them go in; without it they alternate from an entering one. No crossings give (0, 0, 0).

    Raises:
        CrossingsError: they are not in order, or do not alternate in, out, in, out.

    >>> line_invariants([1.0, 3.0])
    (1, 2.0, 8.0)
    """
    s = _paired(s_cm, entering)
    k, l1_cm, l3_cm3 = chord_invariants(s, 0, s.size)
    return int(k), float(l1_cm), float(l3_cm3)


def invariants_table(crossings: pd.DataFrame) -> pd.DataFrame:
    """Give one row (line, k, l1_cm, l3_cm3) for each line of a crossings table.

    ``crossings`` needs the columns line, order, s_cm, entering. Lines without crossings are not in such a
    table and so not in the result. A line whose crossings do not pair up (the run began or ended in the
    light, or a crossing was missed) is left out and named in ``result.attrs["unpaired_lines"]``.
    """
    missing = {"line", "order", "s_cm", "entering"} - set(crossings.columns)
    if missing:
        raise RequestError(f"the crossings table lacks the column(s) {', '.join(sorted(missing))}")
    ordered = crossings.sort_values(["line", "order"], kind="stable")
    lines = np.asarray(ordered["line"], dtype=np.int64)
    s_cm = np.asarray(ordered["s_cm"], dtype=float)
    entering = np.asarray(ordered["entering"], dtype=bool)
    rows: list[tuple[int, int, float, float]] = []
    unpaired: list[int] = []
    starts = np.flatnonzero(np.diff(lines, prepend=lines[:1] - 1))
    for first, last in zip(starts, np.append(starts, lines.size)[1:], strict=True):
        line = int(lines[first])
        try:
            rows.append((line, *line_invariants(s_cm[first:last], entering[first:last])))
        except CrossingsError:
            unpaired.append(line)
    if unpaired:
        log.error("%d of %d lines left out: their crossings do not pair up", len(unpaired), len(starts))
    table = pd.DataFrame(
        {
            "line": np.array([row[0] for row in rows], dtype=np.int64),
            "k": np.array([row[1] for row in rows], dtype=np.int64),
            "l1_cm": np.array([row[2] for row in rows], dtype=float),
            "l3_cm3": np.array([row[3] for row in rows], dtype=float),
        }
    )
    table.attrs["unpaired_lines"] = unpaired
    return table


def lit_lengths(crossings: pd.DataFrame) -> Floats:
    """Lengths (n,) in cm of the lit stretches: each entering crossing with the leaving one that follows it.

    A crossing without its partner on the same line makes no chord.
    """
    ordered = crossings.sort_values(["line", "order"])
    line = np.asarray(ordered["line"], dtype=np.int64)
    s_cm = np.asarray(ordered["s_cm"], dtype=float)
    entering = ordered["entering"].to_numpy(dtype=bool)
    lit = (line[1:] == line[:-1]) & entering[:-1] & ~entering[1:]
    return (s_cm[1:] - s_cm[:-1])[lit]


def area_cm2(mean_l1_cm: ArrayLike, mean_l3_cm3: ArrayLike) -> Floats:
    """Eq. 1 with its prefactor put right: A = (π/3) ⟨𝓛_3⟩/⟨𝓛_1⟩. Broadcasts; NaN where ⟨𝓛_1⟩ is 0."""
    l1 = np.asarray(mean_l1_cm, dtype=float)
    l3 = np.asarray(mean_l3_cm3, dtype=float)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(l1 > 0, AREA_PREFACTOR * l3 / l1, np.nan)


def perimeter_cm(mean_k: ArrayLike, mean_l1_cm: ArrayLike, mean_l3_cm3: ArrayLike) -> Floats:
    """Cauchy's theorem with Eq. 1: P = π A ⟨k⟩/⟨𝓛_1⟩. Broadcasts; NaN where ⟨𝓛_1⟩ is 0."""
    l1 = np.asarray(mean_l1_cm, dtype=float)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(l1 > 0, np.pi * area_cm2(l1, mean_l3_cm3) * np.asarray(mean_k, dtype=float) / l1, np.nan)


def sizes(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """(…, 2) of (A in cm², P in cm) from sums or means (…, 3) of (k, 𝓛_1 in cm, 𝓛_3 in cm³) over lines."""
    k, l1_cm, l3_cm3 = np.moveaxis(sums, -1, 0)
    return np.stack([area_cm2(l1_cm, l3_cm3), perimeter_cm(k, l1_cm, l3_cm3)], axis=-1)


def _paired(s_cm: ArrayLike, entering: ArrayLike | None = None) -> Floats:
    s = np.ascontiguousarray(np.asarray(s_cm, dtype=float).ravel())
    if s.size % 2:
        raise CrossingsError(f"{s.size} is an odd number of crossings", s)
    if not np.isfinite(s).all() or (np.diff(s) < 0).any():
        raise CrossingsError("their positions must be finite and in the order of travel", s)
    if entering is not None:
        flags = np.asarray(entering, dtype=bool).ravel()
        if flags.size != s.size or (flags != (np.arange(s.size) % 2 == 0)).any():
            raise CrossingsError("they must alternate in, out, in, out", s)
    return s
