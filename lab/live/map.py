"""The arena from above as an inline SVG: the shape, and where the camera saw the LED dark and lit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import Polygon

from lab.live.folder import Sightings

Floats = NDArray[np.float64]
_MOST_SPOTS = 3000
_MARGIN_CM = 2.0


def arena_svg(arena: Polygon, outline_cm: Sequence[Floats], seen: Sightings, *, label: str) -> str:
    """Draw the floor between the walls, y up, in cm.

    Args:
        arena: the floor.
        outline_cm: the shape's rings, (n, 2) each.
        seen: where LEDs were seen; of more than some thousands, evenly chosen ones are drawn.
        label: what a screen reader says.
    """
    left, bottom, right, top = (float(bound) for bound in arena.bounds)
    width, height = right - left + 2 * _MARGIN_CM, top - bottom + 2 * _MARGIN_CM
    step = max(1, -(-len(seen.t_s) // _MOST_SPOTS))
    x_cm, y_cm, lit = seen.x_cm[::step], seen.y_cm[::step], seen.lit[::step]
    here = ""
    for last in np.flatnonzero(seen.t_s == seen.t_s[-1]) if len(seen.t_s) else ():
        kind = "lit" if seen.lit[last] else "dark"
        here += f'<circle class="here {kind}" cx="{seen.x_cm[last]:.1f}" cy="{-seen.y_cm[last]:.1f}" r="3"/>'
    return (
        f'<svg class="arena" role="img" aria-label="{label}" '
        f'viewBox="{left - _MARGIN_CM:g} {-top - _MARGIN_CM:g} {width:g} {height:g}">'
        f'<path class="floor" d="{_ring(np.asarray(arena.exterior.coords))}"/>'
        f'<path class="shape" fill-rule="evenodd" d="{"".join(_ring(ring) for ring in outline_cm)}"/>'
        f'<path class="way" d="{_spots(x_cm[~lit], y_cm[~lit])}"/>'
        f'<path class="lit" d="{_spots(x_cm[lit], y_cm[lit])}"/>{here}</svg>'
    )


def _ring(points: Floats) -> str:
    return "M" + "L".join(f"{x:.1f} {-y:.1f}" for x, y in points[:, :2].tolist()) + "Z"


def _spots(x_cm: Floats, y_cm: Floats) -> str:
    """Round dots: strokes of no length."""
    return "".join(f"M{x:.1f} {-y:.1f}h0" for x, y in zip(x_cm.tolist(), y_cm.tolist(), strict=True))
