"""What is off in a session, and what to do about it: each problem with the command or the setting that mends it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import numpy as np

from analysis.budget import Budget, Side
from analysis.compare import deviation, squared_distance
from analysis.estimate import Estimate
from analysis.figures.camera import Agreement, agreement
from analysis.figures.values import Entry
from analysis.report.conclusion import Problem
from analysis.report.result import SessionResult
from analysis.report.words import count, p_is, percent, signed, signed_with

UNLIKELY = 0.01  # a joint deviation rarer than this is a bias, not chance
SCALE_TOLERANCE = 0.01
MISSED_TOLERANCE = 0.02
BUDGET_TOLERANCE = 1.0  # per cent of A or P that is worth a cure
FEW_LINES = 100  # below, the estimates of intricate shapes are skewed and a Gaussian ellipse only a rough guide

BUDGET_CURES = {
    "speed": "Calibrate the robot on this floor (`chordlab calibrate robot`); where runs differ from each other, take "
    'lengths from the wheels (`motion.length_from = "odometry"`).',
    "latency": "Measure the robot's delays (`chordlab robot characterise`) and roll more slowly (`motion.speed_cm_s`).",
    "sampling": "Roll more slowly (`motion.speed_cm_s`) or shorten `sensor.interval_s`: chords shorter than one step "
    "are lost.",
    "footprint": "Focus the projector or show the shape larger; recognition by lines matched to the sensor is not "
    "affected.",
    "parallax": "Calibrate the projector for the sensor's plane (`chordlab calibrate projector`) and measure "
    "`sensor.height_cm`.",
    "anisotropy": 'Turn by the cosine law at the wall (`motion.turning = "lambert"`) and check the bumps\' directions '
    "(`chordlab robot characterise`).",
}


NOTHING_MEASURED = Problem(
    "The robot reported no line with a lit stretch.",
    "Look whether the projector shows the shape (`chordlab project SHAPE`), whether the robot rolls inside the arena, "
    "and whether its light levels separate (`levels` in manifest.json); `chordlab doctor` says what the bench lacks.",
)


def problems_of(result: SessionResult, measured: Estimate) -> tuple[Problem, ...]:
    """Everything that spoils the session, the recognition's first."""
    return (
        *_of_the_recognition(result, measured),
        *_of_the_sizes(result, measured),
        *_of_the_runs(result),
        *_of_the_budget(result),
    )


def lines_to_tell_apart(one: Entry, other: Entry, stop_at: float) -> float:
    """Crossing lines after which (A, P) tell ``one`` from ``other`` with posterior ``stop_at`` in 95 of 100 sessions.

    With d² the squared distance for one line, the log odds after N lines are normal, mean N d²/2 and variance N d²;
    x = √(N d²) must satisfy x²/2 − 1.645 x = ln(s/(1 − s)). Infinite for equal (A, P).
    """
    gap = np.array([one.area_cm2 - other.area_cm2, one.perimeter_cm - other.perimeter_cm])
    squared = squared_distance(gap, (one.covariance_per_line + other.covariance_per_line) / 2)
    odds = np.log(stop_at / (1 - stop_at)) if stop_at < 1 else np.inf
    return float((1.645 + np.sqrt(1.645**2 + 2 * max(odds, 0.0))) ** 2 / squared) if squared > 1e-9 else float("inf")


def sides_of(budget: Budget) -> tuple[tuple[str, Side], ...]:
    """The budgets of A and of P, with their symbols."""
    return ("A", budget.area), ("P", budget.perimeter)


def part_of(budget: Budget, name: str) -> str:
    """What one cause puts on A and on P, in words."""
    terms = [(quantity, side.of(name)) for quantity, side in sides_of(budget)]
    return ", ".join(
        f"{signed_with(term.percent, term.sigma_percent)} % of {quantity}"
        for quantity, term in terms
        if term is not None
    )


def _of_the_budget(result: SessionResult) -> list[Problem]:
    """What no other check looks for: an image of the wrong size, delays, and errors without a known cause."""
    budget = result.budget
    if budget is None or not budget.filmed:
        return []
    problems: list[Problem] = []
    for name in ("latency", "parallax"):
        terms = [term for _, side in sides_of(budget) if (term := side.of(name)) is not None]
        if any(abs(term.percent) > max(BUDGET_TOLERANCE, 3 * term.sigma_percent) for term in terms):
            problems.append(Problem(f"A and P are off by {name}: {part_of(budget, name)}.", BUDGET_CURES[name]))
    if not budget.closes:
        problems.append(
            Problem(
                "The error budget does not add up to what was seen: something is wrong that it does not know of.",
                "Look at the chords that robot and camera disagree on (`chordlab validate "
                f"{_folder(result)}`); calibrate the camera (`chordlab calibrate camera`) and check that nothing was "
                "moved during the session.",
            )
        )
    return problems


def _of_the_recognition(result: SessionResult, measured: Estimate) -> list[Problem]:
    problems: list[Problem] = []
    if result.ranking and (result.ranking[0][0] != result.name or result.ranking[0][1] < result.stop_at):
        others = {name: entry for name, entry in result.dictionary.items() if name != result.name}
        if others:
            needed, rival = max(
                (lines_to_tell_apart(result.exact, entry, result.stop_at), name) for name, entry in others.items()
            )
            problems.append(_undecided(result, measured, rival, needed))
    if measured.n < FEW_LINES:
        problems.append(
            Problem(
                f"Only {count(measured.n, 'line')} crossed the shape; below {FEW_LINES} the uncertainties are rough.",
                f"Let it go on to {FEW_LINES} crossing lines: `{_go_on(result, FEW_LINES)}`.",
            )
        )
    return problems


def _undecided(result: SessionResult, measured: Estimate, rival: str, needed: float) -> Problem:
    title = result.title_of(rival)
    if not np.isfinite(needed):
        return Problem(
            f"{result.title} and {title} have the same area and perimeter: (A, P) cannot tell them apart.",
            f"Recognise line by line instead of by (A, P): `chordlab recognize {_folder(result)}`.",
        )
    lines = round(needed, -int(np.floor(np.log10(max(needed, 1.0)))) + 1)
    if needed > measured.n:
        step = f"By theory about {lines:.0f} crossing lines settle it: `{_go_on(result, round(lines))}`."
    else:
        step = (
            f"By theory about {lines:.0f} lines suffice: the measurement is biased rather than short. Calibrate the "
            "robot (`chordlab calibrate robot`) and the projector (`chordlab calibrate projector`)."
        )
    return Problem(f"The recognition is not settled; the hardest rival is {title}.", step)


def cure_of_sizes(area_rel: float, perimeter_rel: float) -> str:
    """What to do about A and P that are off by these shares of the truth."""
    if abs(area_rel - 2 * perimeter_rel) < 0.5 * abs(area_rel):
        return (
            "A deviates about twice as much as P, as a wrong speed or scale makes it: calibrate the robot on this "
            "floor (`chordlab calibrate robot`; it sets `motion.cm_s_per_unit`), then the projector "
            "(`chordlab calibrate projector`)."
        )
    return (
        "Check the light threshold (`levels` in manifest.json), the sensor's footprint and lost short chords: a slower "
        "robot (`motion.speed_cm_s`) or faster sampling (`sensor.interval_s`) mends the latter."
    )


def _of_the_sizes(result: SessionResult, measured: Estimate) -> list[Problem]:
    problems: list[Problem] = []
    off = deviation(measured, result.exact)
    if off.p_value < UNLIKELY:
        problems.append(
            Problem(
                f"A and P deviate more than chance allows ({p_is(off.p_value)}).",
                cure_of_sizes(off.area_rel, off.perimeter_rel),
            )
        )
    found = None if result.chord_pairs is None else agreement(result.chord_pairs)
    if found is not None:
        problems += _of_the_chords(found, result.chords_missed or 0, result.chords_extra or 0, _speed_unit(result))
    return problems


def _of_the_chords(found: Agreement, missed: int, extra: int, cm_s_per_unit: float | None) -> list[Problem]:
    problems: list[Problem] = []
    off = found.scale - 1
    becomes = f" ({cm_s_per_unit:.3g} becomes {cm_s_per_unit / found.scale:.3g})" if cm_s_per_unit else ""
    if abs(off) > max(SCALE_TOLERANCE, 3 * found.scale_sigma):
        problems.append(
            Problem(
                f"The robot's lengths are {signed(100 * off)} % off the camera's; that puts "
                f"{signed(100 * (found.scale**2 - 1))} % on A.",
                f"Divide the setting `motion.cm_s_per_unit` by {found.scale:.3f}{becomes}, or calibrate on this floor: "
                "`chordlab calibrate robot`. If the camera is wrong: `chordlab calibrate camera`.",
            )
        )
    share = missed / (found.chords + missed)
    if share <= MISSED_TOLERANCE:
        return problems
    if extra > missed / 2:
        problems.append(
            Problem(
                f"{percent(share)} of the camera's chords found no partner among the robot's, nor {extra} of the "
                "robot's among the camera's.",
                "As many on either side: the chords were made but not matched. Calibrate the camera "
                "(`chordlab calibrate camera`), and look whether it saw where each run begins.",
            )
        )
    else:
        problems.append(
            Problem(
                f"The robot missed {percent(share)} of the chords, which lowers P.",
                "Roll more slowly (`motion.speed_cm_s`) or sample faster (`sensor.interval_s`): chords shorter than "
                "one step are lost.",
            )
        )
    return problems


def _of_the_runs(result: SessionResult) -> list[Problem]:
    problems: list[Problem] = []
    short = result.lines["ended"].isin(["stall", "timeout", "link"])  # contacts are made good by weights
    cut = int(short.sum())
    if result.runs and cut / result.runs > MISSED_TOLERANCE:
        kinds = result.lines.loc[short, "ended"].value_counts()
        listed = ", ".join(f"{number_of} by {kind}" for kind, number_of in kinds.items())
        problems.append(
            Problem(
                f"{count(cut, 'run')} did not end at the wall ({listed}); cut runs lower A.",
                "Charge the robot (`chordlab robot info` says its voltage), clear the floor and stay in radio range, "
                "then repeat the session.",
            )
        )
    check = result.runs_check
    if check is not None and not check.lengths.passed:
        expected = f" {check.bias.verdict}" if check.bias is not None else ""
        problems.append(
            Problem(
                f"The runs are not those of isotropic lines ({p_is(check.lengths.p_value)}).{expected}",
                'Let it turn by Lambert\'s law at the edge (`motion.turning = "lambert"`), check that the bumps give '
                "the wall's normal (`chordlab robot characterise`), and that [arena] is the arena that was rolled in.",
            )
        )
    if result.isotropy is not None and not result.isotropy.passed:
        problems.append(
            Problem(
                "The runs were not isotropic and homogeneous, so that A and P may be biased.",
                'Turn by the cosine law at the wall (`motion.turning = "lambert"`), check that the bumps give the '
                "wall's normal (`chordlab robot characterise`), and look for slopes and obstacles on the floor.",
            )
        )
    return problems


def _folder(result: SessionResult) -> str:
    return result.session or "SESSION"


def _go_on(result: SessionResult, lines: int) -> str:
    return f"chordlab run --resume {_folder(result)} --lines {lines}"


def _speed_unit(result: SessionResult) -> float | None:
    """The speed in cm/s of one unit of the drive command that the session took; None where it is not known."""
    profile = result.provenance.get("devices", {}).get("profile")
    found = cast("Mapping[str, object]", profile).get("cm_s_per_unit") if isinstance(profile, Mapping) else None
    return found if isinstance(found, float) else None
