"""What many sessions show together: how many are whole, what they recognised, whether A and P are right."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from analysis.pulls import Pull, Share, Uniformity, more_than
from analysis.report.conclusion import Finding, Problem, Tone, Verdict
from analysis.report.problems import FEW_LINES, cure_of_sizes
from analysis.report.sheethealth import health_finding, health_problems
from analysis.report.sheetrows import Rows, numbers, texts
from analysis.report.words import count, listed, number, p_value, percent, signed, signed_with

LEVEL = 0.01  # of any false alarm among all checks of one kind
SLIGHT_Z = 0.1  # a mean z below is a bias that no session can notice
SLIGHT_SPREAD = 0.2
SURE = 0.95  # a posterior from which a session counts as decided

P_VALUES: Mapping[str, tuple[str, str]] = {
    "isotropy_p_value": (
        "isotropy",
        "Turn by the cosine law at the wall (`motion.turning`) and check that the bumps give the wall's normal.",
    ),
    "homogeneity_p_value": (
        "homogeneity",
        "Check that [arena] is the arena that was rolled in, and that no obstacle or slope keeps the robot from a part "
        "of it.",
    ),
    "run_length_p_value": (
        "run lengths",
        "Let the robot turn by Lambert's law at the edge (`motion.turning`), and check that [arena] is the arena that "
        "was rolled in.",
    ),
    "montecarlo_p_value": (
        "Monte Carlo",
        "The curves A(N) and P(N) leave what simulated sessions do: open the reports of those sessions and read their "
        "error budgets.",
    ),
}


@dataclass(frozen=True, slots=True)
class Side:
    """A or P of one shape: mean relative error ± standard error, z by the predicted σ and by the robot's own."""

    symbol: str
    error_rel: float
    error_sigma_rel: float
    pull: Pull
    own: Pull


@dataclass(frozen=True, slots=True)
class ShapeFigures:
    """What the sessions of one shape say. ``mistaken``: sure of a wrong name; ``undecided``: sure of none."""

    name: str
    right: Share
    mistaken: int
    undecided: int
    lines: float
    area: Side
    perimeter: Side

    @property
    def sides(self) -> tuple[Side, Side]:
        """A and P."""
        return self.area, self.perimeter


def shape_figures(rows: Rows) -> list[ShapeFigures]:
    """Give one for each shape that was projected, those with most sessions first."""
    return [_figures(rows, name) for name in rows.shapes]


def side_of(rows: Rows, table: pd.DataFrame, quantity: str) -> Side:
    """A ("area") or P ("perimeter") over the sessions of ``table``."""
    errors = numbers(table, f"{quantity}_error_rel")
    errors = errors[np.isfinite(errors)]
    return Side(
        "A" if quantity == "area" else "P",
        float(errors.mean()) if errors.size else float("nan"),
        float(errors.std(ddof=1) / np.sqrt(errors.size)) if errors.size > 1 else float("nan"),
        Pull.of(rows.z(table, quantity)),
        Pull.of(numbers(table, f"{quantity}_z")),
    )


def _figures(rows: Rows, name: str) -> ShapeFigures:
    own = rows.whole[rows.whole["shape"] == name]
    known = own[own["recognised_right"].notna()]
    right = numbers(known, "recognised_right") > 0.5
    sure = numbers(known, "recognised_posterior") >= SURE
    steady = rows.steady[rows.steady["shape"] == name]
    lines = numbers(rows.of_shape(name), "lines")
    return ShapeFigures(
        name,
        Share.counted(int(right.sum()), len(known)),
        int((sure & ~right).sum()),
        int((~sure & ~right).sum()),
        float(np.nanmedian(lines)) if np.isfinite(lines).any() else float("nan"),
        side_of(rows, steady, "area"),
        side_of(rows, steady, "perimeter"),
    )


def sheet_verdict(rows: Rows) -> Verdict:
    """Judge the batch: a headline, what was found, and what is off with what to do about it."""
    if not len(rows.whole):
        said = count(len(rows.every), "session")
        headline = f"Nothing to judge: {said}, and none could be analysed." if len(rows.every) else "No session at all."
        return Verdict("poor", headline, (), tuple(_broken(rows)))
    figures = shape_figures(rows)
    biased, uneven, names = _biased(figures), _spread(figures), _recognition(figures)
    problems = [
        *_broken(rows),
        *biased,
        *_stray(rows),
        *uneven,
        *names,
        *_random(rows),
        *_copies(rows),
        *health_problems(rows),
    ]
    grave = bool(biased or any("sure of a wrong name" in problem.what for problem in names))
    tone: Tone = "poor" if grave else "fair" if problems else "good"
    findings = (
        _sessions(rows),
        *_named(figures),
        *_sizes(rows, figures),
        *_randomness(rows),
        *health_finding(rows),
    )
    return Verdict(tone, _headline(rows, figures, biased=bool(biased)), findings, tuple(problems))


def _headline(rows: Rows, figures: Sequence[ShapeFigures], *, biased: bool) -> str:
    parts = [f"{count(len(rows.every), 'session')} of {count(len(figures), 'shape')}"]
    parts.append(f"{len(rows.broken)} broken" if len(rows.broken) else "none broken")
    known = sum(one.right.of for one in figures)
    if known:
        parts.append(f"{sum(one.right.hits for one in figures)} of {known} recognised")
    if not len(rows.measured):
        said = "nothing was measured"
    elif not any(side.pull.count for one in figures for side in one.sides):
        said = "how far A and P are off is unknown"
    elif biased:
        said = f"A or P is off for {listed([one.name for one in figures if _is_off(one, figures)])}"
    else:
        said = "A and P are right within their errors"
    return f"{', '.join(parts)}; {said}."


def _sessions(rows: Rows) -> Finding:
    lines = numbers(rows.measured, "lines")
    lines = lines[np.isfinite(lines)]
    said = f"{len(rows.whole)} whole, {len(rows.broken)} broken."
    if lines.size:
        few, middle, many = (f"{value:.0f}" for value in np.quantile(lines, [0.0, 0.5, 1.0]).tolist())
        said += f" {few} crossing lines a session" if few == many else f" {few} to {many} crossing lines a session"
        said += "." if few == many else f", {middle} in the middle."
        if np.median(lines) < FEW_LINES:
            said += f" Below {FEW_LINES} lines estimates are skewed by themselves, and errors rough."
    return Finding("Sessions", said)


def _named(figures: Sequence[ShapeFigures]) -> list[Finding]:
    known = [one for one in figures if one.right.of]
    if not known:
        return []
    each = [
        f"{one.name} {percent(one.right.value, 0)} ({one.right.hits} of {one.right.of}; "
        f"{percent(one.right.low, 0)} to {percent(one.right.high, 0)})"
        for one in known[:8]
    ]
    rest = f"; {count(len(known) - 8, 'more shape')} in the table below" if len(known) > 8 else ""
    return [Finding("Recognition", f"Rightly named, with Wilson's 95 % interval: {'; '.join(each)}{rest}.")]


def _sizes(rows: Rows, figures: Sequence[ShapeFigures]) -> list[Finding]:
    found: list[Finding] = []
    for topic, quantity in (("Area", "area"), ("Perimeter", "perimeter")):
        side = side_of(rows, rows.steady, quantity)
        pull = side.pull
        if not pull.count:
            continue
        off = [one.name for one in figures for part in one.sides if part.symbol == side.symbol and _off(part, figures)]
        said = f"mean z {signed_with(pull.mean, pull.sigma)} over {count(pull.count, 'session')}"
        if np.isfinite(pull.spread):
            said += f", spread {number(pull.spread, 2)}"
            said += f" ± {number(pull.spread_sigma, 2)}" if np.isfinite(pull.spread_sigma) else ""
            said += " (1 is right)"
        if rows.exact and np.isfinite(side.own.spread):
            said += f"; in the robot's own errors the spread is {number(side.own.spread, 2)}"
        right = f"off for {listed(off)}" if off else "right within its errors"
        found.append(Finding(topic, f"{side.symbol} is {right}: {said}."))
    return found


def _randomness(rows: Rows) -> list[Finding]:
    said: list[str] = []
    for column, (title, _) in P_VALUES.items():
        found = Uniformity.of(numbers(rows.whole, column))
        if found.count:
            chance = number(found.count / 20, 1 if found.count < 200 else 0)
            said.append(f"{title} {found.small} of {found.count} ({chance} by chance)")
    return [Finding("Randomness", f"p-values of 0.05 or less: {'; '.join(said)}.")] if said else []


def _tests(figures: Sequence[ShapeFigures], value: Callable[[Side], float]) -> int:
    return max(1, sum(bool(np.isfinite(value(side))) for one in figures for side in one.sides))


def _off(side: Side, figures: Sequence[ShapeFigures]) -> bool:
    allowed = LEVEL / _tests(figures, lambda part: part.pull.mean_p)
    return bool(side.pull.mean_p < allowed and abs(side.pull.mean) > SLIGHT_Z)


def _is_off(one: ShapeFigures, figures: Sequence[ShapeFigures]) -> bool:
    return any(_off(side, figures) for side in one.sides)


def _biased(figures: Sequence[ShapeFigures]) -> list[Problem]:
    problems: list[Problem] = []
    for one in figures:
        off = [side for side in one.sides if _off(side, figures)]
        if off:
            parts = " and ".join(
                f"{side.symbol} is {_error(side)} off (mean z {signed_with(side.pull.mean, side.pull.sigma)})"
                for side in off
            )
            said = f"{one.name}: {parts} over {count(off[0].pull.count, 'session')}; chance does not do that."
            problems.append(Problem(said, cure_of_sizes(one.area.error_rel, one.perimeter.error_rel)))
    return problems


def _error(side: Side) -> str:
    if not np.isfinite(side.error_sigma_rel):
        return f"{signed(100 * side.error_rel)} %"
    return f"{signed_with(100 * side.error_rel, 100 * side.error_sigma_rel)} %"


def _spread(figures: Sequence[ShapeFigures]) -> list[Problem]:
    allowed = LEVEL / (2 * _tests(figures, lambda side: side.pull.spread_p))

    def off(pull: Pull) -> bool:
        return bool(pull.spread_p < allowed and abs(pull.spread - 1) > SLIGHT_SPREAD)

    wide, narrow, wrong = list[str](), list[str](), list[str]()
    for one in figures:
        for side in one.sides:
            if off(side.pull):
                (wide if side.pull.spread > 1 else narrow).append(f"{side.symbol} of {one.name} ({_width(side.pull)})")
            elif off(side.own):
                wrong.append(f"{side.symbol} of {one.name} ({_width(side.own)})")
    problems: list[Problem] = []
    if wide:
        cure = "Something changes from one session to the next: compare their light levels, batteries and calibrations."
        problems.append(Problem(f"Sessions differ by more than chance: spread of z for {listed(wide)}.", cure))
    if narrow:
        cure = "Look for copies of one session, and for seeds that were used twice: such sessions are not independent."
        problems.append(Problem(f"Sessions agree better than chance allows: spread of z for {listed(narrow)}.", cure))
    if wrong:
        cure = f"Do not lean on single sessions' errors; {FEW_LINES} lines or more make them reliable."
        problems.append(Problem(f"The robot's own errors are misjudged: spread of z for {listed(wrong)}.", cure))
    return problems


def _width(pull: Pull) -> str:
    return f"{number(pull.spread, 2)} ± {number(pull.spread_sigma, 2)}"


def _recognition(figures: Sequence[ShapeFigures]) -> list[Problem]:
    allowed = LEVEL / max(1, len(figures))
    mistaken, undecided = list[str](), list[str]()
    for one in figures:
        if _too_many(one.mistaken, one.right.of, allowed):
            mistaken.append(f"{one.name} ({one.mistaken} of {one.right.of})")
        elif _too_many(one.mistaken + one.undecided, one.right.of, allowed):
            undecided.append(f"{one.name} ({one.right.of - one.right.hits} of {one.right.of})")
    problems: list[Problem] = []
    if mistaken:
        cure = (
            "Mend what biases A and P first; else match the dictionary to the sensor, and look in the confusion figure "
            "for the name that is favoured."
        )
        problems.append(Problem(f"Sessions were sure of a wrong name: {listed(mistaken)}.", cure))
    if undecided:
        cure = "Roll more lines: `chordlab plan` says how many these shapes take."
        problems.append(Problem(f"Not recognised, and not sure of anything else: {listed(undecided)}.", cure))
    return problems


def _too_many(wrong: int, of: int, allowed: float) -> bool:
    """Whether more are wrong than the twentieth that a decision at 95 % allows."""
    return of > 0 and wrong / of > 1 - SURE and more_than(wrong, of, 1 - SURE) < allowed


def _random(rows: Rows) -> list[Problem]:
    problems: list[Problem] = []
    for column, (title, cure) in P_VALUES.items():
        p_values = numbers(rows.whole, column)
        found = Uniformity.of(p_values)
        if found.count and found.p_value < LEVEL / len(P_VALUES):
            order = [int(index) for index in np.argsort(p_values)[:3] if p_values[index] <= 0.05]
            worst = [f"{rows.whole['session'].iloc[index]} ({p_value(float(p_values[index]))})" for index in order]
            said = (
                f"The p-values of {title} are not uniform: {found.small} of {found.count} are 0.05 or less, "
                f"{number(found.count / 20, 1)} would be chance."
            )
            problems.append(Problem(f"{said} Smallest: {listed(worst)}." if worst else said, cure))
    return problems


def _broken(rows: Rows) -> list[Problem]:
    if not len(rows.broken):
        return []
    said = f"{count(len(rows.broken), 'session')} could not be analysed: {listed(texts(rows.broken, 'session'))}."
    return [
        Problem(
            said,
            "The reasons are in the table of broken sessions; `chordlab recover` mends a folder that was cut short.",
        )
    ]


def _stray(rows: Rows) -> list[Problem]:
    stray = rows.measured[rows.stray]
    if stray.empty:
        return []
    each = [
        f"{name} (z {signed(a)} in A, {signed(p)} in P)"
        for name, a, p in zip(
            texts(stray, "session"),
            rows.z(stray, "area").tolist(),
            rows.z(stray, "perimeter").tolist(),
            strict=True,
        )
    ]
    return [
        Problem(
            f"{count(len(stray), 'session')} beyond all chance from the others, left out of means and spreads: "
            f"{listed(each)}.",
            "Open the reports of these sessions: a wrong shape, a wrong calibration or a robot that was touched.",
        )
    ]


def _copies(rows: Rows) -> list[Problem]:
    same = rows.measured.duplicated(["shape", "lines", "robot_area_cm2", "robot_perimeter_cm"], keep="first")
    if not bool(same.any()):
        return []
    names = listed(texts(rows.measured[same], "session"))
    return [
        Problem(
            f"{count(int(same.sum()), 'session')} with the very lines of another: {names}.",
            "Take copies out of the folder and give each simulated session a seed of its own.",
        )
    ]
