# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# (matplotlib's stubs leave every **kwargs untyped)
"""Many sessions in one picture: small multiples of A and P, pulls, recognition, p-values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.path import Path as MplPath
from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullLocator
from numpy.typing import NDArray
from scipy.stats import norm

from analysis.estimate import ellipse
from analysis.figures import pen
from analysis.figures.fields import paint
from analysis.figures.style import AREA, MANY_DOTS, PERIMETER, colour_of, fitting
from analysis.pulls import Pull, Share, uniform_band

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LEVEL = 0.95
_WIDTH_IN = 7.2
_WIDTHS_IN = {1: 4.2, 2: 6.2, 3: _WIDTH_IN}  # by columns of small multiples
_TICKS = ((1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0))  # in each decade; the finer where the coarse are too few
_WIDEST_Z = 5.0
_FARTHEST = 6.0  # σ of the session with the fewest lines, beyond which an error is drawn at the rim


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """The sessions of one shape.

    Attributes:
        name: The shape.
        truth: (A cm², P cm).
        area_cm2: (n,) measured; ``perimeter_cm`` likewise.
        lines: (n,) crossing lines of each session.
        covariance_per_line: (2, 2) of (A cm², P cm) from one line; NaN where no prediction is known.
    """

    name: str
    truth: tuple[float, float]
    area_cm2: Floats
    perimeter_cm: Floats
    lines: Floats
    covariance_per_line: Floats

    @property
    def predicted(self) -> bool:
        """Whether an ellipse can be drawn."""
        return bool(np.isfinite(self.covariance_per_line).all() and np.isfinite(self.truth).all())

    def inside(self) -> Bools:
        """Which sessions (n,) lie inside the 95 % ellipse of their own number of lines."""
        if not self.predicted:
            return np.ones(self.area_cm2.size, dtype=np.bool_)
        off = np.column_stack([self.area_cm2 - self.truth[0], self.perimeter_cm - self.truth[1]])
        squared = self.lines * np.einsum("ij,ij->i", off @ np.linalg.pinv(self.covariance_per_line), off)
        return squared <= -2 * np.log1p(-LEVEL)


def clouds_figure(clouds: Sequence[Cloud]) -> Figure:
    """Draw each shape's sessions in the plane of P and A, with the truth and the ellipses that hold 95 %."""
    columns = _columns(len(clouds))
    rows = -(-len(clouds) // columns)
    figure = pen.new_figure(_WIDTHS_IN[columns], 0.7 + 2.35 * rows)
    for index, cloud in enumerate(clouds):
        axes = figure.add_subplot(rows, columns, index + 1)
        first = index % columns == 0
        pen.dress(axes, x="P (cm)", y="A (cm²)" if first else "", title=fitting(cloud.name, 26))
        _cloud(axes, cloud)
    last = figure.axes[-1]
    pen.dots(last, [], [], pen.MUTED, size=16, label="session")
    pen.dots(last, [], [], pen.PAPER, edge=pen.INK, size=22, marker="D", label="outside its own ellipse")
    pen.dots(last, [], [], pen.INK, marker="+", size=60, label="truth")
    pen.line(last, [], [], pen.MUTED, label="95 % at the median N")
    pen.line(last, [], [], pen.MUTED, width=0.9, style=":", label="fewest and most lines")
    pen.legend_below(figure, last, columns=max(2, columns))
    return figure


def _columns(panels: int) -> int:
    """Columns of small multiples that leave no row with a single panel beside emptiness, where that can be."""
    return {1: 1, 2: 2, 4: 2}.get(panels, 3)


def _cloud(axes: Axes, cloud: Cloud) -> None:
    colour = colour_of(cloud.name)
    corners = [np.column_stack([cloud.perimeter_cm, cloud.area_cm2])]
    if np.isfinite(cloud.truth).all():
        corners.append(np.array([[cloud.truth[1], cloud.truth[0]]]))
    if cloud.predicted:
        few, middle, many = np.quantile(cloud.lines, [0.0, 0.5, 1.0]).tolist()
        wanted = [(middle, True), *((n, False) for n in dict.fromkeys((few, many)) if abs(n / middle - 1) > 0.1)]
        for n, main in wanted:
            area, perimeter = ellipse(cloud.truth, cloud.covariance_per_line / n, LEVEL)
            points = np.column_stack([perimeter, area])
            corners.append(points)
            if main:
                path = MplPath(points, closed=True)
                pen.outline(axes, path, colour, fill=0.12, width=1.2, gid=f"ellipse {cloud.name}")
            else:
                pen.line(axes, perimeter, area, colour, width=0.9, style=":", alpha=0.9)
    inside = cloud.inside()
    size = float(np.clip(900 / max(inside.size, 1), 4.0, 16.0))
    p, a = cloud.perimeter_cm, cloud.area_cm2
    pixels = inside.size > MANY_DOTS
    pen.dots(axes, p[inside], a[inside], colour, size=size, alpha=0.75, pixels=pixels, gid=f"inside {cloud.name}")
    pen.dots(
        axes,
        p[~inside],
        a[~inside],
        pen.PAPER,
        size=max(size, 12.0),
        marker="D",
        edge=colour,
        above=3,
        gid=f"outside {cloud.name}",
    )
    pen.dots(axes, [cloud.truth[1]], [cloud.truth[0]], pen.INK, marker="+", size=70, above=5, gid="truth")
    if cloud.predicted:
        words = f"{int(inside.sum())} of {inside.size} inside"
        pen.text(axes, (0.02, 1.0), words, shift=(0, -6), frame="axes", colour=pen.MUTED, halo=True)
    points = np.concatenate(corners)
    low, high = points.min(axis=0), points.max(axis=0)
    free = 0.07 * np.maximum(high - low, 0.02 * np.abs(high) + 1e-9)
    axes.set_xlim(float(low[0] - free[0]), float(high[0] + free[0]))
    axes.set_ylim(float(low[1] - free[1]), float(high[1] + 2 * free[1]))


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Relative errors (n,) of A and P of one shape's sessions, their ``lines`` (n,), and σ from one line (or NaN)."""

    name: str
    lines: Floats
    area_rel: Floats
    perimeter_rel: Floats
    sigma_area_rel: float
    sigma_perimeter_rel: float


def errors_figure(shapes: Sequence[Errors]) -> Figure:
    """Draw the relative errors over the number of lines, with the bands of one and two σ, ∝ 1/√N; A above P."""
    columns = _columns(len(shapes))
    blocks = -(-len(shapes) // columns)
    figure = pen.new_figure(_WIDTHS_IN[columns], 0.6 + 3.5 * blocks)
    for index, shape in enumerate(shapes):
        block, column = divmod(index, columns)
        for row, (symbol, errors, sigma) in enumerate(
            (("A", shape.area_rel, shape.sigma_area_rel), ("P", shape.perimeter_rel, shape.sigma_perimeter_rel))
        ):
            axes = figure.add_subplot(2 * blocks, columns, (2 * block + row) * columns + column + 1)
            pen.dress(
                axes,
                x="crossing lines N" if row else "",
                y=f"error of {symbol} (%)" if column == 0 else "",
                title="" if row else fitting(shape.name, 26),
            )
            _errors(axes, shape, 100 * errors, 100 * sigma, symbol)
    axes = figure.axes[-1]
    pen.dots(axes, [], [], pen.MUTED, size=14, label="session")
    pen.dots(axes, [], [], pen.MUTED, marker="^", size=22, label="farther off than drawn")
    pen.band(axes, [], [], [], pen.MUTED, alpha=0.3, label="1 σ and 2 σ")
    pen.legend_below(figure, axes, columns=3)
    return figure


def _errors(axes: Axes, shape: Errors, percent: Floats, sigma: float, symbol: str) -> None:
    colour = colour_of(shape.name)
    known = np.isfinite(percent) & np.isfinite(shape.lines) & (shape.lines > 0)
    lines, percent = shape.lines[known], percent[known]
    low, high = (float(lines.min()) / 1.25, float(lines.max()) * 1.25) if lines.size else (1.0, 10.0)
    farthest = float(np.abs(percent).max(initial=0.5))
    if np.isfinite(sigma) and sigma > 0:
        n = np.geomspace(low, high, 60)
        for width, alpha in ((2.0, 0.16), (1.0, 0.2)):
            pen.band(axes, n, -width * sigma / np.sqrt(n), width * sigma / np.sqrt(n), colour, alpha=alpha)
        farthest = min(farthest, _FARTHEST * sigma / low**0.5)
        farthest = max(farthest, 2.2 * sigma / low**0.5)
    pen.level(axes, 0.0, pen.MUTED, width=0.8, style="-")
    beyond = np.abs(percent) > farthest
    size = float(np.clip(900 / max(lines.size, 1), 4.0, 14.0))
    pixels = lines.size > MANY_DOTS
    gid = f"{symbol} {shape.name}"
    pen.dots(axes, lines[~beyond], percent[~beyond], colour, size=size, alpha=0.8, pixels=pixels, gid=gid)
    for up, marker in ((True, "^"), (False, "v")):
        rim = beyond & ((percent > 0) == up)
        at = np.full(int(rim.sum()), farthest if up else -farthest)
        pen.dots(axes, lines[rim], at, colour, size=24, marker=marker, above=3)
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    _ticks(axes, low, high)
    axes.set_ylim(-1.08 * farthest, 1.08 * farthest)


def _ticks(axes: Axes, low: float, high: float) -> None:
    """Write the ticks of a logarithmic axis of counts out, two at least."""
    found: list[float] = []
    for steps in _TICKS:
        found = [step * 10.0**decade for decade in range(-1, 7) for step in steps if low <= step * 10**decade <= high]
        if len(found) > 1:
            break
    axes.xaxis.set_major_locator(FixedLocator(found))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.xaxis.set_minor_locator(NullLocator())


def pulls_figure(area_z: Floats, perimeter_z: Floats, *, area: Pull, perimeter: Pull) -> Figure:
    """Draw histograms of z of A and of P against the normal curve; what lies beyond ±5 is in the outermost bars.

    ``area`` and ``perimeter`` are the mean and spread to be written beside them.
    """
    figure = pen.new_figure(_WIDTH_IN, 2.9)
    first: Axes | None = None
    for column, (title, z, pull, colour) in enumerate(
        (("area A", area_z, area, AREA), ("perimeter P", perimeter_z, perimeter, PERIMETER)), start=1
    ):
        axes = figure.add_subplot(1, 2, column, sharey=first)
        first = axes
        pen.dress(axes, x="z = (robot − truth) / σ", y="density" if column == 1 else "", title=title)
        known = z[np.isfinite(z)]
        bins = int(np.clip(2 * round(float(np.sqrt(known.size))), 10, 50))
        if known.size:
            held = np.clip(known, -_WIDEST_Z, _WIDEST_Z)
            pen.histogram(axes, held, colour, bins=bins, within=(-_WIDEST_Z, _WIDEST_Z))
        x = np.linspace(-_WIDEST_Z, _WIDEST_Z, 201)
        pen.line(axes, x, norm.pdf(x), pen.INK, width=1.3, gid="normal")
        said = f"mean {pull.mean:+.2f} ± {pull.sigma:.2f}" if pull.count else "none known"
        said += f"\nspread {pull.spread:.2f}" if np.isfinite(pull.spread) else ""
        pen.text(axes, (0.02, 0.97), said.replace("-", "−"), frame="axes", height="top", halo=True)
        axes.set_xlim(-_WIDEST_Z, _WIDEST_Z)
    return figure


def recognition_figure(shares: Mapping[str, Share], named: Mapping[str, Mapping[str, int]]) -> Figure:
    """Draw the share rightly named, with Wilson's interval, and beside it which names the sessions gave.

    Args:
        shares: By projected shape, from the top.
        named: By projected shape, how many sessions gave each name; with one shape and one name nothing is drawn.
    """
    answers = list(
        dict.fromkeys([*(name for name in shares if any(name in own for own in named.values())), *_also(named)])
    )
    confused = len(shares) > 1 or len(answers) > 1
    height = 1.5 + 0.27 * len(shares)
    longest = max((len(fitting(name, 18)) for name in answers), default=0)
    figure = pen.new_figure(_WIDTH_IN, height + (0.06 * longest if confused else 0.0))
    if confused:
        grid = figure.add_gridspec(1, 2, width_ratios=(1.0, float(np.clip(len(answers) / 5, 0.6, 2.2))))
        axes, beside = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
        _confusion(beside, list(shares), answers, named)
        pen.name_rows(axes, beside, [fitting(name, 18) for name in shares])
    else:
        axes = figure.add_subplot(1, 1, 1)
        pen.name_rows(axes, axes, [fitting(name, 18) for name in shares])
        axes.tick_params(labelleft=True)
    pen.dress(axes, x="rightly named (%)")
    for row, (name, share) in enumerate(shares.items()):
        colour = colour_of(name)
        if share.of:
            pen.line(axes, [100 * share.low, 100 * share.high], [row, row], colour, width=2.0, gid=f"interval {name}")
            pen.dots(axes, [100 * share.value], [row], colour, size=34, above=4)
    axes.set_xlim(-3, 103)
    axes.grid(visible=False, axis="y")
    return figure


def _also(named: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Names that were given for no shape of the batch, the most frequent first."""
    total: dict[str, int] = {}
    for own in named.values():
        for name, number in own.items():
            total[name] = total.get(name, 0) + number
    return sorted(total, key=lambda name: (-total[name], name))


def _confusion(axes: Axes, shapes: list[str], answers: list[str], named: Mapping[str, Mapping[str, int]]) -> None:
    counts = np.array([[named.get(shape, {}).get(answer, 0) for answer in answers] for shape in shapes], dtype=float)
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    pen.dress(axes, x="named", grid=False)
    x, y = np.arange(len(answers), dtype=float), np.arange(len(shapes), dtype=float)
    right = np.array([[shape == answer for answer in answers] for shape in shapes])
    paint(axes, x, y, np.where(right, 0, 1), 0.65 * share, [AREA, PERIMETER])
    for row, column in zip(*(found.tolist() for found in np.nonzero(counts)), strict=True):
        pen.text(axes, (column, row), f"{counts[row, column]:.0f}", side="center")
    axes.set_xticks(
        x,
        [fitting(name, 18) for name in answers],
        rotation=60 if len(answers) > 3 else 0,
        ha="right" if len(answers) > 3 else "center",
    )
    axes.set_xlim(-0.5, len(answers) - 0.5)


def uniform_figure(p_values: Mapping[str, Floats]) -> Figure:
    """Draw sorted p-values over what as many uniform numbers are expected to be, with each one's 95 % limits."""
    rows, columns = -(-len(p_values) // 4), min(4, len(p_values))
    figure = pen.new_figure(0.4 + 1.7 * columns if columns > 1 else 3.4, 0.3 + 2.1 * rows if columns > 1 else 3.4)
    for index, (title, values) in enumerate(p_values.items()):
        axes = figure.add_subplot(rows, columns, index + 1)
        found = np.sort(values[np.isfinite(values)])
        pen.dress(axes, x="if uniform", y="p-value" if index % columns == 0 else "", title=f"{title} ({found.size})")
        expected, low, high = uniform_band(found.size)
        pen.band(axes, expected, low, high, pen.MUTED, alpha=0.22)
        pen.line(axes, [0, 1], [0, 1], pen.MUTED, width=0.9, style="--")
        size = float(np.clip(600 / max(found.size, 1), 3.0, 12.0))
        pen.dots(axes, expected, found, AREA, size=size, pixels=found.size > MANY_DOTS, gid=f"p {title}")
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1)
        axes.set_aspect("equal")
        axes.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
        axes.set_yticks([0, 0.5, 1], ["0", "0.5", "1"])
    return figure
