"""The page's charts as ECharts options: pure functions of what is known. Lengths in cm."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.figures.style import colour_of
from lab.base.errors import RequestError
from lab.live.story import Rolled, Standing
from lab.live.words import percent

Floats = NDArray[np.float64]
Options = dict[str, Any]
_MOST_POINTS = 300
_MOST_RUNS = 24
_ELLIPSES_AT = (5, 10, 20, 40, 80, 160, 320, 640, 1280, 2560, 5120)
_LEAST_LINES = 5  # fewer give ellipses that fill the picture
CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Ink:
    """Colours and sizes: readable on the page's ground, and told apart by colour-blind people.

    ``text_px`` is the size of letters; ``first`` and ``second`` differ in lightness too.
    """

    text: str
    faint: str
    grid: str
    first: str
    second: str
    text_px: int = 13


LIGHT = Ink("#1d2730", "#55616d", "#d5dbe1", "#0b6aa8", "#b35c00")
DARK = Ink("#eef2f6", "#b4bfca", "#3b454f", "#5db4ea", "#ffb054")


def convergence(standings: Sequence[Standing], which: str, truth: float, unit: str, ink: Ink) -> Options:
    """``which`` (area_cm2 or perimeter_cm) against N with its 95 % band, and the projected shape's own."""
    rows = _thinned(standings)
    bands = [standing.band(which) for standing in rows]
    known = [[row.n, *band] for row, band in zip(rows, bands, strict=True) if math.isfinite(band[1])]
    n_end = rows[-1].n if rows else 1
    # The first lines' bands would squeeze all the rest: the scale is that of the estimates and of the truth.
    top = 1.6 * max([truth, *(getattr(row, which) for row in rows[len(rows) // 4 :])])
    shade = {"type": "line", "symbol": "none", "silent": True, "stack": "band", "lineStyle": {"opacity": 0}}
    return _framed(ink) | {
        "xAxis": _along(ink, "lines N", 0, max(10, n_end)),
        "yAxis": _axis(ink, unit, 0, float(f"{top:.2g}")),
        "series": [
            {**shade, "name": "from", "data": [[n, low] for n, low, _ in known]},
            {
                **shade,
                "name": "95 % band",
                "areaStyle": {"color": ink.first, "opacity": 0.28},
                "data": [[n, high - low] for n, low, high in known],
            },
            {
                "type": "line",
                "name": "estimate",
                "symbol": "none",
                "lineStyle": {"color": ink.first, "width": 2.5},
                "data": [[row.n, getattr(row, which)] for row in rows],
                "markLine": {
                    "silent": True,
                    "symbol": "none",
                    "lineStyle": {"color": ink.second, "type": "dashed", "width": 2},
                    "label": {
                        "formatter": f"true {truth:.0f}",
                        "position": "insideEndTop",
                        "color": ink.text,
                        "fontSize": ink.text_px,
                    },
                    "data": [{"yAxis": truth}],
                },
            },
        ],
    }


def plane(standings: Sequence[Standing], truth: tuple[float, float], ink: Ink) -> Options:
    """The (P, A) plane: the way of the estimates, their 95 % ellipses as they shrink, and the true shape.

    ``truth`` is (area, perimeter).
    """
    rows = [row for row in _thinned(standings) if row.n >= _LEAST_LINES] or list(standings[-1:])
    numbers = sorted({*_ELLIPSES_AT, standings[-1].n}) if standings else []
    rings = [ring for n in numbers if n <= len(standings) and len(ring := _ellipse(standings[n - 1]))]
    series: list[Options] = [
        {
            "type": "line",
            "name": f"ellipse {place}",
            "symbol": "none",
            "silent": True,
            "lineStyle": {"color": ink.first, "width": 1 + 1.5 * share, "opacity": 0.3 + 0.7 * share},
            "data": ring.round(2).tolist(),
        }
        for place, ring in enumerate(rings)
        for share in ((place + 1) / len(rings),)
    ]
    series += [{"type": "line", "name": f"ellipse {place}", "data": []} for place in range(len(rings), 12)]
    series.append(
        {
            "type": "line",
            "name": "way",
            "symbol": "none",
            "lineStyle": {"color": ink.faint, "width": 1.5},
            "data": [[round(row.perimeter_cm, 2), round(row.area_cm2, 2)] for row in rows],
        }
    )
    last = rows[-1:]
    series.append(_spot("now", [[row.perimeter_cm, row.area_cm2] for row in last], "circle", "left", ink.first, ink))
    series.append(_spot("true", [[truth[1], truth[0]]], "diamond", "right", ink.second, ink))
    points = np.array([[truth[1], truth[0]], *([row.perimeter_cm, row.area_cm2] for row in rows[len(rows) // 3 :])])
    points = np.concatenate([points, *rings[-3:]])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.08 * (high - low) + 0.02 * high
    low, high = np.maximum(0.0, low - margin), high + margin
    return _framed(ink) | {
        "xAxis": _along(ink, "P / cm", _round(low[0]), _round(high[0])),
        "yAxis": _axis(ink, "A / cm²", _round(low[1]), _round(high[1])),
        "series": series,
    }


def names(last: Standing | None, ink: Ink) -> Options:
    """The likeliest entries' probabilities as bars, "none of these" among them; the likeliest on top."""
    shares = list(last.names) if last is not None else []
    if last is not None and math.isfinite(last.unknown):
        shares = [(name, share * (1 - last.unknown)) for name, share in shares]
        shares = sorted([*shares, ("none of these", last.unknown)], key=lambda each: -each[1])
    shares = shares[:6]
    colours = [ink.faint if name == "none of these" else colour_of(name) for name, _ in shares]
    label = {"show": True, "position": "right", "color": ink.text, "fontSize": ink.text_px}
    bars = [
        {
            "value": round(share, 4),
            "itemStyle": {"color": colour},
            "label": {**label, "formatter": percent(share)},
        }
        for (_, share), colour in zip(shares, colours, strict=True)
    ]
    return {
        "animation": False,
        "grid": {"left": 8, "right": 56, "top": 8, "bottom": 8, "containLabel": True},
        "xAxis": {"type": "value", "min": 0, "max": 1, "show": False},
        "yAxis": {
            "type": "category",
            "inverse": True,
            "data": [name for name, _ in shares],
            "axisLine": {"lineStyle": {"color": ink.grid}},
            "axisTick": {"show": False},
            "axisLabel": {"color": ink.text, "fontSize": ink.text_px, "width": 130, "overflow": "truncate"},
        },
        "series": [{"type": "bar", "name": "probability", "barMaxWidth": 26, "data": bars}],
    }


def runs(rolled: Sequence[Rolled], ink: Ink) -> Options:
    """The last runs as bars along their way: thin in the dark, thick where the light was on."""
    shown = list(rolled)[-_MOST_RUNS:]
    way: list[list[float] | None] = []
    lit: list[list[float] | None] = []
    for run in shown:
        way += [[0.0, run.line], [round(run.end_cm, 1), run.line], None]
        for begin, end in run.lit_cm:
            lit += [[round(begin, 1), run.line], [round(end, 1), run.line], None]
    line = {"type": "line", "symbol": "none", "silent": True, "connectNulls": False}
    first = shown[0].line if shown else 0
    last = max(first + _MOST_RUNS, shown[-1].line + 1 if shown else 0)
    return _framed(ink) | {
        "xAxis": _along(ink, "way / cm", 0),
        "yAxis": _axis(ink, "run", first - 1, last) | {"inverse": True, "minInterval": 1, "nameLocation": "start"},
        "series": [
            {**line, "name": "dark", "lineStyle": {"color": ink.faint, "width": 1, "opacity": 0.7}, "data": _gaps(way)},
            {**line, "name": "lit", "lineStyle": {"color": ink.second, "width": 5, "cap": "butt"}, "data": _gaps(lit)},
        ],
    }


def light_strip(light: Mapping[str, Sequence[tuple[float, float]]], ink: Ink) -> Options:
    """Each robot's newest light samples, (t_s, lux); several are told apart by colour and by their strokes."""
    end_s = max((samples[-1][0] for samples in light.values() if samples), default=0.0)
    looks = itertools.cycle(itertools.product(("solid", "dashed", "dotted"), (ink.second, ink.first)))
    several = len(light) > 1
    lines: list[Options] = [
        {
            "type": "line",
            "name": robot,
            "symbol": "none",
            "lineStyle": {"color": colour, "width": 2, "type": stroke},
            "itemStyle": {"color": colour},
            "data": [[round(t_s - end_s, 2), lux] for t_s, lux in samples if t_s > end_s - 20],
        }
        for (robot, samples), (stroke, colour) in zip(light.items(), looks, strict=False)
    ]
    legend = {"show": several, "right": 8, "top": 0, "textStyle": {"color": ink.text, "fontSize": ink.text_px}}
    return _framed(ink) | {
        "legend": legend,
        "xAxis": _along(ink, "s before now", -20, 0),
        "yAxis": _axis(ink, "lux", 0),
        "series": lines,
    }


def _thinned(standings: Sequence[Standing]) -> list[Standing]:
    """At most some hundreds, the first lines all, the last always."""
    step = max(1, math.ceil(len(standings) / _MOST_POINTS))
    kept = list(standings[::step])
    if standings and kept[-1] is not standings[-1]:
        kept.append(standings[-1])
    return kept


def _ellipse(standing: Standing) -> Floats:
    """The 95 % region as (n, 2) points (P, A); empty where it is not known yet."""
    if standing.n < _LEAST_LINES or not math.isfinite(standing.correlation):
        return np.empty((0, 2))
    try:
        area, perimeter = standing.estimate().region(CONFIDENCE, points=61)
    except (RequestError, np.linalg.LinAlgError):
        return np.empty((0, 2))
    ring = np.column_stack([perimeter, area])
    return ring if np.isfinite(ring).all() else np.empty((0, 2))


def _spot(name: str, points: list[list[float]], symbol: str, side: str, colour: str, ink: Ink) -> Options:
    return {
        "type": "scatter",
        "name": name,
        "symbol": symbol,
        "symbolSize": ink.text_px + 1,
        "itemStyle": {"color": colour, "borderColor": ink.text, "borderWidth": 1},
        "label": {"show": True, "formatter": name, "position": side, "color": ink.text, "fontSize": ink.text_px},
        "data": points,
    }


def _framed(ink: Ink) -> Options:
    return {
        "animation": False,
        "textStyle": {"color": ink.text, "fontSize": ink.text_px},
        "grid": {"left": 10, "right": 26, "top": 2.6 * ink.text_px, "bottom": 2.4 * ink.text_px, "containLabel": True},
    }


def _along(ink: Ink, name: str, minimum: float | None = None, maximum: float | None = None) -> Options:
    """An x axis: its name stands under its middle."""
    return _axis(ink, name, minimum, maximum) | {"nameLocation": "middle", "nameGap": 2 * ink.text_px}


def _axis(ink: Ink, name: str, minimum: float | None = None, maximum: float | None = None) -> Options:
    """A value axis, its name over its end."""
    return {
        "type": "value",
        "name": name,
        "min": minimum,
        "max": maximum,
        "nameLocation": "end",
        "nameTextStyle": {"color": ink.text, "fontSize": ink.text_px},
        "axisLabel": {
            "color": ink.faint,
            "fontSize": ink.text_px - 1,
            "hideOverlap": True,
            # the ends are where the picture ends, no round numbers
            "showMinLabel": not minimum,
            "showMaxLabel": maximum is None,
        },
        "axisLine": {"onZero": False, "lineStyle": {"color": ink.grid}},
        "splitLine": {"lineStyle": {"color": ink.grid, "opacity": 0.6}},
    }


def _gaps(points: list[list[float] | None]) -> list[list[float | str]]:
    """Points with ECharts' own mark between the pieces of a broken line."""
    return [["-", "-"] if point is None else [point[0], point[1]] for point in points]


def _round(value: float) -> float:
    return float(f"{value:.3g}")
