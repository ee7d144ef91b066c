"""What the session shows, in plain language: a headline, findings with their numbers, and what to do next."""

from __future__ import annotations

import numpy as np

from analysis.budget import Side
from analysis.compare import deviation
from analysis.estimate import Estimate
from analysis.figures.budget import name_of
from analysis.figures.camera import agreement
from analysis.report.conclusion import Finding, Tone, Verdict
from analysis.report.problems import BUDGET_CURES, NOTHING_MEASURED, part_of, problems_of, sides_of
from analysis.report.result import SessionResult
from analysis.report.words import count, number, p_value, percent, plus_minus, probability, signed


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
            problems=(NOTHING_MEASURED,),
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
    problems = problems_of(result, measured)
    return Verdict("fair" if tone == "good" and problems else tone, headline, findings, problems)


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
            f"From its own crossings the camera gives "
            f"A = {plus_minus(camera.area_cm2, camera.sigma_area_cm2, 'cm²')} and "
            f"P = {plus_minus(camera.perimeter_cm, camera.sigma_perimeter_cm, 'cm')}; the robot differs from it by "
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


def _budget(result: SessionResult) -> tuple[Finding, ...]:
    budget = result.budget
    if budget is None:
        return ()
    parts = " and ".join(
        f"{signed(side.seen_percent)} % in {name}, of which chance is {_chance(side)}"
        for name, side in sides_of(budget)
    )
    largest = budget.largest()
    if largest is None:
        cause = "No systematic cause stands out of its error: more lines make it better."
    else:
        cause = (
            f"The largest systematic cause is {name_of(largest)} ({part_of(budget, largest)}). {BUDGET_CURES[largest]}"
        )
    how = "" if budget.filmed else " Without video the causes are only predicted."
    return (Finding("Error budget", f"{parts}. {cause}{how}"),)


def _chance(side: Side) -> str:
    term = side.of("counting")
    return "unknown" if term is None else f"{signed(term.percent)} ({number(term.sigma_percent)} expected)"
