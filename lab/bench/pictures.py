"""What a session projects: the shape on its floor, and the plain fields that the light levels are learnt from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.base.pinhole import Pinhole
from lab.settings.sections import ArenaSettings
from projector.render import RenderError, code_to_light, light_to_code, render
from projector.shape import Shape, Silhouette, check_fits

Picture = NDArray[np.uint8]

# What lies nearer to the edge of the runs is never crossed whole: at a wall a little beyond the ball's radius,
# at a ring what the sensor needs between two changes of the light.
_MARGIN_CM = {"bump": 0.35, "dark_ring": 1.0, "bright_ring": 1.0}

# Relative light of floor, shape and ring. Where light marks the edge, three levels must be told apart: the
# ring takes the end of the scale that is farther from the shape's.
_LIGHT = {"bump": (0.0, 1.0, 0.0), "dark_ring": (0.4, 1.0, 0.0), "bright_ring": (0.0, 0.4, 1.0)}


def span_of(arena: ArenaSettings) -> float:
    """How much brighter the shape is than the floor, of the projector's whole span."""
    floor, lit, _ = _LIGHT[arena.edge]
    return lit - floor


@dataclass(frozen=True, slots=True)
class Pictures:
    """Images, uint8 (height, width): the shape in its arena, and fields of the floor's, shape's and ring's light.

    ``ring`` is None where runs end at the wall itself.
    """

    shape: Picture
    floor: Picture
    lit: Picture
    ring: Picture | None


def check_on_floor(shape: Shape, arena: ArenaSettings) -> None:
    """Check that the runs can cross all of ``shape``. Raises ShapeError with the size that would fit."""
    check_fits(shape, arena.lines_within, _MARGIN_CM[arena.edge])


def draw_pictures(
    geometry: Silhouette, arena: ArenaSettings, optics: Pinhole, sensor_height_cm: float, image_size: tuple[int, int]
) -> Pictures:
    """Draw what the projector will show, for the plane of the light sensor.

    Raises:
        RenderError: the projector cannot show all of the shape, or of the ring.
    """
    floor, lit, ring = _LIGHT[arena.edge]
    light = floor + (lit - floor) * code_to_light(render(geometry, optics, sensor_height_cm))
    if arena.ring is not None:
        try:
            cover = code_to_light(render(arena.ring, optics, sensor_height_cm))
        except RenderError as error:
            raise RenderError(
                f"{100 * error.outside_share:.3g} % of the arena's ring falls beyond the projector's image; "
                "take a smaller arena or move the projector back",
                error.outside_share,
            ) from error
        light += (ring - light) * cover
    width_px, height_px = image_size

    def field(level: float) -> Picture:
        return np.full((height_px, width_px), light_to_code(level), dtype=np.uint8)

    return Pictures(light_to_code(light), field(floor), field(lit), field(ring) if arena.ring is not None else None)
