"""The tracker on pictures drawn from a known truth, encoded as the lab encodes them."""

from fractions import Fraction

import av
import cv2
import numpy as np
import pandas as pd
import pytest

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from tracking.calibration import Calibration, CalibrationError
from tracking.overlay import draw_frame, write_preview
from tracking.synthetic import CameraSettings, OverheadScene, RobotView
from tracking.table import CM_COLUMNS, PIXEL_COLUMNS
from tracking.track import track_segments, track_video
from tracking.video import VideoError, read_frames

SIZE = (640, 360)
OPTICS = Pinhole.looking_down(
    SIZE, height_cm=205.0, field_width_cm=92.0, distortion=(-0.04, 0, 0, 0, 0), tilt_rad=(0.02, -0.01)
)
CALIBRATION = Calibration(OPTICS, 7.3)
SQUARE_CM = 14.0


def square_light(x_cm, y_cm, height_cm):
    """A lit square of half side 14 cm from a projector 250 cm up: 20 lux dark, 120 lux lit."""
    spread = 250.0 / (250.0 - height_cm)
    inside = [1 / (1 + np.exp(np.clip((np.abs(v * spread) - SQUARE_CM) / 0.08, -60, 60))) for v in (x_cm, y_cm)]
    return 20.0 + 100.0 * inside[0] * inside[1]


def film(path, pictures, times_s=None, *, rate=30):
    """Encode packed I420 pictures with time stamps to the millisecond, as the recorder's settings do."""
    rows, width = pictures[0].shape
    with av.open(str(path), "w") as container:
        options = {"preset": "ultrafast", "tune": "zerolatency", "crf": "20"}
        stream = container.add_stream("libx264", rate=rate, options=options)
        stream.width, stream.height, stream.pix_fmt = width, rows * 2 // 3, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="yuv420p")
            frame.time_base = Fraction(1, 1000)
            frame.pts = round(1000 * (times_s[number] if times_s is not None else number / rate))
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def roll(times_s, start, velocity, turn_s=99.0, velocity_after=(0.0, 0.0)):
    """(n, 4) x, y, vx, vy in cm and cm/s: straight, and from ``turn_s`` on straight another way."""
    before, after = np.minimum(times_s, turn_s)[:, None], np.maximum(times_s - turn_s, 0.0)[:, None]
    velocities = np.where(times_s[:, None] < turn_s, velocity, velocity_after)
    return np.hstack([np.asarray(start) + before * velocity + after * velocity_after, velocities])


def draw(path_cm, levels, seed=1, **settings):
    scene = OverheadScene(OPTICS, square_light, np.random.default_rng(seed), CameraSettings(**settings))
    return [
        scene.render([] if level is None else [RobotView(x, y, level, vx, vy)])
        for (x, y, vx, vy), level in zip(path_cm, levels, strict=True)
    ]


def inside_levels(path_cm, bright=1.0, dim=0.25):
    return np.where((np.abs(path_cm[:, :2]) < SQUARE_CM).all(axis=1), bright, dim)


def truth_px(path_cm):
    return OPTICS.project(np.column_stack([path_cm[:, :2], np.full(len(path_cm), 7.3)]))


def error_px(track, path_cm):
    return np.hypot(*(track[["x_px", "y_px"]].to_numpy() - truth_px(path_cm)).T)


@pytest.fixture(scope="module")
def bounce(tmp_path_factory):
    """A robot that crosses the square, bounces and comes back; some frames dropped, one shown twice."""
    times = np.arange(110) / 30.0
    times = np.delete(times, [12, 13, 40, 71])
    path = roll(times, (-32.0, -6.0), np.array([22.0, 5.0]), 2.75, np.array([-20.0, 9.0]))
    levels = inside_levels(path)
    pictures = draw(path, levels)
    pictures[30] = pictures[29]
    video = film(tmp_path_factory.mktemp("bounce") / "run.mkv", pictures, times)
    return video, times, path, levels, track_video(video, calibration=CALIBRATION)


def test_one_row_a_frame_with_its_own_time(bounce):
    _, times, _, _, track = bounce
    assert list(track.columns) == [*PIXEL_COLUMNS, *CM_COLUMNS]
    assert (track["frame"] == np.arange(len(times))).all()
    assert np.allclose(track["t_s"], times, atol=6e-4)
    assert track["led_on"].dtype == bool


def test_positions_agree_with_the_truth(bounce):
    _, _, path, _, track = bounce
    fresh = np.arange(len(path)) != 30
    error = error_px(track, path)[fresh]
    assert np.isfinite(error).all()
    assert np.sqrt(np.mean(error**2)) < 0.35
    assert error.max() < 1.5
    smooth = track[["x_smooth_cm", "y_smooth_cm"]].to_numpy() - path[:, :2]
    assert np.sqrt(np.mean(smooth[fresh] ** 2)) < 0.04
    assert np.mean((smooth[fresh, 0] / track["sigma_x_cm"][fresh]) ** 2) < 4.0


def test_speed_is_right_in_spite_of_dropped_frames(bounce):
    _, times, path, _, track = bounce
    steady = (np.abs(times - 2.75) > 0.3) & (times > 0.2) & (times < times[-1] - 0.2)
    for axis, name in ((2, "vx_cm_s"), (3, "vy_cm_s")):
        assert np.abs(track[name] - path[:, axis])[steady].median() < 0.6
        assert np.abs(track[name] - path[:, axis])[steady].max() < 3.0


def test_led_state_tells_inside_from_outside(bounce):
    _, _, _, levels, track = bounce
    wrong = np.flatnonzero(track["led_on"].to_numpy() != (levels > 0.5))
    assert set(wrong) <= {30}


def test_preview_shows_the_track(bounce, tmp_path):
    video, times, _, _, track = bounce
    preview = write_preview(video, track, tmp_path / "preview.mp4")
    with read_frames(preview) as drawn, read_frames(video) as plain:
        shown = list(drawn)
        first = next(plain)
    assert len(shown) == len(times)
    x, y = track.loc[0, ["x_px", "y_px"]].astype(float)
    ring = draw_frame(first, track).astype(int) - first.decoded.to_ndarray(format="bgr24")
    rows, columns = np.nonzero(np.abs(ring).sum(axis=2))
    assert abs(columns.mean() - x) < 1.0 and abs(rows.mean() - y) < 1.0
    with pytest.raises(RequestError, match="led_on"):
        write_preview(video, track.drop(columns="led_on"), tmp_path / "p.mp4")
    with pytest.raises(RequestError, match="goes on to frame"):
        write_preview(video, pd.concat([track, track.assign(frame=track["frame"] + 500)]), tmp_path / "p.mp4")
    with pytest.raises(RequestError, match="cannot write"):
        write_preview(video, track, tmp_path / "no" / "p.mp4")
    with pytest.raises(RequestError, match="cannot write"):
        write_preview(video, track, tmp_path / "preview.nonsense")


def test_a_dark_led_is_awaited_and_glints_are_not_taken_for_it(tmp_path):
    times = np.arange(100) / 30.0
    path = roll(times, (-30.0, 8.0), np.array([18.0, -2.0]))
    levels = np.where((np.arange(100) // 20) % 2, 0.0, 1.0)
    pictures = draw(path, levels)
    for number in (10, 25, 26, 47, 70, 71):
        # A flash as bright as the LED, far from it.
        at = (560, 80) if number % 2 else (90, 300)
        cv2.circle(pictures[number][:360], at, 5, 230, -1)
        v = pictures[number].reshape(-1)[-(320 * 180) // 2 :].reshape(180, 160)
        v[:] = v  # the flash is white: it leaves the colour planes alone
    track = track_video(film(tmp_path / "blink.mkv", pictures, times), calibration=CALIBRATION)
    seen = track["x_px"].notna().to_numpy()
    assert np.array_equal(seen, levels > 0)
    assert np.array_equal(track["led_on"], levels > 0)
    assert error_px(track, path)[seen].max() < 2.0
    assert (track["quality"] > 0).to_numpy().tolist() == seen.tolist()
    within = slice(0, np.flatnonzero(seen)[-1] + 1)
    gap_error = np.hypot(*(track[["x_smooth_cm", "y_smooth_cm"]].to_numpy() - path[:, :2])[within].T)
    assert gap_error.max() < 0.5


def _grey(pictures):
    out = [picture.copy() for picture in pictures]
    for picture in out:
        picture[picture.shape[0] * 2 // 3 :] = 128
    return out


def test_without_colour_luma_alone_will_do(tmp_path):
    times = np.arange(90) / 30.0
    path = roll(times, (-30.0, -6.0), np.array([20.0, 4.0]))
    levels = inside_levels(path)
    pictures = _grey(draw(path, levels))
    for number in (20, 50):
        cv2.circle(pictures[number][:360], (560, 320), 5, 230, -1)
    track = track_video(film(tmp_path / "grey.mkv", pictures, times))
    assert list(track.columns) == list(PIXEL_COLUMNS)
    error = error_px(track, path)
    # With nothing but luma the projected edge under the ball still pulls: the frames around it are worse.
    assert np.nanmedian(error) < 0.3
    assert np.nanmax(error) < 6.0
    assert np.isfinite(error).mean() > 0.95
    assert (track["led_on"] != (levels > 0.5)).mean() < 0.03


def test_a_lost_robot_is_found_again_and_a_brief_flash_is_not_it(tmp_path):
    times = np.arange(120) / 30.0
    path = roll(times, (-30.0, 8.0), np.array([14.0, -2.0]))
    levels = [None if 40 <= number < 80 else 1.0 for number in range(120)]
    pictures = _grey(draw(path, levels))
    for number in (60, 61):
        rows, columns = np.indices((360, 640))
        spot = 120 * np.exp(-((columns - 300) ** 2 + (rows - 300) ** 2) / 18.0)
        pictures[number][:360] = np.clip(pictures[number][:360] + spot, 0, 255)
    track = track_video(film(tmp_path / "lost.mkv", pictures, times))
    seen = track["x_px"].notna().to_numpy()
    assert not seen[40:80].any()
    assert seen[:40].all() and seen[80:].all()
    assert error_px(track, path)[seen].max() < 1.5


def test_an_empty_arena_holds_no_ghosts(tmp_path, caplog):
    pictures = draw(np.zeros((40, 4)), [None] * 40)
    track = track_video(film(tmp_path / "empty.mkv", pictures), calibration=CALIBRATION)
    assert len(track) == 40
    assert track[["x_px", "x_cm", "x_smooth_cm"]].isna().all().all()
    assert not track["led_on"].any()
    assert "never seen" in caplog.text


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Four segments of one session; the first two miss the square."""
    folder = tmp_path_factory.mktemp("session")
    times = np.arange(45) / 30.0
    starts = [
        ((-34.0, 17.5), (22.0, 0.0)),
        ((34.0, -17.5), (-22.0, 0.0)),
        ((-32.0, 0.0), (21.0, 3.0)),
        ((0.0, -19.0), (3.0, 22.0)),
    ]
    scene = OverheadScene(OPTICS, square_light, np.random.default_rng(9), CameraSettings())
    paths, files = {}, {}
    for line, (start, velocity) in zip((3, 4, 8, 9), starts, strict=True):
        paths[line] = roll(times, start, np.array(velocity))
        levels = inside_levels(paths[line])
        pictures = [
            scene.render([RobotView(x, y, level, vx, vy)])
            for (x, y, vx, vy), level in zip(paths[line], levels, strict=True)
        ]
        files[line] = film(folder / f"{line}.mkv", pictures, times)
    return files, paths


def test_segments_share_background_and_led_levels(session):
    files, paths = session
    done = []
    track = track_segments(files, CALIBRATION, workers=1, progress=lambda n, total: done.append((n, total)))
    assert done == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert track.columns[0] == "line"
    assert track.groupby("line").size().to_dict() == dict.fromkeys((3, 4, 8, 9), 45)
    for line, part in track.groupby("line"):
        assert error_px(part, paths[line]).max() < 1.5
        # A line that misses the square shows one level; that it is the dim one the other lines tell.
        assert np.array_equal(part["led_on"], inside_levels(paths[line]) > 0.5)
    assert not track[track["line"] == 3]["led_on"].any()


def test_workers_give_the_same_track(session):
    files, _ = session
    alone = track_segments(list(files.values()), CALIBRATION, workers=1)
    together = track_segments(list(files.values()), CALIBRATION, workers=2)
    pd.testing.assert_frame_equal(alone, together)
    assert alone["line"].unique().tolist() == [0, 1, 2, 3]


def _pan(n, robots, shift_px=5):
    """A camera that moves over a textured floor, with red matrices in white balls that roll on it; and red chalk."""
    rng = np.random.default_rng(4)
    floor = cv2.resize(rng.normal(110, 30, (60, 200)).astype(np.float32), (1200, 360), interpolation=cv2.INTER_CUBIC)
    pictures, places = [], []
    rows, columns = np.indices((360, 640))
    for number in range(n):
        left = number * shift_px
        luma = floor[:, left : left + 640].copy()
        v = np.full((180, 320), 128.0)
        chalk = (np.abs(columns - (400 - left) - 0.4 * rows) < 3)[::2, ::2]
        v[chalk] = 190
        here = []
        for x0, y0, vx, vy in robots:
            x, y = x0 + (vx - shift_px) * number, y0 + vy * number
            ball = np.hypot(columns - x, rows - y) < 18
            luma[ball], v[ball[::2, ::2]] = 200, 128
            v[(np.abs(columns - x) < 8)[::2, ::2] & (np.abs(rows - y) < 8)[::2, ::2]] = 180
            here.append((x, y))
        places.append(here)
        picture = np.full((540, 640), 128, np.uint8)
        picture[:360] = np.clip(luma + rng.normal(0, 2, luma.shape), 0, 255)
        picture.reshape(-1)[640 * 360 * 5 // 4 :] = np.clip(v, 0, 255).ravel().astype(np.uint8)
        pictures.append(picture)
    return pictures, np.array(places)


def test_a_moving_camera_is_followed_by_colour(tmp_path):
    pictures, places = _pan(40, [(500.0, 100.0, 2.0, 3.0)])
    track = track_video(film(tmp_path / "pan.mkv", pictures))
    assert "robot" not in track.columns
    error = np.hypot(*(track[["x_px", "y_px"]].to_numpy() - places[:, 0]).T)
    assert np.nanmax(error) < 2.5
    assert track["led_on"].all()


def test_robots_keep_their_identities_when_they_pass_each_other(tmp_path):
    done = []
    pictures, places = _pan(50, [(400.0, 100.0, 4.0, 3.0), (600.0, 230.0, -2.0, 0.0), (500.0, 310.0, 3.0, -1.0)])
    track = track_video(
        film(tmp_path / "three.mkv", pictures), robots=3, progress=lambda n, total: done.append((n, total))
    )
    assert done[-1] == (50, 50)
    assert len(track) == 150
    assert track["robot"].tolist() == [0, 1, 2] * 50
    for robot in range(3):
        mine = track[track["robot"] == robot][["x_px", "y_px"]].to_numpy()
        assert np.nanmax(np.hypot(*(mine - places[:, robot]).T)) < 3.0
    with_cm = track_video(tmp_path / "three.mkv", robots=4, calibration=CALIBRATION)
    assert with_cm[with_cm["robot"] == 3]["x_px"].isna().all()
    assert np.isfinite(with_cm[with_cm["robot"] == 0]["x_smooth_cm"]).all()


def test_bad_requests_are_named(tmp_path, bounce, session):
    video = bounce[0]
    with pytest.raises(RequestError, match="0 robots"):
        track_video(video, robots=0)
    with pytest.raises(VideoError):
        track_video(tmp_path / "none.mkv")
    other = Calibration(Pinhole.looking_down((320, 240), height_cm=200.0, field_width_cm=90.0))
    with pytest.raises(CalibrationError, match="320x240"):
        track_video(video, calibration=other)
    panned = film(tmp_path / "pan.mkv", _pan(30, [(500.0, 100.0, 2.0, 3.0)])[0])
    with pytest.raises(RequestError, match="still scene"):
        track_segments([panned], None)
    assert track_segments([], CALIBRATION).columns.tolist() == ["line", *PIXEL_COLUMNS, *CM_COLUMNS]
    with av.open(str(tmp_path / "grey.avi"), "w") as container:
        stream = container.add_stream("rawvideo", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "gray"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((48, 64), 90, np.uint8), format="gray")))
        container.mux(stream.encode())
    nothing = track_video(tmp_path / "grey.avi", robots=2)
    assert len(nothing) == 6
    assert nothing["x_px"].isna().all()


def test_a_stuck_clock_costs_no_row(tmp_path):
    times = np.arange(30) / 30.0
    path = roll(times, (-10.0, 0.0), np.array([20.0, 0.0]))
    pictures = draw(path, np.ones(30))
    track = track_video(film(tmp_path / "t.mkv", pictures, times), calibration=CALIBRATION)
    from tracking.passes import RawTrack
    from tracking.table import track_table

    raw = RawTrack(
        np.where(np.arange(30) == 12, times[11], times),
        np.column_stack([track[["x_px", "y_px"]], np.full((30, 2), 0.01)]),
        np.ones(30),
        np.ones(30),
    )
    table = track_table(raw, CALIBRATION)
    assert len(table) == 30
    assert table.loc[12, "x_smooth_cm"] == table.loc[11, "x_smooth_cm"]
    assert np.abs(table["x_smooth_cm"] - path[:, 0])[np.arange(30) != 12].max() < 0.2


def test_a_picture_shown_twice_tells_the_filter_nothing():
    """A stamp of its own under the place of the frame before."""
    from tracking.passes import RawTrack
    from tracking.table import track_table

    times = np.arange(60) / 30.0
    path = roll(times, (-10.0, 0.0), np.array([20.0, 0.0]))
    pixels = OPTICS.project(np.column_stack([path[:, :2], np.full(60, CALIBRATION.led_height_cm)]))
    shown = np.arange(60)
    shown[[20, 40]] -= 1
    raw = RawTrack(times, np.column_stack([pixels[shown], np.full((60, 2), 0.01)]), np.ones(60), np.ones(60))
    table = track_table(raw, CALIBRATION)
    assert np.flatnonzero(table["nis"].isna() & (table["frame"] > 1)).tolist() == [20, 40]
    assert np.abs(table["x_smooth_cm"] - path[:, 0]).max() < 0.02
    assert np.allclose(table["x_px"], pixels[shown, 0])
