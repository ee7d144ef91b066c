"""A ChArUco board in pictures: where its corners are seen, and what views a calibration still lacks."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.board import Board

Floats = NDArray[np.float64]
Plane = NDArray[np.uint8]

FEWEST_CORNERS = 6
_FIELDS = (4, 3)  # the picture is covered when corners were seen in each field of this grid, across and down
_CORNERS_IN_FIELD = 3
_TILTED_RAD = math.radians(15.0)
_SCALES = 1.3
_FOCAL_GUESS = 1.1  # focal length by the picture's width, of a common camera: good enough to tell a tilt
_NEW_PLACE = 0.06  # of the picture's width
_NEW_TILT_RAD = math.radians(8.0)
_TILT_MOVES = 0.01  # of the width, what a new tilt moves the corners by at least
_FIELD_NAMES = (("far left", "left", "right", "far right"), ("top", "middle", "bottom"))
_TOLD_FIELDS = 3
_EDGES = ("left", "right", "top", "bottom")


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The corners of a board that one picture shows: their numbers (n,) and places (n, 2) in pixels."""

    name: str
    numbers: NDArray[np.int64]
    pixels: Floats

    def moved_px(self, other: View) -> float:
        """How far the corners that both show lie apart on average; infinite where they share none."""
        _, here, there = np.intersect1d(self.numbers, other.numbers, return_indices=True)
        if not len(here):
            return math.inf
        return float(np.linalg.norm(self.pixels[here] - other.pixels[there], axis=1).mean())

    def keeping(self, keep: NDArray[np.bool_]) -> View:
        """The view without the corners where ``keep`` is False."""
        return View(self.name, self.numbers[keep], self.pixels[keep])


class BoardDetector:
    """Finds a board's corners to about a tenth of a pixel. ``board`` may also be one that a projector shows."""

    def __init__(self, board: cv2.aruco.CharucoBoard) -> None:
        self._detector = cv2.aruco.CharucoDetector(board)

    def find(self, luma: Plane, name: str = "") -> View | None:
        """The board in a picture (h, w); None where fewer than six corners are seen, or all on one line."""
        corners, numbers, _, _ = self._detector.detectBoard(np.ascontiguousarray(luma))
        # OpenCV gives None, or an empty array, where there is nothing
        if numbers is None or len(numbers) < FEWEST_CORNERS:  # pyright: ignore[reportUnnecessaryComparison]
            return None
        pixels = np.asarray(corners, dtype=float).reshape(-1, 2)
        if np.linalg.matrix_rank(pixels - pixels.mean(axis=0), tol=2.0) < 2:
            return None
        return View(name, np.asarray(numbers, dtype=np.int64).ravel(), pixels)


@dataclass(frozen=True, slots=True)
class Coverage:
    """What a set of views shows of picture, tilts and distances.

    Attributes:
        fields: corners seen in each field of a 4 x 3 grid over the picture, row by row.
        tilts_rad: the largest tilt with the board's left, right, top and bottom edge nearer to the camera.
        scales: the largest apparent size by the smallest.
    """

    fields: tuple[int, ...]
    tilts_rad: tuple[float, ...]
    scales: float

    @property
    def missing(self) -> tuple[str, ...]:
        """What to show the camera yet, in words."""
        across, down = _FIELD_NAMES
        bare = [
            f"{down[field // _FIELDS[0]]} {across[field % _FIELDS[0]]}"
            for field, seen in enumerate(self.fields)
            if seen < _CORNERS_IN_FIELD
        ]
        flat = [edge for edge, tilt_rad in zip(_EDGES, self.tilts_rad, strict=True) if tilt_rad < _TILTED_RAD]
        todo: list[str] = []
        if bare:
            more = f" and {len(bare) - _TOLD_FIELDS} more places" if len(bare) > _TOLD_FIELDS else ""
            todo.append(f"the board in the picture's {', '.join(bare[:_TOLD_FIELDS])}{more}")
        if flat:
            todo.append(f"the board tilted 15 to 45 degrees with its {', '.join(flat)} edge nearer")
        if self.scales < _SCALES:
            todo.append("the board nearer to the camera, and farther away")
        return tuple(todo)


@dataclass(frozen=True, slots=True)
class _Stance:
    """Where a board's face turns, to the picture's right and to its bottom, and how far away it is."""

    tilt_rad: tuple[float, float]
    distance_cm: float


class Collector:
    """Picks views that show something new, and says what is missing.

    Args:
        board: the printed board.
        image_size: (width, height) of the pictures.
    """

    def __init__(self, board: Board, image_size: tuple[int, int]) -> None:
        self.views: list[View] = []
        self._board = board
        self._size = image_size
        self._stances: list[_Stance] = []

    def offer(self, view: View) -> bool:
        """Take a view if the board stands at another place, or tilted otherwise, than in those taken."""
        stance = self._stance(view)
        if stance is None:
            return False
        for taken, other in zip(self.views, self._stances, strict=True):
            moved = view.moved_px(taken) / self._size[0]
            # far away, one picture fits two tilts: a board that has not moved is not tilted anew
            tilted = moved > _TILT_MOVES and math.dist(stance.tilt_rad, other.tilt_rad) > _NEW_TILT_RAD
            if moved < _NEW_PLACE and not tilted:
                return False
        self.views.append(view)
        self._stances.append(stance)
        return True

    def take(self, views: Iterable[View]) -> None:
        """Take views whether or not they are new."""
        for view in views:
            stance = self._stance(view)
            if stance is not None:
                self.views.append(view)
                self._stances.append(stance)

    @property
    def coverage(self) -> Coverage:
        """What the views taken so far show."""
        across, down = _FIELDS
        width, height = self._size
        pixels = np.concatenate([np.empty((0, 2)), *(view.pixels for view in self.views)])
        column = np.clip(pixels[:, 0] * across // width, 0, across - 1).astype(int)
        row = np.clip(pixels[:, 1] * down // height, 0, down - 1).astype(int)
        fields = np.bincount(row * across + column, minlength=across * down)
        right, bottom = np.array([stance.tilt_rad for stance in self._stances] or [(0.0, 0.0)]).T
        # a face that turns to the right has its left edge nearer
        tilts = tuple(float(side.max()) for side in (right, -right, bottom, -bottom))
        distances_cm = [stance.distance_cm for stance in self._stances] or [1.0]
        scales = max(distances_cm) / min(distances_cm)
        return Coverage(tuple(int(n) for n in fields), tilts, scales)

    def _stance(self, view: View) -> _Stance | None:
        """How the board stands, by a common lens; None where no such pose would look so."""
        width, height = self._size
        focal = _FOCAL_GUESS * width
        matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
        found, rvec, tvec = cv2.solvePnP(
            self._board.corners_cm[view.numbers], view.pixels, matrix, np.zeros(5), flags=cv2.SOLVEPNP_IPPE
        )
        if not found:
            return None
        right, bottom, back = np.asarray(cv2.Rodrigues(rvec)[0], dtype=float)[:, 2]
        return _Stance((math.atan2(right, -back), math.atan2(bottom, -back)), float(np.linalg.norm(tvec)))
