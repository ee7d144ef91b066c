"""Follow one LED through the frames of a static camera: predict, look there, and search the picture when lost.

Two planes tell of the LED. Luma has the finer pixels; but the ball hides the projected light, so at the edges of the
projected shape, just where the LED switches, what lies beneath the spot is not the background. The V plane of a red
LED does not care for white light. Both are fitted, and joined by their variances.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.background import Background
from tracking.led import Spot, find_peaks, fit_spot

Plane = NDArray[np.uint8]
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FollowSettings:
    """How the LED is looked for.

    Attributes:
        sigma_px: first guess at the spot's radius in luma; the track's first frames correct it.
        least_snr: amplitude over its standard error below which a spot is noise.
        least_explained: share of the patch's variance that a spot must explain.
        least_amplitude: least height of a spot, grey levels.
        coast_s: how long a dark LED is awaited where it should be before the whole picture is searched.
        confirm: frames in a row that a spot found by searching must be seen in before it is believed.
        q_px2_s3: how freely the spot may change its pace, spectral density of its acceleration.
        edge_error: error of a luma fit, in px, where the floor's contrast under the patch is as large as the spot's
            height; luma's variance grows by its square.
    """

    sigma_px: float = 3.0
    least_snr: float = 8.0
    least_explained: float = 0.2
    least_amplitude: float = 6.0
    coast_s: float = 0.4
    confirm: int = 3
    q_px2_s3: float = 1.2e5
    edge_error: float = 3.0


@dataclass(frozen=True, slots=True)
class Sighting:
    """The LED in one frame; pixels of luma, pixel centres at whole numbers.

    ``luma`` and ``red`` are the positions (x, y) with their variances (x, y) in the two planes, None where that
    plane does not show it.
    """

    luma: tuple[float, float, float, float] | None
    red: tuple[float, float, float, float] | None
    amplitude: float
    quality: float
    flat: bool

    @property
    def position(self) -> tuple[float, float]:
        """The joint position (x, y)."""
        x, y, _, _ = join(self.luma, self.red, (0.0, 0.0))
        return x, y


@dataclass(slots=True)
class _Motion:
    """Constant-velocity filter in pixels; both axes share the covariance (xx, xv, vv)."""

    x: float
    y: float
    vx: float = 0.0
    vy: float = 0.0
    xx: float = 4.0
    xv: float = 0.0
    vv: float = 3.0e4

    def predict(self, dt_s: float, q: float) -> None:
        self.x += dt_s * self.vx
        self.y += dt_s * self.vy
        self.xx += 2.0 * dt_s * self.xv + dt_s * dt_s * self.vv + q * dt_s**3 / 3.0
        self.xv += dt_s * self.vv + q * dt_s * dt_s / 2.0
        self.vv += q * dt_s

    def update(self, x: float, y: float, variance: float = 0.25) -> None:
        s = self.xx + variance
        gain_x, gain_v = self.xx / s, self.xv / s
        dx, dy = x - self.x, y - self.y
        self.x += gain_x * dx
        self.y += gain_x * dy
        self.vx += gain_v * dx
        self.vy += gain_v * dy
        self.vv -= gain_v * self.xv
        self.xx *= variance / s
        self.xv *= variance / s


class _Radius:
    """The spot's radius in one plane: free in the first frames, then their median."""

    def __init__(self, guess_px: float, learn_from: int = 15) -> None:
        self.sigma_px = guess_px
        self._learn_from = learn_from
        self._seen: list[float] = []

    @property
    def is_free(self) -> bool:
        return len(self._seen) < self._learn_from

    def learn(self, spot: Spot) -> None:
        if self.is_free:
            self._seen.append(spot.sigma_px)
            self.sigma_px = float(np.median(self._seen))


class LedFollower:
    """Follows one LED; give it the frames in order, then read ``sightings``.

    ``sightings`` has one entry a frame, None where the LED was not seen. A spot found by searching enters it, with
    its first frames, once it has been confirmed, so entries may be filled in late.
    """

    def __init__(self, background: Background, settings: FollowSettings | None = None) -> None:
        self.background = background
        self.settings = settings or FollowSettings()
        self.sightings: list[Sighting | None] = []
        self._contrast = _local_contrast(background.luma, self.settings.sigma_px, background.noise)
        self._small_luma = np.ascontiguousarray(background.luma[::_STRIDE, ::_STRIDE])
        self._radius = _Radius(self.settings.sigma_px)
        self._red_radius = _Radius(self.settings.sigma_px / 2.0)
        self._motion: _Motion | None = None
        self._pending: list[tuple[int, Sighting]] | None = None
        self._t_s = -math.inf
        self._last_seen: tuple[float, float, float] | None = None

    def step(self, t_s: float, luma: Plane, red: Plane | None) -> None:
        """Look at the next frame. ``luma`` (h, w), ``red`` the V plane or None, ``t_s`` its time."""
        if self.background.red is None:
            red = None
        dt_s = max(0.0, t_s - self._t_s) if math.isfinite(self._t_s) else 0.0
        self._t_s = t_s
        self.sightings.append(None)
        if self._motion is not None:
            self._motion.predict(dt_s, self.settings.q_px2_s3)
            found = self._look(luma, red, self._motion)
            if found is not None:
                self._take(found)
                return
            if (
                self._pending is None
                and self._last_seen is not None
                and t_s - self._last_seen[2] <= self.settings.coast_s
            ):
                return
            # A candidate that did not last was none; a robot out of sight for too long is lost.
            self._motion = self._pending = None
        found = self._search(luma, red)
        if found is not None:
            self._motion = _Motion(*found.position)
            self._pending = []
            self._take(found)

    def _take(self, found: Sighting) -> None:
        motion = self._motion
        if motion is None:
            return
        x, y = found.position
        motion.update(x, y)
        number = len(self.sightings) - 1
        if self._pending is None:
            self.sightings[number] = found
        else:
            self._pending.append((number, found))
            if len(self._pending) < self.settings.confirm:
                return
            for earlier, sighting in self._pending:
                self.sightings[earlier] = sighting
            self._pending = None
        self._last_seen = (x, y, self._t_s)

    def _look(self, luma: Plane, red: Plane | None, motion: _Motion) -> Sighting | None:
        """Look for the LED about its predicted place."""
        rows, columns = luma.shape
        spread = math.sqrt(motion.xx)
        half = int(min(max(24.0, 20.0 + 4.0 * spread), 80.0))
        prior = 8.0 + spread
        # Even corners, so that the box is one of whole colour pixels too.
        left, right = max(0, int(motion.x) - half) & ~1, min(columns, int(motion.x) + half + 1)
        top, bottom = max(0, int(motion.y) - half) & ~1, min(rows, int(motion.y) + half + 1)
        if right - left < 8 or bottom - top < 8:
            return None
        if red is not None and self.background.red is not None:
            box = np.s_[top // 2 : (bottom + 1) // 2, left // 2 : (right + 1) // 2]
            peaks = find_peaks(
                red[box],
                self.background.red[box],
                self._red_radius.sigma_px,
                near=((motion.x - left - 0.5) / 2.0, (motion.y - top - 0.5) / 2.0),
                prior_sigma_px=prior / 2.0,
            )
            return next((s for x, y, _ in peaks if (s := self._fit_red(luma, red, x + left // 2, y + top // 2))), None)
        box = np.s_[top:bottom, left:right]
        peaks = find_peaks(
            luma[box],
            self.background.luma[box],
            self._radius.sigma_px,
            count=2,
            near=(motion.x - left, motion.y - top),
            prior_sigma_px=prior,
        )
        return next((s for x, y, _ in peaks if (s := self._fit_luma(luma, x + left, y + top))), None)

    def _search(self, luma: Plane, red: Plane | None) -> Sighting | None:
        """Look for the LED in the whole picture, within reach of where it was last seen."""
        candidates: list[Sighting] = []
        if red is not None and self.background.red is not None:
            for x, y, height in find_peaks(red, self.background.red, self._red_radius.sigma_px, count=3):
                if height > 4.0 * self.background.red_noise and (s := self._fit_red(luma, red, x, y)):
                    candidates.append(s)
        else:
            small = np.ascontiguousarray(luma[::_STRIDE, ::_STRIDE])
            for x, y, height in find_peaks(small, self._small_luma, max(1.0, self._radius.sigma_px / _STRIDE), count=4):
                near = self._climb(luma, x * _STRIDE, y * _STRIDE)
                if height > 2.0 * self.background.noise and (s := self._fit_luma(luma, *near)):
                    candidates.append(s)
        within = [s for s in candidates if self._in_reach(*s.position, luma.shape[1])]
        return max(within, key=lambda s: s.amplitude * s.quality, default=None)

    def _climb(self, luma: Plane, x: float, y: float) -> tuple[float, float]:
        """Find the peak at full resolution near a strided one."""
        half = 6 * _STRIDE
        left, top = max(0, int(x) - half), max(0, int(y) - half)
        box = np.s_[top : int(y) + half + 1, left : int(x) + half + 1]
        peaks = find_peaks(
            luma[box],
            self.background.luma[box],
            self._radius.sigma_px,
            near=(x - left, y - top),
            prior_sigma_px=2.0 * _STRIDE,
        )
        return (peaks[0][0] + left, peaks[0][1] + top) if peaks else (x, y)

    def _in_reach(self, x: float, y: float, width: int) -> bool:
        """Whether the robot can have come here since it was last seen: half a picture's width a second."""
        if self._last_seen is None:
            return True
        last_x, last_y, last_s = self._last_seen
        return math.hypot(x - last_x, y - last_y) <= 80.0 + 0.5 * width * (self._t_s - last_s)

    def _good(self, spot: Spot | None, noise: float) -> bool:
        settings = self.settings
        return (
            spot is not None
            and spot.snr >= settings.least_snr
            and spot.explained >= settings.least_explained
            and spot.amplitude >= max(settings.least_amplitude, 2.0 * noise)
        )

    def _fit_luma(self, luma: Plane, x: float, y: float) -> Sighting | None:
        floor = self.background
        radius = self._radius
        spot = fit_spot(luma, floor.luma, x, y, radius.sigma_px, free_sigma=radius.is_free)
        if spot is None or not self._good(spot, floor.noise):
            return None
        radius.learn(spot)
        place, flat = self._luma_place(spot)
        return Sighting(place, None, spot.amplitude, spot.explained, flat)

    def _luma_place(self, spot: Spot) -> tuple[tuple[float, float, float, float], bool]:
        rows, columns = self._contrast.shape
        row, column = min(max(round(spot.y_px), 0), rows - 1), min(max(round(spot.x_px), 0), columns - 1)
        edge = self.settings.edge_error * float(self._contrast[row, column]) / spot.amplitude
        return (spot.x_px, spot.y_px, spot.var_x_px2 + edge * edge, spot.var_y_px2 + edge * edge), edge < 0.1

    def _fit_red(self, luma: Plane, red: Plane, x: float, y: float) -> Sighting | None:
        floor = self.background
        if floor.red is None:
            return None
        radius = self._red_radius
        spot = fit_spot(red, floor.red, x, y, radius.sigma_px, free_sigma=radius.is_free)
        if spot is None or not self._good(spot, floor.red_noise):
            return None
        radius.learn(spot)
        # A colour pixel j stands for the luma pixels 2 j and 2 j + 1; what the camera's siting adds is learnt later.
        place = (2.0 * spot.x_px + 0.5, 2.0 * spot.y_px + 0.5, 4.0 * spot.var_x_px2, 4.0 * spot.var_y_px2)
        fine = fit_spot(luma, floor.luma, place[0], place[1], self._radius.sigma_px, free_sigma=self._radius.is_free)
        luma_place, flat = None, False
        if fine is not None and self._good(fine, floor.noise):
            if math.hypot(fine.x_px - place[0], fine.y_px - place[1]) < 3.0:
                luma_place, flat = self._luma_place(fine)
            if flat:
                self._radius.learn(fine)
        return Sighting(luma_place, place, spot.amplitude, spot.explained, flat)


_STRIDE = 4


def _local_contrast(floor: Plane, sigma_px: float, noise: float) -> NDArray[np.float32]:
    """Standard deviation of the floor's luma over a spot's patch, (h, w), without the noise's share."""
    size = (2 * math.ceil(4.0 * sigma_px) + 1,) * 2
    values = floor.astype(np.float32)
    mean = np.asarray(cv2.blur(values, size), dtype=np.float32)
    square = np.asarray(cv2.blur(values * values, size), dtype=np.float32)
    return np.sqrt(np.maximum(square - mean * mean - np.float32(noise * noise), 0.0))


def join(
    luma: tuple[float, float, float, float] | None,
    red: tuple[float, float, float, float] | None,
    offset_px: tuple[float, float],
) -> tuple[float, float, float, float]:
    """Join the two planes' positions by their variances: (x, y, variance of x, of y); NaN where there is neither.

    ``offset_px`` is what the red position has too much against luma.
    """
    if red is None:
        return luma or (math.nan, math.nan, math.nan, math.nan)
    moved = (red[0] - offset_px[0], red[1] - offset_px[1], red[2], red[3])
    if luma is None:
        return moved
    out: list[float] = []
    variances: list[float] = []
    for axis in (0, 1):
        weight = 1.0 / luma[axis + 2], 1.0 / moved[axis + 2]
        out.append((luma[axis] * weight[0] + moved[axis] * weight[1]) / sum(weight))
        variances.append(1.0 / sum(weight))
    return out[0], out[1], variances[0], variances[1]


def places(sightings: list[Sighting | None]) -> Floats:
    """Give (n, 4) columns x, y, var x, var y in px, NaN where not seen.

    Where colour pixels really sit against luma depends on camera and encoder (H.264's default is half a pixel to
    the left): the median difference over frames with a flat floor is taken off the red positions.
    """
    differences = [(s.red[0] - s.luma[0], s.red[1] - s.luma[1]) for s in sightings if s and s.flat and s.red and s.luma]
    offset = (0.0, 0.0)
    if len(differences) >= 15:
        middle = np.median(np.asarray(differences, dtype=float), axis=0)
        offset = float(middle[0]), float(middle[1])
    rows = [join(s.luma, s.red, offset) if s else (math.nan,) * 4 for s in sightings]
    return np.asarray(rows, dtype=float).reshape(-1, 4)
