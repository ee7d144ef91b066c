"""The preview: a ring where the robot is, its middle white where the LED is on, a tail where it was, its times."""

import numpy as np
import pandas as pd
import pytest

from lab.base.errors import RequestError
from tracking.film import FilmEncoding, default_optics, make_film
from tracking.overlay import draw_frame, write_preview
from tracking.video import read_frames

SIZE = (320, 240)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """An empty, dim floor."""
    path = tmp_path_factory.mktemp("overlay") / "film.mkv"
    encoding = FilmEncoding(quality=10)
    make_film(
        path, lambda _: [], np.random.default_rng(1), optics=default_optics(SIZE), duration_s=0.5, encoding=encoding
    )
    return path


def track_of(frames, x_px, y_px, *, on=True, robot=None):
    table = pd.DataFrame({"frame": np.arange(frames), "x_px": x_px, "y_px": y_px, "led_on": on})
    return table if robot is None else table.assign(robot=robot)


def drawn(film, table, number=14, **more):
    """The picture with the track, and where it differs from the one without."""
    with read_frames(film) as reader:
        frame = list(reader)[number]
    bare = draw_frame(frame, table.iloc[:0])
    picture = draw_frame(frame, table, **more)
    return picture, np.abs(picture.astype(int) - bare).max(axis=2) > 20


@pytest.mark.parametrize("on", [True, False])
def test_a_ring_about_the_robot_whose_middle_tells_the_led(film, on):
    picture, changed = drawn(film, track_of(15, 100.0, 80.0, on=on))
    rows, columns = np.nonzero(changed)
    assert (columns.min() + columns.max()) / 2 == pytest.approx(100, abs=0.6)
    assert (rows.min() + rows.max()) / 2 == pytest.approx(80, abs=0.6)
    assert (picture[80, 100] > 240).all() == on


def test_the_tail_goes_where_the_robot_was_and_no_farther_back(film):
    table = track_of(15, 60.0 + 10.0 * np.arange(15), 120.0)
    _, changed = drawn(film, table, tail=6)
    assert changed[120, 145:180].all()
    assert not changed[:, :138].any()
    gone = table.assign(x_px=table["x_px"].where(table["frame"] != 11))
    _, gap = drawn(film, gone, tail=6)
    assert not gap[120, 165:175].any()
    _, unseen = drawn(film, table.assign(x_px=table["x_px"].where(table["frame"] != 14)), tail=6)
    assert not unseen[:, 195:].any()


def test_several_robots_bear_their_own_colours(film):
    both = pd.concat([track_of(15, 80.0, 60.0, robot=0), track_of(15, 240.0, 180.0, robot=1)], ignore_index=True)
    picture, changed = drawn(film, both)
    one, other = picture[:120, :160][changed[:120, :160]], picture[120:, 160:][changed[120:, 160:]]
    assert len(one) > 100
    assert np.abs(one.mean(axis=0) - other.mean(axis=0)).max() > 20


def test_the_preview_keeps_the_times_and_gets_its_name_when_it_is_whole(film, tmp_path):
    done = []
    track = track_of(15, 100.0, 80.0)
    out = write_preview(film, track, tmp_path / "p.mkv", progress=lambda *now: done.append(now))
    with read_frames(film) as before, read_frames(out) as after:
        times = [[frame.t_s for frame in reader] for reader in (before, after)]
    assert np.allclose(np.diff(times[0]), np.diff(times[1]), atol=1e-3)
    assert len(times[1]) == 15
    assert [file.name for file in tmp_path.iterdir()] == ["p.mkv"]


def test_what_cannot_be_drawn_is_said_and_leaves_nothing(film, tmp_path):
    track = track_of(15, 100.0, 80.0)
    with pytest.raises(RequestError, match="no column led_on"):
        write_preview(film, track.drop(columns="led_on"), tmp_path / "p.mkv")
    with pytest.raises(RequestError, match="goes on to frame 19"):
        write_preview(film, track_of(20, 100.0, 80.0), tmp_path / "p.mkv")
    with pytest.raises(RequestError, match=r"give an \.mp4 or \.mkv"):
        write_preview(film, track, tmp_path / "nowhere" / "p.mkv")
    assert not list(tmp_path.iterdir())
