"""The report's figures: which of them the session allows, with captions that say what to look for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from analysis.compare import squared_distance
from analysis.estimate import Estimate
from analysis.figures.blinks import blinks_figure, panels_at
from analysis.figures.budget import budget_figure, name_of
from analysis.figures.camera import agreement, chord_pairs_figure
from analysis.figures.chords import Chords, chords_figure
from analysis.figures.convergence import Convergence, convergence_figure, posterior_figure
from analysis.figures.isotropy import isotropy_figure, lines_figure
from analysis.figures.plane import plane_figure
from analysis.figures.values import Entry
from analysis.invariants import lit_lengths
from analysis.report.result import SessionResult
from analysis.report.words import number, p_value, percent, probability, signed

_PLANE_ENTRIES = 8  # more ellipses than this cover each other
BLINK_COUNTS: tuple[int | None, ...] = (10, 100, None)


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """A figure of the report; ``alt`` tells what it shows to who cannot see it, ``caption`` what to look for."""

    name: str
    title: str
    figure: Figure
    alt: str
    caption: str


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A figure that could not be drawn, and why."""

    title: str
    reason: str


Maker = Callable[[SessionResult], Panel | LeftOut]


def panels_of(result: SessionResult) -> tuple[list[Panel], list[LeftOut]]:
    """Draw what the session allows, in the report's order."""
    makers: tuple[Maker, ...] = (
        _blinks,
        _plane,
        _convergence,
        _posterior,
        _chords,
        _camera,
        _lines,
        _isotropy,
        _budget,
    )
    made = [maker(result) for maker in makers]
    return [part for part in made if isinstance(part, Panel)], [part for part in made if isinstance(part, LeftOut)]


_NO_VIDEO = "the session was run without video, so that nobody saw where the robot was."
_NO_LINE = "no line crossed the shape."


def _blinks(result: SessionResult) -> Panel | LeftOut:
    title = "Light blinks accumulated over the shape"
    if result.track is None:
        return LeftOut(title, _NO_VIDEO)
    shown = panels_at(result.track, result.estimates, BLINK_COUNTS)
    figure = blinks_figure(
        result.track, result.geometry, result.arena, name=result.name, estimates=result.estimates, counts=BLINK_COUNTS
    )
    counts = ", ".join(str(n) for n, _ in shown)
    return Panel(
        "blinks",
        title,
        figure,
        f"{len(shown)} maps of the shape {result.title} with a dot wherever the camera saw the robot's LED lit, after "
        f"N = {counts} crossing lines; {len(shown[-1][1])} dots in the last.",
        "Every dot is a video frame in which the robot believed itself inside. The dots should fill the silhouette "
        "evenly and stop at its contour: a shifted edge points to the light threshold or to parallax, an empty patch "
        "to runs that are not random.",
    )


def _plane(result: SessionResult) -> Panel | LeftOut:
    title = "Perimeter and area against the dictionary"
    measured = result.measured
    if measured is None:
        return LeftOut(title, _NO_LINE)
    entries = _nearest(result.dictionary or {result.name: result.exact}, measured, result.name)
    figure = plane_figure(entries, {result.name: result.estimates}, n=measured.n, camera=result.camera)
    left_out = len(result.dictionary) - len(entries)
    nearest = f" The {left_out} entries farther from the estimate are left out." if left_out > 0 else ""
    names = ", ".join(entry.title for entry in entries.values())
    return Panel(
        "plane",
        title,
        figure,
        f"The robot's estimate moves through the plane of perimeter and area and ends at P = "
        f"{number(measured.perimeter_cm)} cm, A = {number(measured.area_cm2)} cm²; ellipses mark {len(entries)} "
        f"entries: {names}.",
        f"The trace grows stronger as lines arrive. Ellipses hold 75, 95 and 99 % of the estimates after {measured.n} "
        "lines on each entry, by the exact moments. The last point should lie inside the ellipses of one entry only; "
        f"where ellipses overlap, more lines are needed.{nearest}",
    )


def _nearest(entries: Mapping[str, Entry], measured: Estimate, name: str) -> dict[str, Entry]:
    """The projected entry, and those whose ellipses lie nearest to the estimate, few enough to be told apart."""

    def distance(entry: Entry) -> float:
        gap = np.array([measured.area_cm2 - entry.area_cm2, measured.perimeter_cm - entry.perimeter_cm])
        return squared_distance(gap, entry.covariance_at(measured.n))

    kept = set(sorted(entries, key=lambda key: (key != name, distance(entries[key])))[:_PLANE_ENTRIES])
    return {key: entry for key, entry in entries.items() if key in kept}


def _convergence(result: SessionResult) -> Panel | LeftOut:
    title = "Area and perimeter as lines arrive"
    measured = result.measured
    if measured is None:
        return LeftOut(title, _NO_LINE)
    shape = Convergence(result.name, result.title, result.estimates, result.exact, result.band)
    share = ""
    if result.band is not None:
        levels = result.band.levels
        share = (
            f" The shade is where {percent(float(levels[-1] - levels[0]), 0)} of "
            f"{result.band.runs} simulated sessions lie; the robot should stay in it and narrow as 1/√N."
        )
    return Panel(
        "convergence",
        title,
        convergence_figure([shape]),
        f"Two curves against the number of crossing lines N: area, ending at {number(measured.area_cm2)} cm² with "
        f"{number(result.exact.area_cm2)} exact, and perimeter, ending at {number(measured.perimeter_cm)} cm with "
        f"{number(result.exact.perimeter_cm)} exact.",
        f"Both curves should settle on the dashed exact values.{share} A curve that settles beside them is biased.",
    )


def _posterior(result: SessionResult) -> Panel | LeftOut:
    title = "How sure the recognition is"
    estimates = result.estimates
    if estimates.empty:
        return LeftOut(title, _NO_LINE)
    if result.posteriors is None and not {"leading", "posterior"} <= set(estimates.columns):
        return LeftOut(title, "the estimates carry no posterior.")
    titles = {name: result.title_of(name) for name in {*result.dictionary, *(name for name, _ in result.ranking)}}
    figure = posterior_figure(estimates, titles=titles, posteriors=result.posteriors, stop_at=result.stop_at)
    ranking = ", ".join(f"{result.title_of(name)} {probability(posterior)}" for name, posterior in result.ranking[:3])
    return Panel(
        "posterior",
        title,
        figure,
        f"Posterior probability against the number of crossing lines N; at the end: {ranking or 'unknown'}.",
        f"The dashed line is where the session may stop ({percent(result.stop_at, 0)}). Early changes of the leader "
        "are normal; a leader that changes late means that two entries are close.",
    )


def _chords(result: SessionResult) -> Panel | LeftOut:
    title = "Chord lengths"
    measured = result.measured
    lengths = lit_lengths(result.crossings[result.crossings["line"].isin(result.lines["line"])])
    if measured is None or not lengths.size:
        return LeftOut(title, _NO_LINE)
    exact = result.exact
    chords = Chords(result.name, result.title, lengths, measured.area_cm2, exact.area_cm2, exact.perimeter_cm)
    return Panel(
        "chords",
        title,
        chords_figure([chords]),
        f"Histogram of {lengths.size} chord lengths, the longest {number(chords.longest_cm)} cm, their mean "
        f"{number(chords.mean_cm)} cm; the root of the area is {number(float(np.sqrt(measured.area_cm2)))} cm.",
        "The mean chord ⟨ℓ⟩ = πA/P and the root of the area are the shape's invariants; dotted, where they lie for the "
        "projected shape. A gap at the shortest chords means that the sampling was too slow for them.",
    )


def _camera(result: SessionResult) -> Panel | LeftOut:
    title = "Robot against camera, chord by chord"
    if result.chord_pairs is None:
        return LeftOut(title, _NO_VIDEO if result.track is None else "no chords were matched with the camera's.")
    found = agreement(result.chord_pairs)
    if found is None:
        return LeftOut(title, "fewer than two chords could be matched with the camera's.")
    low, high = found.limits_cm
    return Panel(
        "camera",
        title,
        chord_pairs_figure(result.chord_pairs, name=result.name),
        f"{found.chords} chords: on the left the robot's length against the camera's, on the right their difference "
        f"against their mean, {number(found.bias_cm, 2)} cm on average, 95 % between {number(low, 2)} and "
        f"{number(high, 2)} cm.",
        "Left: points on the dashed line agree; another slope is a wrong speed. Right: the solid line is the mean "
        "difference, the dashed ones hold 95 % of the chords, grey is how well they are known; a dash-dotted line is "
        "drawn where the difference changes with length. A cloud that tilts or widens with length is a speed "
        "error, one that is shifted as a whole a threshold or a delay.",
    )


def _lines(result: SessionResult) -> Panel | LeftOut:
    title = "All runs in the arena"
    if result.true_lines is None or result.true_lines.empty:
        return LeftOut(title, _NO_VIDEO if result.track is None else "no straight run was found in the track.")
    return Panel(
        "lines",
        title,
        lines_figure(result.true_lines, result.geometry, result.arena, name=result.name),
        f"Map of the arena with {len(result.true_lines)} straight runs, wall to wall, over the shape {result.title}.",
        "The net should be even. A favoured direction is a turn that is not random, or a floor that slopes; an empty "
        "corner or stripe is a place that the robot cannot reach, or does not dare to.",
    )


def _isotropy(result: SessionResult) -> Panel | LeftOut:
    title = "Randomness of the runs"
    found = result.isotropy
    if found is None or not found.u.size:
        return LeftOut(title, _NO_VIDEO if result.track is None else "too few tracked runs to test.")
    smallest = f" The smallest p-value is {p_value(min(found.p_values.values()))}." if found.p_values else ""
    return Panel(
        "isotropy",
        title,
        isotropy_figure(found, name=result.name),
        f"Square scatter of {found.u.size} runs, direction U against place V, with histograms along both.{smallest}",
        "For isotropic, homogeneous lines the points fill the square evenly and 95 % of the bars end in the grey "
        f"stripes. {found.verdict}",
    )


def _budget(result: SessionResult) -> Panel | LeftOut:
    title = "Where the errors come from"
    budget = result.budget
    if budget is None:
        return LeftOut(title, "too few lines crossed the shape for an error budget.")
    largest = budget.largest()
    told = "no cause stands out of its error" if largest is None else f"the largest cause is {name_of(largest)}"
    seen = f"{signed(budget.area.seen_percent)} % in A and {signed(budget.perimeter.seen_percent)} % in P"
    source = (
        "What is left grey is chance, and what robot and camera do not explain."
        if budget.filmed
        else "Without video the causes are predicted, and what is left grey is the remainder."
    )
    return Panel(
        "budget",
        title,
        budget_figure(budget, name=result.name),
        f"Two waterfalls from the truth to what the robot found, {seen}; {told}.",
        "Each block begins where the one above it ended; its whisker is one standard error, for counting "
        f"statistics the size that chance makes expected. {source} Look for a coloured block that is longer than "
        "its whisker and than the whisker of counting statistics: more lines will not mend that.",
    )
