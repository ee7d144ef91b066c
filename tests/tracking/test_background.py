from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lab.base.errors import RequestError
from tracking.background import background_from, background_of, temporal_median


@dataclass
class Sample:
    luma: np.ndarray
    red: np.ndarray | None = None

    def chroma(self):
        return None if self.red is None else (np.full_like(self.red, 128), self.red)


def _scene(rng, lamp=None, shift=0, size=(120, 200), red=True, level=1.0):
    """A textured floor with noise, and a lamp that is red."""
    texture = np.random.default_rng(0).normal(0, 25, (size[0] // 8, size[1] // 8 + 20)).astype(np.float32)
    floor = 90 + cv2.resize(texture, (size[1] + 160, size[0]))[:, shift : shift + size[1]]
    plane = np.full((size[0] // 2, size[1] // 2), 128.0)
    if lamp is not None:
        rows, columns = np.indices(size)
        spot = np.exp(-((columns - lamp[0]) ** 2 + (rows - lamp[1]) ** 2) / 18.0)
        floor = floor + level * 100 * spot
        plane = plane + level * 60 * spot[::2, ::2]
    luma = np.clip(np.rint(floor + rng.normal(0, 1.5, size)), 0, 255).astype(np.uint8)
    v = np.clip(np.rint(plane + rng.normal(0, 0.7, plane.shape)), 0, 255).astype(np.uint8)
    return Sample(luma, v if red else None)


@given(hnp.arrays(np.uint8, st.tuples(st.sampled_from([1, 3, 5, 7]), st.integers(1, 130), st.integers(1, 6))))
def test_median_is_numpys(stack):
    assert np.array_equal(temporal_median(list(stack)), np.median(stack, axis=0).astype(np.uint8))


def test_a_moving_lamp_leaves_no_trace():
    rng = np.random.default_rng(1)
    floor = background_from([_scene(rng, (20 + 11 * k, 60)) for k in range(15)])
    empty = _scene(rng)
    assert np.abs(floor.luma.astype(int) - empty.luma).max() < 10
    assert floor.is_static
    assert floor.hue_rad == pytest.approx(np.pi / 2, abs=0.1)  # V alone
    assert floor.noise == pytest.approx(1.5, rel=0.3)


def test_a_lamp_that_rests_most_of_the_time_does_not_melt_into_the_floor():
    rng = np.random.default_rng(2)
    places = [(20, 60), (50, 60), (80, 60), (110, 60)] + [(140, 60)] * 11
    floor = background_from([_scene(rng, place) for place in places])
    assert abs(int(floor.luma[60, 140]) - int(_scene(rng).luma[60, 140])) < 10


def test_a_moving_camera_is_noticed():
    rng = np.random.default_rng(3)
    assert not background_from([_scene(rng, shift=8 * k) for k in range(12)]).is_static


def test_without_a_red_lamp_colour_is_not_relied_on():
    rng = np.random.default_rng(4)
    assert np.isnan(background_from([_scene(rng) for _ in range(9)]).hue_rad)
    grey = background_from([_scene(rng, (20 + 11 * k, 60), red=False) for k in range(9)])
    assert np.isnan(grey.hue_rad)
    assert grey.chroma is None


@pytest.mark.parametrize("red", [True, False])
def test_a_lamp_that_rests_and_blinks_does_not_melt_into_the_floor(red):
    # Blinking makes each sample another one: that nothing moved cannot tell the resting ones apart.
    rng = np.random.default_rng(6)
    frames = [_scene(rng, (140, 60), red=red, level=1.0 if k % 3 else 0.6) for k in range(12)]
    frames += [_scene(rng, place, red=red) for place in ((30, 60), (50, 30), (80, 90))]
    floor = background_from(frames)
    empty = _scene(rng).luma.astype(int)
    assert np.abs(floor.luma.astype(int) - empty).max() < 12
    if red:
        assert np.abs(floor.chroma[1].astype(int) - 128).max() <= 4


def test_what_a_ball_hides_now_and_then_stays_on_the_floor():
    # A small lit spot of the projected shape, which a dark ball with an LED beside it covers in a few samples.
    rng = np.random.default_rng(7)
    rows, columns = np.indices((120, 200))
    shape = 90.0 * np.exp(-((columns - 120) ** 2 + (rows - 60) ** 2) / 18.0)
    frames = []
    for k in range(15):
        x = 20 + 11 * k
        frame = _scene(rng, (x, 60))
        ball = np.hypot(columns - x, rows - 60) < 15
        frame.luma = np.clip(frame.luma + np.where(ball, -20.0, shape), 0, 255).astype(np.uint8)
        frames.append(frame)
    floor = background_from(frames)
    assert floor.luma[60, 120] - _scene(rng).luma[60, 120].astype(int) > 70


def test_the_corner_of_a_shape_that_a_dark_ball_hides_once_stays_on_the_floor():
    # The ball's LED is off: nothing says where it is but that it hides the corner, in one sample.
    rng = np.random.default_rng(9)
    rows, columns = np.indices((120, 200))
    shape = cv2.GaussianBlur(np.where((columns > 120) & (rows > 60), 90.0, 0.0), (0, 0), 1.0)
    frames = []
    for k in range(15):
        frame = _scene(rng)
        ball = np.hypot(columns - 33 - 12 * k, rows - 66) < 15
        frame.luma = np.clip(np.where(ball, 40.0 + 0.3 * shape, frame.luma + shape), 0, 255).astype(np.uint8)
        frames.append(frame)
    floor = background_from(frames)
    expected = _scene(rng).luma + shape
    assert np.abs(floor.luma - expected)[55:75, 115:140].max() < 15


def test_light_and_unevenness_show_the_edges():
    rng = np.random.default_rng(8)
    planes = [np.clip(np.where(np.arange(200) < 100, 30, 120) + rng.normal(0, 1, (120, 200)), 0, 255) for _ in range(5)]
    floor = background_from([Sample(plane.astype(np.uint8)) for plane in planes])
    assert floor.light[60, 20] == pytest.approx(14, abs=2)
    assert floor.light[60, 180] == pytest.approx(104, abs=2)
    assert floor.uneven_at(100, 60) > 0.9
    assert floor.uneven_at(20, 60) < 0.1
    assert floor.uneven_at(-5, 500) < 0.1


def _film(path: Path, pictures, key_every=12):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "10", "preset": "ultrafast"})
        stream.width, stream.height = pictures[0].shape[1], pictures[0].shape[0]
        stream.gop_size = key_every
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(np.dstack([picture] * 3), format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_one_video_and_many_segments_give_the_same_floor(tmp_path):
    rng = np.random.default_rng(5)
    lumas = [_scene(rng, (20 + 9 * k, 60)).luma for k in range(18)]
    whole = background_of([_film(tmp_path / "whole.mkv", lumas)])
    keyed = background_of([_film(tmp_path / "keyed.mkv", lumas, key_every=1)])
    assert np.abs(keyed.luma.astype(int) - whole.luma).mean() < 3
    parts = background_of([_film(tmp_path / f"{k}.mkv", [luma]) for k, luma in enumerate(lumas)])
    assert np.abs(whole.luma.astype(int) - parts.luma).mean() < 3
    assert whole.is_static and parts.is_static


def test_bad_input_is_named(tmp_path):
    with pytest.raises(RequestError, match="at least one"):
        temporal_median([])
    with pytest.raises(RequestError, match="no videos"):
        background_of([])
    with pytest.raises(RequestError, match="one size"):
        temporal_median([np.zeros((4, 4), np.uint8), np.zeros((4, 5), np.uint8)])
    floor = background_from([_scene(np.random.default_rng(0)) for _ in range(3)])
    with pytest.raises(RequestError, match="200x120"):
        floor.check_size(np.zeros((10, 20), np.uint8), tmp_path / "v.mkv")
