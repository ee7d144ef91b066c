"""Calibration: pixels to arena cm against OpenCV's forward projection, and files that are wrong."""

import json

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from tracking.calibration import Calibration, CalibrationError, load_calibration, save_calibration

OPTICS = Pinhole.looking_down(
    (1280, 720),
    height_cm=205.0,
    field_width_cm=165.0,
    centre_cm=(3.0, -2.0),
    tilt_rad=(0.03, -0.02),
    distortion=(-0.28, 0.09, 0.001, -0.001, 0.0),
)


def seen_by_opencv(x_cm: float, y_cm: float, z_cm: float) -> np.ndarray:
    """Forward projection by OpenCV alone."""
    point = np.array([[[x_cm, y_cm, z_cm]]])
    pixels, _ = cv2.projectPoints(point, OPTICS.rvec, OPTICS.tvec, OPTICS.camera_matrix, OPTICS.distortion)
    return np.asarray(pixels).reshape(1, 2)


@given(st.floats(-58, 58), st.floats(-40, 40), st.floats(0.0, 12.0))
def test_a_pixel_of_the_led_comes_back_to_its_place(x_cm, y_cm, height_cm):
    calibration = Calibration(OPTICS, height_cm)
    back = calibration.to_arena(seen_by_opencv(x_cm, y_cm, height_cm))
    assert np.allclose(back, [[x_cm, y_cm]], atol=1e-3)


def test_taking_the_led_for_the_floor_errs_by_the_parallax():
    pixel = seen_by_opencv(50.0, 30.0, 7.3)
    on_floor = Calibration(OPTICS, 0.0).to_arena(pixel)[0]
    # Similar triangles about the camera's foot: the floor point lies further out by 7.3 / (205 - 7.3).
    expected = np.array([50.0, 30.0]) + (np.array([50.0, 30.0]) - OPTICS.centre_cm[:2]) * 7.3 / (205.0 - 7.3)
    assert np.allclose(on_floor, expected, atol=1e-3)


def test_no_pixel_no_place():
    found = Calibration(OPTICS).to_arena([[np.nan, np.nan], [640.0, 360.0]])
    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1]).all()
    assert Calibration(OPTICS).to_arena(np.empty((0, 2))).shape == (0, 2)


def test_the_jacobian_is_the_inverse_of_the_forward_one():
    calibration = Calibration(OPTICS, 7.3)
    x_cm, y_cm = 35.0, -22.0
    step_cm = 0.01
    forward = np.column_stack(
        [
            (seen_by_opencv(x_cm + step_cm, y_cm, 7.3) - seen_by_opencv(x_cm - step_cm, y_cm, 7.3))[0] / (2 * step_cm),
            (seen_by_opencv(x_cm, y_cm + step_cm, 7.3) - seen_by_opencv(x_cm, y_cm - step_cm, 7.3))[0] / (2 * step_cm),
        ]
    )
    jacobian = calibration.cm_per_px(seen_by_opencv(x_cm, y_cm, 7.3))
    assert jacobian.shape == (1, 2, 2)
    assert np.allclose(jacobian[0], np.linalg.inv(forward), rtol=1e-3, atol=1e-5)


def test_round_trip_through_the_file(tmp_path):
    path = tmp_path / "calibration.json"
    save_calibration(Calibration(OPTICS, 7.1), path)
    data = json.loads(path.read_text())
    assert set(data) == {"image_size", "camera_matrix", "distortion", "rvec", "tvec", "led_height_cm"}
    loaded = load_calibration(path)
    assert loaded.led_height_cm == 7.1
    pixels = [[100.0, 200.0], [900.0, 50.0]]
    assert np.array_equal(loaded.to_arena(pixels), Calibration(OPTICS, 7.1).to_arena(pixels))
    assert [file.name for file in tmp_path.iterdir()] == ["calibration.json"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "cannot read"),
        ("{", "not a JSON"),
        (b"\xff\xfe\x00", "not a JSON"),
        ("[1, 2]", "one JSON object"),
        ({"led_height_cm": None}, "number of cm"),
        ({"led_height_cm": "tall"}, "number of cm"),
        ({"led_height_cm": -1.0}, "between the floor"),
        ({"led_height_cm": 300.0}, "between the floor"),
        ({"led_height_cm": float("nan")}, "between the floor"),
        ({"camera_matrix": [[1, 2], [3, 4]]}, "camera_matrix"),
        ({"distortion": [0.1]}, "distortion"),
        ({"image_size": "big"}, "image_size"),
        ({"tvec": "here"}, "tvec"),
        ("no led", "led_height_cm"),
    ],
)
def test_wrong_files_are_told_in_one_line(tmp_path, text, says):
    path = tmp_path / "calibration.json"
    good = Calibration(OPTICS).to_dict()
    if text == "no led":
        del good["led_height_cm"]
        path.write_text(json.dumps(good))
    elif isinstance(text, dict):
        path.write_text(json.dumps(good | text))
    elif isinstance(text, bytes):
        path.write_bytes(text)
    elif text is not None:
        path.write_text(text)
    with pytest.raises(CalibrationError, match=says) as caught:
        load_calibration(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    assert caught.value.path == path
    assert isinstance(caught.value, RequestError)


def test_a_video_of_another_size_is_refused():
    calibration = Calibration(OPTICS)
    calibration.check_size((1280, 720))
    with pytest.raises(CalibrationError, match="1280x720 pixels but the video has 640x480"):
        calibration.check_size((640, 480))
