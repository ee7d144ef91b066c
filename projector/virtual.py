"""A projector's light without the projector: what falls on any point above the virtual arena's floor."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from projector.device import check_image, now_s
from projector.kernels import sample_plane
from projector.render import GAMMA, code_to_light

Floats = NDArray[np.float64]

_HEIGHTS_KEPT = 32  # sensor, LED and floor are three; a bound for those who sweep the height
_IDENTITY = np.eye(3)


@dataclass(frozen=True, slots=True)
class LightSettings:
    """The light of the virtual room.

    ``ambient_lux`` falls everywhere; the projector adds ``black_lux`` where its image is black and
    ``white_lux`` where it is white, and nothing beyond its image. ``blur_px`` is the standard deviation
    of its optics' blur in projector pixels. Dark is 20 lux and lit 120 lux by default.
    """

    ambient_lux: float = 15.0
    black_lux: float = 5.0
    white_lux: float = 105.0
    blur_px: float = 1.0
    gamma: float = GAMMA

    def __post_init__(self) -> None:
        values = (self.ambient_lux, self.black_lux, self.white_lux, self.blur_px, self.gamma)
        if not np.isfinite(values).all() or min(values) < 0 or self.gamma == 0:
            raise RequestError("light: every setting must be finite and not below 0, and gamma above 0")
        if self.white_lux <= self.black_lux:
            raise RequestError("light: white_lux must lie above black_lux, or no shape can be seen")

    @property
    def dark_lux(self) -> float:
        """What a sensor reads where the image is black."""
        return self.ambient_lux + self.black_lux

    @property
    def lit_lux(self) -> float:
        """What a sensor reads where the image is white."""
        return self.ambient_lux + self.white_lux


class VirtualProjector:
    """Shows images from a true pose and answers how much light falls where.

    ``pinhole`` is where the projector really is, which a calibration only estimates. ``image`` is the
    image now shown, ``shows`` counts the images so far. It starts with black.
    """

    def __init__(self, pinhole: Pinhole, settings: LightSettings | None = None) -> None:
        self.pinhole = pinhole
        self.settings = settings or LightSettings()
        self.shows = 0
        self._shown_s: float | None = None
        self._homographies: dict[float, Floats] = {}
        self._distorted = bool(np.any(pinhole.distortion != 0))
        width, height = pinhole.image_size
        self.image: NDArray[np.uint8] = np.zeros((height, width), dtype=np.uint8)
        self._lux = self._to_lux(self.image)

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.pinhole.image_size

    @property
    def shown_s(self) -> float | None:
        """When the image now shown was put out, on the event loop's clock; None before the first."""
        return self._shown_s

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show ``image``, uint8 (height, width). Raises ProjectorRequestError for another size or type."""
        check_image(image, self.image_size, "virtual")
        self.image = image.copy()
        self._lux = self._to_lux(self.image)
        self.shows += 1
        self._shown_s = now_s()

    def close(self) -> None:
        """Nothing to let go of."""

    def light_at(self, x_cm: ArrayLike, y_cm: ArrayLike, height_cm: float) -> Floats:
        """Light in lux at the points (``x_cm``, ``y_cm``), any shape alike, of the plane z = ``height_cm``.

        Bilinear between the projector's pixels; ambient light alone beyond its image, and at NaN.
        """
        x = np.asarray(x_cm, dtype=np.float64)
        y = np.asarray(y_cm, dtype=np.float64)
        if x.shape != y.shape:
            x, y = np.broadcast_arrays(x, y)
        out = np.empty(x.shape)
        # reshape(-1) views what is contiguous, and out always is
        flat_x, flat_y = np.ascontiguousarray(x).reshape(-1), np.ascontiguousarray(y).reshape(-1)
        homography = self._homography(height_cm)
        if self._distorted:
            points = np.column_stack([flat_x, flat_y, np.full(flat_x.size, height_cm)])
            pixels = self.pinhole.project(points) + 1.0
            flat_x, flat_y = np.ascontiguousarray(pixels[:, 0]), np.ascontiguousarray(pixels[:, 1])
            homography = _IDENTITY
        sample_plane(self._lux, homography, flat_x, flat_y, self.settings.ambient_lux, out.reshape(-1))
        return out

    def _homography(self, height_cm: float) -> Floats:
        known = self._homographies.get(height_cm)
        if known is None:
            if len(self._homographies) >= _HEIGHTS_KEPT:
                self._homographies.clear()
            # the lux image has a rim of one pixel, so its pixel (1, 1) is the projector's (0, 0)
            past_rim = np.array([[1.0, 0, 1], [0, 1, 1], [0, 0, 1]])
            known = np.ascontiguousarray(past_rim @ self.pinhole.plane_homography(height_cm))
            self._homographies[height_cm] = known
        return known

    def _to_lux(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The projector's own light in lux, blurred in linear light, in a dark rim of one pixel."""
        settings = self.settings
        light = code_to_light(image, settings.gamma).astype(np.float32)
        if settings.blur_px > 0:
            light = np.asarray(
                cv2.GaussianBlur(light, (0, 0), settings.blur_px, borderType=cv2.BORDER_REPLICATE), dtype=np.float32
            )
        lux = settings.black_lux + (settings.white_lux - settings.black_lux) * light
        return np.pad(np.asarray(lux, dtype=np.float32), 1)
