"""Pixel to plane and back, held to 1e-6 cm, and the variance of a pixel carried into the arena."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.base.pinhole import Pinhole
from tracking.calibration import Calibration

MILD = (-0.28, 0.09, 0.001, -0.001, 0.0)
BARREL = (-0.38, 0.18, 0.002, -0.0015, -0.04)
RATIONAL = (0.9, 0.12, 0.0007, -0.0009, 0.01, 1.2, 0.35, 0.03)


def optics(distortion, tilt_rad=(0.0, 0.0)):
    return Pinhole.looking_down(
        (1280, 720), height_cm=205.0, field_width_cm=165.0, centre_cm=(3.0, -2.0), tilt_rad=tilt_rad,
        distortion=distortion,
    )  # fmt: skip


def seen_by_opencv(pinhole, points_cm):
    """Forward by OpenCV alone; the way back under test never sees it."""
    pixels, _ = cv2.projectPoints(
        np.asarray(points_cm, dtype=float).reshape(-1, 1, 3),
        pinhole.rvec, pinhole.tvec, pinhole.camera_matrix, pinhole.distortion,
    )  # fmt: skip
    return np.asarray(pixels, dtype=float).reshape(-1, 2)


def floor_grid(height_cm):
    x, y = np.meshgrid(np.linspace(-75, 75, 31), np.linspace(-42, 42, 21))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height_cm)])


@pytest.mark.parametrize("distortion", [(0.0,) * 5, MILD, BARREL, RATIONAL])
@pytest.mark.parametrize("tilt_rad", [(0.0, 0.0), (0.25, -0.3)])
@pytest.mark.parametrize("height_cm", [0.0, 7.3, 12.0])
def test_the_way_back_is_exact(distortion, tilt_rad, height_cm):
    pinhole = optics(distortion, tilt_rad)
    points = floor_grid(height_cm)
    pixels = seen_by_opencv(pinhole, points)
    assert np.allclose(pinhole.project(points), pixels, atol=1e-9)
    assert np.abs(pinhole.to_plane(pixels, height_cm) - points[:, :2]).max() < 1e-6


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-60, 60), st.floats(-40, 40), st.floats(0, 12), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3),
    st.floats(-0.35, 0.2),
)  # fmt: skip
def test_the_way_back_is_exact_anywhere(x_cm, y_cm, z_cm, tilt_x, tilt_y, k1):
    pinhole = optics((k1, 0.05, 0.001, -0.001, 0.0), (tilt_x, tilt_y))
    pixel = seen_by_opencv(pinhole, [(x_cm, y_cm, z_cm)])
    assert np.abs(pinhole.to_plane(pixel, z_cm) - (x_cm, y_cm)).max() < 1e-6


@pytest.mark.parametrize(("distortion", "tilt_rad"), [(MILD, (0.0, 0.0)), (BARREL, (0.25, -0.3))])
def test_pixel_variance_becomes_arena_covariance(distortion, tilt_rad):
    calibration = Calibration(optics(distortion, tilt_rad), 7.3)
    rng = np.random.default_rng(4)
    sigma_px = np.array([0.4, 0.15])
    for x_cm, y_cm in ((0.0, 0.0), (55.0, 38.0), (-58.0, 20.0)):
        pixel = seen_by_opencv(calibration.optics, [(x_cm, y_cm, 7.3)])[0]
        drawn = calibration.to_arena(pixel + sigma_px * rng.standard_normal((40_000, 2)))
        jacobian = calibration.cm_per_px([pixel])[0]
        stated = jacobian @ np.diag(sigma_px**2) @ jacobian.T
        assert np.cov(drawn.T) == pytest.approx(stated, rel=0.04, abs=0.02 * np.trace(stated))
        assert np.linalg.norm(drawn.mean(axis=0) - (x_cm, y_cm)) < 0.01
