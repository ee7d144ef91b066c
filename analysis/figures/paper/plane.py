# pyright: reportUnknownMemberType=false
# (matplotlib's stubs leave the **kwargs of set_xscale untyped)
"""Figs. 2G, 2I, 3A, 3C: where in the plane of P and A an entry is named with 95 %."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.path import Path as MplPath
from numpy.typing import NDArray

from analysis.estimate import ellipse
from analysis.figures import fields, pen
from analysis.figures.paper.known import Known
from analysis.figures.paper.panel import PaperPanel
from analysis.figures.style import colour_of
from analysis.landscape import Domains, domains

Floats = NDArray[np.float64]

LEVEL = 0.95
_RADIUS2 = -2 * np.log1p(-LEVEL)
GRID = 600, 420  # points across and up
EVERY = 4  # grid point that goes into a table


@dataclass(frozen=True, slots=True)
class Window:
    """A part of the plane with a grid over it, on linear or logarithmic axes."""

    perimeter_cm: tuple[float, float]
    area_cm2: tuple[float, float]
    points: tuple[int, int] = GRID
    log: bool = False

    def grid(self) -> tuple[Floats, Floats]:
        """Perimeters (columns,) and areas (rows,)."""
        space = np.geomspace if self.log else np.linspace
        return space(*self.perimeter_cm, self.points[0]), space(*self.area_cm2, self.points[1])

    def fit(self, axes: Axes) -> None:
        """Give axes this part of the plane."""
        if self.log:
            axes.set_xscale("log")
            axes.set_yscale("log")
            fields.plain_log_ticks(axes.xaxis, *self.perimeter_cm)
            fields.plain_log_ticks(axes.yaxis, *self.area_cm2)
        axes.set_xlim(*self.perimeter_cm)
        axes.set_ylim(*self.area_cm2)


def window_of(
    known: Known,
    n: float,
    *,
    names: Sequence[str] = (),
    log: bool = False,
    room: float = 0.12,
    points: tuple[int, int] = GRID,
) -> Window:
    """The window that shows the 95 % ellipses of some entries after ``n`` lines, or of all, with some room."""
    corners = np.concatenate([contour(known, name, n) for name in names or known.names])
    corners = corners[(corners > 0).all(axis=1)]
    low, high = corners.min(axis=0), corners.max(axis=0)
    if log:
        free = np.maximum((high / low) ** (room / 2), 1.02)
        low, high = low / free, high * free
    else:
        free = room * (high - low)
        low, high = np.maximum(low - free, 0.02 * high), high + free
    return Window((float(low[0]), float(high[0])), (float(low[1]), float(high[1])), points, log)


def domains_panel(
    name: str,
    known: Known,
    window: Window,
    *,
    n: int,
    size_in: tuple[float, float] = (7.2, 4.8),
    kind: str = "shapes",
    grid_table: bool = True,
) -> PaperPanel:
    """Draw where estimates from ``n`` lines name an entry with more than 95 % (2G, 2I, 3A, 3C)."""
    figure = pen.new_figure(*size_in)
    axes = figure.add_subplot(1, 1, 1)
    found = draw_domains(axes, known, window, n=n)
    pen.line(axes, [], [], pen.INK, width=1.2, label=f"95 % of estimates after {n} lines")
    pen.line(axes, [], [], pen.MUTED, width=7, alpha=0.35, label="one entry has more than 95 %")
    pen.legend_below(figure, axes, columns=2)
    written = label_entries(axes, known, n)
    table = known.table(n)
    right = np.asarray(table["right"], dtype=float)
    sure = int(np.count_nonzero(right >= LEVEL))
    unnamed = len(known.names) - len(written)
    never = list(known.twins)
    words = [
        f"Pale: where an estimate from N = {n} lines gives one of the {len(known.names)} {kind} a posterior above 95 "
        f"%, in "
        "its colour; strong: the part of it where 95 % of its own estimates fall (ellipse). White: undecided. "
        f"{sure} of {len(right)} are named rightly in at least 95 % of runs after N = {n} lines"
    ]
    if sure < len(right):
        weakest = table.sort_values("right").head(4)
        told = ", ".join(
            f"{known.titles[str(row['entry'])]} {100 * float(row['right']):.0f} %" for _, row in weakest.iterrows()
        )
        words.append(f"; least: {told}")
    words.append(".")
    if unnamed:
        words.append(f" {unnamed} names found no room.")
    if never:
        words.append(
            f" Twins, one class each: {'; '.join('/'.join(known.titles[m] for m in twins) for twins in never)}."
        )
    tables = {"": table}
    if grid_table:
        tables = {"": _grid_table(found, known), "entries": table}
    return PaperPanel(name, figure, "".join(words), tables, {"n": n, "sure": sure, "entries": len(right)})


def draw_domains(axes: Axes, known: Known, window: Window, *, n: int, ellipses: Sequence[str] | None = None) -> Domains:
    """Paint the domains, and the 95 % ellipses of ``ellipses`` (all without it)."""
    pen.dress(axes, x="perimeter P (cm)", y="area A (cm²)", grid=False)
    window.fit(axes)
    perimeter, area = window.grid()
    found = domains(known.recogniser, perimeter, area, n)
    colours = [colour_of(name) for name in known.names]
    p, a = np.meshgrid(perimeter, area)
    size = np.array([[m.area_cm2, m.perimeter_cm] for m in known.moments.values()])[found.leader]
    inverse = np.linalg.inv(np.array([m.covariance_at(n) for m in known.moments.values()]))[found.leader]
    off = np.stack([a, p], axis=-1) - size
    own = np.einsum("rci,rcij,rcj->rc", off, inverse, off) <= _RADIUS2
    sure = (found.posterior > LEVEL) & ~_seams(found.leader)
    fields.paint(axes, perimeter, area, found.leader, np.where(sure, np.where(own, 0.62, 0.17), 0.0), colours)
    for name in known.names if ellipses is None else ellipses:
        path = MplPath(contour(known, name, n), closed=True)
        pen.outline(axes, path, pen.INK, width=0.6, alpha=0.8, above=2.0, gid=f"{name} ellipse")
    return found


def _seams(leader: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Grid points next to another leader's, so that a seam finer than the grid is drawn whole and not as dots."""
    seams = np.zeros(leader.shape, dtype=bool)
    seams[:, 1:] |= leader[:, 1:] != leader[:, :-1]
    seams[1:] |= leader[1:] != leader[:-1]
    return seams


def label_entries(axes: Axes, known: Known, n: float, names: Sequence[str] | None = None) -> list[str]:
    """Name the entries beside their ellipses as far as there is room; gives the names written."""
    chosen = list(known.names if names is None else names)
    contours = [np.maximum(contour(known, name, n), 1e-3) for name in chosen]
    return pen.spread_labels(axes, contours, [known.titles[name] for name in chosen], [pen.INK] * len(chosen))


def _grid_table(found: Domains, known: Known) -> pd.DataFrame:
    p, a = np.meshgrid(found.perimeter_cm[::EVERY], found.area_cm2[::EVERY])
    leader = found.leader[::EVERY, ::EVERY].ravel()
    return pd.DataFrame(
        {
            "perimeter_cm": p.ravel(),
            "area_cm2": a.ravel(),
            "leading": np.array(known.names)[leader],
            "posterior": found.posterior[::EVERY, ::EVERY].ravel(),
        }
    )


def contour(known: Known, name: str, n: float) -> Floats:
    """The ellipse (points, 2), in (P, A), that holds 95 % of the estimates of an entry after ``n`` lines."""
    area, perimeter = ellipse(centre(known, name), known.moments[name].covariance_at(n), LEVEL)
    return np.column_stack([perimeter, area])


def centre(known: Known, name: str) -> tuple[float, float]:
    """(A, P) of an entry."""
    return known.moments[name].area_cm2, known.moments[name].perimeter_cm
