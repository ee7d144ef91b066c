import numpy as np
import pytest

from tracking.markers import CameraMotion, Marker, MarkerSettings, find_markers, link

SETTINGS = MarkerSettings(ball_px=40.0)


def _picture(matrices, chalk=(), room=110.0, tilt=0):
    """Luma and V of white balls with red matrices, and of red chalk on the floor."""
    rng = np.random.default_rng(0)
    luma, v = rng.normal(room, 8, (240, 320)), np.full((120, 160), 128.0)
    rows, columns = np.indices((240, 320))
    for x, y, width in chalk:
        line = np.abs(columns - x + 0.2 * (rows - y)) < width / 2
        luma[line], v[line[::2, ::2]] = room + 25, 195
    for x, y in matrices:
        ball = np.hypot(columns - x, rows - y) < 20
        luma[ball], v[ball[::2, ::2]] = room + 80, 128
        matrix = (np.abs(columns - x - tilt) < 9) & (np.abs(rows - y) < 9)
        luma[matrix], v[matrix[::2, ::2]] = room + 50, 170
    return luma.clip(0, 255).astype(np.uint8), v.astype(np.uint8)


def test_matrices_are_found_and_chalk_is_not():
    found = find_markers(*_picture([(80, 60), (230, 180)], chalk=[(150, 120, 6), (300, 120, 10)]), SETTINGS, most=5)
    assert len(found) == 2
    for x, y in ((80, 60), (230, 180)):
        assert min(np.hypot(marker.x_px - x, marker.y_px - y) for marker in found) < 1.0
    assert all(marker.quality > 0.9 for marker in found)


def test_chalk_that_touches_the_ball_does_not_pull_the_centre():
    # The ball leans towards the line, so that matrix and chalk nearly meet.
    (marker,) = find_markers(*_picture([(160, 120)], chalk=[(184, 120, 6)], tilt=9), SETTINGS, most=1)
    assert np.hypot(marker.x_px - 169, marker.y_px - 120) < 1.5


def test_in_a_dark_room_no_shell_is_asked_for():
    luma, v = _picture([], room=10.0)
    v[50:58, 70:78] = 190
    (marker,) = find_markers(luma, v, SETTINGS, most=3)
    assert np.hypot(marker.x_px - 147.5, marker.y_px - 107.5) < 1.0


def test_camera_motion_is_measured():
    rng = np.random.default_rng(1)
    world = np.kron(rng.integers(60, 180, (60, 70)), np.ones((8, 8))).astype(np.uint8)
    motion = CameraMotion()
    moves = [(0, 0), (8, 4), (24, 0), (20, 12), (40, 20)]
    for x, y in moves:
        found = motion.step(world[y : y + 360, x : x + 480])
        assert found == pytest.approx((-x, -y), abs=1.5)


def _seen(*places):
    return [Marker(x, y, 25.0, 1.0) for x, y in places]


def test_a_shaken_camera_does_not_mix_robots_up():
    rng = np.random.default_rng(2)
    camera = [tuple(shake) for shake in rng.uniform(-60, 60, (40, 2))]
    truth = [[(100.0 + 2 * k, 100.0), (160.0, 120.0 - k), (130.0 - k, 180.0)] for k in range(40)]
    markers = [_seen(*((x + sx, y + sy) for x, y in row)) for row, (sx, sy) in zip(truth, camera, strict=True)]
    for row in markers:
        rng.shuffle(row)
    identities = link(markers, camera, 3, SETTINGS)
    for identity in identities:
        places = [(identity[k].x_px - camera[k][0], identity[k].y_px - camera[k][1]) for k in range(40)]
        which = {min(range(3), key=lambda n: np.hypot(*np.subtract(truth[k][n], places[k]))) for k in range(40)}
        assert len(which) == 1


def test_a_robot_that_was_hidden_is_the_same_and_noise_is_none():
    markers = [_seen((100, 100), (200 + k, 150)) if not 15 <= k < 30 else _seen((100, 100)) for k in range(45)]
    markers[20] = _seen((100, 100), (300, 30))
    identities = link(markers, [(0.0, 0.0)] * 45, 3, SETTINGS)
    assert [len(identity) for identity in identities] == [45, 30, 0]
    assert set(identities[1]) == {*range(15), *range(30, 45)}
