"""A whole robot characterised on the virtual bench: what it hides from its driver is found."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from lab.base.errors import RequestError
from lab.calibrate.characterise import characterise_robot, settings_for
from lab.cli.characterise import characterise
from lab.settings.load import load_settings
from lab.settings.settings import Settings
from robot.profile import RobotProfile, load_profile, save_profile
from robot.trial import CharacteriseError

HIDDEN = {
    "swapped": RobotProfile(
        cm_s_per_unit=0.48,
        least_speed_units=29,
        least_interval_s=0.031,
        motion_latency_s=0.115,
        light_latency_s=0.024,
        drift_rad_per_cm=1.2e-4,
        locator_scale=0.92,
        reply_flags=0x19,
        collision_axes=("forward", "right"),
    ),
    "turned": RobotProfile(
        cm_s_per_unit=0.73,
        least_speed_units=15,
        least_interval_s=0.019,
        motion_latency_s=0.034,
        light_latency_s=0.078,
        drift_rad_per_cm=-7.6e-4,
        locator_scale=1.09,
        reply_flags=0x29,
        collision_axes=("left", "back"),
    ),
    "both": RobotProfile(
        cm_s_per_unit=0.62,
        least_speed_units=22,
        least_interval_s=0.052,
        motion_latency_s=0.07,
        light_latency_s=0.05,
        drift_rad_per_cm=4e-4,
        locator_scale=1.03,
        collision_axes=("back", "left"),
    ),
}
EXACT = ("least_speed_units", "collision_axes", "reply_flags")
LATENCIES = ("motion_latency_s", "light_latency_s")
SCALES = ("least_interval_s", "cm_s_per_unit", "locator_scale", "drift_rad_per_cm")


def bench(folder: Path, hidden: RobotProfile, **overrides) -> Settings:
    """A virtual bench whose robot is secretly so; a small camera, to be quick."""
    path = folder / "hidden.toml"
    save_profile(hidden, path)
    keys = {
        "virtual.robot_profile": str(path),
        "virtual.speed_error_sigma": 0.01,
        "virtual.heading_drift_rad_per_cm": 1e-5,
        "camera_optics.image_size": [640, 360],
        "projector_optics.image_size": [480, 270],
    } | {name.replace("__", "."): value for name, value in overrides.items()}
    return load_settings(None, keys)


def hush(_: str) -> None:
    """Say nothing."""


@pytest.mark.parametrize(
    "name", ["swapped", pytest.param("turned", marks=pytest.mark.slow), pytest.param("both", marks=pytest.mark.slow)]
)
def test_hidden_profiles_are_recovered(tmp_path: Path, name: str) -> None:
    hidden = HIDDEN[name]
    found = characterise_robot("virtual", bench(tmp_path, hidden), RobotProfile(), seed=3, runs=10, workers=1, say=hush)
    assert found.robot_s < 600.0
    profile = found.profile
    for key in EXACT:
        assert getattr(profile, key) == getattr(hidden, key), key
    for key in LATENCIES:
        assert getattr(profile, key) == pytest.approx(getattr(hidden, key), rel=0.1, abs=0.003), key
    for key in SCALES:
        assert getattr(profile, key) == pytest.approx(getattr(hidden, key), rel=0.1), key
    # The virtual room: 15 lux of its own, and the projector's 5 or 105.
    assert (profile.dark_lux, profile.bright_lux) == (pytest.approx(20.0, abs=1.5), pytest.approx(120.0, abs=1.5))
    found.save(tmp_path / "robot-profile.toml", {})
    assert load_profile(tmp_path / "robot-profile.toml") == profile


def test_without_a_camera_scales_are_the_odometers_and_the_rest_keeps_its_value(tmp_path: Path) -> None:
    hidden = replace(HIDDEN["both"], drift_rad_per_cm=0.0)
    found = characterise_robot(
        "virtual", bench(tmp_path, hidden, camera="none"), RobotProfile(), seed=1, runs=8, workers=1, say=hush
    )
    by_key = {finding.key: finding for finding in found.findings}
    assert by_key["cm_s_per_unit"].number == pytest.approx(0.62 / 1.03, rel=0.03)
    assert "no camera" in by_key["cm_s_per_unit"].how
    for key in ("locator_scale", "drift_rad_per_cm"):
        assert by_key[key].value is None
        assert "needs a camera" in by_key[key].comment
    assert (found.profile.locator_scale, found.profile.drift_rad_per_cm) == (1.0, 0.0)


def test_a_weary_robot_is_sent_to_its_charger(tmp_path: Path) -> None:
    faults = [{"kind": "low_battery", "at_s": 0.0, "for_s": 60.0}]
    settings = bench(tmp_path, RobotProfile(), camera="none", virtual__faults=faults)
    with pytest.raises(CharacteriseError, match="charge it first"):
        characterise_robot("virtual", settings, RobotProfile(), seed=1, runs=4, workers=1, say=hush)


def test_the_bench_of_a_name() -> None:
    assert settings_for("SB-1234", None) is None
    virtual = settings_for("virtual", None)
    assert virtual is not None
    assert (virtual.robots, virtual.camera) == (("virtual",), "virtual")


def test_the_bench_of_a_name_and_a_file(tmp_path: Path) -> None:
    path = tmp_path / "session.toml"
    path.write_text('robot = "ble:SB-0001"\ncamera = "usb:0"\nprojector = "display:1"\n', encoding="utf-8")
    real = settings_for("SB-1234", path)
    assert real is not None
    assert (real.robots, real.camera) == (("ble:SB-1234",), "usb:0")
    virtual = settings_for("virtual", path)
    assert virtual is not None
    assert (virtual.robots, virtual.camera, virtual.projector) == (("virtual",), "virtual", "virtual")
    path.write_text('camera = "none"\n', encoding="utf-8")
    blind = settings_for("virtual", path)
    assert blind is not None
    assert blind.camera == "none"


def command() -> typer.Typer:
    app = typer.Typer()
    app.command("characterise")(characterise)
    return app


def test_the_command_writes_a_profile_and_one_json_object(tmp_path: Path) -> None:
    path = tmp_path / "session.toml"
    path.write_text('camera = "none"\n[virtual]\nspeed_error_sigma = 0.01\n', encoding="utf-8")
    out = tmp_path / "robot-profile.toml"
    before = RobotProfile(refresh_s=0.7, locator_scale=1.03, least_speed_units=9)
    save_profile(before, out, {"locator_scale": "measured: last week"})
    result = CliRunner().invoke(
        command(), ["virtual", "--settings", str(path), "--out", str(out), "--runs", "6", "--json"]
    )
    assert result.exit_code == 0, result.exception
    data = json.loads(result.stdout)
    assert data["profile"] == str(out)
    keys = [finding["key"] for finding in data["findings"]]
    assert len(keys) == len(set(keys)) == 11
    assert data["robot_seconds"] < 600
    profile = load_profile(out)
    assert profile.cm_s_per_unit == pytest.approx(0.59, rel=0.03)
    assert profile.collision_axes == ("right", "forward")
    # What is measured now replaces what was known; what is not keeps its value and its story.
    assert (profile.least_speed_units, profile.refresh_s, profile.locator_scale) == (1, 0.7, 1.03)
    assert "locator_scale = 1.03  # measured: last week" in out.read_text(encoding="utf-8")


def test_runs_that_the_camera_did_not_see_cost_only_what_they_would_have_told(tmp_path: Path) -> None:
    # A camera over another room.
    settings = bench(tmp_path, RobotProfile(), camera_optics__centre_cm=[600.0, 0.0])
    found = characterise_robot("virtual", settings, RobotProfile(), seed=1, runs=4, workers=1, say=hush)
    by_key = {finding.key: finding for finding in found.findings}
    assert by_key["locator_scale"].value is None
    assert "let the camera see the whole arena" in by_key["locator_scale"].how
    assert by_key["motion_latency_s"].number == pytest.approx(0.0, abs=0.003)


def test_a_file_that_cannot_be_written_is_told_before_the_robot_rolls(tmp_path: Path) -> None:
    result = CliRunner().invoke(command(), ["virtual", "--out", str(tmp_path / "none" / "profile.toml")])
    assert isinstance(result.exception, RequestError)
    assert "there is no folder" in str(result.exception)
    assert "\n" not in str(result.exception)


def test_seeds_repeat(tmp_path: Path) -> None:
    settings = bench(tmp_path, RobotProfile(), camera="none")
    first, again = (
        characterise_robot("virtual", settings, RobotProfile(), seed=7, runs=4, workers=1, say=hush).profile
        for _ in range(2)
    )
    assert first == again
    assert np.isfinite(first.cm_s_per_unit)
