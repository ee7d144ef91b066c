"""Runs from the track: the straight line of each, the bounces between them, what is reported as unusable."""

from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import box

from tracking.linespace import roll
from tracking.runs import TRUE_LINES, TrackError, fit_lines, place_along, segment_runs

FPS = 30.0


def rolled(start, heading, length, *, line=0, t0=0.0, noise=0.0, rng=None, stand=0, speed=25.0):
    """Frames of a run from rest to rest: accelerates within 0.2 s, stands ``stand`` frames before and after."""
    ramp = 0.2
    duration = length / speed + ramp
    t = np.arange(0, duration, 1 / FPS)
    # trapezoidal speed: s(t) in closed form
    s = np.where(
        t < ramp,
        speed * t**2 / (2 * ramp),
        np.where(
            t < duration - ramp,
            speed * (t - ramp / 2),
            length - speed * np.clip(duration - t, 0, None) ** 2 / (2 * ramp),
        ),
    )
    s = np.concatenate([np.zeros(stand), s, np.full(stand, length)])
    t = t0 + np.arange(len(s)) / FPS
    xy = np.asarray(start) + s[:, None] * np.array([np.cos(heading), np.sin(heading)])
    if noise:
        xy = xy + rng.normal(0, noise, xy.shape)
    return pd.DataFrame({"line": line, "t_s": t, "x_smooth_cm": xy[:, 0], "y_smooth_cm": xy[:, 1]}), s


def path(corners, rng, noise=0.05, stand=6):
    """A continuous track through corners, and the index of the frame at every corner."""
    parts, t = [], 0.0
    for a, b in pairwise(corners):
        leg = b - a
        part, _ = rolled(a, np.arctan2(leg[1], leg[0]), np.hypot(*leg), t0=t, noise=noise, rng=rng, stand=stand)
        parts.append(part)
        t = float(part["t_s"].iloc[-1]) + 1 / FPS
    return pd.concat(parts, ignore_index=True).drop(columns="line")


@settings(max_examples=60, deadline=None)
@given(
    x=st.floats(-50, 50),
    y=st.floats(-40, 40),
    heading=st.floats(-np.pi, np.pi),
    length=st.floats(12, 140),
    stand=st.integers(0, 20),
)
def test_line_of_a_clean_run(x, y, heading, length, stand):
    frames, _ = rolled((x, y), heading, length, line=7, t0=100.0, stand=stand)
    row = fit_lines(frames).iloc[0]
    assert row["reason"] == ""
    assert 0 <= row["theta_rad"] < np.pi
    normal = np.array([np.cos(row["theta_rad"]), np.sin(row["theta_rad"])])
    along = np.array([np.cos(heading), np.sin(heading)])
    assert abs(normal @ along) < 1e-6
    assert row["p_cm"] == pytest.approx(normal @ np.array([x, y]), abs=1e-4)
    begin, end = (np.array([row[f"x_{e}_cm"], row[f"y_{e}_cm"]]) for e in ("start", "end"))
    # from rest the first and last millimetres pass below a fifth of the cruising speed
    assert np.hypot(*(begin - (x, y))) < 1.0
    assert np.hypot(*(end - (np.array([x, y]) + length * along))) < 1.0
    assert row["length_cm"] == pytest.approx(np.hypot(*(end - begin)))
    assert row["rms_cm"] < 1e-6
    assert row["t_start_s"] >= 100.0
    assert row["t_end_s"] - row["t_start_s"] == pytest.approx(length / 25, abs=0.35)


def test_table_has_the_agreed_columns_and_types():
    lines = fit_lines(rolled((0, 0), 0.4, 50, line=3)[0])
    assert tuple(lines.columns) == TRUE_LINES
    assert lines["line"].dtype == np.int64
    assert lines["n_frames"].dtype == np.int64
    assert lines["theta_rad"].dtype == np.float64
    empty = fit_lines(rolled((0, 0), 0.4, 50, line=-1)[0])
    assert len(empty) == 0
    assert tuple(empty.columns) == TRUE_LINES


def test_noise_averages_out():
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(60):
        frames, _ = rolled((-40, -30), 0.7, 80, noise=0.1, rng=rng, stand=5)
        row = fit_lines(frames).iloc[0]
        assert row["rms_cm"] == pytest.approx(0.1, abs=0.04)
        errors.append(np.mod(row["theta_rad"] - 0.7, np.pi) - np.pi / 2)
    # least squares over ~100 even points: sigma sqrt(12/n)/length
    assert np.std(errors) < 2.0 * 0.1 * np.sqrt(12 / 96) / 80
    assert abs(np.mean(errors)) < 4 * np.std(errors) / np.sqrt(60)


def test_outliers_do_not_pull_the_line():
    rng = np.random.default_rng(2)
    frames, _ = rolled((-40, 10), -0.3, 90, noise=0.05, rng=rng)
    bad = rng.choice(len(frames), len(frames) // 5, replace=False)
    frames.loc[bad, ["x_smooth_cm", "y_smooth_cm"]] += rng.uniform(5, 30, (len(bad), 2))
    row = fit_lines(frames).iloc[0]
    assert row["reason"] == ""
    assert np.mod(row["theta_rad"] + 0.3, np.pi) == pytest.approx(np.pi / 2, abs=0.002)
    assert row["rms_cm"] < 0.1
    assert row["length_cm"] == pytest.approx(90, abs=3)


def test_uncertain_frames_weigh_less():
    rng = np.random.default_rng(3)
    frames, s = rolled((0, 0), 0.0, 60, noise=0.01, rng=rng)
    frames["sigma_x_cm"] = frames["sigma_y_cm"] = 0.03
    rough = s > 30
    frames.loc[rough, "y_smooth_cm"] += 0.08
    even = fit_lines(frames).iloc[0]
    frames.loc[rough, ["sigma_x_cm", "sigma_y_cm"]] = 1.0
    weighted = fit_lines(frames).iloc[0]

    def tilt(row):
        return abs(row["theta_rad"] - np.pi / 2)

    assert tilt(weighted) < 0.5 * tilt(even)


def test_neighbouring_runs_in_the_segment_are_left_out():
    rng = np.random.default_rng(4)
    corners = np.array([(-30.0, 40.0), (-50, 20), (40, -30), (56, -10)])
    track = path(corners, rng, stand=2).assign(line=5)
    row = fit_lines(track).iloc[0]
    assert row["reason"] == ""
    begin, end = (np.array([row[f"x_{e}_cm"], row[f"y_{e}_cm"]]) for e in ("start", "end"))
    assert np.hypot(*(begin - corners[1])) < 1.0
    assert np.hypot(*(end - corners[2])) < 1.0


def test_bounce_without_a_pause():
    rng = np.random.default_rng(5)
    s = np.arange(0, 100, 25 / FPS)
    xy = np.where(s[:, None] < 25, np.column_stack([s, s * 0]), np.column_stack([25 - (s - 25) * 0.8, (s - 25) * 0.6]))
    xy = xy + rng.normal(0, 0.03, xy.shape)
    row = fit_lines(pd.DataFrame({"line": 0, "t_s": s / 25, "x_cm": xy[:, 0], "y_cm": xy[:, 1]})).iloc[0]
    assert row["x_start_cm"] == pytest.approx(25, abs=1.5)
    assert row["length_cm"] == pytest.approx(75, abs=1.5)
    assert row["x_end_cm"] < row["x_start_cm"]


def test_lost_frames_are_bridged():
    frames, s = rolled((0, 0), 0.5, 100, line=2)
    frames.loc[(s > 30) & (s < 60), ["x_smooth_cm", "y_smooth_cm"]] = np.nan
    row = fit_lines(frames).iloc[0]
    assert row["length_cm"] == pytest.approx(100, abs=1.0)
    assert row["n_frames"] == pytest.approx(np.isfinite(frames["x_smooth_cm"]).sum(), abs=6)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda f: f.iloc[::40], "LED seen in 3 frames, 5 needed"),
        (lambda f: f.assign(x_smooth_cm=np.nan), "LED seen in 0 frames"),
        (lambda f: f.assign(x_smooth_cm=1.0, y_smooth_cm=2.0), "stood still"),
        (lambda f: f.assign(y_smooth_cm=6 * np.sin(f["x_smooth_cm"] / 8)), "not straight"),
        (
            lambda f: f.assign(x_smooth_cm=f["x_smooth_cm"] / 400, y_smooth_cm=0.02 * np.sin(f["t_s"] * 60)),
            "stood still",
        ),
        (lambda f: f[f["x_smooth_cm"] < 2.0].assign(y_smooth_cm=lambda f: 0.3 * np.sin(f.index)), "rolled only"),
        (lambda f: f.assign(x_smooth_cm=np.where(f.index > 50, 80.0, 0.0), y_smooth_cm=0.0), "less than 5 frames"),
    ],
)
def test_unusable_runs_are_reported_not_lost(change, reason):
    good, _ = rolled((0, 0), 0.0, 90, line=1)
    other, _ = rolled((0, 0), 1.0, 50, line=4, t0=50)
    lines = fit_lines(pd.concat([change(good).assign(line=1), other]))
    assert lines["line"].tolist() == [1, 4]
    assert reason in lines["reason"][0]
    assert lines["reason"][0] != ""
    assert np.isnan(lines["theta_rad"][0])
    assert lines["n_frames"][0] == 0
    assert lines["reason"][1] == ""


def test_crooked_run():
    frames, s = rolled((0, 0), 0.0, 90)
    frames["y_smooth_cm"] = 0.004 * s**2
    line = fit_lines(frames).iloc[0]
    assert "not straight" in line["reason"]
    assert line["rms_cm"] > 2
    assert fit_lines(frames, crookedest_cm=10)["reason"][0] == ""


def test_tracks_that_cannot_be_read():
    frames, _ = rolled((0, 0), 0.0, 90)
    with pytest.raises(TrackError, match="`line`") as caught:
        fit_lines(frames.drop(columns="line"))
    assert caught.value.column == "line"
    with pytest.raises(TrackError, match="`x_cm`"):
        fit_lines(frames.drop(columns=["x_smooth_cm"]))
    with pytest.raises(TrackError, match="several robots"):
        fit_lines(pd.concat([frames.assign(robot=0), frames.assign(robot=1)]))


# --- progress along the run


def test_place_along_follows_acceleration():
    rng = np.random.default_rng(6)
    frames, s = rolled((10, 5), 2.5, 70, noise=0.05, rng=rng, stand=10)
    frames.loc[30, "x_smooth_cm"] += 9.0
    row = fit_lines(frames).iloc[0]
    t, place = place_along(frames, row)
    assert (np.diff(t) > 0).all()
    assert (np.diff(place) > 0).all()
    begin = np.hypot(row["x_start_cm"] - 10, row["y_start_cm"] - 5)
    true_t = np.interp(place[2:-2] + begin, s[10:-10], frames["t_s"][10:-10])
    assert np.abs(t[2:-2] - true_t).max() < 0.03
    assert 30 / FPS not in t


# --- bounces


def test_runs_are_split_at_the_bounces():
    rng = np.random.default_rng(7)
    rolls = roll(box(-56, -41, 56, 41), 1, 60, np.random.default_rng(8))
    # corners = where successive lines meet
    n = np.column_stack([np.cos(rolls.theta_rad[0]), np.sin(rolls.theta_rad[0])])
    corners = np.array([np.linalg.solve(n[i : i + 2], rolls.p_cm[0][i : i + 2]) for i in range(59)])
    track = segment_runs(path(corners, rng))
    lines = fit_lines(track)
    length = np.hypot(*np.diff(corners, axis=0).T)
    leg = np.diff(corners, axis=0)
    turn = np.abs(np.degrees(np.angle((leg[1:, 0] + 1j * leg[1:, 1]) / (leg[:-1, 0] + 1j * leg[:-1, 1]))))
    assert turn.min() > 8
    assert len(lines) == (length >= 3).sum()
    fitted = lines[lines["reason"] == ""]
    assert len(fitted) >= (length > 6).sum()
    theta, p = rolls.theta_rad[0][1:-1][length >= 3], rolls.p_cm[0][1:-1][length >= 3]
    long = (lines["length_cm"] > 15).to_numpy()
    off = np.abs(np.sin(lines["theta_rad"].to_numpy() - theta))[long]
    assert off.max() < 0.02
    assert np.abs(np.abs(lines["p_cm"].to_numpy()) - np.abs(p))[long].max() < 0.8


def test_grazing_bounces_and_drift():
    rng = np.random.default_rng(9)
    a = np.array([(-50.0, 0), (0, 0), (49.0, 49 * np.tan(np.radians(11)))])
    assert segment_runs(path(a, rng, stand=0))["line"].max() == 1
    # a run that drifts by a few degrees over its length is one run
    frames, s = rolled((0, 0), 0.0, 100)
    for degrees in (4, 7):
        drift = np.radians(degrees) * s**2 / (2 * 100)
        track = frames.drop(columns="line").assign(y_smooth_cm=drift + rng.normal(0, 0.05, len(s)))
        assert set(segment_runs(track)["line"]) == {0}


def test_straight_back_is_a_bounce():
    rng = np.random.default_rng(10)
    there = np.array([(-50.0, 3), (50, 3), (-45, 3.5)])
    lines = fit_lines(segment_runs(path(there, rng)))
    assert len(lines) == 2
    assert lines["x_end_cm"].tolist() == pytest.approx([50, -45], abs=0.5)


def test_frames_of_no_run():
    frames, _ = rolled((0, 0), 0.0, 2.0)
    assert set(segment_runs(frames)["line"]) == {-1}
    assert set(segment_runs(frames.assign(x_smooth_cm=np.nan))["line"]) == {-1}
    one = rolled((0, 0), 0.0, 40)[0]
    one.loc[[0, 20], "y_smooth_cm"] = np.nan
    line = segment_runs(one)["line"]
    assert line[0] == -1  # before the LED was first seen
    assert line[20] == 0
    assert segment_runs(one).drop(columns="line").equals(one.drop(columns="line"))
