"""The tracker on recorded footage of five real BOLTs, against labels that were set by hand."""

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tracking.track import track_video

HERE = Path(__file__).parent
FOOTAGE = HERE.parents[2] / "shared" / "real" / "bolts-led-matrix.mp4"
FRAMES = 372

pytestmark = pytest.mark.real


@pytest.fixture(scope="module")
def track():
    if not FOOTAGE.is_file():
        reason = f"no recorded footage at {FOOTAGE}"
        if os.environ.get("CI", "").lower() == "true":
            pytest.fail(reason)
        pytest.skip(reason)
    return track_video(FOOTAGE, robots=5)


@pytest.fixture(scope="module")
def labels():
    return pd.read_csv(HERE / "data" / "bolts-led-matrix.csv")


def _matched(track, labels):
    """Each hand label with the nearest tracked robot of its frame."""
    rows = []
    for label in labels[labels["what"] == "centre"].itertuples():
        here = track[(track["frame"] == label.frame) & track["x_px"].notna()]
        distance = np.hypot(here["x_px"] - label.x_px, here["y_px"] - label.y_px)
        nearest = distance.idxmin()
        rows.append((label.frame, label.robot, here.loc[nearest, "robot"], distance[nearest]))
    return pd.DataFrame(rows, columns=["frame", "robot", "track", "error_px"])


def test_the_labels_cover_the_lit_part(labels):
    centres = labels[labels["what"] == "centre"]
    assert centres["frame"].nunique() >= 12
    assert set(centres["robot"]) == set("ABCDE")
    assert len(labels[labels["what"] != "centre"]) == 10


def test_one_row_a_frame_and_robot(track):
    assert len(track) == 5 * FRAMES
    assert (track.groupby("robot")["frame"].apply(list).map(len) == FRAMES).all()
    assert np.allclose(track["t_s"], track["frame"] / 30.0, atol=1e-6)


def test_positions_agree_with_the_hand_labels(track, labels):
    errors = _matched(track, labels)["error_px"]
    assert errors.median() <= 2.0
    assert errors.max() <= 8.0


def test_identities_are_kept_while_lit(track, labels):
    matched = _matched(track, labels)
    assert (matched.groupby("robot")["track"].nunique() == 1).all()
    assert matched.groupby("robot")["track"].first().is_unique


def test_led_goes_on_and_off_when_it_is_seen_to(track, labels):
    of_robot = _matched(track, labels).groupby("robot")["track"].first()
    for label in labels[labels["what"] != "centre"].itertuples():
        mine = track[(track["robot"] == of_robot[label.robot]) & track["led_on"]]["frame"]
        found = mine.min() if label.what == "on" else mine.max() + 1
        assert abs(found - label.frame) <= 2, f"robot {label.robot} {label.what}: {found} against {label.frame}"


def test_led_stays_on_in_between(track, labels):
    matched = _matched(track, labels)
    for robot, number in matched.groupby("robot")["track"].first().items():
        mine = track[track["robot"] == number].set_index("frame")["led_on"]
        lit = mine.loc[57:285]
        # Robot A rolls out of the picture for half a second.
        hidden = 20 if robot == "A" else 3
        assert (~lit).sum() <= hidden


def test_chalk_is_not_taken_for_a_robot(track):
    dark = track[(track["frame"] < 55) | (track["frame"] > 297)]
    assert not dark["led_on"].any()
    assert dark["x_px"].isna().all()


def test_no_robot_jumps(track):
    for _, mine in track.groupby("robot"):
        step = np.hypot(mine["x_px"].diff(), mine["y_px"].diff())
        assert step.max() < 20.0


def _balls(name, robots):
    video = FOOTAGE.with_name(f"{name}.mp4")
    if not video.is_file():
        pytest.skip(f"no recorded footage at {video}")
    marks = pd.read_csv(HERE / "data" / f"{name}.csv")
    return track_video(video, robots=robots, balls=True), marks


def _nearest_px(track, marks):
    found = []
    for mark in marks.itertuples():
        here = track[track["frame"] == mark.frame]
        found.append(np.hypot(here["x_px"] - mark.x_px, here["y_px"] - mark.y_px).min())
    return np.array(found)


def test_balls_with_their_leds_off_are_found_on_mats():
    track, marks = _balls("bolts-on-mats", 3)
    assert len(track) == 3 * 902
    assert not track["led_on"].any()
    errors = _nearest_px(track, marks)
    assert np.nanmedian(errors) <= 2.0
    assert np.mean(errors <= 4.0) >= 0.9
    assert track["x_px"].notna().mean() > 0.9


def test_fast_balls_that_bump_are_found_upright_in_a_rotated_film():
    track, marks = _balls("minis-rotated", 2)
    assert len(track) == 2 * 269
    errors = _nearest_px(track, marks)
    assert np.nanmedian(errors) <= 2.0
    # One ball that is half out of the picture.
    assert np.mean(errors <= 4.0) >= 0.95
    for _, mine in track.groupby("robot"):
        step = np.hypot(mine["x_px"].diff(), mine["y_px"].diff())
        assert step.max() < 40.0  # less than a ball: they never change places


def test_forty_frames_are_labelled_by_hand(labels):
    frames = [labels[labels["what"] == "centre"]["frame"].nunique()]
    frames += [
        pd.read_csv(HERE / "data" / f"{name}.csv")["frame"].nunique() for name in ("bolts-on-mats", "minis-rotated")
    ]
    assert sum(frames) >= 40
