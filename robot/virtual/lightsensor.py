"""The light sensor of a virtual robot: what it sees at once, its own LED's light in it, and its noise."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from robot.virtual.physics import BodySettings

Floats = NDArray[np.float64]
LightAt = Callable[[Floats, Floats], Floats]


class LightSensor:
    """Reads the light below a ball.

    Args:
        light_at: Light in lux, at the sensor's height, for arrays x and y of arena cm, shape (n,) each.
        rng: Source of the noise.
        settings: Its footprint, its noise and the LED's leak are taken from them.
    """

    def __init__(self, light_at: LightAt, rng: Generator, settings: BodySettings) -> None:
        self._light_at = light_at
        self._rng = rng
        self._settings = settings
        self._footprint_x, self._footprint_y = _footprint(settings.footprint_cm)

    def read_lux(self, x_cm: float, y_cm: float, led_level: float) -> float:
        """One reading at (``x_cm``, ``y_cm``): footprint mean, own LED at ``led_level`` (0 to 1) and noise, >= 0."""
        light = self._light_at(self._footprint_x + x_cm, self._footprint_y + y_cm)
        mean = float(light.sum()) / light.size
        settings = self._settings
        noise = settings.light_noise_lux * self._rng.standard_normal() if settings.light_noise_lux else 0.0
        return max(0.0, mean + settings.led_leak_lux * led_level + noise)


def _footprint(radius_cm: float) -> tuple[Floats, Floats]:
    """Thirteen points (13,), (13,) that stand for a disc: the centre and rings of 4 and 8, each for a like area.

    The rings lie at the root mean square radius of the area they stand for, so the second moment of the
    disc, R²/4 about each axis, is kept within 1 %.
    """
    rings = [(1, 0.0), (4, math.sqrt(3 / 13)), (8, math.sqrt(9 / 13))]
    points = [
        (radius * math.cos(math.tau * (i + 0.5) / count), radius * math.sin(math.tau * (i + 0.5) / count))
        for count, radius in rings
        for i in range(count)
    ]
    array = radius_cm * np.asarray(points, dtype=float)
    return np.ascontiguousarray(array[:, 0]), np.ascontiguousarray(array[:, 1])
