"""The robot's scales from camera against odometry: on paper, on the virtual bench, and from a stored session."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from lab.base.errors import RequestError
from lab.calibrate.robot import (
    Wheels,
    calibrate_robot,
    fit_runs,
    profile_to_update,
    scales_of,
    scales_of_session,
    speeds_for,
)
from lab.cli.calibrate import app, effects_of
from lab.settings.load import load_settings
from robot.finding import applied, comments_of
from robot.profile import RobotProfile, load_profile, save_profile
from robot.virtual.bolt import body_settings

HIDDEN = RobotProfile(cm_s_per_unit=0.532, locator_scale=1.064, drift_rad_per_cm=-2.5e-4, least_speed_units=20)


def paper_runs(rng: np.random.Generator, *, count=12, scatter=0.01, late_s=0.1):
    """Runs in closed form: 1 s of ramp, 3 s steady, a wall; the camera's clock is ``late_s`` behind."""
    wheels: dict[int, Wheels] = {}
    frames: list[pd.DataFrame] = []
    for line in range(count):
        units = (30, 40, 50)[line % 3]
        speed = HIDDEN.cm_s_per_unit * units * (1 + scatter * rng.standard_normal())

        def rolled(t, speed=speed):
            since = np.clip(t, 0.0, 4.0)
            return np.where(since < 1, speed * since**2 / 2, speed * (since - 0.5))

        t = np.arange(-0.3, 4.5, 0.05)
        felt = np.where((t > 0) & (t < 4), speed * np.minimum(t, 1.0), 0.0) / HIDDEN.locator_scale
        wheels[line] = Wheels(units, 100 * line + t, rolled(t) / HIDDEN.locator_scale, felt)
        t = np.arange(-0.3, 4.5, 1 / 30)
        # The arc, seen from above, turning clockwise by the drift; x right, y up.
        s = rolled(t)
        angle = rng.uniform(0, 2 * np.pi)
        bend = HIDDEN.drift_rad_per_cm
        along, right = np.sin(bend * s) / bend, (1 - np.cos(bend * s)) / bend
        x = along * np.cos(angle) + right * np.sin(angle)
        y = along * np.sin(angle) - right * np.cos(angle)
        noise = rng.normal(0, 0.02, (2, len(t)))
        frames.append(pd.DataFrame({"line": line, "t_s": 100 * line + t + late_s, "x_cm": x, "y_cm": y}))
        frames[-1][["x_cm", "y_cm"]] += noise.T
    return wheels, pd.concat(frames, ignore_index=True)


def test_scales_on_paper() -> None:
    wheels, track = paper_runs(np.random.default_rng(1))
    scales = scales_of(fit_runs(wheels, track))
    assert scales.filmed
    assert scales.cm_s_per_unit.n == 12
    assert scales.cm_s_per_unit.value == pytest.approx(0.532, abs=4 * scales.cm_s_per_unit.error)
    assert scales.cm_s_per_unit.scatter == pytest.approx(0.0053, rel=0.6)
    assert scales.locator_scale.value == pytest.approx(1.064, rel=5e-4)
    assert scales.drift_rad_per_cm.value == pytest.approx(-2.5e-4, abs=4 * scales.drift_rad_per_cm.error)
    assert scales.drift_rad_per_cm.error < 2e-5


def test_a_clock_that_lags_changes_nothing() -> None:
    figures = []
    for late_s in (-0.15, 0.15):
        wheels, track = paper_runs(np.random.default_rng(2), late_s=late_s)
        figures.append(scales_of(fit_runs(wheels, track)).locator_scale.value)
    assert figures[0] == pytest.approx(figures[1], rel=3e-4)


def test_standard_errors_cover_the_truth() -> None:
    pulls = []
    for seed in range(40):
        wheels, track = paper_runs(np.random.default_rng(seed))
        figure = scales_of(fit_runs(wheels, track)).cm_s_per_unit
        pulls.append((figure.value - 0.532) / figure.error)
    assert 0.7 < float(np.std(pulls)) < 1.5


def test_what_the_camera_did_not_see_is_left_out() -> None:
    wheels, track = paper_runs(np.random.default_rng(3))
    track.loc[track["line"] == 4, ["x_cm", "y_cm"]] = np.nan
    runs = fit_runs(wheels, track[track["line"] != 7])
    assert sorted(runs["line"]) == [line for line in range(12) if line not in (4, 7)]
    row = runs.iloc[0]
    assert row["length_cm"] / row["odometer_cm"] == pytest.approx(1.064, rel=2e-3)


def test_without_a_camera_there_is_the_odometers_scale_alone() -> None:
    wheels, _ = paper_runs(np.random.default_rng(4), scatter=0.0)
    scales = scales_of(fit_runs(wheels, None))
    assert not scales.filmed
    assert scales.cm_s_per_unit.value == pytest.approx(0.532 / 1.064, rel=1e-3)
    assert [finding.value is None for finding in scales.findings()] == [False, True, True]


def test_too_few_runs_are_told() -> None:
    wheels, track = paper_runs(np.random.default_rng(5), count=2)
    with pytest.raises(RequestError, match="only 2 runs"):
        scales_of(fit_runs(wheels, track))


def test_speeds_differ_and_all_roll() -> None:
    for least in (1, 20, 45):
        speeds = speeds_for(20, least)
        assert len(speeds) == 20
        assert len(set(speeds)) == 4
        assert min(speeds) >= least
        assert max(speeds) <= 255


def test_scales_change_area_by_their_square() -> None:
    effects = effects_of(RobotProfile(cm_s_per_unit=0.5), RobotProfile(cm_s_per_unit=0.55, locator_scale=0.9))
    assert effects["time"] == {"area": pytest.approx(1.21), "perimeter": pytest.approx(1.1)}
    assert effects["odometry"] == {"area": pytest.approx(0.81), "perimeter": pytest.approx(0.9)}


def test_an_updated_profile_keeps_what_was_not_measured_with_its_story(tmp_path: Path) -> None:
    path = tmp_path / "robot-profile.toml"
    before = RobotProfile(least_speed_units=17, collision_axes=("back", "left"), dark_lux=12.5)
    save_profile(before, path, {"least_speed_units": "measured: by hand", "collision_axes": "measured: bumps"})
    profile, comments = profile_to_update(path, RobotProfile())
    assert profile == before
    wheels, track = paper_runs(np.random.default_rng(6))
    findings = scales_of(fit_runs(wheels, track)).findings()
    save_profile(applied(profile, findings), path, {**comments, **comments_of(findings)})
    after = load_profile(path)
    assert replace(after, cm_s_per_unit=0.59, locator_scale=1.0, drift_rad_per_cm=0.0) == before
    text = path.read_text(encoding="utf-8")
    assert "least_speed_units = 17  # measured: by hand" in text
    assert 'collision_axes = ["back", "left"]  # measured: bumps' in text
    assert "measured: camera against odometer" in text


def bench(folder: Path, **overrides):
    """A virtual bench whose robot is secretly ``HIDDEN``; a small camera, to be quick."""
    path = folder / "hidden.toml"
    save_profile(HIDDEN, path)
    return load_settings(
        None,
        {
            "virtual.robot_profile": str(path),
            "virtual.speed_error_sigma": 0.003,
            "virtual.heading_drift_rad_per_cm": 1e-5,
            "camera_optics.image_size": [640, 360],
        }
        | overrides,
    )


def hush(_: str) -> None:
    """Say nothing."""


def test_hidden_scales_are_recovered_within_half_a_percent(tmp_path: Path, monkeypatch) -> None:
    # The twin's odometer would else be off by a draw of its own, which no profile tells.
    monkeypatch.setattr("lab.bench.world.body_settings", lambda p, s: body_settings(p, replace(s, locator_error=0.0)))
    scales = calibrate_robot(bench(tmp_path), RobotProfile(), 12, workers=1, say=hush)
    assert scales.cm_s_per_unit.value == pytest.approx(0.532, rel=0.005)
    assert scales.locator_scale.value == pytest.approx(1.064, rel=0.005)
    assert scales.drift_rad_per_cm.value == pytest.approx(-2.5e-4, rel=0.1)
    assert scales.cm_s_per_unit.error < 0.005 * 0.532
    assert len(scales.runs) >= 10


def test_a_bench_without_a_camera_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="the scales need a camera"):
        calibrate_robot(bench(tmp_path, camera="none"), RobotProfile(), 12, workers=1, say=hush)
    with pytest.raises(RequestError, match="--runs 3 or more"):
        calibrate_robot(bench(tmp_path), RobotProfile(), 2, workers=1, say=hush)


def test_scales_from_a_stored_session(filmed_session) -> None:
    scales = scales_of_session(filmed_session.folder, workers=1)
    # Twelve lines and the runs that missed the shape, by a robot of which the driver knew the scale; its speed
    # is off by 2 % a run, its odometer by a draw of 0.5 %.
    assert scales.cm_s_per_unit.value == pytest.approx(0.59, abs=4 * scales.cm_s_per_unit.error)
    assert 0.002 < scales.cm_s_per_unit.scatter < 0.04
    assert scales.locator_scale.value == pytest.approx(1.0, abs=0.02)
    assert scales.locator_scale.error < 1e-3


def test_what_the_driver_of_a_session_corrected_is_undone(tmp_path: Path, filmed_session) -> None:
    before = scales_of_session(filmed_session.folder, workers=1)
    folder = tmp_path / "session"
    shutil.copytree(filmed_session.folder, folder)
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    devices = manifest["devices"]
    devices["profile"] |= {"locator_scale": 1.1, "cm_s_per_unit": devices["cruising_cm_s"] / 20}
    (folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    after = scales_of_session(folder, workers=1)
    assert after.locator_scale.value == pytest.approx(1.1 * before.locator_scale.value, rel=1e-6)
    assert set(after.runs["units"]) == {20.0}


def test_a_session_without_video_is_refused(square_session) -> None:
    with pytest.raises(RequestError, match="was not filmed"):
        scales_of_session(square_session.folder, workers=1)


def test_the_command_updates_a_profile(tmp_path: Path, filmed_session) -> None:
    out = tmp_path / "robot-profile.toml"
    save_profile(RobotProfile(least_speed_units=11), out)
    folder = str(filmed_session.folder)
    result = CliRunner().invoke(app, ["robot", "--from", folder, "--out", str(out), "--json"])
    assert result.exit_code == 0, result.exception
    data = json.loads(result.stdout)
    profile = load_profile(out)
    assert profile.least_speed_units == 11
    assert profile.cm_s_per_unit == pytest.approx(data["cm_s_per_unit"]["value"], rel=1e-5)
    assert data["effects"]["odometry"]["area"] == pytest.approx(profile.locator_scale**2)
    assert len(data["table"]) == data["runs"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--from", "somewhere", "--runs", "5"], "leave SESSION.toml and --runs out"),
        (["--from", "nowhere"], "holds no manifest.json"),
        (["--out", "none/profile.toml"], "there is no folder none"),
    ],
)
def test_wrong_requests_are_one_line(tmp_path: Path, monkeypatch, options: list[str], told: str) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["robot", *options])
    assert isinstance(result.exception, RequestError)
    assert told in str(result.exception)
    assert "\n" not in str(result.exception)
