"""Figs. 1B–G and 2A–C: what a robot finds of each shape."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from analysis.compare import deviation
from analysis.estimate import Estimate, ellipse
from analysis.figures import pen
from analysis.figures.blinks import blinks_figure, lit_positions, panels_at
from analysis.figures.chords import Chords, chords_figure
from analysis.figures.paper.panel import PaperPanel
from analysis.figures.plane import LEVELS, plane_figure
from analysis.figures.style import colour_of
from analysis.figures.values import Entry
from analysis.montecarlo import Bands
from analysis.quadrature import Moments

Floats = NDArray[np.float64]

_THIN_RUNS = 3  # single simulated runs drawn for each shape
_SHOWN_FROM = 10  # lines: earlier estimates would set the scale
_CALM = 0.10  # relative error that the paper says is soon reached


@dataclass(frozen=True, slots=True, eq=False)
class Explored:
    """One robot's exploration of one shape.

    Attributes:
        name: the dictionary's name.
        title: how it is written.
        geometry: the silhouette, cm.
        arena: the arena, cm.
        source: "a simulated robot", or the session's name.
        estimates: rows n, line, area_cm2, perimeter_cm.
        chords_cm: lengths of all chords.
        runs: runs from edge to edge, those that missed the shape included.
        track: rows line, x_cm, y_cm, led_on; None where nobody saw the robot.
        random: says in a sentence whether the runs were isotropic and homogeneous; "" where nobody can.
    """

    name: str
    title: str
    geometry: BaseGeometry
    arena: BaseGeometry
    source: str
    estimates: pd.DataFrame
    chords_cm: Floats
    runs: int
    track: pd.DataFrame | None = None
    random: Callable[[], str] = str

    @property
    def lines(self) -> int:
        """Crossing lines."""
        return int(self.estimates["n"].max())

    @property
    def last(self) -> tuple[float, float]:
        """The last estimate, (A cm², P cm)."""
        row = int(np.argmax(self.estimates["n"]))
        return float(np.asarray(self.estimates["area_cm2"])[row]), float(
            np.asarray(self.estimates["perimeter_cm"])[row]
        )


def blinks_panel(name: str, seen: Explored, track: pd.DataFrame, counts: Sequence[int | None]) -> PaperPanel:
    """Draw where the LED was lit, one map for each N in ``counts`` (None: all lines). ``track``: what was seen."""
    figure = blinks_figure(track, seen.geometry, seen.arena, name=seen.name, estimates=seen.estimates, counts=counts)
    drawn = panels_at(track, seen.estimates, counts)
    lit = track["led_on"].to_numpy(dtype=bool, na_value=False)
    line = np.asarray(track["line"], dtype=float)[lit]
    places = np.asarray(track[["x_cm", "y_cm"]], dtype=float)[lit].round(3)
    crossing = seen.estimates.sort_values("line")
    # the map in which a blink first appears
    reached = np.searchsorted(np.asarray(crossing["line"], dtype=float), line)
    n = np.asarray(crossing["n"], dtype=int)[np.minimum(reached, len(crossing) - 1)]
    table = pd.DataFrame({"n": n, "line": line.astype(int), "x_cm": places[:, 0], "y_cm": places[:, 1]})
    shown = ", ".join(str(count) for count, _ in drawn)
    return PaperPanel(
        name,
        figure,
        f"{seen.title}: places where the LED of {seen.source} was lit, after N = {shown} lines that cross the shape "
        f"({seen.runs} runs through the arena in all). The blinks should fill the silhouette evenly and end at its "
        f"contour. {seen.random()}".strip(),
        {"": table.dropna()},
        {
            "source": seen.source,
            "lines": seen.lines,
            "arena_runs": seen.runs,
            "blinks": len(lit_positions(track)),
            "lines_shown": [count for count, _ in drawn],
        },
    )


def chords_panel(name: str, robots: Sequence[Explored], exact: Mapping[str, Moments]) -> PaperPanel:
    """Draw the histogram of chord lengths for one shape (1F), or for several (2A)."""
    shapes = [
        Chords(
            robot.name,
            robot.title,
            robot.chords_cm,
            robot.last[0],
            exact[robot.name].area_cm2,
            exact[robot.name].perimeter_cm,
        )
        for robot in robots
    ]
    table = pd.concat(
        [
            pd.DataFrame(
                {
                    "shape": chords.name,
                    "length_cm": chords.lengths_cm,
                    "length_over_longest": chords.lengths_cm / chords.longest_cm,
                }
            )
            for chords in shapes
        ],
        ignore_index=True,
    )
    found = {
        chords.name: {
            "source": robot.source,
            "chords": chords.lengths_cm.size,
            "longest_cm": chords.longest_cm,
            "mean_cm": chords.mean_cm,
            "root_area_cm": float(np.sqrt(chords.area_cm2)),
            "mean_exact_cm": float(np.pi * exact[chords.name].area_cm2 / exact[chords.name].perimeter_cm),
            "root_area_exact_cm": float(np.sqrt(exact[chords.name].area_cm2)),
        }
        for robot, chords in zip(robots, shapes, strict=True)
    }
    told = "; ".join(
        f"{chords.title}: ⟨ℓ⟩ = {chords.mean_cm:.1f} cm ({found[chords.name]['mean_exact_cm']:.1f}), "
        f"√A = {found[chords.name]['root_area_cm']:.1f} cm ({found[chords.name]['root_area_exact_cm']:.1f})"
        for chords in shapes
    )
    return PaperPanel(
        name,
        chords_figure(shapes),
        f"Chord lengths over the longest chord, from {_sources(robots)}. {told}; in brackets the exact values, πA/P "
        f"and "
        "√A, dotted. √A is from Eq. 1 with the prefactor π/3: the paper prints 3/π, which would put it 4.5 % lower.",
        {"": table},
        found,
    )


def way_panel(
    name: str, robots: Sequence[Explored], simulated: Mapping[str, Bands], exact: Mapping[str, Moments], *, n: int
) -> PaperPanel:
    """Draw the robots' ways through the plane and the ellipses of simulated runs at ``n`` lines (1G).

    Raises KeyError where ``n`` is none of the simulation's checkpoints.
    """
    entries: dict[str, Entry] = {}
    rows: list[pd.DataFrame] = []
    found: dict[str, object] = {}
    ratios: list[float] = []
    held: list[float] = []
    for robot in robots:
        bands, moments = simulated[robot.name], exact[robot.name]
        area, perimeter = runs_at(bands, n)
        scatter = np.cov(area, perimeter)
        entries[robot.name] = Entry(robot.title, float(area.mean()), float(perimeter.mean()), scatter * n)
        known = moments.covariance_at(n)
        inside = {
            f"inside_{100 * level:g}_percent": float(
                np.count_nonzero(_squared(area, perimeter, moments, n) <= -2 * np.log1p(-level)) / area.size
            )
            for level in LEVELS
        }
        over = np.sqrt(np.diag(scatter) / np.diag(known))
        ratios += over.tolist()
        held.append(inside["inside_95_percent"])
        found[robot.name] = {
            "source": robot.source,
            "sigma_area_over_exact": float(over[0]),
            "sigma_perimeter_over_exact": float(over[1]),
            "correlation": float(scatter[0, 1] / np.sqrt(scatter[0, 0] * scatter[1, 1])),
            "correlation_exact": moments.correlation,
            **inside,
        }
        way = robot.estimates[["n", "perimeter_cm", "area_cm2"]].assign(shape=robot.name, what="robot", level=np.nan)
        rows.append(way)
        for what, centre, covariance in (
            ("ellipse, simulated", (area.mean(), perimeter.mean()), scatter),
            ("ellipse, exact", (moments.area_cm2, moments.perimeter_cm), known),
        ):
            for level in LEVELS:
                a, p = ellipse(centre, covariance, level, points=61)
                rows.append(
                    pd.DataFrame(
                        {"n": n, "perimeter_cm": p, "area_cm2": a, "shape": robot.name, "what": what, "level": level}
                    )
                )
    table = pd.concat(rows, ignore_index=True)[["shape", "what", "level", "n", "perimeter_cm", "area_cm2"]]
    runs = len(next(iter(simulated.values())).area_runs_cm2)
    apart = _inside_one(robots, exact)
    return PaperPanel(
        name,
        plane_figure(entries, {robot.name: robot.estimates for robot in robots}, n=n),
        f"(P, A) as lines accumulate, the contrast growing with N, from {_sources(robots)}; ellipses hold 75, 95 and "
        f"99 % "
        f"of {runs} simulated runs of N = {n} lines. Their half-axes are {min(ratios):.2f} to {max(ratios):.2f} of "
        f"those of "
        f"the exact covariance, whose 95 % ellipses hold {100 * min(held):.1f} to {100 * max(held):.1f} % of the runs. "
        f"{apart} of {len(robots)} robots end inside the 99 % ellipse of their own shape and of no other. Triangle and "
        "pyramid have the same area.",
        {"": table},
        found,
    )


def runs_at(bands: Bands, n: int) -> tuple[Floats, Floats]:
    """(A cm², P cm) of every simulated run after ``n`` lines. Raises KeyError where that is no checkpoint."""
    places = np.flatnonzero(bands.n == n)
    if not places.size:
        raise KeyError(n)
    return bands.area_runs_cm2[:, places[0]], bands.perimeter_runs_cm[:, places[0]]


def evolution_panel(
    name: str,
    robots: Sequence[Explored],
    simulated: Mapping[str, Bands],
    exact: Mapping[str, Moments],
    *,
    column: str,
) -> PaperPanel:
    """Draw A(N) or P(N), thick for the robots and thin for simulated runs (2B, C).

    ``column`` is "area_cm2" or "perimeter_cm".
    """
    of_area = column == "area_cm2"
    figure = pen.new_figure(7.2, 4.4)
    axes = figure.add_subplot(1, 1, 1)
    pen.dress(axes, x="crossing lines N", y="area A (cm²)" if of_area else "perimeter P (cm)")
    last = max(robot.lines for robot in robots)
    pen.count_axis(axes, last)
    axes.set_xlim(_SHOWN_FROM, last)
    rows: list[pd.DataFrame] = []
    calm: dict[str, int] = {}
    for robot in robots:
        colour, bands = colour_of(robot.name), simulated[robot.name]
        truth = exact[robot.name].area_cm2 if of_area else exact[robot.name].perimeter_cm
        runs = bands.area_runs_cm2 if of_area else bands.perimeter_runs_cm
        shown = bands.n <= last
        for number, run in enumerate(runs[:_THIN_RUNS]):
            pen.line(axes, bands.n[shown], run[shown], colour, width=0.6, alpha=0.75, gid=f"{robot.name} simulated")
            rows.append(_rows(robot.name, f"simulated {number + 1}", bands.n[shown], run[shown], column))
        ordered = robot.estimates.sort_values("n")
        pen.line(axes, ordered["n"], ordered[column], colour, width=2.2, above=3, label=robot.title, gid=robot.name)
        rows.append(_rows(robot.name, "robot", ordered["n"], ordered[column], column))
        pen.level(axes, truth, colour, width=0.9, gid=f"{robot.name} exact")
        rows.append(_rows(robot.name, "exact", [0], [truth], column))
        calm[robot.name] = lines_until_calm(ordered["n"], ordered[column], truth)
    late = pd.concat(rows)
    late = late[(late["n"] >= _SHOWN_FROM) & np.isfinite(late[column])]
    low, high = np.percentile(late[column], [0.5, 99.5])
    free = 0.08 * (high - low)
    axes.set_ylim(max(0.0, float(low - free)), float(high + free))
    pen.line(axes, [], [], pen.MUTED, width=2.2, label="robot")
    pen.line(axes, [], [], pen.MUTED, width=0.6, label="simulated runs")
    pen.line(axes, [], [], pen.MUTED, width=0.9, style="--", label="exact")
    pen.legend_below(figure, axes, columns=5)
    scale = {robot.name: _expected(exact[robot.name], of_area) for robot in robots}
    quantity = "Area" if of_area else "Perimeter"
    told = ", ".join(f"{robot.title} {calm[robot.name]} ({scale[robot.name]})" for robot in robots)
    return PaperPanel(
        name,
        figure,
        f"{quantity} against the number of lines: thick {_sources(robots)}, thin {_THIN_RUNS} runs of independent "
        f"lines "
        f"each. Lines from which on the robot's error stays below 10 %: {told}; in brackets the lines after which 95 "
        f"% of "
        "all runs have less, (1.96 σ₀/0.1)² by the exact moments.",
        {"": pd.concat(rows, ignore_index=True)},
        {"lines_until_10_percent": calm, "lines_until_10_percent_expected": scale},
    )


def lines_until_calm(n: object, values: object, truth: float) -> int:
    """The number of lines from which on the relative error stays within 10 %; one more than all, where never."""
    counts, found = np.asarray(n, dtype=int), np.asarray(values, dtype=float)
    wrong = np.flatnonzero(~(np.abs(found / truth - 1) < _CALM))
    if not wrong.size:
        return int(counts[0])
    return int(counts[wrong[-1]]) + 1


def _expected(moments: Moments, of_area: bool) -> int:
    sigma = moments.sigma_area_rel if of_area else moments.sigma_perimeter_rel
    return int(np.ceil((1.96 * sigma / _CALM) ** 2))


def _rows(shape: str, what: str, n: object, values: object, column: str) -> pd.DataFrame:
    return pd.DataFrame({"shape": shape, "what": what, "n": np.asarray(n), column: np.asarray(values, dtype=float)})


def _squared(area: Floats, perimeter: Floats, moments: Moments, n: float) -> Floats:
    off = np.stack([area - moments.area_cm2, perimeter - moments.perimeter_cm])
    return np.einsum("ir,ij,jr->r", off, np.linalg.inv(moments.covariance_at(n)), off)


def _inside_one(robots: Sequence[Explored], exact: Mapping[str, Moments]) -> int:
    """How many end inside the 99 % ellipse of their own shape and of no other, each after its own lines."""
    count = 0
    for robot in robots:
        ended = Estimate(robot.lines, *robot.last, np.full((2, 2), np.nan))
        near = [name for name, moments in exact.items() if deviation(ended, moments).distance2 <= -2 * np.log(0.01)]
        count += near == [robot.name]
    return count


def _sources(robots: Sequence[Explored]) -> str:
    """Who explored, in words."""
    by_source: dict[str, list[str]] = {}
    for robot in robots:
        by_source.setdefault(robot.source, []).append(robot.title)
    if len(by_source) == 1:
        return next(iter(by_source))
    return " and ".join(f"{source} ({', '.join(titles)})" for source, titles in by_source.items())
