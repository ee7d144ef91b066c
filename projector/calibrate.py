"""The projector's pose and lens from where its pixels fall in the arena.

A projector is a camera run backwards: points of the arena (cm) with the pixels that light them are the views
of one pose. Points on the floor alone do not say everything: how far the lens is away trades with the focal
length, its tilt with the lens's shift. So what is known beforehand (where the lens hangs, by tape; how far it
zooms) enters as measurements with their errors, and the fit's covariance says what that costs in any plane.
Points in a second plane above the floor make the tape superfluous.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole

Floats = NDArray[np.float64]

FEWEST_POINTS = 4
_OUTLYING = 5.0  # times a point's typical error, by the median
_FINEST_PX = 0.02  # no measurement is better: keeps the weights finite on perfect data
_NOISE_BY_MEDIAN = 1.1774  # median of a distance in the plane by its deviation in one axis: √(2 ln 2)
_SAME_PLANE_CM = 0.5
_STEP = 0.01


class ProjectorFitError(RequestError):
    """The points do not make a pose; the line says why and what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class Beforehand:
    """What is known of a projector before it is measured, with one standard deviation of each.

    Attributes:
        focal_px: focal length; ``focal_std_px``.
        principal_px: where the optical axis meets the image (x, y). Lenses are shifted up or down, seldom sideways.
        centre_cm: where the lens hangs in the arena's frame (3,), by tape.
        distortion_std: of k1 and k2 around none.
    """

    focal_px: float
    focal_std_px: float
    principal_px: tuple[float, float]
    principal_std_px: tuple[float, float]
    centre_cm: tuple[float, float, float]
    centre_std_cm: float = 10.0
    distortion_std: float = 0.05

    @classmethod
    def of(cls, nominal: Pinhole, *, centre_std_cm: float = 10.0) -> Beforehand:
        """From a pose measured by hand: focal length to 15 %, lens shift to half the image's height."""
        width, height = nominal.image_size
        focal_px = float(nominal.camera_matrix[0, 0])
        x_cm, y_cm, z_cm = nominal.centre_cm.tolist()
        return cls(
            focal_px=focal_px,
            focal_std_px=0.15 * focal_px,
            principal_px=(float(nominal.camera_matrix[0, 2]), float(nominal.camera_matrix[1, 2])),
            principal_std_px=(0.02 * width, 0.5 * height),
            centre_cm=(x_cm, y_cm, z_cm),
            centre_std_cm=centre_std_cm,
        )


@dataclass(frozen=True, slots=True, eq=False)
class ProjectorFit:
    """A calibrated projector.

    Attributes:
        optics: pose and lens.
        planes_cm: heights of the planes in which it was seen.
        points: how many points were used.
        rms_px: how far they lie from their pixels.
        rms_cm: the same on the floor.
    """

    optics: Pinhole
    planes_cm: tuple[float, ...]
    points: int
    rms_px: float
    rms_cm: float
    _parameters: Floats
    _covariance: Floats

    def spread_cm(self, places_cm: ArrayLike, height_cm: float) -> Floats:
        """One standard deviation (n,) of where light meant for ``places_cm`` (n, 2) falls in z = ``height_cm``.

        Of this fit alone; what the camera's calibration is wrong by comes on top.
        """
        places = np.asarray(places_cm, dtype=float).reshape(-1, 2)
        pixels = self.optics.project(np.column_stack([places, np.full(len(places), height_cm)]))
        variances, directions = np.linalg.eigh(self._covariance)
        total = np.zeros(len(places))
        for variance, direction in zip(variances, directions.T, strict=True):
            if variance > 0:
                # a short step, since what is badly known is far from straight at its full length
                step = _STEP * np.sqrt(variance) * direction
                other = _pinhole(self._parameters + step, self.optics.image_size)
                total += ((other.to_plane(pixels, height_cm) - places) ** 2).sum(axis=1)
        return np.sqrt(total) / _STEP

    @property
    def centre_std_cm(self) -> Floats:
        """One standard deviation (3,) of where the lens hangs."""
        return np.sqrt(np.diag(self._covariance)[8:11])

    def summary(self) -> dict[str, Any]:
        """The figures for a report or a JSON object."""
        return {
            "planes_cm": list(self.planes_cm),
            "points": self.points,
            "rms_px": self.rms_px,
            "rms_mm": 10.0 * self.rms_cm,
            "focal_px": float(self.optics.camera_matrix[0, 0]),
            "centre_cm": self.optics.centre_cm.tolist(),
            "centre_std_cm": self.centre_std_cm.tolist(),
        }


def fit_projector(
    points_cm: ArrayLike,
    pixels: ArrayLike,
    image_size: tuple[int, int],
    beforehand: Beforehand,
    *,
    error_cm: float | None = None,
) -> ProjectorFit:
    """Fit pose and lens to points of the arena (n, 3) and the pixels (n, 2) that light them.

    Args:
        points_cm: on the floor, and in a second plane where there is one.
        pixels: of the projector.
        image_size: (width, height) of its image.
        beforehand: what is known without them.
        error_cm: one standard deviation of the points; None: from how they scatter.

    Raises:
        ProjectorFitError: fewer than four points, or points on one line.
    """
    points = np.asarray(points_cm, dtype=float).reshape(-1, 3)
    seen = np.asarray(pixels, dtype=float).reshape(-1, 2)
    if len(points) < FEWEST_POINTS or np.linalg.matrix_rank(points[:, :2] - points[:, :2].mean(axis=0), tol=1.0) < 2:
        raise ProjectorFitError(
            f"{len(points)} points of the projected picture were seen, and {FEWEST_POINTS} that are not on one line "
            "are needed: let the camera see more of it, in a darker room"
        )
    start = _start(points, seen, beforehand)
    cm_per_px = beforehand.centre_cm[2] / beforehand.focal_px
    noise_px = 0.5 if error_cm is None else max(error_cm / cm_per_px, _FINEST_PX)
    fitted, covariance = _solve(start, points, seen, image_size, beforehand, noise_px)
    if error_cm is None:
        far_px = _distances_px(fitted, points, seen, image_size)
        typical_px = max(float(np.median(far_px)) / _NOISE_BY_MEDIAN, _FINEST_PX)
        good = far_px <= _OUTLYING * typical_px
        points, seen = points[good], seen[good]
        fitted, covariance = _solve(fitted, points, seen, image_size, beforehand, typical_px)
    optics = _pinhole(fitted, image_size)
    far_px = _distances_px(fitted, points, seen, image_size)
    landed = np.empty((len(points), 2))
    planes_cm = _planes(points[:, 2])
    for height_cm in planes_cm:
        there = np.abs(points[:, 2] - height_cm) < _SAME_PLANE_CM
        landed[there] = optics.to_plane(seen[there], height_cm)
    off_cm = np.linalg.norm(landed - points[:, :2], axis=1)
    return ProjectorFit(
        optics=optics,
        planes_cm=planes_cm,
        points=len(points),
        rms_px=float(np.sqrt((far_px**2).mean())),
        rms_cm=float(np.sqrt((off_cm**2).mean())),
        _parameters=fitted,
        _covariance=covariance,
    )


def _planes(heights_cm: Floats) -> tuple[float, ...]:
    return tuple(float(height) for height in np.unique(np.round(heights_cm, 3)))


def _pinhole(parameters: Floats, image_size: tuple[int, int]) -> Pinhole:
    """Parameters: focal length, principal point (2), k1, k2, rotation vector (3), centre in the arena (3)."""
    focal, cx, cy, k1, k2 = parameters[:5]
    rotation = np.asarray(cv2.Rodrigues(parameters[5:8])[0], dtype=float)
    return Pinhole(
        image_size=image_size,
        camera_matrix=np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]]),
        distortion=np.array([k1, k2, 0.0, 0.0, 0.0]),
        rvec=parameters[5:8].copy(),
        tvec=-rotation @ parameters[8:11],
    )


def _start(points: Floats, seen: Floats, beforehand: Beforehand) -> Floats:
    """A first pose from the picture of the lowest plane, through the lens as it is known beforehand.

    A homography K (r1 r2 t) holds two columns of the rotation and the way to the plane (Zhang 2000).
    """
    lowest_cm = float(points[:, 2].min())
    there = np.abs(points[:, 2] - lowest_cm) < _SAME_PLANE_CM
    homography, _ = cv2.findHomography(points[there, :2], seen[there], cv2.RANSAC, 3.0)
    if homography is None:  # pyright: ignore[reportUnnecessaryComparison]
        raise ProjectorFitError("the projected picture makes no sense on the floor; calibrate the camera again")
    if np.linalg.det(homography) > 0:
        raise ProjectorFitError("the projected picture is mirrored; switch the projector's rear or mirror mode off")
    cx, cy = beforehand.principal_px
    matrix = np.array([[beforehand.focal_px, 0, cx], [0, beforehand.focal_px, cy], [0, 0, 1.0]])
    columns = np.linalg.inv(matrix) @ np.asarray(homography, dtype=float)
    columns /= (np.linalg.norm(columns[:, 0]) + np.linalg.norm(columns[:, 1])) / 2
    columns *= np.sign(columns[2, 2])  # before the lens, not behind it
    left, _, right = np.linalg.svd(np.column_stack([columns[:, :2], np.cross(columns[:, 0], columns[:, 1])]))
    rotation = left @ right
    centre = -rotation.T @ columns[:, 2] + (0.0, 0.0, lowest_cm)
    rvec = np.asarray(cv2.Rodrigues(rotation)[0], dtype=float).ravel()
    return np.concatenate([[beforehand.focal_px, cx, cy, 0.0, 0.0], rvec, centre])


def _distances_px(parameters: Floats, points: Floats, seen: Floats, image_size: tuple[int, int]) -> Floats:
    return np.linalg.norm(_pinhole(parameters, image_size).project(points) - seen, axis=1)


def _solve(
    start: Floats,
    points: Floats,
    seen: Floats,
    image_size: tuple[int, int],
    beforehand: Beforehand,
    noise_px: float,
) -> tuple[Floats, Floats]:
    """Least squares over points and prior knowledge, each by its error; parameters and their covariance."""
    known = np.array([beforehand.focal_px, *beforehand.principal_px, 0.0, 0.0, *beforehand.centre_cm])
    errors = np.array(
        [
            beforehand.focal_std_px,
            *beforehand.principal_std_px,
            *(2 * [beforehand.distortion_std]),
            *(3 * [beforehand.centre_std_cm]),
        ]
    )
    told = np.array([0, 1, 2, 3, 4, 8, 9, 10])

    def residuals(parameters: Floats) -> Floats:
        off_px = _pinhole(parameters, image_size).project(points) - seen
        return np.concatenate([off_px.ravel() / noise_px, (parameters[told] - known) / errors])

    scale = np.array([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1])
    found = least_squares(
        lambda x: residuals(x * scale), start / scale, method="lm", x_scale="jac", xtol=1e-12, ftol=1e-12
    )
    jacobian = np.asarray(found.jac, dtype=float)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * np.outer(scale, scale)
    return np.asarray(found.x, dtype=float) * scale, covariance
