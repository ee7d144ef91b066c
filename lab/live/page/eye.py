"""Finds the LEDs in small pictures, well enough for the eye; what counts is the film's track."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.live.folder import StoryFolder
from tracking.background import temporal_median
from tracking.led import find_peaks

Picture = NDArray[np.uint8]
Place = tuple[float, float]
_LED_RADIUS_CM = 1.0
_LEAST_RESPONSE = 3.0  # grey levels: a dimmed LED in a small picture
_FLOORS = 15
_LEAST_FLOORS = 3
_FLOOR_EVERY = 8
_HEIGHTS = 400
_LEAST_HEIGHTS = 20
_TWO_LEVELS = 0.7  # of the ratio of both levels as set: what is nearer together is one level's own spread


@dataclass(frozen=True, slots=True)
class Spot:
    """An LED in a picture: where, px, and how much brighter than the floor, grey levels."""

    x_px: float
    y_px: float
    height: float


class Eye:
    """Looks at one picture after the other, all of one size, and learns from them what the empty floor looks like.

    An LED is told by being brighter than the floor, and a lit one from a dark one by how much: the two levels are
    learnt from all LEDs together, since each shines in one of them at a time.

    Args:
        folder: the session's, for its calibration and how many LEDs there are.

    Attributes:
        leds: how many are looked for.
    """

    def __init__(self, folder: StoryFolder) -> None:
        led = folder.settings.led
        self.leds = len(folder.settings.robots)
        self._optics = folder.settings.camera_calibration().optics
        self._height_cm = led.height_cm
        x_px, y_px = self._optics.image_size[0] / 2, self._optics.image_size[1] / 2
        one, next_to_it = self._optics.to_plane(np.array([[x_px, y_px], [x_px + 1, y_px]]), led.height_cm)
        self._cm_per_px = float(np.hypot(*(next_to_it - one)))
        self._ratio = _TWO_LEVELS * led.lit_level / led.dark_level if led.dark_level > 0 else np.inf
        self._floors: deque[Picture] = deque(maxlen=_FLOORS)
        self._floor: Picture | None = None
        self._heights: deque[float] = deque(maxlen=_HEIGHTS)
        self._count = 0

    def look(self, picture: Picture) -> list[Spot]:
        """The LEDs in a BGR picture, the brightest first."""
        bright: Picture = np.ascontiguousarray(picture.max(axis=2))  # an LED of any colour is bright in one of them
        if self._count % _FLOOR_EVERY == 0:
            self._floors.append(bright)
            self._floor = temporal_median(list(self._floors))
        self._count += 1
        if self._floor is None or len(self._floors) < _LEAST_FLOORS:
            return []
        radius_px = max(1.0, _LED_RADIUS_CM / (self._cm_per_px * self._scale(picture.shape[1])))
        peaks = find_peaks(bright, self._floor, radius_px, count=self.leds, least=_LEAST_RESPONSE)
        self._heights.extend(height for _, _, height in peaks)
        return [Spot(*peak) for peak in peaks]

    def are_lit(self, heights: Sequence[float], *, otherwise: bool) -> list[bool]:
        """Whether LEDs of such heights are lit, as far as is known by now; ``otherwise``: while one level was seen."""
        threshold = self._threshold()
        return [otherwise if threshold is None else height > threshold for height in heights]

    def on_the_floor(self, spots: Sequence[Spot], width: int) -> list[Place]:
        """Where spots in a picture so many pixels wide are in the arena, cm; NaN beyond the horizon."""
        if not spots:
            return []
        scale = self._scale(width)
        at = np.array([[(spot.x_px + 0.5) * scale - 0.5, (spot.y_px + 0.5) * scale - 0.5] for spot in spots])
        return [(float(x_cm), float(y_cm)) for x_cm, y_cm in self._optics.to_plane(at, self._height_cm)]

    def _scale(self, width: int) -> float:
        """The camera's pixels in one of a picture so many pixels wide."""
        return self._optics.image_size[0] / width

    def _threshold(self) -> float | None:
        """The height between dark and lit; None while only one level was seen."""
        if not np.isfinite(self._ratio):
            return 0.0  # dark is not seen at all
        if len(self._heights) < _LEAST_HEIGHTS:
            return None
        low, high = np.percentile(self._heights, (2, 98))
        return float(low + high) / 2 if high > self._ratio * low else None
