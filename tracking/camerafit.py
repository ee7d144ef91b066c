"""From views of a board to a calibrated camera: its lens, and its pose over the arena.

The views held in the air give the lens (Zhang's method, OpenCV). Then all are fitted together: the lens, every
held board's pose, and the camera's pose over a floor on which the board lies at the origin and, turned and
shifted, elsewhere. Boards that share a plane fix the camera's tilt far better than one small board alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from tracking.board import Board
from tracking.charuco import FEWEST_CORNERS, View

Floats = NDArray[np.float64]

FEWEST_VIEWS = 8
_LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
_WORST_RMS_PX = 1.0
_OUTLYING_VIEW = 3.0  # times the median view's error
_OUTLYING_CORNER = 5.0  # times a corner's typical error, by the median
_SIGNIFICANT = 2.0  # standard deviations
_LOOSEST_RAD = math.radians(0.25)
_NEGLIGIBLE_PX = 0.15  # no view is bad that fits this well


class CameraFitError(RequestError):
    """The views do not make a calibration. ``rms_px``: the reprojection error, where there is one."""

    def __init__(self, message: str, rms_px: float = math.nan) -> None:
        super().__init__(message)
        self.rms_px = rms_px


@dataclass(frozen=True, slots=True)
class ViewError:
    """How well one view fits: root mean square of its corners' distances in pixels; ``kept`` False: thrown out."""

    name: str
    kind: str
    corners: int
    rms_px: float
    kept: bool


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """A calibrated camera.

    Attributes:
        optics: lens, and pose over the arena.
        rms_px: reprojection error, over all corners of the views kept.
        views: each view's own.
        lens_std: one standard deviation of fx fy cx cy (pixels) and of k1 k2 p1 p2 k3.
        position_std_cm: of the optical centre (3,).
        angles_std_rad: of the orientation about the arena's axes (3,).
    """

    optics: Pinhole
    rms_px: float
    views: tuple[ViewError, ...]
    lens_std: dict[str, float]
    position_std_cm: tuple[float, ...]
    angles_std_rad: tuple[float, ...]

    def summary(self) -> dict[str, Any]:
        """The figures for a report or a JSON object."""
        matrix, distortion = self.optics.camera_matrix, self.optics.distortion
        lens = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion)
        return {
            "rms_px": self.rms_px,
            "lens": {
                name: {"value": float(value), "std": self.lens_std[name]}
                for name, value in zip(_LENS, lens, strict=True)
            },
            "position_cm": self.optics.centre_cm.tolist(),
            "position_std_cm": list(self.position_std_cm),
            "angles_std_deg": [math.degrees(angle) for angle in self.angles_std_rad],
            "views": [
                {
                    "name": view.name,
                    "kind": view.kind,
                    "corners": view.corners,
                    "rms_px": view.rms_px,
                    "kept": view.kept,
                }
                for view in self.views
            ],
        }


def fit_camera(
    board: Board, image_size: tuple[int, int], held: Sequence[View], origin: View, on_floor: Sequence[View] = ()
) -> CameraFit:
    """Calibrate from views of a board held in the air, laid at the arena's origin, and laid elsewhere on the floor.

    Raises:
        CameraFitError: too few views fit, or they fit badly; the line says what to mend.
    """
    good, lens = _fit_lens(board, image_size, held)
    held, on_floor = ([_without_strays(board, lens, view) for view in views] for views in (held, on_floor))
    origin = _without_strays(board, lens, origin)
    flying, lying = [held[i] for i in good], list(on_floor)
    while True:
        bundle = _Bundle(board, image_size, lens, flying, origin, lying)
        bundle.solve()
        worst = bundle.outlying()
        if worst is None:
            break
        if worst is origin:
            raise CameraFitError("the board at the origin does not fit: lay it flat there and do not touch it")
        # one at a time: a bad view spoils its neighbours
        flying = [view for view in flying if view is not worst]
        lying = [view for view in lying if view is not worst]
        if len(flying) < FEWEST_VIEWS:
            raise CameraFitError(_too_few(len(flying), len(held)))
    rms_px = bundle.rms_px()
    if rms_px > _WORST_RMS_PX:
        raise CameraFitError(
            f"the views fit to {rms_px:.2f} pixels only; is the board flat, and the one named by --board?", rms_px
        )
    report = _report(bundle, held, on_floor)
    loosest_rad = max(report.angles_std_rad)
    if loosest_rad > _LOOSEST_RAD:
        raise CameraFitError(
            f"the camera's tilt is known to {math.degrees(loosest_rad):.1f} degrees only: "
            "lay the board flat in the arena's corners too, or take a larger one",
            rms_px,
        )
    return report


def _too_few(good: int, shown: int) -> str:
    return (
        f"{good} of {shown} views of the held board fit, and {FEWEST_VIEWS} are needed: "
        "film it again, flat, sharp and slowly moved"
    )


def _fit_lens(board: Board, image_size: tuple[int, int], held: Sequence[View]) -> tuple[list[int], _Lens]:
    """The lens by Zhang's method from the views that agree, and which those are."""
    good = list(range(len(held)))
    while len(good) >= FEWEST_VIEWS:
        lens, errors_px = _zhang(board, image_size, [held[i] for i in good])
        worst = int(np.argmax(errors_px))
        if errors_px[worst] <= max(_OUTLYING_VIEW * float(np.median(errors_px)), _NEGLIGIBLE_PX):
            return good, lens
        del good[worst]
    raise CameraFitError(_too_few(len(good), len(held)))


@dataclass(frozen=True, slots=True, eq=False)
class _Lens:
    """fx fy cx cy k1 k2 p1 p2 k3, and which of them the views determine."""

    values: Floats
    free: NDArray[np.bool_]

    @property
    def matrix(self) -> Floats:
        """The 3x3 camera matrix."""
        fx, fy, cx, cy = self.values[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    @property
    def distortion(self) -> Floats:
        """In OpenCV's order (5,)."""
        return self.values[4:]


def _zhang(board: Board, image_size: tuple[int, int], views: Sequence[View]) -> tuple[_Lens, Floats]:
    corners = board.corners_cm.astype(np.float32)
    solid = [corners[view.numbers] for view in views]
    seen = [view.pixels.astype(np.float32) for view in views]
    free = np.ones(len(_LENS), dtype=bool)
    flags = 0
    while True:
        _, matrix, distortion, _, _, deviations, _, errors_px = cv2.calibrateCameraExtended(
            solid, seen, image_size, np.eye(3), np.zeros(5), flags=flags
        )
        k = np.asarray(distortion, dtype=float).ravel()[:5]
        values = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *k])
        # Coefficients lost in their errors do harm: k3 makes the picture's corners wild, p1 and p2 stand in for
        # the principal point, and so for the camera's tilt.
        lost = np.abs(values) < _SIGNIFICANT * np.asarray(deviations, dtype=float).ravel()[: len(_LENS)]
        fixed = (cv2.CALIB_FIX_K3 if lost[8] else 0) | (cv2.CALIB_ZERO_TANGENT_DIST if lost[6:8].all() else 0)
        if flags or not fixed:
            break
        flags = fixed
        free[8] = not lost[8]
        free[6:8] = not lost[6:8].all()
    return _Lens(values, free), np.asarray(errors_px, dtype=float).ravel()


def _pose_of(board: Board, lens: _Lens, view: View) -> Floats:
    """The pose (6,), rotation vector and translation, of a board by itself."""
    corners = board.corners_cm[view.numbers]
    _, rvec, tvec = cv2.solvePnP(corners, view.pixels, lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_IPPE)
    return np.concatenate([np.asarray(rvec, dtype=float).ravel(), np.asarray(tvec, dtype=float).ravel()])


def _without_strays(board: Board, lens: _Lens, view: View) -> View:
    """Leave out corners far off where the others say: half under a finger, or on a reflection. The worst goes first."""
    while len(view.numbers) > FEWEST_CORNERS:
        pose = _pose_of(board, lens, view)
        seen, _ = cv2.projectPoints(board.corners_cm[view.numbers], pose[:3], pose[3:], lens.matrix, lens.distortion)
        far_px = np.linalg.norm(np.asarray(seen, dtype=float).reshape(-1, 2) - view.pixels, axis=1)
        worst = int(np.argmax(far_px))
        if far_px[worst] <= max(_OUTLYING_CORNER * float(np.median(far_px)), 2.0 * _NEGLIGIBLE_PX):
            break
        view = view.keeping(np.arange(len(far_px)) != worst)
    return view


class _Bundle:
    """All views fitted together.

    Parameters: the free part of the lens, the camera's pose over the arena, (x, y, turn) of each further board
    on the floor, the pose of each held board.
    """

    def __init__(
        self,
        board: Board,
        image_size: tuple[int, int],
        lens: _Lens,
        held: Sequence[View],
        origin: View,
        on_floor: Sequence[View],
    ) -> None:
        self.free = lens.free
        self._corners = board.corners_cm
        self._size = image_size
        self._lens = lens
        self._floor = len(on_floor)
        self.views = [origin, *on_floor, *held]
        self._pose_at = int(lens.free.sum())
        camera = _pose_of(board, lens, origin)
        rotation = cv2.Rodrigues(camera[:3])[0]
        places: list[Floats] = []
        for view in on_floor:
            pose = _pose_of(board, lens, view)
            relative = np.asarray(rotation.T @ cv2.Rodrigues(pose[:3])[0], dtype=float)
            place = rotation.T @ (pose[3:] - camera[3:])
            places.append(np.array([place[0], place[1], math.atan2(relative[1, 0], relative[0, 0])]))
        self._x = np.concatenate(
            [lens.values[lens.free], camera, *places, *(_pose_of(board, lens, view) for view in held)]
        )
        self._jacobian: Floats = np.empty((0, 0))

    def solve(self) -> None:
        """Least squares from where the parameters stand."""

        def residuals(x: Floats) -> Floats:
            return self._evaluate(x)[0]

        def jacobian(x: Floats) -> Floats:
            return self._evaluate(x)[1]

        found = least_squares(residuals, self._x, jac=jacobian, method="lm", x_scale="jac", xtol=1e-9, ftol=1e-9)
        self._x = np.asarray(found.x, dtype=float)
        self._jacobian = np.asarray(found.jac, dtype=float)

    def errors_px(self) -> list[float]:
        """Each view's error, origin first, then the floor's, then the held ones'."""
        return [float(np.sqrt((part**2).sum(axis=1).mean())) for part in self._parts()]

    def rms_px(self) -> float:
        """The error over all corners."""
        return float(np.sqrt((np.concatenate(self._parts()) ** 2).sum(axis=1).mean()))

    def outlying(self) -> View | None:
        """The view that fits worst, if far worse than most."""
        errors_px = np.array(self.errors_px())
        worst = int(np.argmax(errors_px))
        bound = max(_OUTLYING_VIEW * float(np.median(errors_px)), _NEGLIGIBLE_PX)
        return self.views[worst] if errors_px[worst] > bound else None

    def camera(self, x: Floats | None = None) -> Pinhole:
        """The camera over the arena."""
        vector = self._x if x is None else x
        lens = self._lens_of(vector)
        pose = vector[self._pose_at : self._pose_at + 6]
        return Pinhole(self._size, lens.matrix, lens.distortion, pose[:3].copy(), pose[3:].copy())

    def covariance(self) -> Floats:
        """Of the free lens parameters and the camera's pose together."""
        rows, columns = self._jacobian.shape
        residuals, _ = self._evaluate(self._x)
        variance = float(residuals @ residuals) / max(1, rows - columns)
        whole = np.linalg.pinv(self._jacobian.T @ self._jacobian) * variance
        known = self._pose_at + 6
        return np.asarray(whole[:known, :known], dtype=float)

    @property
    def parameters(self) -> Floats:
        """The free lens parameters and the camera's pose."""
        return self._x[: self._pose_at + 6].copy()

    def _lens_of(self, x: Floats) -> _Lens:
        values = self._lens.values.copy()
        values[self._lens.free] = x[: self._pose_at]
        return replace(self._lens, values=values)

    def _parts(self) -> list[Floats]:
        residuals = self._evaluate(self._x)[0].reshape(-1, 2)
        ends = np.cumsum([len(view.numbers) for view in self.views])
        return np.split(residuals, ends[:-1])

    def _evaluate(self, x: Floats) -> tuple[Floats, Floats]:
        """Residuals (2n,) in pixels, and their derivatives by all parameters."""
        lens = self._lens_of(x)
        places_at = self._pose_at + 6
        held_at = places_at + 3 * self._floor
        residuals: list[Floats] = []
        rows: list[Floats] = []
        for number, view in enumerate(self.views):
            points = self._corners[view.numbers]
            on_floor = number <= self._floor
            at = self._pose_at if on_floor else held_at + 6 * (number - 1 - self._floor)
            pose = x[at : at + 6]
            turned = np.zeros_like(points)
            if on_floor and number:
                place = x[places_at + 3 * (number - 1) : places_at + 3 * number]
                cos, sin = math.cos(place[2]), math.sin(place[2])
                turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
                turned = points @ turn.T
                points = turned + np.array([place[0], place[1], 0.0])
            seen, derivatives = cv2.projectPoints(points, pose[:3], pose[3:], lens.matrix, lens.distortion)
            # OpenCV's columns: rvec, tvec, fx fy, cx cy, distortion
            by = np.asarray(derivatives, dtype=float)
            part = np.zeros((2 * len(points), len(x)))
            part[:, : self._pose_at] = by[:, 6:15][:, lens.free]
            part[:, at : at + 6] = by[:, :6]
            if on_floor and number:
                by_point = by[:, 3:6] @ np.asarray(cv2.Rodrigues(pose[:3])[0], dtype=float)
                # turning on moves a point by (−y, x), seen from the board's centre
                onward = np.repeat(np.column_stack([-turned[:, 1], turned[:, 0]]), 2, axis=0)
                column = places_at + 3 * (number - 1)
                part[:, column : column + 2] = by_point[:, :2]
                part[:, column + 2] = (by_point[:, :2] * onward).sum(axis=1)
            rows.append(part)
            residuals.append((np.asarray(seen, dtype=float).reshape(-1, 2) - view.pixels).ravel())
        return np.concatenate(residuals), np.concatenate(rows)


def _report(bundle: _Bundle, held: Sequence[View], on_floor: Sequence[View]) -> CameraFit:
    """The fit with its standard deviations, carried to the arena's frame."""
    optics = bundle.camera()
    covariance = bundle.covariance()
    known = bundle.parameters
    step = np.sqrt(np.maximum(np.diag(covariance), 1e-18))

    def shown(x: Floats) -> Floats:
        moved = bundle.camera(x)
        turn, _ = cv2.Rodrigues(optics.rotation.T @ moved.rotation)
        return np.concatenate([moved.centre_cm - optics.centre_cm, np.asarray(turn, dtype=float).ravel()])

    slopes = np.column_stack([(shown(known + move) - shown(known - move)) / 2 for move in np.diag(step)]) / step
    spread = np.sqrt(np.diag(slopes @ covariance @ slopes.T))
    deviations = np.zeros(len(_LENS))
    deviations[bundle.free] = step[: int(bundle.free.sum())]
    names = {view.name: error for view, error in zip(bundle.views, bundle.errors_px(), strict=True)}
    told: list[ViewError] = []
    for kind, views in (("origin", bundle.views[:1]), ("floor", on_floor), ("held", held)):
        for view in views:
            error = names.get(view.name)
            told.append(
                ViewError(view.name, kind, len(view.numbers), math.nan if error is None else error, error is not None)
            )
    return CameraFit(
        optics=optics,
        rms_px=bundle.rms_px(),
        views=tuple(told),
        lens_std=dict(zip(_LENS, deviations.tolist(), strict=True)),
        position_std_cm=tuple(spread[:3].tolist()),
        angles_std_rad=tuple(spread[3:].tolist()),
    )
