"""Overhead pictures drawn from the truth: floor, ball, LED, noise, through the real camera's optics.

The same ``Pinhole`` that turns pixels into cm draws them, but by other routes: the floor through the
inverse lens, the ball by cutting each pixel's ray with the sphere, the LED by projecting its place.
Pixel centres lie at whole numbers, as in OpenCV; a colour sample j stands for the luma pixels 2j and
2j + 1 (centre siting).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from tracking.cameras import check_even, chroma_planes

Plane = NDArray[np.uint8]
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
LightAt = Callable[[Floats, Floats, float], Floats]

# A camera's red filter lets some of the LED through to green and blue (R 1, G 0.25, B 0.2), so by BT.601 each
# step of luma comes with these steps of U and V.
_LED_U, _LED_V = -0.32, 0.81
_GRID_PX = 8
_BALL_BLOCK_PX = 4


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """How the virtual camera sees.

    Attributes:
        rate_hz: frames a second.
        exposure_s: the LED smears along its way for so long; the stamp is the middle.
        noise_sigma: standard deviation of a pixel's luma noise; half of it in colour.
        drop_probability: chance that a frame is lost.
        luma_per_lux: gain from light on the white floor to luma.
        black_luma: luma of no light.
        led_luma: luma that the LED adds at its peak at level 1.
        led_sigma_px: radius (sigma) of the LED's glow through the shell.
        vignetting: part of the light that is lost in the corners.
        floor_texture: relative standard deviation of the floor's albedo.
        ball_albedo: brightness of the ball's shell against the floor's.
        ambient_lux: light that the ball's shadow does not take away.
        clock_drift_ppm: how much faster than the host's the camera's clock runs.
    """

    rate_hz: float = 30.0
    exposure_s: float = 0.008
    noise_sigma: float = 2.0
    drop_probability: float = 0.002
    luma_per_lux: float = 0.8
    black_luma: float = 16.0
    led_luma: float = 110.0
    led_sigma_px: float = 3.0
    vignetting: float = 0.12
    floor_texture: float = 0.02
    ball_albedo: float = 0.65
    ambient_lux: float = 15.0
    clock_drift_ppm: float = 0.0

    def __post_init__(self) -> None:
        if self.rate_hz <= 0 or self.led_sigma_px <= 0:
            raise RequestError("virtual camera: rate_hz and led_sigma_px must be above 0")
        if min(self.exposure_s, self.noise_sigma, self.luma_per_lux, self.led_luma, self.floor_texture) < 0:
            raise RequestError("virtual camera: exposure, noise, gains and texture cannot be negative")
        if not 0.0 <= self.drop_probability < 1.0 or not 0.0 <= self.vignetting < 1.0:
            raise RequestError("virtual camera: drop_probability and vignetting must lie in [0, 1)")


@dataclass(frozen=True, slots=True)
class RobotView:
    """What the camera can see of one robot: its centre (cm), its velocity, its LED's level (0..1).

    ``led_uv``: the steps of U and V that come with each step of the LED's luma; by default those of red.
    """

    x_cm: float
    y_cm: float
    led_level: float
    vx_cm_s: float = 0.0
    vy_cm_s: float = 0.0
    led_height_cm: float = 7.3
    radius_cm: float = 3.65
    led_uv: tuple[float, float] = (_LED_U, _LED_V)


@dataclass(frozen=True, slots=True)
class Glint:
    """A white reflex of some lamp on the floor: its centre in the picture (px), its height in luma, its radius."""

    x_px: float
    y_px: float
    luma: float = 200.0
    sigma_px: float = 3.0


class OverheadScene:
    """Draws frames of the arena from above.

    Args:
        optics: the camera's true pose and lens.
        light_at: (x_cm, y_cm, height_cm) -> lux, arrays of one dimension and a height; the projected light.
        rng: noise and texture are drawn from it, so the same seed gives the same pictures.
        settings: how the camera sees.
        light_from_cm: the projector's optical centre (3,) where the ball is to throw a shadow, else None.

    Raises:
        CameraRequestError: the image has an odd side.
    """

    def __init__(
        self,
        optics: Pinhole,
        light_at: LightAt,
        rng: np.random.Generator,
        settings: CameraSettings | None = None,
        *,
        light_from_cm: Sequence[float] | None = None,
    ) -> None:
        check_even(optics.image_size, "virtual camera")
        self.optics = optics
        self.settings = settings or CameraSettings()
        self._light_at = light_at
        self._light_from = None if light_from_cm is None else np.asarray(light_from_cm, dtype=float)
        self._camera_cm = optics.centre_cm
        self._rng = rng
        width, height = optics.image_size
        self._floor_x, self._floor_y = _floor_points(optics)
        self._fall_off = _vignetting(width, height, self.settings.vignetting)
        self._albedo = _texture(width, height, self.settings.floor_texture, rng)
        self._brighter, self._darker, self._colour = _noise_banks(width * height, self.settings.noise_sigma, rng)
        self._clean: Floats32 = np.zeros((height, width), dtype=np.float32)
        self._clean8: Plane = np.zeros((height, width), dtype=np.uint8)
        self._stale = True

    def scene_changed(self) -> None:
        """Say that the projected light is another one; the floor is drawn anew with the next frame."""
        self._stale = True

    def floor_luma(self) -> Floats32:
        """The empty floor without noise, (h, w) float32 luma."""
        if self._stale:
            self._light_floor()
        return self._clean

    def render(
        self, robots: Sequence[RobotView] = (), *, light: Floats | None = None, glints: Sequence[Glint] = ()
    ) -> Plane:
        """Draw one frame, packed I420 (h · 3/2, w) uint8.

        Args:
            robots: what there is to see of each.
            light: (h,) factor of the projected light in each row of pixels, where the lamp flickers; else None.
            glints: reflexes on the floor; a ball in front hides them.
        """
        if self._stale:
            self._light_floor()
        width, height = self.optics.image_size
        floor = self._clean8 if light is None else self._under(light)
        pixels = width * height
        start, colour_start = (int(value) for value in self._rng.integers(0, (pixels, pixels // 2)))
        brighter = self._brighter[start : start + pixels].reshape(height, width)
        darker = self._darker[start : start + pixels].reshape(height, width)
        packed: Plane = np.empty((height * 3 // 2, width), dtype=np.uint8)
        luma = packed[:height]
        # Unsigned, saturating and in two passes: several times faster than signed or float arithmetic on all pixels.
        cv2.add(floor, brighter, dst=luma)
        cv2.subtract(luma, darker, dst=luma)
        packed.reshape(-1)[pixels:] = self._colour[colour_start : colour_start + pixels // 2]
        for glint in glints:
            self._draw_glint(glint, packed, brighter, darker)
        for robot in robots:
            self._draw_robot(robot, packed, brighter, darker, light)
        return packed

    def _under(self, light: Floats) -> Plane:
        """The floor under a flickering lamp."""
        black = np.float32(self.settings.black_luma)
        lit = (self._clean - black) * np.asarray(light, dtype=np.float32)[:, None] + black
        return np.clip(np.rint(lit), 0.0, 255.0).astype(np.uint8)

    def _light_floor(self) -> None:
        lux = self._light_at(self._floor_x.ravel().astype(float), self._floor_y.ravel().astype(float), 0.0)
        light = np.asarray(lux, dtype=np.float32).reshape(self._floor_x.shape)
        settings = self.settings
        clean = settings.black_luma + light * (settings.luma_per_lux * self._albedo * self._fall_off)
        self._clean = np.clip(clean, 0.0, 255.0).astype(np.float32)
        self._clean8 = np.rint(self._clean).astype(np.uint8)
        self._stale = False

    def _draw_glint(self, glint: Glint, packed: Plane, brighter: Plane, darker: Plane) -> None:
        centre = np.array([[glint.x_px, glint.y_px]])
        if (box := self._box(centre, 5.0 * glint.sigma_px)) is None:
            return
        rows, columns = (np.arange(side.start, side.stop, dtype=float) for side in box)
        patch = _without_noise(packed, brighter, darker, box)
        patch += np.float32(glint.luma) * _spot(columns, rows, centre, glint.sigma_px)
        _with_noise(patch, packed, brighter, darker, box)

    def _draw_robot(
        self, robot: RobotView, packed: Plane, brighter: Plane, darker: Plane, light: Floats | None
    ) -> None:
        # Three equal taps at ±L/√8 have the variance L²/12 of a smear of length L.
        tap_s = self.settings.exposure_s / math.sqrt(8.0)
        points = [(robot.x_cm, robot.y_cm, robot.radius_cm)]
        points += [
            (robot.x_cm + robot.vx_cm_s * tap, robot.y_cm + robot.vy_cm_s * tap, robot.led_height_cm)
            for tap in (-tap_s, 0.0, tap_s)
        ]
        seen = self.optics.project(points)
        if not np.isfinite(seen).all():
            return
        # Room for the ball and for its shadow.
        reach = 1.7 if self._light_from is not None else 1.2
        depth_cm = float(self._camera_cm[2]) - robot.radius_cm
        reach_px = reach * robot.radius_cm * float(self.optics.camera_matrix[0, 0]) / depth_cm
        if (box := self._box(seen[:1], reach_px)) is not None:
            patch = _without_noise(packed, brighter, darker, box)
            self._draw_ball(robot, patch, box, None if light is None else light[box[0]])
            _with_noise(patch, packed, brighter, darker, box)
        if (box := self._box(seen[1:], 5.0 * self.settings.led_sigma_px)) is not None:
            patch = _without_noise(packed, brighter, darker, box)
            self._draw_led(robot, seen[1:], patch, packed, box)
            _with_noise(patch, packed, brighter, darker, box)

    def _box(self, around: Floats, reach_px: float) -> tuple[slice, slice] | None:
        """Rows and columns within reach of some pixels, in whole blocks of 4; None outside the picture."""
        width, height = self.optics.image_size
        low, high = around.min(axis=0) - reach_px, around.max(axis=0) + reach_px
        block = _BALL_BLOCK_PX
        left, top = (max(0, int(value) // block * block) for value in low)
        right = min(width, int(high[0]) // block * block + block)
        bottom = min(height, int(high[1]) // block * block + block)
        return np.s_[top:bottom, left:right] if min(right - left, bottom - top) >= block else None

    def _draw_led(
        self, robot: RobotView, seen: Floats, patch: Floats32, packed: Plane, box: tuple[slice, slice]
    ) -> None:
        """Add the LED's glow to a patch of luma, in place, and to the picture's colour planes."""
        sigma_px = self.settings.led_sigma_px
        rows, columns = (np.arange(side.start, side.stop, dtype=float) for side in box)
        peak = self.settings.led_luma * robot.led_level
        patch += peak * _spot(columns, rows, seen, sigma_px)
        colour_box = tuple(slice(side.start // 2, side.stop // 2) for side in box)
        colour = peak * _spot(columns[::2] / 2.0, rows[::2] / 2.0, (seen - 0.5) / 2.0, sigma_px / 2.0)
        for plane, share in zip(chroma_planes(packed), robot.led_uv, strict=True):
            plane[colour_box] = np.clip(np.rint(plane[colour_box] + share * colour), 16.0, 240.0)

    def _draw_ball(self, robot: RobotView, patch: Floats32, box: tuple[slice, slice], flicker: Floats | None) -> None:
        """Draw shadow and sphere into a patch of floor luma, in place; ``flicker``: the lamp's factor in its rows."""
        settings = self.settings
        radius_cm = np.float32(robot.radius_cm)
        x_cm, y_cm = self._floor_x[box], self._floor_y[box]
        ball = np.array([robot.x_cm, robot.y_cm, robot.radius_cm])
        gain = np.float32(settings.luma_per_lux) * self._fall_off[box]
        if flicker is not None:
            gain = gain * flicker.astype(np.float32)[:, None]
        if self._light_from is not None:
            miss_cm, _ = _ray_miss(self._light_from, x_cm, y_cm, ball)
            umbra = np.clip((radius_cm - miss_cm) * np.float32(1.0 / 0.4) + np.float32(0.5), 0.0, 1.0)
            dark = np.minimum(patch, np.float32(settings.black_luma) + gain * np.float32(settings.ambient_lux))
            patch += umbra * (dark - patch)

        camera = self._camera_cm
        miss_cm, along_cm = _ray_miss(camera, x_cm, y_cm, ball)
        cm_per_px = abs(float(x_cm[0, -1] - x_cm[0, 0])) / max(1, x_cm.shape[1] - 1)
        cover = np.clip((radius_cm - miss_cm) * np.float32(1.0 / max(cm_per_px, 1e-6)) + np.float32(0.5), 0.0, 1.0)
        # Where the ray meets the sphere, as a part of its way to the floor: hit = camera + part · (floor - camera).
        half_chord_cm = np.sqrt(np.maximum(radius_cm**2 - miss_cm**2, 0.0))
        dx, dy = x_cm - np.float32(camera[0]), y_cm - np.float32(camera[1])
        part = (along_cm - half_chord_cm) / np.sqrt(dx * dx + dy * dy + np.float32(camera[2] ** 2))
        # How the surface leans there: the vertical component of its normal (hit - ball) / radius.
        up = np.clip((np.float32(camera[2] - ball[2]) - np.float32(camera[2]) * part) / radius_cm, 0.0, 1.0)

        # The light on the ball, at its upper half's height; sampled in blocks, since the shell scatters it anyway.
        middle = slice(_BALL_BLOCK_PX // 2, None, _BALL_BLOCK_PX)
        blocks = (middle, middle)
        sample_x = np.clip(camera[0] + part[blocks] * dx[blocks], ball[0] - radius_cm, ball[0] + radius_cm)
        sample_y = np.clip(camera[1] + part[blocks] * dy[blocks], ball[1] - radius_cm, ball[1] + radius_cm)
        lux = self._light_at(sample_x.ravel().astype(float), sample_y.ravel().astype(float), 1.5 * robot.radius_cm)
        coarse = np.asarray(lux, dtype=np.float32).reshape(sample_x.shape)
        fine = cv2.resize(coarse, (patch.shape[1], patch.shape[0]))
        light = np.asarray(cv2.blur(fine, (_BALL_BLOCK_PX + 1, _BALL_BLOCK_PX + 1)), dtype=np.float32)
        lean = np.float32(0.35) + np.float32(0.65) * up
        shell = np.float32(settings.black_luma) + np.float32(settings.ball_albedo) * gain * light * lean
        patch += cover * (shell - patch)


def _without_noise(packed: Plane, brighter: Plane, darker: Plane, box: tuple[slice, slice]) -> Floats32:
    """A patch of the picture so far as it was before its noise: robots close together do not wipe each other out."""
    patch = packed[box].astype(np.float32)
    patch += darker[box]
    patch -= brighter[box]
    return patch


def _with_noise(patch: Floats32, packed: Plane, brighter: Plane, darker: Plane, box: tuple[slice, slice]) -> None:
    patch += brighter[box]
    patch -= darker[box]
    packed[box] = np.clip(np.rint(patch), 0.0, 255.0)


def _floor_points(optics: Pinhole) -> tuple[Floats32, Floats32]:
    """Floor points (x_cm, y_cm), each (h, w), that every pixel looks at.

    Undistorting is iterative and slow, and the map is smooth: exact on a coarse grid, linear in between (good to 0.005
    pixels; OpenCV's cubic does not keep even a straight ramp straight).
    """
    width, height = optics.image_size
    # One cell beyond each border, so that every pixel has nodes around it.
    us = np.arange(-_GRID_PX, width + 2 * _GRID_PX, _GRID_PX, dtype=float)
    vs = np.arange(-_GRID_PX, height + 2 * _GRID_PX, _GRID_PX, dtype=float)
    nodes = np.stack(np.meshgrid(us, vs), axis=-1).reshape(-1, 2)
    floor = optics.to_plane(nodes, 0.0).reshape(len(vs), len(us), 2).astype(np.float32)
    across = np.arange(width, dtype=np.float32) / _GRID_PX + 1
    down = np.arange(height, dtype=np.float32) / _GRID_PX + 1
    map_u, map_v = np.meshgrid(across, down)
    fine = np.asarray(cv2.remap(floor, map_u, map_v, cv2.INTER_LINEAR), dtype=np.float32)
    return np.ascontiguousarray(fine[:, :, 0]), np.ascontiguousarray(fine[:, :, 1])


def _vignetting(width: int, height: int, loss: float) -> Floats32:
    u = (np.arange(width, dtype=np.float32) - (width - 1) / 2) / (width / 2)
    v = (np.arange(height, dtype=np.float32) - (height - 1) / 2) / (height / 2)
    return (1.0 - loss * (u[None, :] ** 2 + v[:, None] ** 2) / 2.0).astype(np.float32)


def _texture(width: int, height: int, sigma: float, rng: np.random.Generator) -> Floats32:
    """Soft patches of lighter and darker floor around 1."""
    coarse = rng.standard_normal((height // 8 + 1, width // 8 + 1), dtype=np.float32)
    fine = np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.float32)
    return (1.0 + sigma * fine).astype(np.float32)


def _noise_banks(pixels: int, sigma: float, rng: np.random.Generator) -> tuple[Plane, Plane, Plane]:
    """Noise for all frames: what brightens, what darkens (2 frames long each) and colour (2 frames long).

    A frame takes its noise from a random place in the bank, so it repeats in another place only.
    """
    noise = np.rint(np.float32(sigma) * rng.standard_normal(2 * pixels, dtype=np.float32))
    brighter: Plane = np.clip(noise, 0, 255).astype(np.uint8)
    darker: Plane = np.clip(-noise, 0, 255).astype(np.uint8)
    colour = 128.0 + np.float32(sigma / 2.0) * rng.standard_normal(pixels, dtype=np.float32)
    return brighter, darker, np.clip(np.rint(colour), 16, 240).astype(np.uint8)


def _ray_miss(eye: Floats, x_cm: Floats32, y_cm: Floats32, ball: Floats) -> tuple[Floats32, Floats32]:
    """By how much rays from ``eye`` to floor points miss the ball's centre, and where on the ray, in cm."""
    to_ball = ball - eye
    bx, by, bz = (np.float32(value) for value in to_ball)
    dx, dy, dz = x_cm - np.float32(eye[0]), y_cm - np.float32(eye[1]), np.float32(-eye[2])
    along = (dx * bx + dy * by + dz * bz) / np.sqrt(dx * dx + dy * dy + dz * dz)
    miss = np.sqrt(np.maximum(np.float32(to_ball @ to_ball) - along * along, 0.0))
    return np.asarray(miss, dtype=np.float32), np.asarray(along, dtype=np.float32)


def _spot(columns: Floats, rows: Floats, centres: Floats, sigma: float) -> Floats32:
    """A Gaussian of height 1 (rows, columns), averaged over its centres (n, 2)."""
    across = np.exp(-0.5 * ((columns[None, :] - centres[:, :1]) / sigma) ** 2)
    down = np.exp(-0.5 * ((rows[:, None] - centres[:, 1]) / sigma) ** 2)
    return np.asarray(down @ across / len(centres), dtype=np.float32)
