import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole

LENS = (-0.28, 0.06, 0.001, -0.0005, 0.0)


def tilted() -> Pinhole:
    return Pinhole.looking_down(
        (1280, 720),
        height_cm=205,
        field_width_cm=165,
        centre_cm=(3.0, -2.0),
        tilt_rad=(0.03, -0.02),
        distortion=LENS,
    )


def test_a_plumb_camera_sees_by_similar_triangles():
    optics = Pinhole.looking_down((1000, 500), height_cm=200, field_width_cm=100)
    # 10 px a cm on the floor; at 50 cm height the scale grows by 200 / 150. Image v points down.
    u0, v0 = 499.5, 249.5
    assert optics.project([[0, 0, 0], [10, 5, 0], [10, 5, 50]]) == pytest.approx(
        np.array([[u0, v0], [u0 + 100, v0 - 50], [u0 + 100 * 4 / 3, v0 - 50 * 4 / 3]])
    )


def test_the_optical_centre_is_where_it_was_hung():
    assert tilted().centre_cm == pytest.approx([3.0, -2.0, 205.0])


@given(st.floats(-60, 60), st.floats(-45, 45), st.floats(0, 10))
def test_a_pixel_goes_back_to_the_point_in_its_plane(x_cm, y_cm, height_cm):
    optics = tilted()
    there = optics.project([[x_cm, y_cm, height_cm]])
    assert optics.to_plane(there, height_cm) == pytest.approx(np.array([[x_cm, y_cm]]), abs=1e-5)


def test_taking_a_raised_led_for_the_floor_displaces_it_by_r_h_over_H_minus_h():
    optics = Pinhole.looking_down((1280, 720), height_cm=200, field_width_cm=150)
    seen = optics.to_plane(optics.project([[60, 0, 7]]), 0)
    assert seen[0, 0] - 60 == pytest.approx(60 * 7 / (200 - 7))


def test_nan_pixels_stay_nan_and_nothing_gives_nothing():
    found = tilted().to_plane([[np.nan, 3], [600, 300]], 7)
    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1]).all()
    assert tilted().to_plane(np.empty((0, 2)), 7).shape == (0, 2)
    assert tilted().project(np.empty((0, 3))).shape == (0, 2)


def test_the_homography_of_a_plane_agrees_with_projection():
    optics = Pinhole.looking_down((640, 480), height_cm=250, field_width_cm=200, tilt_rad=(0.1, -0.05))
    point = optics.plane_homography(6.0) @ [12.0, -7.0, 1.0]
    assert point[:2] / point[2] == pytest.approx(optics.project([[12.0, -7.0, 6.0]])[0])


def test_json_keeps_every_digit():
    optics = tilted()
    again = Pinhole.from_dict(json.loads(json.dumps(optics.to_dict())))
    assert again.project([[1, 2, 3]]).tolist() == optics.project([[1, 2, 3]]).tolist()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"camera_matrix": [[1, 0], [0, 1]]}, "camera_matrix"),
        ({"rvec": None}, "rvec"),
        ({"tvec": [1, 2, float("nan")]}, "tvec"),
        ({"distortion": [1, 2, 3]}, "distortion"),
        ({"image_size": [1280]}, "image_size"),
        ({"image_size": [0, 720]}, "image_size"),
        ({"image_size": "big"}, "image_size"),
    ],
)
def test_a_malformed_calibration_names_the_key(change, says):
    with pytest.raises(RequestError, match=says):
        Pinhole.from_dict(tilted().to_dict() | change)


def test_no_height_no_camera():
    with pytest.raises(RequestError, match="height"):
        Pinhole.looking_down((10, 10), height_cm=0, field_width_cm=1)
