"""Were the lines random enough? Fig. 1C–E asks the eye; here are the numbers that the tests look at."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from shapely.geometry.base import BaseGeometry

from analysis.figures import pen
from analysis.figures.maps import draw_arena, draw_scale, draw_silhouette
from analysis.figures.style import colour_of
from analysis.figures.values import Isotropy


def isotropy_figure(isotropy: Isotropy, *, name: str) -> Figure:
    """Draw each run's (U, V) with marginal histograms; a uniform square is what isotropy looks like.

    The grey stripes hold a fair histogram's bars in 95 of 100 cases, each bar by itself (normal approximation).
    """
    colour = colour_of(name)
    u, v = isotropy.u, isotropy.v
    figure = pen.new_figure(5.4, 5.2)
    square, over, beside = pen.square_with_margins(figure)
    pen.dress(square, x="U: direction of the run, as a uniform number", y="V: place of the run, as a uniform number")
    pen.dress(over, y="runs", grid=False)
    pen.dress(beside, x="runs", grid=False)
    size = float(np.clip(6000 / max(u.size, 1), 2.0, 14.0))
    pen.dots(square, u, v, colour, size=size, alpha=0.75, pixels=u.size > 500, gid="runs")
    bins = int(np.clip(np.sqrt(u.size) / 2, 4, 20))
    fair = u.size / bins
    spread = 1.96 * np.sqrt(fair * (1 - 1 / bins))
    whole = np.array([0.0, 1.0])
    pen.band(over, whole, [fair - spread] * 2, [fair + spread] * 2, pen.MUTED, alpha=0.22)
    pen.band_sideways(beside, whole, [fair - spread] * 2, [fair + spread] * 2, pen.MUTED, alpha=0.22)
    pen.histogram(over, u, colour, bins=bins, within=(0.0, 1.0), density=False)
    pen.histogram(beside, v, colour, bins=bins, within=(0.0, 1.0), density=False, sideways=True)
    square.set_xlim(0, 1)
    square.set_ylim(0, 1)
    return figure


def lines_figure(true_lines: pd.DataFrame, geometry: BaseGeometry, arena: BaseGeometry, *, name: str) -> Figure:
    """Draw every run that the camera saw, from wall to wall, over the shape."""
    west, south, east, north = arena.bounds
    free = 0.02 * (east - west)
    west, south, east, north = west - free, south - 3.5 * free, east + free, north + free
    figure = pen.new_figure(6.0, 6.0 * (north - south) / (east - west))
    axes = figure.add_subplot(1, 1, 1)
    pen.dress_map(axes)
    axes.set_xlim(west, east)
    axes.set_ylim(south, north)
    draw_arena(axes, arena)
    colour = colour_of(name)
    draw_silhouette(axes, geometry, colour, fill=0.35)
    ends = np.asarray(true_lines[["x_start_cm", "y_start_cm", "x_end_cm", "y_end_cm"]], dtype=float)
    ends = ends[np.isfinite(ends).all(axis=1)]
    opacity = float(np.clip(9 / np.sqrt(max(len(ends), 1)), 0.15, 0.7))
    pen.web(axes, ends.reshape(-1, 2, 2), pen.MUTED, width=0.5, alpha=opacity, gid="runs")
    draw_scale(axes, (west, south, east, north))
    return figure
