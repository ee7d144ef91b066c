"""Several robots, filmed: one film for all, each LED its own colour, each run with its own truth."""

import numpy as np
import pandas as pd
import pytest
from shapely import Polygon

from lab.review.attribution import attribute, lines_from_the_edge
from lab.review.review import review
from lab.review.watched import places_at
from lab.settings.load import load_settings
from lab.store.reader import SessionReader
from tests.lab.traces import rolled
from tracking.video import read_frames


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Three robots on a small floor, filmed."""
    small = {"arena__width_cm": 90, "arena__height_cm": 70}
    return rolled(
        tmp_path_factory.mktemp("filmed"), robot=["virtual"] * 3, camera="virtual", stop__lines=14, seed=6, **small
    )


@pytest.fixture(scope="module")
def reviewed(filmed):
    return review(filmed.folder, report=True)


def test_each_robot_has_its_colour(filmed):
    robots = SessionReader(filmed.folder).manifest["devices"]["robots"]
    assert [robot["led"] for robot in robots] == ["red", "green", "blue"]


def test_the_film_has_neither_gap_nor_overlap(filmed):
    """Slice after slice in the order of the log; nothing but committed runs is left."""
    stamps = []
    for run in filmed.runs:
        folder = filmed.folder / f"lines/{run['line']:06d}"
        assert (folder / "light.parquet").is_file()
        if run["video"]["frames"]:
            table = pd.read_parquet(folder / "video.frames.parquet")
            assert len(table) == run["video"]["frames"] == sum(1 for _ in read_frames(folder / "video.mkv"))
            stamps.append(table)
    film = pd.concat(stamps, ignore_index=True)
    steps = film["index"].diff().iloc[1:]
    assert (steps == film["dropped_before"].iloc[1:] + 1).all()
    assert film["t_host_s"].is_monotonic_increasing
    assert film["t_host_s"].iloc[-1] == pytest.approx(filmed.runs[-1]["t_end_s"], abs=0.1)
    assert not list((filmed.folder / "lines").glob("*.part"))


def test_every_track_is_its_own_robots(filmed, reviewed):
    track = pd.read_parquet(filmed.folder / "track.parquet")
    frames = sum(run["video"]["frames"] for run in filmed.runs)
    assert len(track) == 3 * frames
    assert set(track["robot"]) == {"SB-7E57", "SB-7E58", "SB-7E59"}
    for number, body in enumerate(filmed.bodies):
        mine = track[track["robot"] == f"SB-{0x7E57 + number:04X}"]
        trace = np.array(body.trace)
        truth = np.column_stack([np.interp(mine["t_s"], trace[:, 0], trace[:, axis]) for axis in (1, 2)])
        off_cm = np.hypot(*(mine[["x_cm", "y_cm"]].to_numpy() - truth).T)
        assert np.isfinite(off_cm).mean() > 0.97
        assert np.nanmedian(off_cm) < 0.1
        assert np.nanquantile(off_cm, 0.99) < 1.0  # the trace is straight between readings, the robot was not
        runs = {run["line"]: run for run in filmed.runs if run["robot"] == f"SB-{0x7E57 + number:04X}"}
        for line, part in mine[mine["line"] >= 0].groupby("line"):
            assert part["t_s"].between(runs[line]["t_start_s"], runs[line]["t_end_s"]).all()


def test_validate_works_with_all_of_them(filmed, reviewed):
    chords = reviewed["chords"]
    assert chords["matched"] >= 8
    assert chords["missed"] + chords["extra"] <= 2
    assert chords["rms_cm"] < 1.0
    assert reviewed["camera"]["lines"] >= 12
    robot, camera = reviewed["robot"], reviewed["camera"]
    assert abs(robot["area_cm2"] - camera["area_cm2"]) < 0.5 * robot["sigma_area_cm2"]
    assert reviewed["isotropy"] is not None
    assert "was run without video" not in reviewed["report"].read_text(encoding="utf-8")


def test_what_was_felt_before_the_film_saw_a_run_begin_is_at_its_begin():
    """A run that a contact begins in the light may be left so soon that it lay 5 cm before the begin."""
    felt_s, seen_s, seen_cm = np.array([-0.2, 2.0, 3.04, 9.0]), np.array([1.0, 3.0]), np.array([0.2, 20.2])
    assert places_at(felt_s, seen_s, seen_cm, 20.4) == pytest.approx([0.0, 10.2, 20.4, 20.4])


def test_a_track_is_attributed_by_time():
    track = pd.DataFrame({"line": [5, 5, 5, 5], "robot": [0, 1, 0, 1], "t_s": [1.0, 1.0, 4.0, 4.0]})
    runs = pd.DataFrame(
        {"line": [8, 9], "robot": ["A", "B"], "t_start_s": [0.5, 3.0], "t_end_s": [2.0, 5.0], "ended": "bump"}
    )
    found = attribute(track, runs, ["A", "B"])
    assert found["line"].tolist() == [8, -1, -1, 9]
    assert found["robot"].tolist() == ["A", "B", "A", "B"]
    assert found["segment"].tolist() == [5] * 4


def test_only_runs_from_the_edge_are_judged_and_cut_ones_as_whole_lines():
    square = Polygon([(-10, -10), (10, -10), (10, 10), (-10, 10)])
    runs = pd.DataFrame(
        {
            "line": [0, 1, 2, 3],
            "robot": "A",
            "t_start_s": [0.0, 1.0, 2.0, 3.0],
            "ended": ["bump", "contact", "bump", "bump"],
        }
    )
    lines = pd.DataFrame({"line": [0, 1, 2, 3], "theta_rad": 0.0, "p_cm": 3.0, "length_cm": [9.0, 4.0, 8.0, 19.0]})
    found = lines_from_the_edge(lines, runs, square)
    # The first was set down somewhere, the third began at another robot; the second lay on a line of 20 cm.
    assert found["line"].tolist() == [1, 3]
    assert found["length_cm"].tolist() == pytest.approx([20.0, 19.0])


def test_colours_are_a_setting():
    settings = load_settings(None, {"robot": ["virtual"] * 2, "led.colours": ["blue", "yellow"]})
    assert [settings.led_colour(number) for number in (0, 1)] == ["blue", "yellow"]
