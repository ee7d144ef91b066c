"""Several robots in drawn films: told apart by colour, blink and motion, each followed as finely as one."""

import numpy as np
import pytest

from lab.base.colours import LED_COLOURS, led_yuv
from lab.base.errors import RequestError
from tests.tracking.test_track import CALIBRATION, OPTICS, film, roll, square_light, truth_px
from tracking.identity import LedMark
from tracking.synthetic import CameraSettings, OverheadScene, RobotView
from tracking.table import CM_COLUMNS, PIXEL_COLUMNS
from tracking.track import track_segments, track_video

SQUARE_CM = 14.0
TIMES_S = np.arange(120) / 30.0


def draw(paths, levels, colours, *, hidden=(), seed=1):
    """Frames of robots with LEDs of some colours; ``hidden``: (robot, first, last frame) of a dark LED."""
    scene = OverheadScene(OPTICS, square_light, np.random.default_rng(seed), CameraSettings())
    pictures = []
    for frame in range(len(paths[0])):
        views = []
        for robot, (path, level, colour) in enumerate(zip(paths, levels, colours, strict=True)):
            luma, u, v = led_yuv(LED_COLOURS[colour])
            x, y, vx, vy = path[frame]
            dark = any(robot == who and first <= frame <= last for who, first, last in hidden)
            shine = 0.0 if dark else level[frame] * luma
            views.append(RobotView(x, y, shine, vx, vy, led_uv=(u / luma, v / luma)))
        pictures.append(scene.render(views))
    return pictures


def inside(path):
    return np.where((np.abs(path[:, :2]) < SQUARE_CM).all(axis=1), 1.0, 0.25)


def of_robot(track, robot):
    return track[track["robot"] == robot].reset_index(drop=True)


def error_px(mine, path):
    return np.hypot(*(mine[["x_px", "y_px"]].to_numpy() - truth_px(path)).T)


def assert_is(mine, path, *, seen=0.95):
    """Every sighting is this robot's, and the smoothed path is within a millimetre."""
    error = error_px(mine, path)
    assert np.isfinite(error).mean() >= seen
    assert np.nanmax(error) < 5.0  # a ball is 50 px across: never the other one
    assert np.sqrt(np.nanmean(error**2)) < 0.6
    off_cm = mine[["x_smooth_cm", "y_smooth_cm"]].to_numpy() - path[:, :2]
    assert np.sqrt(np.mean(np.sum(off_cm**2, axis=1))) < 0.1


def bouncing():
    """Two robots that run into each other in the middle and roll back, and a third that passes behind them."""
    gap = 3.65 * 1.02
    left = roll(TIMES_S, (-30.0 - gap, 0.0), np.array([15.0, 0.0]), 2.0, np.array([-13.0, 6.0]))
    right = roll(TIMES_S, (30.0 + gap, 0.0), np.array([-15.0, 0.0]), 2.0, np.array([13.0, -6.0]))
    third = roll(TIMES_S, (-20.0, 16.0), np.array([10.0, -1.0]))
    return [left, right, third]


PALETTES = [("red", "green", "blue"), ("yellow", "magenta", "cyan"), ("orange", "red", "violet")]


@pytest.fixture(scope="module")
def contact(tmp_path_factory):
    paths = bouncing()
    folder = tmp_path_factory.mktemp("contact")
    levels = [inside(path) for path in paths]
    return paths, levels, {
        colours: film(folder / f"{'-'.join(colours)}.mkv", draw(paths, levels, colours), TIMES_S)
        for colours in [*PALETTES, ("red", "red", "red")]
    }  # fmt: skip


@pytest.mark.parametrize("colours", PALETTES)
def test_colours_are_kept_apart_through_a_contact(contact, colours):
    paths, levels, films = contact
    # Asked for in another order than they are drawn in: names decide, not places.
    order = [2, 0, 1]
    track = track_video(films[colours], robots=3, calibration=CALIBRATION, leds=[LedMark(colours[k]) for k in order])
    columns = [*PIXEL_COLUMNS, *CM_COLUMNS]
    columns.insert(1, "robot")
    columns.insert(columns.index("quality") + 1, "identity")
    assert list(track.columns) == columns
    assert track["frame"].tolist() == [frame for frame in range(120) for _ in range(3)]
    assert track["robot"].tolist() == [0, 1, 2] * 120
    for robot, k in enumerate(order):
        mine = of_robot(track, robot)
        assert_is(mine, paths[k])
        assert (mine["led_on"] == (levels[k] == 1.0)).mean() > 0.95
        assert mine.loc[mine["x_px"].notna(), "identity"].min() > 0.95  # orange is near red
        assert (mine.loc[mine["x_px"].isna(), "identity"] == 0.0).all()


def test_colours_need_not_be_named(contact):
    paths, _, films = contact
    track = track_video(films["red", "green", "blue"], robots=3, calibration=CALIBRATION)
    whose = [int(np.argmin([np.nanmedian(error_px(of_robot(track, n), path)) for path in paths])) for n in range(3)]
    assert whose[0] == 2  # the first sighting nearest to the picture's top
    assert sorted(whose) == [0, 1, 2]
    for robot, k in enumerate(whose):
        assert_is(of_robot(track, robot), paths[k])


def test_equal_robots_are_told_by_their_motion(contact):
    paths, _, films = contact
    track = track_video(films["red", "red", "red"], robots=3, calibration=CALIBRATION)
    whose = [int(np.argmin([np.nanmedian(error_px(of_robot(track, n), path)) for path in paths])) for n in range(3)]
    assert sorted(whose) == [0, 1, 2]
    for robot, k in enumerate(whose):
        assert_is(of_robot(track, robot), paths[k])


def test_an_led_dark_for_seconds_comes_back_as_its_own(tmp_path):
    """While the red one is dark the green one rolls past where it was last seen."""
    red = roll(TIMES_S, (-20.0, -4.0), np.array([9.0, 1.0]))
    green = roll(TIMES_S, (8.0, 6.0), np.array([-7.0, -1.0]))
    paths = [red, green]
    video = film(
        tmp_path / "dark.mkv", draw(paths, [np.ones(120)] * 2, ("red", "green"), hidden=[(0, 30, 95)]), TIMES_S
    )
    track = track_video(video, robots=2, calibration=CALIBRATION, leds=[LedMark("red"), LedMark("green")])
    mine = of_robot(track, 0)
    assert mine.loc[32:93, "x_px"].isna().all()
    assert not mine.loc[32:93, "led_on"].any()
    assert np.nanmax(error_px(mine, red)) < 5.0
    assert mine["x_px"].notna().sum() >= 50
    assert_is(of_robot(track, 1), green)


def test_equal_robots_that_vanish_together_are_not_said_to_be_sure(tmp_path, caplog):
    """Both go dark as they meet and come back: who is who is a guess, and the table says so."""
    one = roll(TIMES_S, (-10.0, 8.0), np.array([5.0, 0.0]))
    two = roll(TIMES_S, (10.0, -2.0), np.array([-5.0, 0.0]))
    pictures = draw([one, two], [np.ones(120)] * 2, ("red", "red"), hidden=[(0, 45, 75), (1, 45, 75)])
    track = track_video(film(tmp_path / "vanish.mkv", pictures, TIMES_S), robots=2, calibration=CALIBRATION)
    after, before = track[track["frame"] > 80], track[track["frame"] < 40]
    assert before["identity"].min() > 0.99
    assert after["identity"].max() < before["identity"].min()
    lit = draw([one, two], [np.ones(120)] * 2, ("red", "blue"), hidden=[(0, 45, 75), (1, 45, 75)])
    track = track_video(film(tmp_path / "told.mkv", lit, TIMES_S), robots=2, calibration=CALIBRATION)
    assert track.loc[track["x_px"].notna(), "identity"].min() > 0.99


def test_a_blink_tells_robots_of_one_colour_apart(tmp_path):
    """They go dark together in the middle and change sides meanwhile: only the blink can say who is who."""
    times = np.arange(240) / 30.0
    one = roll(times, (-18.0, 5.0), np.array([4.5, 0.0]))
    two = roll(times, (18.0, -3.0), np.array([-4.5, 0.0]))
    blinks = [np.where((times / period) % 1.0 < 0.5, 1.0, 0.25) for period in (0.5, 0.8)]
    pictures = draw([one, two], blinks, ("red", "red"), hidden=[(0, 100, 140), (1, 100, 140)])
    video = film(tmp_path / "blink.mkv", pictures, times)
    marks = [LedMark("red", blink_s=0.8), LedMark("red", blink_s=0.5)]
    track = track_video(video, robots=2, calibration=CALIBRATION, leds=marks)
    for robot, path in enumerate((two, one)):
        error = error_px(of_robot(track, robot), path)
        assert np.isfinite(error).sum() > 180
        assert np.nanmax(error) < 5.0


def test_slices_of_one_film_are_followed_as_one(tmp_path):
    """Cut in two, the second part with a clock of its own: who is who carries over, and rows count anew."""
    paths = bouncing()
    pictures = draw(paths, [inside(path) for path in paths], ("red", "green", "blue"))
    parts = {7: film(tmp_path / "a.mkv", pictures[:50], TIMES_S[:50]), 3: film(tmp_path / "b.mkv", pictures[50:])}
    leds = [LedMark(colour) for colour in ("red", "green", "blue")]
    track = track_segments(parts, CALIBRATION, robots=3, leds=leds)
    assert track["line"].tolist() == [7] * 150 + [3] * 210
    second = track[track["line"] == 3]
    assert second["frame"].tolist() == [frame for frame in range(70) for _ in range(3)]
    assert second["t_s"].iloc[0] == pytest.approx(0.0, abs=1e-3)
    for robot, path in enumerate(paths):
        assert_is(of_robot(track, robot), path)
    empty = track_segments([], CALIBRATION, robots=3)
    assert empty.columns.tolist() == track.columns.tolist()


def test_bad_marks_are_named(contact):
    video = contact[2]["red", "red", "red"]
    with pytest.raises(RequestError, match="2 LED marks for 3 robots"):
        track_video(video, robots=3, leds=[LedMark("red"), LedMark("blue")])
    with pytest.raises(RequestError, match="mauve"):
        LedMark("mauve")
    with pytest.raises(RequestError, match="period above 0"):
        LedMark(blink_s=0.0)


def test_a_film_without_a_ball_is_named(tmp_path):
    scene = OverheadScene(OPTICS, square_light, np.random.default_rng(1), CameraSettings())
    video = film(tmp_path / "none.mkv", [scene.render() for _ in range(20)])
    with pytest.raises(RequestError, match="nothing round"):
        track_video(video, balls=True)


def test_balls_are_followed_with_their_leds_off(tmp_path):
    """White balls on a dark floor, two of which touch."""
    paths = bouncing()
    scene = OverheadScene(
        OPTICS, lambda x, y, h: np.full(np.shape(x), 30.0 + 90.0 * (h > 0)), np.random.default_rng(3), CameraSettings()
    )
    pictures = [scene.render([RobotView(*path[frame][:2], 0.0) for path in paths]) for frame in range(120)]
    track = track_video(film(tmp_path / "balls.mkv", pictures, TIMES_S), robots=3, balls=True)
    assert not track["led_on"].any()
    for robot in range(3):
        mine = of_robot(track, robot)
        middles = [OPTICS.project(np.column_stack([path[:, :2], np.full(120, 3.65)])) for path in paths]
        errors = [np.hypot(*(mine[["x_px", "y_px"]].to_numpy() - middle).T) for middle in middles]
        best = min(errors, key=np.nanmedian)
        assert np.nanmedian(best) < 2.0
        assert np.isfinite(best).mean() > 0.9
        assert np.nanmax(best) < 25.0
