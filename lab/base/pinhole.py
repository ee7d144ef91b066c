"""Pinhole optics between the arena (cm) and an image (pixels): a camera, or a projector run backwards.

Arena frame: origin at the arena's centre, x right, y up, z towards the camera. Image frame: u right,
v down. ``rvec`` and ``tvec`` take arena cm to the optical frame, as in OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lab.base.errors import RequestError

Floats = NDArray[np.float64]
_UNDISTORT_UNTIL = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-9)


@dataclass(frozen=True, slots=True, eq=False)
class Pinhole:
    """A calibrated camera or projector.

    ``image_size`` is (width, height) in pixels, ``camera_matrix`` 3x3, ``distortion`` OpenCV's order,
    ``rvec`` and ``tvec`` (3,) take arena coordinates in cm to the optical frame.
    """

    image_size: tuple[int, int]
    camera_matrix: Floats
    distortion: Floats
    rvec: Floats
    tvec: Floats

    @classmethod
    def looking_down(
        cls,
        image_size: tuple[int, int],
        *,
        height_cm: float,
        field_width_cm: float,
        centre_cm: tuple[float, float] = (0.0, 0.0),
        tilt_rad: tuple[float, float] = (0.0, 0.0),
        distortion: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0),
    ) -> Pinhole:
        """Build a device ``height_cm`` above the floor that sees ``field_width_cm`` across.

        ``tilt_rad`` turns it about the arena's x and y axes away from the plumb line.
        """
        if height_cm <= 0 or field_width_cm <= 0:
            raise RequestError("a camera or projector needs a height and a field width above 0 cm")
        width_px, height_px = image_size
        focal_px = width_px * height_cm / field_width_cm
        matrix = np.array(
            [[focal_px, 0, (width_px - 1) / 2], [0, focal_px, (height_px - 1) / 2], [0, 0, 1]], dtype=float
        )
        down = np.diag([1.0, -1.0, -1.0])
        tilt, _ = cv2.Rodrigues(np.array([tilt_rad[0], tilt_rad[1], 0.0]))
        rotation: Floats = np.asarray(tilt, dtype=float) @ down
        position = np.array([centre_cm[0], centre_cm[1], height_cm])
        rvec, _ = cv2.Rodrigues(rotation)
        return cls(
            image_size=image_size,
            camera_matrix=matrix,
            distortion=np.asarray(distortion, dtype=float).ravel(),
            rvec=np.asarray(rvec, dtype=float).ravel(),
            tvec=np.asarray(-rotation @ position, dtype=float),
        )

    @property
    def rotation(self) -> Floats:
        """The 3x3 rotation from the arena to the optical frame."""
        matrix, _ = cv2.Rodrigues(self.rvec)
        return np.asarray(matrix, dtype=float)

    @property
    def centre_cm(self) -> Floats:
        """The optical centre (3,) in the arena frame, cm."""
        return np.asarray(-self.rotation.T @ self.tvec, dtype=float)

    def project(self, points_cm: ArrayLike) -> Floats:
        """Map arena points (n, 3) in cm to pixels (n, 2), distortion included."""
        points = np.ascontiguousarray(np.asarray(points_cm, dtype=float).reshape(-1, 1, 3))
        if len(points) == 0:
            return np.empty((0, 2))
        pixels, _ = cv2.projectPoints(points, self.rvec, self.tvec, self.camera_matrix, self.distortion)
        return np.asarray(pixels, dtype=float).reshape(-1, 2)

    def to_plane(self, pixels: ArrayLike, height_cm: float) -> Floats:
        """Map pixels (n, 2) to arena cm (n, 2): undistort, then cut the ray with z = ``height_cm``.

        NaN pixels give NaN positions.
        """
        pixels_in = np.ascontiguousarray(np.asarray(pixels, dtype=float).reshape(-1, 1, 2))
        if len(pixels_in) == 0:
            return np.empty((0, 2))
        known = np.isfinite(pixels_in).all(axis=(1, 2))
        out = np.full((len(pixels_in), 2), np.nan)
        if known.any():
            flat = cv2.undistortPoints(
                pixels_in[known], self.camera_matrix, self.distortion, criteria=_UNDISTORT_UNTIL
            ).reshape(-1, 2)
            rays = np.column_stack([flat, np.ones(len(flat))]) @ self.rotation
            centre = self.centre_cm
            reach = (height_cm - centre[2]) / rays[:, 2]
            out[known] = centre[:2] + rays[:, :2] * reach[:, None]
        return out

    def plane_homography(self, height_cm: float) -> Floats:
        """The 3x3 map from arena cm (x, y, 1) in the plane z = ``height_cm`` to undistorted pixels."""
        rotation = self.rotation
        columns = np.column_stack([rotation[:, 0], rotation[:, 1], rotation[:, 2] * height_cm + self.tvec])
        return np.asarray(self.camera_matrix @ columns, dtype=float)

    def to_dict(self) -> dict[str, Any]:
        """The JSON form of calibration.json, without ``led_height_cm``."""
        return {
            "image_size": list(self.image_size),
            "camera_matrix": self.camera_matrix.tolist(),
            "distortion": self.distortion.tolist(),
            "rvec": self.rvec.tolist(),
            "tvec": self.tvec.tolist(),
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Pinhole:
        """Read the JSON form. Raises RequestError naming the key that is missing or malformed."""
        shapes: dict[str, tuple[int, ...] | None] = {
            "camera_matrix": (3, 3),
            "distortion": None,
            "rvec": (3,),
            "tvec": (3,),
        }
        arrays: dict[str, Floats] = {}
        for key, shape in shapes.items():
            try:
                array = np.asarray(data[key], dtype=float)
                array = array.ravel() if shape != (3, 3) else array
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                raise RequestError(f"calibration: `{key}` is missing or not numbers; calibrate again") from error
            if (shape is not None and array.shape != shape) or not np.isfinite(array).all():
                raise RequestError(f"calibration: `{key}` must be finite numbers of shape {shape}, got {array.shape}")
            arrays[key] = array
        if arrays["distortion"].size not in (4, 5, 8, 12, 14):
            raise RequestError("calibration: `distortion` needs 4, 5, 8, 12 or 14 numbers in OpenCV's order")
        size: Any = data.get("image_size")
        try:
            width_px, height_px = (int(value) for value in size)
        except (TypeError, ValueError, OverflowError) as error:
            raise RequestError("calibration: `image_size` must be [width, height] in pixels") from error
        if width_px <= 0 or height_px <= 0:
            raise RequestError("calibration: `image_size` must be above 0 pixels")
        return cls(image_size=(width_px, height_px), **arrays)
