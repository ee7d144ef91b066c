"""Fig. 1B–E: the blinks of the robot's LED, accumulated by the camera while the robot explores the shape."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray
from shapely.geometry import box
from shapely.geometry.base import BaseGeometry

from analysis.figures import pen
from analysis.figures.maps import draw_arena, draw_scale, draw_silhouette
from analysis.figures.style import colour_of

Floats = NDArray[np.float64]

_MOST_COLUMNS = 3
_ABOUT = 1e-6  # cm


def lit_positions(track: pd.DataFrame, *, last_line: int | None = None) -> Floats:
    """Places (m, 2) in cm where the camera saw the LED lit, up to and including run ``last_line``."""
    chosen = track["led_on"].to_numpy(dtype=bool, na_value=False)
    if last_line is not None:
        chosen = chosen & (np.asarray(track["line"], dtype=float) <= last_line)
    places = np.asarray(track.loc[chosen, ["x_cm", "y_cm"]], dtype=float)
    return places[np.isfinite(places).all(axis=1)]


def panels_at(track: pd.DataFrame, estimates: pd.DataFrame, counts: Sequence[int | None]) -> list[tuple[int, Floats]]:
    """Give (N, lit places) for each of the ``counts`` that the session reached; None stands for all.

    The run at which N was reached is read from ``estimates``. A track without ``line`` cannot be cut, so that only
    the last panel remains.
    """
    reached = int(estimates["n"].max()) if len(estimates) else 0
    line_at = dict(zip(estimates["n"].astype(int), estimates["line"].astype(int), strict=True))
    panels: list[tuple[int, Floats]] = []
    for n in counts:
        if n is None:
            panels.append((reached, lit_positions(track)))
        elif n < reached and n in line_at and "line" in track.columns:
            panels.append((n, lit_positions(track, last_line=line_at[n])))
    return panels


def blinks_figure(
    track: pd.DataFrame,
    geometry: BaseGeometry,
    arena: BaseGeometry,
    *,
    name: str,
    estimates: pd.DataFrame,
    counts: Sequence[int | None] = (10, 100, None),
) -> Figure:
    """Draw the blinks over the silhouette, one panel for each N in ``counts`` (None: all lines)."""
    panels = panels_at(track, estimates, counts)
    width, columns = 7.2, max(min(len(panels), _MOST_COLUMNS), 1)
    rows = max(-(-len(panels) // columns), 1)
    west, south, east, north = _view(geometry, panels[-1][1] if panels else np.empty((0, 2)))
    figure = pen.new_figure(width, rows * (min(width / columns * (north - south) / (east - west), 4.2) + 0.4))
    colour = colour_of(name)
    for place, (n, places) in enumerate(panels):
        axes = figure.add_subplot(rows, columns, place + 1)
        pen.dress_map(axes, title=f"N = {n}")
        axes.set_xlim(west, east)
        axes.set_ylim(south, north)
        if arena.buffer(_ABOUT).within(box(west, south, east, north)):  # a stray stretch of wall says nothing
            draw_arena(axes, arena)
        draw_silhouette(axes, geometry, colour)
        # Strokes overlap more and more: the dots shrink so that single runs stay visible as they fill the shape.
        # Below, on smaller maps of a second row, smaller yet.
        size = float(np.clip(10000 / max(len(places), 1), 0.6 if rows == 1 else 0.15, 5.0))
        pen.dots(axes, places[:, 0], places[:, 1], colour, size=size, alpha=0.7, pixels=True, gid="blinks")
        if place == 0:
            draw_scale(axes, (west, south, east, north))
    return figure


def _view(geometry: BaseGeometry, places: Floats) -> tuple[float, float, float, float]:
    """(west, south, east, north) around the shape and nearly all that was seen, with room for the scale bar."""
    west, south, east, north = geometry.bounds
    if len(places) > 50:
        low, high = np.percentile(places, [0.5, 99.5], axis=0).tolist()
        west, south, east, north = min(west, low[0]), min(south, low[1]), max(east, high[0]), max(north, high[1])
    free = 0.07 * max(east - west, north - south)
    return west - free, south - 2 * free, east + free, north + free
