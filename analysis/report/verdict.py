"""What the session shows, in plain language: a headline, findings with their numbers, and what to do next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.budget import Budget, Side
from analysis.compare import deviation, squared_distance
from analysis.estimate import Estimate
from analysis.figures.budget import name_of
from analysis.figures.camera import Agreement, agreement
from analysis.figures.values import Entry
from analysis.report.result import SessionResult
from analysis.report.words import count, number, p_value, percent, plus_minus, probability, signed, signed_with

Floats = NDArray[np.float64]
Tone = Literal["good", "fair", "poor"]

UNLIKELY = 0.01  # a joint deviation rarer than this is a bias, not chance
SCALE_TOLERANCE = 0.01
MISSED_TOLERANCE = 0.02
BUDGET_TOLERANCE = 1.0  # per cent of A or P that is worth a cure
FEW_LINES = 100  # below, the estimates of intricate shapes are skewed and a Gaussian ellipse only a rough guide


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing the session shows: ``topic`` in a word or two, ``text`` in whole sentences."""

    topic: str
    text: str


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that spoils the session, and what to do next."""

    what: str
    next_step: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """The conclusion: ``tone`` good (nothing to do), fair (usable, see the problems) or poor."""

    tone: Tone
    headline: str
    findings: tuple[Finding, ...]
    problems: tuple[Problem, ...]


def lines_to_tell_apart(one: Entry, other: Entry, stop_at: float) -> float:
    """Crossing lines after which (A, P) tell ``one`` from ``other`` with posterior ``stop_at`` in 95 of 100 sessions.

    With d² the squared distance for one line, the log odds after N lines are normal, mean N d²/2 and variance N d²;
    x = √(N d²) must satisfy x²/2 − 1.645 x = ln(s/(1 − s)). Infinite for equal (A, P).
    """
    gap = np.array([one.area_cm2 - other.area_cm2, one.perimeter_cm - other.perimeter_cm])
    squared = squared_distance(gap, (one.covariance_per_line + other.covariance_per_line) / 2)
    odds = np.log(stop_at / (1 - stop_at)) if stop_at < 1 else np.inf
    return float((1.645 + np.sqrt(1.645**2 + 2 * max(odds, 0.0))) ** 2 / squared) if squared > 1e-9 else float("inf")


def decided_at(result: SessionResult) -> int | None:
    """The N from which on the final leader stayed ahead with posterior ≥ ``stop_at``; None if it never settled."""
    estimates = result.estimates
    if estimates.empty or not result.ranking or not {"leading", "posterior"} <= set(estimates.columns):
        return None
    ordered = estimates.sort_values("n")
    ahead = (ordered["leading"] == result.ranking[0][0]).to_numpy(dtype=bool)
    sure = ahead & (np.asarray(ordered["posterior"], dtype=float) >= result.stop_at)
    if not sure[-1]:
        return None
    doubts = np.flatnonzero(~sure)
    return int(np.asarray(ordered["n"])[doubts[-1] + 1 if doubts.size else 0])


def verdict_of(result: SessionResult) -> Verdict:
    """Judge a session by its tables alone: what was recognised and how far to trust it."""
    measured = result.measured
    if measured is None:
        return Verdict(
            tone="poor",
            headline=f"Nothing was measured: none of the {count(result.runs, 'run')} crossed the shape.",
            findings=(),
            problems=(
                Problem(
                    "The robot reported no line with a lit stretch.",
                    "Check that the projector shows the shape, that the robot rolls inside the arena, and that its "
                    "light levels separate (`levels` in manifest.json).",
                ),
            ),
        )
    tone, headline = _headline(result, measured)
    findings = (
        _recognition(result, measured),
        *_sizes(result, measured),
        _camera(result, measured),
        *_against_simulation(result),
        _randomness(result),
        *_turning(result),
        *_budget(result),
    )
    problems = [
        *_of_the_recognition(result, measured),
        *_of_the_sizes(result, measured),
        *_of_the_runs(result),
        *_of_the_budget(result),
    ]
    if tone == "good" and problems:
        tone = "fair"
    return Verdict(tone, headline, findings, tuple(problems))


def _headline(result: SessionResult, measured: Estimate) -> tuple[Tone, str]:
    lines = count(measured.n, "crossing line")
    if not result.ranking:
        return "fair", f"Measured after {lines}; there was no dictionary to recognise the shape from."
    best, posterior = result.ranking[0]
    title = " or ".join(map(result.title_of, (best, *result.twins)))
    if result.unknown > 0.5:
        known = result.name in {name for name, _ in result.ranking}
        said = f"Unknown: none of the dictionary's shapes (probability {probability(result.unknown)}) after {lines}"
        nearest = f"the nearest is {title}"
        return ("poor", f"{said}; {result.title} was projected.") if known else ("good", f"{said}; {nearest}.")
    if result.name not in {name for name, _ in result.ranking}:
        return "fair", f"{result.title} is not in the dictionary; after {lines} the robot takes it for: {title}."
    sure = probability(posterior)
    if posterior < result.stop_at:
        projected = "" if best == result.name else f", but {result.title} was projected"
        return "fair", f"Undecided: {title} leads with posterior {sure} after {lines}{projected}."
    if best != result.name:
        return "poor", f"Mistaken: {result.title} was projected, {title} is favoured ({sure}) after {lines}."
    return "good", f"Recognised: {title}, posterior {sure} after {lines}."


def _recognition(result: SessionResult, measured: Estimate) -> Finding:
    runs = (
        f"{count(measured.n, 'line')} of {count(result.runs, 'arena run')} crossed the shape "
        f"({percent(measured.n / result.runs, 0) if result.runs else 'unknown'})."
    )
    if not result.ranking:
        return Finding("Lines", runs)
    best, posterior = result.ranking[0]
    text = f"{runs} {result.title_of(best)} has posterior {probability(posterior)}"
    if len(result.ranking) > 1:
        rival, other = result.ranking[1]
        text += f", the next is {result.title_of(rival)} with {probability(other)}"
    settled = decided_at(result)
    text += "." if settled is None else f"; from N = {settled} on it stayed above {percent(result.stop_at, 0)}."
    return Finding("Recognition", text)


def _sizes(result: SessionResult, measured: Estimate) -> list[Finding]:
    off = deviation(measured, result.exact)
    shape = result.exact
    return [
        Finding(
            "Area",
            f"A = {plus_minus(measured.area_cm2, measured.sigma_area_cm2, 'cm²')}; projected "
            f"{number(shape.area_cm2)} cm²: {signed(100 * off.area_rel)} %, {signed(off.z_area)} σ.",
        ),
        Finding(
            "Perimeter",
            f"P = {plus_minus(measured.perimeter_cm, measured.sigma_perimeter_cm, 'cm')}; projected "
            f"{number(shape.perimeter_cm)} cm: {signed(100 * off.perimeter_rel)} %, {signed(off.z_perimeter)} σ.",
        ),
    ]


def _camera(result: SessionResult, measured: Estimate) -> Finding:
    sentences: list[str] = []
    if result.camera is not None:
        camera = result.camera
        sentences.append(
            f"From its own crossings the camera gives A = {number(camera.area_cm2)} cm² and "
            f"P = {number(camera.perimeter_cm)} cm; the robot differs from it by "
            f"{signed(100 * (measured.area_cm2 / camera.area_cm2 - 1))} % in A and "
            f"{signed(100 * (measured.perimeter_cm / camera.perimeter_cm - 1))} % in P."
        )
    found = None if result.chord_pairs is None else agreement(result.chord_pairs)
    if found is not None:
        low, high = found.limits_cm
        sentences.append(
            f"Over {count(found.chords, 'matched chord')} robot minus camera is {signed(found.bias_cm, 2)} cm on "
            f"average, 95 % between {signed(low, 2)} and {signed(high, 2)} cm; scale {number(found.scale, 3)}."
        )
    if result.chords_missed is not None and result.chords_extra is not None:
        sentences.append(
            f"The robot missed {count(result.chords_missed, 'chord')} and saw {result.chords_extra} too many."
        )
    if not sentences:
        sentences.append("There was no video: nothing checks the robot's chords one by one.")
    return Finding("Camera", " ".join(sentences))


def _against_simulation(result: SessionResult) -> tuple[Finding, ...]:
    check = result.montecarlo
    return () if check is None else (Finding("Against Monte Carlo", check.sentence),)


def _randomness(result: SessionResult) -> Finding:
    if result.isotropy is None:
        return Finding("Randomness", "Whether the lines were isotropic was not tested, for want of tracked lines.")
    found = result.isotropy
    opening = found.verdict or ("The lines look random." if found.passed else "The lines are not random enough.")
    if not found.p_values:
        return Finding("Randomness", opening)
    worst = min(found.p_values, key=found.p_values.__getitem__)
    return Finding("Randomness", f"{opening} Smallest p-value: {p_value(found.p_values[worst])} ({worst}).")


def _turning(result: SessionResult) -> tuple[Finding, ...]:
    check = result.runs_check
    if check is None:
        return ()
    said = (
        check.lengths.verdict if check.consistency is None else f"{check.lengths.verdict} {check.consistency.verdict}"
    )
    return (Finding("The robot's own runs", said),)


_CURES = {
    "speed": "Calibrate the robot on this floor (`chordlab calibrate robot`); where runs differ from each other, take "
    'lengths from the wheels (`motion.length_from = "odometry"`).',
    "latency": "Measure the robot's delays (`chordlab robot characterise`) and roll more slowly.",
    "sampling": "Roll more slowly or shorten `sensor.interval_s`: chords shorter than one step are lost.",
    "footprint": "Focus the projector or show the shape larger; recognition by lines matched to the sensor is not "
    "affected.",
    "parallax": "Calibrate the projector for the sensor's plane (`chordlab calibrate projector`) and measure "
    "`sensor.height_cm`.",
    "anisotropy": "Turn by the cosine law at the wall (`motion.turning`) and check the bumps' directions.",
}


def _budget(result: SessionResult) -> tuple[Finding, ...]:
    budget = result.budget
    if budget is None:
        return ()
    parts = " and ".join(
        f"{signed(side.seen_percent)} % in {name}, of which chance is {_chance(side)}" for name, side in _sides(budget)
    )
    largest = budget.largest()
    if largest is None:
        cause = "No systematic cause stands out of its error: more lines make it better."
    else:
        cause = f"The largest systematic cause is {name_of(largest)} ({_part(budget, largest)}). {_CURES[largest]}"
    how = "" if budget.filmed else " Without video the causes are only predicted."
    return (Finding("Error budget", f"{parts}. {cause}{how}"),)


def _sides(budget: Budget) -> tuple[tuple[str, Side], ...]:
    return ("A", budget.area), ("P", budget.perimeter)


def _chance(side: Side) -> str:
    term = side.of("counting")
    return "unknown" if term is None else f"{signed(term.percent)} ({number(term.sigma_percent)} expected)"


def _part(budget: Budget, name: str) -> str:
    terms = [(quantity, side.of(name)) for quantity, side in _sides(budget)]
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
        terms = [term for _, side in _sides(budget) if (term := side.of(name)) is not None]
        if any(abs(term.percent) > max(BUDGET_TOLERANCE, 3 * term.sigma_percent) for term in terms):
            problems.append(Problem(f"A and P are off by {name}: {_part(budget, name)}.", _CURES[name]))
    if not budget.closes:
        problems.append(
            Problem(
                "The error budget does not add up to what was seen: something is wrong that it does not know of.",
                "Look at the chords that robot and camera disagree on; check the camera's calibration and that nothing "
                "was moved during the session.",
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
                f"Roll at least {FEW_LINES} crossing lines (`chordlab run --lines {FEW_LINES}`).",
            )
        )
    return problems


def _undecided(result: SessionResult, measured: Estimate, rival: str, needed: float) -> Problem:
    title = result.title_of(rival)
    if not np.isfinite(needed):
        return Problem(
            f"{result.title} and {title} have the same area and perimeter: (A, P) cannot tell them apart.",
            "Recognise line by line instead of by (A, P): `chordlab recognize`.",
        )
    lines = round(needed, -int(np.floor(np.log10(max(needed, 1.0)))) + 1)
    if needed > measured.n:
        step = f"By theory about {lines:.0f} crossing lines settle it: `chordlab run --lines {lines:.0f}`."
    else:
        step = (
            f"By theory about {lines:.0f} lines suffice: the measurement is biased rather than short. Calibrate the "
            "robot and the projector, or use a dictionary that is matched to the sensor."
        )
    return Problem(f"The recognition is not settled; the hardest rival is {title}.", step)


def cure_of_sizes(area_rel: float, perimeter_rel: float) -> str:
    """What to do about A and P that are off by these shares of the truth."""
    if abs(area_rel - 2 * perimeter_rel) < 0.5 * abs(area_rel):
        return (
            "A deviates about twice as much as P, as a wrong speed or scale makes it: check `motion.cm_s_per_unit` in "
            "the settings, then the projector's height."
        )
    return (
        "Check the light threshold, the sensor's footprint and lost short chords; a slower robot or faster sampling "
        "mends the latter."
    )


def _of_the_sizes(result: SessionResult, measured: Estimate) -> list[Problem]:
    problems: list[Problem] = []
    off = deviation(measured, result.exact)
    if off.p_value < UNLIKELY:
        problems.append(
            Problem(
                f"A and P deviate more than chance allows (p {p_value(off.p_value)}).",
                cure_of_sizes(off.area_rel, off.perimeter_rel),
            )
        )
    found = None if result.chord_pairs is None else agreement(result.chord_pairs)
    if found is not None:
        problems += _of_the_chords(found, result.chords_missed or 0, result.chords_extra or 0)
    return problems


def _of_the_chords(found: Agreement, missed: int, extra: int) -> list[Problem]:
    problems: list[Problem] = []
    off = found.scale - 1
    if abs(off) > max(SCALE_TOLERANCE, 3 * found.scale_sigma):
        problems.append(
            Problem(
                f"The robot's lengths are {signed(100 * off)} % off the camera's; that puts "
                f"{signed(100 * (found.scale**2 - 1))} % on A.",
                f"Divide the setting `motion.cm_s_per_unit` by {found.scale:.3f}, or check the camera's calibration.",
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
                "As many on either side: the chords were made but not matched. Check the camera's calibration and that "
                "robot and camera agree on where each run begins.",
            )
        )
    else:
        problems.append(
            Problem(
                f"The robot missed {percent(share)} of the chords, which lowers P.",
                "Lower the speed or shorten the sampling interval: chords shorter than one step are lost.",
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
                "Charge the robot, clear the floor and stay in radio range, then repeat the session.",
            )
        )
    check = result.runs_check
    if check is not None and not check.lengths.passed:
        expected = f" {check.bias.verdict}" if check.bias is not None else ""
        problems.append(
            Problem(
                f"The runs are not those of isotropic lines (p-value {p_value(check.lengths.p_value)}).{expected}",
                "Let it turn by Lambert's law at the edge (`motion.turning`), check that the bumps give the wall's "
                "normal, and that [arena] is the arena that was rolled in.",
            )
        )
    if result.isotropy is not None and not result.isotropy.passed:
        problems.append(
            Problem(
                "The runs were not isotropic and homogeneous, so that A and P may be biased.",
                "Turn by the cosine law at the wall and check that the bumps give the wall's normal.",
            )
        )
    return problems
