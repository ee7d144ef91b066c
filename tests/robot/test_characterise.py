"""A robot with hidden manners, measured by its words alone: no camera, the light flipped by a callable."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass, field

import numpy as np
import pytest
from shapely.geometry import Point, box

from lab.clock import run
from robot.bolt import Bolt
from robot.characterise import (
    collision_axes,
    least_interval,
    least_speed,
    light_latency,
    light_levels,
    motion_latency,
    roll_runs,
)
from robot.crossings import LevelsError
from robot.finding import Finding, applied, comments_of
from robot.fitting import ALL_AXES, Figure, mean_of, slope, steady_window
from robot.profile import RobotProfile, load_profile, save_profile
from robot.trial import CharacteriseError, Trial, neutral
from robot.virtual.body import Body, BodySettings
from robot.virtual.bolt import VirtualBolt, body_settings
from robot.virtual.radio import AirSettings, VirtualRadio

FLOOR = box(-56.35, -41.35, 56.35, 41.35)


def hidden_profile(seed: int) -> RobotProfile:
    """Manners drawn within sane ranges."""
    rng = np.random.default_rng(seed)
    return RobotProfile(
        cm_s_per_unit=rng.uniform(0.45, 0.75),
        least_speed_units=int(rng.integers(15, 31)),
        least_interval_s=int(rng.integers(15, 60)) / 1000,
        motion_latency_s=rng.uniform(0.03, 0.12),
        light_latency_s=rng.uniform(0.02, 0.08),
        drift_rad_per_cm=float(rng.choice([-1, 1])) * rng.uniform(1e-4, 8e-4),
        locator_scale=rng.uniform(0.9, 1.1),
        reply_flags=int(rng.choice([0x39, 0x19, 0x29, 0x09])),
        collision_axes=ALL_AXES[int(rng.integers(8))],
    )


@dataclass
class Rig:
    """The trial, the truth, and the light over both."""

    trial: Trial
    robot: Bolt
    body: Body
    twin: VirtualBolt
    lux: list[float] = field(default_factory=lambda: [20.0])

    def show(self, level: float) -> None:
        self.lux[0] = 20.0 + 100.0 * level


@contextlib.asynccontextmanager
async def rig(hidden: RobotProfile, *, seed: int = 0, floor=FLOOR, air: AirSettings | None = None, **place):
    rng = np.random.default_rng(seed)
    radio = VirtualRadio(air, rng=rng)
    await radio.start()
    lux = [20.0]
    settings = body_settings(hidden, BodySettings())
    body = Body(floor, lambda x, _: np.full(np.shape(x), lux[0]), rng, settings, **place)
    twin = VirtualBolt(radio, body, "SB-1234", profile=hidden)
    await twin.start()
    robot = Bolt(
        "SB-1234",
        backend=radio.client_backend,
        scanner_backend=radio.scanner_backend,
        profile=neutral(RobotProfile()),
    )
    try:
        await robot.connect()
        yield Rig(Trial(robot, rng), robot, body, twin, lux)
    finally:
        await robot.disconnect()
        await twin.close()
        await radio.close()


def measure(hidden: RobotProfile, step, **options):
    """What ``step`` finds on a robot that streams every 40 ms, or as its link holds."""

    async def main():
        async with rig(hidden, **options) as made:
            await made.trial.stream(max(0.04, hidden.least_interval_s))
            return await step(made)

    return run(main(), virtual=True)


@pytest.mark.parametrize("seed", range(4))
def test_hidden_manners_are_recovered(seed: int) -> None:
    hidden = hidden_profile(seed)

    async def everything(made: Rig) -> dict[str, Finding]:
        trial = made.trial
        found = [await least_interval(trial)]
        assert found[0].number <= trial.interval_s <= max(0.03, 1.2 * found[0].number)
        found += await light_levels(trial, made.show)
        found.append(await light_latency(trial, made.show, 70.0))
        found.append(await least_speed(trial))
        found.append(await motion_latency(trial))
        found.append(await collision_axes(trial))
        assert asyncio.get_running_loop().time() < 300.0
        return {finding.key: finding for finding in found}

    found = measure(hidden, everything, seed=seed + 50)
    assert found["least_interval_s"].number == pytest.approx(hidden.least_interval_s, abs=1e-9)
    assert found["least_speed_units"].value == hidden.least_speed_units
    assert found["collision_axes"].value == hidden.collision_axes
    assert found["light_latency_s"].number == pytest.approx(hidden.light_latency_s, abs=0.003)
    assert found["motion_latency_s"].number == pytest.approx(hidden.motion_latency_s, abs=0.003)
    assert found["dark_lux"].number == pytest.approx(20.0, abs=1.0)
    assert found["bright_lux"].number == pytest.approx(120.0, abs=1.0)


def test_latencies_are_still_known_through_a_radio_that_dawdles() -> None:
    hidden = RobotProfile(motion_latency_s=0.06, light_latency_s=0.05)

    async def both(made: Rig) -> tuple[float, float]:
        return (
            (await motion_latency(made.trial)).number,
            (await light_latency(made.trial, made.show, 70.0)).number,
        )

    # The radio's delay belongs to the robot as the lab meets it: once out and once back, or back alone.
    motion_s, light_s = measure(hidden, both, air=AirSettings(latency_s=0.01))
    assert motion_s == pytest.approx(0.06 + 2 * 0.01, abs=0.003)
    assert light_s == pytest.approx(0.05 + 0.01, abs=0.003)


def test_a_link_that_breaks_is_made_anew_and_the_robot_rolls_on() -> None:
    async def step(made: Rig) -> tuple[Finding, float]:
        found = await least_interval(made.trial)
        roll = await made.trial.roll(0.0, 45, for_s=3.0, until_cm=10.0)
        return found, roll.rolled_cm

    found, rolled_cm = measure(RobotProfile(least_interval_s=0.05), step, position_cm=(0.0, 0.0))
    assert found.value == 0.05
    assert 10.0 <= rolled_cm < 20.0


def test_a_link_that_holds_everything_says_so() -> None:
    found = measure(RobotProfile(least_interval_s=0.005), lambda made: least_interval(made.trial))
    assert found.value == 0.01
    assert "all held" in found.how


def test_runs_cross_the_arena_and_tell_the_odometers_scale() -> None:
    hidden = RobotProfile(cm_s_per_unit=0.52, locator_scale=1.08)
    told: list[int] = []

    async def begin(number: int) -> None:
        told.append(number)

    async def step(made: Rig):
        return await roll_runs(made.trial, [25, 40, 50] * 4, begin=begin)

    rolls = measure(hidden, step, position_cm=(50.0, 38.0))
    assert set(told) == set(range(12))
    assert [rolls[number].units for number in range(12)] == [25, 40, 50] * 4
    per_unit = []
    for roll in rolls.values():
        assert roll.rolled_cm >= 25.0
        window = steady_window(roll.t_s, roll.speed_cm_s, 0.1)
        assert window is not None
        steady = (roll.t_s >= window[0]) & (roll.t_s <= window[1])
        per_unit.append(slope(roll.t_s[steady], roll.path_cm[steady]).value / roll.units)
    # The odometer reports the true way over its scale, and every run's speed is off by 2 %.
    figure = mean_of(per_unit)
    assert figure.value == pytest.approx(0.52 / 1.08, abs=4 * figure.error + 0.015 * 0.48)


def test_a_robot_that_starts_in_a_corner_is_turned_round() -> None:
    hidden = RobotProfile(motion_latency_s=0.05, least_speed_units=20)

    async def step(made: Rig) -> tuple[Finding, Finding]:
        return await motion_latency(made.trial), await least_speed(made.trial)

    latency, least = measure(hidden, step, position_cm=(-56.0, -41.0), facing_rad=3.9)
    assert latency.number == pytest.approx(0.05, abs=0.003)
    assert least.value == 20


def test_round_walls_tell_the_axes_too() -> None:
    hidden = RobotProfile(collision_axes=("forward", "left"))
    disc = Point(0, 0).buffer(56.0, quad_segs=60)
    assert measure(hidden, lambda made: collision_axes(made.trial), floor=disc).value == ("forward", "left")


def test_the_flags_of_an_answer_are_those_on_the_wire() -> None:
    async def step(made: Rig) -> int | None:
        return made.robot.reply_flags

    assert measure(RobotProfile(reply_flags=0x19), step) == 0x19
    assert measure(RobotProfile(), step) == 0x39


def test_a_robot_that_is_held_is_told_to_be_put_down() -> None:
    async def step(made: Rig) -> Finding:
        made.body.held = True
        return await least_speed(made.trial)

    with pytest.raises(CharacteriseError, match=r"SB-1234: it does not roll; put it on the floor") as failed:
        measure(RobotProfile(), step)
    assert "\n" not in str(failed.value)


def test_light_that_does_not_change_is_told() -> None:
    async def levels(made: Rig) -> object:
        return await light_levels(made.trial, lambda _: None)

    async def latency(made: Rig) -> object:
        return await light_latency(made.trial, lambda _: None, 70.0)

    with pytest.raises(LevelsError, match="noise widths"):
        measure(RobotProfile(), levels)
    with pytest.raises(LevelsError, match="a flip of the projector was not seen"):
        measure(RobotProfile(), latency)


def test_a_link_lost_on_the_way_is_told() -> None:
    async def step(made: Rig) -> object:
        made.twin.after(5.0, made.twin.drop_link)
        return await least_speed(made.trial)

    with pytest.raises(CharacteriseError, match="the link was lost"):
        measure(RobotProfile(), step)


def test_a_robot_that_feels_no_wall_is_told() -> None:
    async def step(made: Rig) -> Finding:
        made.body.on_bump = None
        return await collision_axes(made.trial)

    with pytest.raises(CharacteriseError, match="it reported no bump within"):
        measure(RobotProfile(), step)


def test_a_room_without_long_runs_is_told() -> None:
    with pytest.raises(CharacteriseError, match="hardly a run is longer than 25 cm"):
        measure(RobotProfile(), lambda made: roll_runs(made.trial, [40] * 4), floor=box(-7, -7, 7, 7))


def test_findings_become_a_profile_with_its_story(tmp_path) -> None:
    findings = (
        Finding.of("cm_s_per_unit", Figure(0.5212345678, 0.002, 20), "camera"),
        Finding("collision_axes", ("back", "left"), None, 10, "bumps"),
        Finding("drift_rad_per_cm", None, None, 0, "needs a camera"),
    )
    profile = applied(RobotProfile(least_interval_s=0.04), findings)
    path = tmp_path / "robot-profile.toml"
    save_profile(profile, path, comments_of(findings))
    read = load_profile(path)
    assert read == profile
    assert (read.cm_s_per_unit, read.collision_axes, read.drift_rad_per_cm) == (0.521235, ("back", "left"), 0.0)
    assert read.least_interval_s == 0.04
    text = path.read_text(encoding="utf-8")
    assert "measured: camera; ± 0.002, n = 20" in text
    assert "not measured: needs a camera" in text


def test_a_figure_of_nothing_is_not_measured() -> None:
    finding = Finding.of("motion_latency_s", mean_of([]), "hops")
    assert finding.value is None
    assert "not measured" in finding.comment


def test_the_neutral_profile_changes_nothing_on_the_way() -> None:
    plain = neutral(hidden_profile(3))
    assert [plain.speed_units(float(units)) for units in (1, 20, 255)] == [1, 20, 255]
    assert (plain.locator_scale, plain.collision_axes) == (1.0, ("right", "forward"))


def test_a_robot_without_latencies_has_none() -> None:
    async def both(made: Rig) -> tuple[float, float]:
        return (
            (await motion_latency(made.trial)).number,
            (await light_latency(made.trial, made.show, 70.0)).number,
        )

    motion_s, light_s = measure(RobotProfile(), both)
    assert 0.0 <= motion_s < 0.003
    assert 0.0 <= light_s < 0.003
