"""The plane in which a coloured LED shines and white light does not, and the radius of its spot in a plane."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.spot import Spot

Plane = NDArray[np.uint8]
Floats32 = NDArray[np.float32]


class HuePlane:
    """The colour plane along one hue: 0 where there is none, more where the LED shines.

    Attributes:
        floor: (h, w) float32, that of the empty floor.
        noise: standard deviation of a pixel, grey levels.

    Args:
        chroma: the empty floor's planes (U, V).
        hue_rad: the direction atan2(V, U).
        noise: standard deviation of a pixel of U or V.
    """

    def __init__(self, chroma: tuple[Plane, Plane], hue_rad: float, noise: float) -> None:
        self._u, self._v = math.cos(hue_rad), math.sin(hue_rad)
        self._zero = -128.0 * (self._u + self._v)
        self.floor = self.plane(chroma, np.s_[:, :])
        self.noise = noise

    def plane(self, planes: tuple[Plane, Plane], box: tuple[slice, slice]) -> Floats32:
        """The piece ``box`` of the plane along the hue, float32."""
        along = cv2.addWeighted(planes[0][box], self._u, planes[1][box], self._v, self._zero, dtype=cv2.CV_32F)
        return np.asarray(along, dtype=np.float32)


class SpotRadius:
    """The spot's radius in one plane: free in the first frames, then their median."""

    def __init__(self, guess_px: float, learn_from: int = 15) -> None:
        self.sigma_px = guess_px
        self._learn_from = learn_from
        self._seen: list[float] = []

    @property
    def is_free(self) -> bool:
        """Whether it is still being learnt."""
        return len(self._seen) < self._learn_from

    def learn(self, spot: Spot) -> None:
        """Take in a spot that was fitted with its radius free."""
        if self.is_free:
            self._seen.append(spot.sigma_px)
            self.sigma_px = float(np.median(self._seen))
