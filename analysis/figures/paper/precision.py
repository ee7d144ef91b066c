# pyright: reportUnknownMemberType=false
# (matplotlib's stubs leave the **kwargs of set_yscale untyped)
"""Figs. 2D–F: how the scatter falls with N, and what sets it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from numpy.typing import NDArray

from analysis.compare import Divergence
from analysis.figures import pen
from analysis.figures.fields import decades
from analysis.figures.paper.panel import PaperPanel
from analysis.figures.style import colour_of
from analysis.montecarlo import Bands
from analysis.quadrature import Moments
from analysis.scaling import PowerLaw

Floats = NDArray[np.float64]


def scatter_panel(
    name: str,
    titles: Mapping[str, str],
    simulated: Mapping[str, Bands],
    exact: Mapping[str, Moments],
    fits: Mapping[str, PowerLaw],
    *,
    column: str,
    first: int,
) -> PaperPanel:
    """Draw σ(N) over the simulated runs, with the exact σ₀/√N (2D, E).

    ``fits`` are those of this column ("area_cm2" or "perimeter_cm"), from N = ``first`` on.
    """
    of_area = column == "area_cm2"
    figure = pen.new_figure(7.2, 4.6)
    axes = figure.add_subplot(1, 1, 1)
    pen.dress(axes, x="crossing lines N", y="standard deviation of " + ("A (cm²)" if of_area else "P (cm)"))
    last = max(int(bands.n[-1]) for bands in simulated.values())
    pen.count_axis(axes, last)
    axes.set_yscale("log")
    decades(axes.yaxis)
    rows: list[pd.DataFrame] = []
    for shape, bands in simulated.items():
        colour, moments = colour_of(shape), exact[shape]
        sigma = bands.area_std_cm2 if of_area else bands.perimeter_std_cm
        one = float(np.sqrt(moments.covariance_at(1)[0 if of_area else 1, 0 if of_area else 1]))
        pen.dots(axes, bands.n, sigma, colour, size=11, label=f"{titles[shape]}  {_slope(fits[shape])}", gid=shape)
        pen.line(axes, bands.n, one / np.sqrt(bands.n), colour, width=0.9, above=1.5, gid=f"{shape} exact")
        rows.append(
            pd.DataFrame(
                {
                    "shape": shape,
                    "n": bands.n,
                    f"sigma_{column}": sigma,
                    f"sigma_exact_{column}": one / np.sqrt(bands.n),
                }
            )
        )
    axes.set_xlim(max(1, int(min(bands.n[0] for bands in simulated.values()))), last * 1.1)
    pen.upright(axes, first, pen.MUTED, width=0.7, style=":", gid="fit from")
    pen.text(axes, (first, 0.02), f"fit from N = {first}", shift=(4, 4), frame="x data, y axes", colour=pen.MUTED)
    pen.line(axes, [], [], pen.MUTED, width=0.9, label="exact σ₀/√N")
    pen.legend_below(figure, axes, columns=3)
    runs = len(next(iter(simulated.values())).area_runs_cm2)
    slopes = [fit.slope for fit in fits.values()]
    ratios = {shape: fits[shape].prefactor / _prefactor(exact[shape], of_area) for shape in simulated}
    table = pd.DataFrame(
        [
            {
                "shape": shape,
                "slope": fit.slope,
                "slope_sigma": fit.slope_sigma,
                f"sigma0_{column}": fit.prefactor,
                f"sigma0_sigma_{column}": fit.prefactor_sigma,
                f"sigma0_exact_{column}": _prefactor(exact[shape], of_area),
            }
            for shape, fit in fits.items()
        ]
    )
    return PaperPanel(
        name,
        figure,
        f"Standard deviation of the {'area' if of_area else 'perimeter'} over {runs} simulated runs against N; lines: "
        f"the "
        f"exact σ₀/√N. Fitted slopes lie between {_sign(min(slopes))} and {_sign(max(slopes))} (theory −0.50), the "
        f"fitted "
        f"prefactors between {min(ratios.values()):.2f} and {max(ratios.values()):.2f} of the exact ones: whatever the "
        "shape, scatter falls as 1/√N.",
        {"": pd.concat(rows, ignore_index=True), "fits": table},
        {
            shape: {"slope": fit.slope, "slope_sigma": fit.slope_sigma, "sigma0": fit.prefactor}
            for shape, fit in fits.items()
        },
    )


@dataclass(frozen=True, slots=True)
class Complexity:
    """One shape in Fig. 2F: its divergence from the circle, its fitted and exact prefactors (A cm², P cm)."""

    title: str
    divergence: Divergence
    area: PowerLaw
    perimeter: PowerLaw
    exact: Moments


def complexity_panel(name: str, shapes: Mapping[str, Complexity]) -> PaperPanel:
    """Draw the prefactors against the divergence, absolute and relative, for A and P (2F)."""
    figure = pen.new_figure(7.2, 5.4)
    table = pd.DataFrame(
        [
            {
                "shape": shape,
                "divergence_nats": one.divergence.corrected_nats,
                "divergence_bias_nats": one.divergence.bias_nats,
                "sigma0_area_cm2": one.area.prefactor,
                "sigma0_area_sigma_cm2": one.area.prefactor_sigma,
                "sigma0_area_exact_cm2": _prefactor(one.exact, True),
                "sigma0_area_rel": one.area.prefactor / one.exact.area_cm2,
                "sigma0_area_exact_rel": one.exact.sigma_area_rel,
                "sigma0_perimeter_cm": one.perimeter.prefactor,
                "sigma0_perimeter_sigma_cm": one.perimeter.prefactor_sigma,
                "sigma0_perimeter_exact_cm": _prefactor(one.exact, False),
                "sigma0_perimeter_rel": one.perimeter.prefactor / one.exact.perimeter_cm,
                "sigma0_perimeter_exact_rel": one.exact.sigma_perimeter_rel,
            }
            for shape, one in shapes.items()
        ]
    )
    panels = (
        ("sigma0_area_cm2", "σ₀ of A (cm²)"),
        ("sigma0_area_rel", "σ₀ of A, relative"),
        ("sigma0_perimeter_cm", "σ₀ of P (cm)"),
        ("sigma0_perimeter_rel", "σ₀ of P, relative"),
    )
    for place, (column, label) in enumerate(panels):
        axes = figure.add_subplot(2, 2, place + 1)
        pen.dress(axes, x="divergence from the circle (nats)" if place > 1 else "", y=label)
        _points(axes, table, column, shapes)
    for shape, one in shapes.items():
        pen.dots(figure.axes[0], [], [], colour_of(shape), size=42, label=one.title)
    pen.line(figure.axes[0], [], [], pen.MUTED, width=1.0, style="--", label="guide for the eye")
    pen.legend_below(figure, figure.axes[0], columns=4)
    by_size = {column: [str(name) for name in table.sort_values(column)["shape"]] for column, _ in panels}
    order = list(shapes)
    kept = [label for column, label in panels if by_size[column] == order]
    growth = {column: float(table[column].max() / table[column].iloc[0]) for column, _ in panels}
    told = ", ".join(f"{one.title} {one.divergence.corrected_nats:.2f}" for one in shapes.values())
    return PaperPanel(
        name,
        figure,
        f"Scatter of one line against the Kullback–Leibler divergence of the chord lengths (over the longest) from the "
        f"circle's, in the paper's order: {told} nats. In that order rise: {', '.join(kept) or 'none'}. "
        "Relative σ₀ grows "
        f"{growth['sigma0_area_rel']:.1f}-fold for A and {growth['sigma0_perimeter_rel']:.1f}-fold for P, absolute "
        f"{growth['sigma0_area_cm2']:.1f}- and {growth['sigma0_perimeter_cm']:.1f}-fold; the absolute values depend "
        "on how large each shape was drawn.",
        {"": table},
        {"order": by_size, "growth": growth},
    )


def _points(axes: Axes, table: pd.DataFrame, column: str, shapes: Mapping[str, Complexity]) -> None:
    x, y = np.asarray(table["divergence_nats"], dtype=float), np.asarray(table[column], dtype=float)
    if len(x) > 1:
        slope, start = np.polyfit(x, y, 1)
        ends = np.array([x.min(), x.max()])
        pen.line(axes, ends, start + slope * ends, pen.MUTED, width=1.0, style="--", above=1.2, gid="guide")
    for row, shape in enumerate(shapes):
        pen.dots(axes, x[row : row + 1], y[row : row + 1], colour_of(shape), size=42, edge=pen.INK, gid=shape)
    axes.set_ylim(0, 1.12 * float(y.max()))


def _prefactor(moments: Moments, of_area: bool) -> float:
    place = 0 if of_area else 1
    return float(np.sqrt(moments.covariance_at(1)[place, place]))


def _slope(fit: PowerLaw) -> str:
    return f"{_sign(fit.slope)} ± {fit.slope_sigma:.3f}"


def _sign(value: float) -> str:
    return f"{value:.3f}".replace("-", "−")
