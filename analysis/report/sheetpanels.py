"""The batch report's figures: which of them the table allows, with captions that say what to look for."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.figures.batch import (
    Cloud,
    Errors,
    clouds_figure,
    errors_figure,
    pulls_figure,
    recognition_figure,
    uniform_figure,
)
from analysis.figures.health import Strip, health_figure
from analysis.pulls import Pull, Share
from analysis.report.panels import LeftOut, Panel
from analysis.report.sheethealth import vitals
from analysis.report.sheetrows import NONE_OF_THESE, Rows, numbers, texts
from analysis.report.sheetverdict import P_VALUES, shape_figures
from analysis.report.words import count, listed, number, percent, signed_with

Floats = NDArray[np.float64]

_A_PAGE = 6  # shapes in one figure of small multiples
_MOST_SHAPES = 12
_MOST_ROWS = 24
_MOST_ANSWERS = 12
_OTHERS = "others"
_NAMED_OUTLIERS = 3  # in a strip; the rest is marked without a name

Made = Sequence[Panel | LeftOut]
Maker = Callable[[Rows], Made]


def sheet_panels(rows: Rows) -> tuple[list[Panel], list[LeftOut]]:
    """Draw what the table allows, in the sheet's order."""
    makers: tuple[Maker, ...] = (_clouds, _errors, _pulls, _recognition, _uniform, _health)
    made = [part for maker in makers for part in maker(rows)]
    return [part for part in made if isinstance(part, Panel)], [part for part in made if isinstance(part, LeftOut)]


def _pages(shapes: list[str]) -> list[tuple[list[str], str, str]]:
    """The most frequent shapes in portions, with a suffix for the figure's name and one for its title."""
    shown = shapes[:_MOST_SHAPES]
    portions = [shown[first : first + _A_PAGE] for first in range(0, len(shown), _A_PAGE)]
    if len(portions) < 2:
        return [(portion, "", "") for portion in portions]
    said = [f" (shapes {_A_PAGE * page + 1} to {_A_PAGE * page + len(own)})" for page, own in enumerate(portions)]
    return [(own, f"-{page + 1}", said[page]) for page, own in enumerate(portions)]


def _rest(shapes: list[str]) -> str:
    left = len(shapes) - _MOST_SHAPES
    return f" Shown are the {_MOST_SHAPES} shapes with most sessions; {left} more are not." if left > 0 else ""


def _middle(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _sigma_per_line(rows: Rows, own: pd.DataFrame, quantity: str, unit: str) -> float:
    """σ of one line (cm² or cm): the exact one, or what the robot's own scatter says."""
    column = f"exact_sigma_{quantity}_{unit}" if rows.exact else f"robot_sigma_{quantity}_{unit}"
    return _middle(numbers(own, column) * np.sqrt(numbers(own, "lines")))


def _cloud(rows: Rows, name: str) -> Cloud:
    own = rows.of_shape(name)
    own = own[own["lines"] > 0]
    s_a, s_p = (_sigma_per_line(rows, own, *side) for side in (("area", "cm2"), ("perimeter", "cm")))
    mixed = _middle(numbers(own, "robot_correlation")) * s_a * s_p
    return Cloud(
        name,
        (_middle(numbers(own, "truth_area_cm2")), _middle(numbers(own, "truth_perimeter_cm"))),
        numbers(own, "robot_area_cm2"),
        numbers(own, "robot_perimeter_cm"),
        numbers(own, "lines"),
        np.array([[s_a**2, mixed], [mixed, s_p**2]]),
    )


def _clouds(rows: Rows) -> Made:
    title = "Area and perimeter, shape by shape"
    shapes = [name for name in rows.shapes if len(_cloud(rows, name).lines)]
    if not shapes:
        return [LeftOut(title, "no session has an area and a perimeter.")]
    panels: list[Panel] = []
    source = "the shape's exact moments" if rows.exact else "the robot's own errors, for want of predicted ones"
    for names, suffix, part in _pages(shapes):
        clouds = [_cloud(rows, name) for name in names]
        held = [
            f"{cloud.name}: {int(cloud.inside().sum())} of {cloud.inside().size}" for cloud in clouds if cloud.predicted
        ]
        panels.append(
            Panel(
                f"clouds{suffix}",
                f"{title}{part}",
                clouds_figure(clouds),
                f"Small maps of area against perimeter for {listed(names, _A_PAGE)}, a dot for each session. Inside "
                f"the ellipses are {'; '.join(held) or 'an unknown number of sessions'}.",
                "Each dot is a session, the cross the truth. The ellipses hold 95 % of sessions of the median, the "
                f"smallest and the largest number of lines by {source}. The cloud should surround the cross, with one "
                "session in 20 outside the ellipse of its own number of lines (open diamonds). A cloud beside the "
                f"cross is biased; one much wider than the ellipse has more than chance in it.{_rest(shapes)}",
            )
        )
    return panels


def _errors(rows: Rows) -> Made:
    title = "Errors over the number of lines"
    shapes = [name for name in rows.shapes if _has(rows.of_shape(name), "area_error_rel", "lines")]
    if not shapes:
        return [LeftOut(title, "the table knows no relative errors with their numbers of lines.")]
    panels: list[Panel] = []
    for names, suffix, part in _pages(shapes):
        made = [_shape_errors(rows, name) for name in names]
        spans = numbers(rows.measured[rows.measured["shape"].isin(names)], "lines")
        panels.append(
            Panel(
                f"errors{suffix}",
                f"{title}{part}",
                errors_figure(made),
                f"Relative errors of A and of P in per cent against {np.nanmin(spans):.0f} to {np.nanmax(spans):.0f} "
                f"crossing lines, for {listed(names, _A_PAGE)}, with bands that narrow as 1/√N.",
                "The bands are one and two predicted σ, ∝ 1/√N: two thirds of the sessions belong in the inner one, 19 "
                "of 20 in both. Errors that do not shrink with N are systematic, and more lines will not mend them."
                f"{_rest(shapes)}",
            )
        )
    return panels


def _shape_errors(rows: Rows, name: str) -> Errors:
    own = rows.of_shape(name)
    return Errors(
        name,
        numbers(own, "lines"),
        numbers(own, "area_error_rel"),
        numbers(own, "perimeter_error_rel"),
        _sigma_per_line(rows, own, "area", "cm2") / _middle(numbers(own, "truth_area_cm2")),
        _sigma_per_line(rows, own, "perimeter", "cm") / _middle(numbers(own, "truth_perimeter_cm")),
    )


def _has(table: pd.DataFrame, *columns: str) -> bool:
    return bool(len(table)) and all(bool(table[column].notna().any()) for column in columns)


def _pulls(rows: Rows) -> Made:
    title = "Deviations in units of their error"
    area, perimeter = (rows.z(rows.measured, quantity) for quantity in ("area", "perimeter"))
    if not (np.isfinite(area).any() or np.isfinite(perimeter).any()):
        return [LeftOut(title, "the table knows no deviation in units of its error.")]
    unit = "predicted from the shape's exact moments" if rows.exact else "the robot's own"
    pulls = [Pull.of(rows.z(rows.steady, quantity)) for quantity in ("area", "perimeter")]
    left_out = " The sessions named as beyond all chance are in the bars, not in mean and spread."
    told = " and ".join(
        f"{symbol} has mean {signed_with(pull.mean, pull.sigma)} and spread {number(pull.spread, 2)}"
        for symbol, pull in zip("AP", pulls, strict=True)
        if pull.count
    )
    return [
        Panel(
            "pulls",
            title,
            pulls_figure(area, perimeter, area=pulls[0], perimeter=pulls[1]),
            f"Two histograms of z with the standard normal curve: {told}.",
            f"z is robot less truth, in units of the σ {unit}, over all shapes. The bars should follow the curve: "
            "shifted, A or P is biased; wider, the sessions differ by more than chance; a bar far out is a session to "
            f"look at. What lies beyond ±5 is counted in the outermost bars.{left_out if rows.stray.any() else ''}",
        )
    ]


def _recognition(rows: Rows) -> Made:
    title = "Recognition"
    figures = [one for one in shape_figures(rows) if one.right.of]
    if not figures:
        return [LeftOut(title, "the table does not say what was recognised.")]
    shown = figures[:_MOST_ROWS]
    shares: dict[str, Share] = {one.name: one.right for one in shown}
    named = {name: _answers(rows.whole[rows.whole["shape"] == name]) for name in shares}
    total: dict[str, int] = {}
    for own in named.values():
        for name, times in own.items():
            total[name] = total.get(name, 0) + times
    kept = set(sorted(total, key=lambda name: (-total[name], name))[:_MOST_ANSWERS])
    gathered = {shape: _gathered(own, kept) for shape, own in named.items()}
    left = len(figures) - len(shown)
    rest = f" Shown are the {_MOST_ROWS} shapes with most sessions; {left} more are not." if left > 0 else ""
    rest += f" Answers beyond the {_MOST_ANSWERS} most frequent are “{_OTHERS}”." if len(total) > len(kept) else ""
    confusion = (
        " Beside it, how often each projected shape (row) was given each name (column): blue is right, orange is wrong."
        if len(shares) > 1 or len(total) > 1
        else ""
    )
    each = ", ".join(f"{one.name} {percent(one.right.value, 0)}" for one in shown[:8])
    return [
        Panel(
            "recognition",
            title,
            recognition_figure(shares, gathered),
            f"Share of sessions rightly named with its interval: {each}; and a table of the names given.",
            "The dot is the share of sessions whose most probable name was right (a twin that no lines tell apart "
            f"counts as right), the bar Wilson's 95 % interval: few sessions leave it wide.{confusion} A wrong name "
            f"that comes again and again is a rival that more lines, or a smaller bias, must separate.{rest}",
        )
    ]


def _answers(own: pd.DataFrame) -> dict[str, int]:
    """How many sessions gave each name; a right one through a twin under the shape's own."""
    found: dict[str, int] = {}
    right, unknown = numbers(own, "recognised_right"), numbers(own, "recognised_unknown")
    pairs = zip(texts(own, "shape"), texts(own, "recognised_name"), right, unknown, strict=True)
    for shape, name, is_right, none in pairs:
        if name:
            answer = shape if is_right > 0.5 else NONE_OF_THESE if none > 0.5 else name
            found[answer] = found.get(answer, 0) + 1
    return found


def _gathered(own: dict[str, int], kept: set[str]) -> dict[str, int]:
    found = {name: times for name, times in own.items() if name in kept}
    others = sum(times for name, times in own.items() if name not in kept)
    return {**found, _OTHERS: others} if others else found


def _uniform(rows: Rows) -> Made:
    title = "p-values against uniform"
    found = {said: numbers(rows.whole, column) for column, (said, _) in P_VALUES.items()}
    known = {said: values for said, values in found.items() if np.isfinite(values).any()}
    made: list[Panel | LeftOut] = []
    if "isotropy" not in known:
        made.append(LeftOut("The test of isotropy", "no session has one: it needs a video, and enough tracked lines."))
    if not known:
        return [*made, LeftOut(title, "the table knows no p-values.")]
    told = listed(
        [f"{int((values <= 0.05).sum())} of {np.isfinite(values).sum()} of {said}" for said, values in known.items()]
    )
    panel = Panel(
        "p-values",
        title,
        uniform_figure(known),
        f"Sorted p-values over the values expected of uniform ones; {told} are 0.05 or less.",
        "Of true hypotheses the p-values follow the dashed diagonal, each within the grey with 95 %. A row of points "
        "along the bottom means that many sessions fail the test, a curve below the grey that all of them are a "
        "little off. Above it there is no harm: a test that was corrected for several looks is careful.",
    )
    return [panel, *made]


def _health(rows: Rows) -> Made:
    title = "Latency and health over time"
    found = vitals(rows)
    if not found:
        return [LeftOut(title, "of latency nothing is known, and no run, link or frame was lost.")]
    names = texts(rows.whole, "session")
    started = rows.whole["started"]
    when = started.dt.tz_localize(None).to_numpy(dtype="datetime64[ns]") if bool(started.notna().any()) else None
    strips: list[Strip] = []
    outlying = sum(int(vital.outlying.sum()) for vital in found)
    for vital in found:
        order = np.argsort(-np.abs(vital.values - np.nanmedian(vital.values)))
        odd = [int(index) for index in order if vital.outlying[index]]
        labels = {index: names[index] if rank < _NAMED_OUTLIERS else "" for rank, index in enumerate(odd)}
        unit = f" ({vital.unit})" if vital.unit else ""
        strips.append(Strip(f"{vital.title}{unit}", vital.values, labels))
    return [
        Panel(
            "health",
            title,
            health_figure(strips, when),
            f"{count(len(strips), 'strip')} over the sessions' beginning: {listed([one.title for one in found], 8)}; "
            f"{count(outlying, 'value')} marked as outlying.",
            "A dot a session, dashed the median. Diamonds lie far from the others (more than five scaled median "
            "deviations); the farthest are named. A step or a slope is something that was changed, or wears out: a "
            "battery, a lamp, a radio.",
        )
    ]
