"""Patterns as a projector shows them: found again in their own picture, and in the light that they throw."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from shapely.geometry import Point, box

from lab.base.pinhole import Pinhole
from projector.patterns import PatternError, chessboard, crosses, fiducials
from projector.render import render


@pytest.mark.parametrize("size", [(1920, 1080), (1280, 800), (1024, 768), (854, 480), (3840, 2160)])
def test_a_detector_finds_every_corner_where_the_pattern_says(size: tuple[int, int]) -> None:
    pattern = chessboard(size)
    assert pattern.image.shape == size[::-1]
    found, numbers, _, _ = cv2.aruco.CharucoDetector(pattern.board).detectBoard(pattern.image)
    assert len(numbers) == len(pattern.corners_px) >= 80
    off = found.reshape(-1, 2) - pattern.corners_px[numbers.ravel()]
    assert np.abs(off).max() < 0.1


def test_corners_lie_between_black_and_white_pixels() -> None:
    pattern = chessboard((1920, 1080))
    for x, y in pattern.corners_px:
        assert x % 1 == y % 1 == 0.5
        left, top = int(x - 0.5), int(y - 0.5)
        around = pattern.image[top : top + 2, left : left + 2]
        assert around[0, 0] == around[1, 1] != around[0, 1] == around[1, 0]


def test_an_image_too_small_for_the_pattern_is_refused() -> None:
    with pytest.raises(PatternError, match="too small"):
        chessboard((160, 120))


def test_markers_are_lit_around_and_found_at_their_places() -> None:
    places = np.array([(-40.0, -25.0), (40.0, -25.0), (-40.0, 25.0), (40.0, 25.0), (3.3, 0.7)])
    markers = fiducials(places, 8.0)
    bounds = np.array(markers.lit.bounds)
    assert bounds == pytest.approx(
        [-40 - markers.reach_cm, -25 - markers.reach_cm, 40 + markers.reach_cm, 25 + markers.reach_cm]
    )
    for place in places:
        whole = box(*(place - markers.reach_cm), *(place + markers.reach_cm))
        black = box(*(place - 4.0), *(place + 4.0))
        assert markers.lit.intersection(whole.difference(black)).area == pytest.approx(whole.area - black.area)
        assert not markers.lit.contains(Point(place + 3.7))  # the border is black
    projector = Pinhole.looking_down((1920, 1080), height_cm=250, field_width_cm=160, tilt_rad=(0.05, -0.03))
    seen = markers.find(render(markers.lit, projector, 0.0))
    assert sorted(seen) == [0, 1, 2, 3, 4]
    for number, corners in seen.items():
        on_floor = projector.to_plane(corners, 0.0)
        assert on_floor.mean(axis=0) == pytest.approx(places[number], abs=0.02)
        assert on_floor[0] == pytest.approx(places[number] + (-4.0, 4.0), abs=0.1)  # top left first, y up


def test_a_mirrored_marker_is_none() -> None:
    projector = Pinhole.looking_down((640, 360), height_cm=250, field_width_cm=100)
    markers = fiducials([(0.0, 0.0)], 20.0)
    picture = render(markers.lit, projector, 0.0)
    assert sorted(markers.find(picture)) == [0]
    assert markers.find(np.ascontiguousarray(picture[:, ::-1])) == {}
    assert markers.find(np.zeros_like(picture)) == {}


@pytest.mark.parametrize("count", [0, 251])
def test_too_many_markers_are_refused(count: int) -> None:
    with pytest.raises(PatternError, match="from 1 to 250"):
        fiducials(np.zeros((count, 2)), 5.0)


def test_crosses_are_centred_on_their_pixels() -> None:
    image, pixels = crosses((1280, 720))
    assert len(pixels) == 5
    for x, y in pixels.astype(int):
        bar = np.flatnonzero(image[y, x - 60 : x + 61])
        assert (bar.min() + bar.max()) / 2 == 60
        post = np.flatnonzero(image[y - 60 : y + 61, x])
        assert (post.min() + post.max()) / 2 == 60
    assert pixels[4] == pytest.approx([640, 360], abs=1)
