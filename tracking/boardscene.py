"""A printed board before the virtual camera: held in the air or laid on the floor, drawn by the overhead scene.

The scene draws what lies in the plane z = 0 of its optics. With the board's pose in the place of the camera's,
that plane is the board's, whatever way it is held.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from lab.base.pinhole import Pinhole
from tracking.board import CELLS_PER_SQUARE, Board
from tracking.cameras import Frame
from tracking.synthetic import CameraSettings, LightAt, OverheadScene

Floats = NDArray[np.float64]

_PX_PER_CELL = 16
_BLUR_PX = 0.6  # of the camera's lens and pixels together, one standard deviation
_MARGIN_CELLS = CELLS_PER_SQUARE // 2
_STEEPEST_RAD = math.radians(40.0)


@dataclass(frozen=True, slots=True)
class BoardLight:
    """The light that a board throws back: of its white, of its black, and of the room around it, in lux."""

    white_lux: float = 150.0
    black_lux: float = 12.0
    around_lux: float = 60.0


def board_light(board: Board, pixel_cm: float, light: BoardLight | None = None) -> LightAt:
    """The light from a board in the plane z = 0 of its own frame, blurred as pixels of ``pixel_cm`` see it."""
    lux = light or BoardLight()
    cells = np.pad(board.cells, _MARGIN_CELLS, constant_values=True)
    texel_cm = board.square_cm / CELLS_PER_SQUARE / _PX_PER_CELL
    picture = np.kron(cells.astype(np.float32), np.ones((_PX_PER_CELL, _PX_PER_CELL), dtype=np.float32))
    picture = lux.black_lux + (lux.white_lux - lux.black_lux) * picture
    around = _PX_PER_CELL * _MARGIN_CELLS // 2
    picture = np.pad(picture, around, constant_values=lux.around_lux)
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), _BLUR_PX * pixel_cm / texel_cm), dtype=np.float32)
    rows, columns = picture.shape

    def light_at(x_cm: Floats, y_cm: Floats, _height_cm: float) -> Floats:
        column = x_cm / texel_cm + (columns - 1) / 2
        row = (rows - 1) / 2 - y_cm / texel_cm
        on = (column >= 0) & (column <= columns - 1) & (row >= 0) & (row <= rows - 1)
        out = np.full(x_cm.shape, lux.around_lux)
        out[on] = map_coordinates(picture, [row[on], column[on]], order=1, mode="nearest")
        return out

    return light_at


def board_scene(
    camera: Pinhole, pose: Pinhole, board: Board, rng: np.random.Generator, settings: CameraSettings | None = None
) -> OverheadScene:
    """The picture of a board whose frame ``pose`` relates to ``camera``; see `held` and `laid` for poses."""
    pixel_cm = float(np.linalg.norm(pose.tvec)) / float(camera.camera_matrix[0, 0])
    return OverheadScene(pose, board_light(board, pixel_cm), rng, settings)


def laid(camera: Pinhole, x_cm: float, y_cm: float, turned_rad: float = 0.0) -> Pinhole:
    """The camera as seen from a board that lies on the floor at (``x_cm``, ``y_cm``), turned counterclockwise."""
    turn, _ = cv2.Rodrigues(np.array([0.0, 0.0, turned_rad]))
    rotation = camera.rotation @ np.asarray(turn, dtype=float)
    tvec = camera.tvec + camera.rotation @ np.array([x_cm, y_cm, 0.0])
    return replace(camera, rvec=np.asarray(cv2.Rodrigues(rotation)[0], dtype=float).ravel(), tvec=tvec)


def held(camera: Pinhole, board: Board, rng: np.random.Generator) -> Iterator[Pinhole]:
    """Poses of a board that somebody holds into the picture, here and there, near and far, tilted every way."""
    width, height = camera.image_size
    focal = float(camera.camera_matrix[0, 0])
    lens = replace(camera, rvec=np.zeros(3), tvec=np.zeros(3))
    number = 0
    while True:
        # a picture's places in turn, so that none is left out for long
        place = np.array([number % 4 + 0.5, number // 4 % 3 + 0.5]) / (4, 3) + rng.uniform(-0.08, 0.08, 2)
        distance_cm = board.size_cm[0] * focal / (width * rng.uniform(0.3, 0.6))
        middle = np.append(lens.to_plane([place * (width, height)], 1.0)[0], 1.0) * distance_cm
        axis_rad = math.tau * (number * 0.381966 + rng.uniform(0.0, 0.1))
        tilt_rad = _STEEPEST_RAD * math.sqrt(rng.uniform(0.1, 1.0))
        tilt, _ = cv2.Rodrigues(tilt_rad * np.array([math.cos(axis_rad), math.sin(axis_rad), 0.0]))
        turn, _ = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-0.6, 0.6)]))
        facing = np.asarray(tilt @ turn, dtype=float) @ np.diag([1.0, -1.0, -1.0])
        yield replace(camera, rvec=np.asarray(cv2.Rodrigues(facing)[0], dtype=float).ravel(), tvec=middle)
        number += 1


class StagedCamera:
    """A virtual camera whose scenes somebody changes; speaks the ``Camera`` protocol.

    Args:
        size: (width, height) in pixels.
        rate_hz: frames a second.
    """

    name = "virtual"
    live = False
    dropped = 0

    def __init__(self, size: tuple[int, int], rate_hz: float = 30.0) -> None:
        self.size = size
        self.rate_hz = rate_hz
        self._scenes: Iterator[OverheadScene] = iter(())
        self._scene: OverheadScene | None = None
        self._frames_each = 1
        self._index = 0
        self._runs = False

    def film(self, scenes: Iterable[OverheadScene], frames_each: int = 1) -> None:
        """Film ``scenes``, each for so many frames, and the last one for ever."""
        self._scenes, self._frames_each, self._index = iter(scenes), frames_each, 0

    def scene_changed(self) -> None:
        """Say that the projector shows another image."""
        if self._scene is not None:
            self._scene.scene_changed()

    async def start(self) -> None:
        """Switch on."""
        self._runs = True

    async def next_frame(self) -> Frame | None:
        """Wait for the next frame and draw it; None when stopped, or when there is nothing to film."""
        await asyncio.sleep(1.0 / self.rate_hz)
        if self._index % self._frames_each == 0:
            self._scene = next(self._scenes, self._scene)
        if not self._runs or self._scene is None:
            return None
        now_s = asyncio.get_running_loop().time()
        frame = Frame(index=self._index, t_camera_s=now_s, t_host_s=now_s, i420=self._scene.render())
        self._index += 1
        return frame

    async def stop(self) -> None:
        """Switch off."""
        self._runs = False
