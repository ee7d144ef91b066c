from __future__ import annotations

import asyncio
import math
import tomllib
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lab.base.errors import RequestError
from lab.clock import run
from robot import commands
from robot.commands import Collision
from robot.errors import DriveError
from robot.profile import RobotProfile, load_profile, save_profile
from robot.virtual.body import BodySettings
from robot.virtual.bolt import body_settings

KEYS = [field.name for field in fields(RobotProfile)]
POSITIVE = st.floats(1e-300, 1e300)
LEVELS = st.tuples(st.floats(0.0, 100.0), st.floats(100.5, 1e5))
PROFILES = st.builds(
    lambda levels, **values: RobotProfile(dark_lux=levels[0], bright_lux=levels[1], **values),
    st.one_of(LEVELS, st.just((None, None)), st.tuples(st.none(), st.floats(0, 1e5))),
    cm_s_per_unit=POSITIVE,
    refresh_s=POSITIVE,
    silence_s=POSITIVE,
    command_pacing_s=st.floats(0.0, 10.0),
    collision_dead_s=st.floats(0.0, 2.55),
    write_with_response=st.booleans(),
    collision_threshold=st.integers(1, 255),
    least_speed_units=st.integers(1, 255),
    least_interval_s=POSITIVE,
    motion_latency_s=st.floats(0.0, 5.0),
    light_latency_s=st.floats(0.0, 5.0),
    drift_rad_per_cm=st.floats(-1.0, 1.0),
    locator_scale=POSITIVE,
    reply_flags=st.integers(0, 63).map(lambda n: 2 * n + 1),
    collision_axes=st.tuples(st.sampled_from(["right", "left"]), st.sampled_from(["forward", "back"])).flatmap(
        lambda pair: st.sampled_from([pair, pair[::-1]])
    ),
)


@given(profile=PROFILES)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
def test_what_is_saved_is_read_back_bit_by_bit(tmp_path: Path, profile: RobotProfile) -> None:
    path = tmp_path / "robot.toml"
    save_profile(profile, path)
    assert load_profile(path) == profile
    plain = tomllib.loads(path.read_text(encoding="utf-8"))
    for key, value in plain.items():
        written = getattr(profile, key)
        assert value == (list(written) if isinstance(written, tuple) else written)
        assert type(value) is (list if isinstance(written, tuple) else type(written))
    assert set(KEYS) - set(plain) <= {"dark_lux", "bright_lux"}


def test_each_key_has_one_line_with_its_comment(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    profile = RobotProfile(cm_s_per_unit=np.float64(0.61), dark_lux=3)
    comments = {"cm_s_per_unit": "40 runs,\n±0.004\x07", "bright_lux": "lamp was off"}
    save_profile(profile, path, comments)
    lines = path.read_text(encoding="utf-8").splitlines()[1:]
    assert [line.removeprefix("# ").split()[0].rstrip(":") for line in lines] == KEYS
    assert "cm_s_per_unit = 0.61  # 40 runs, ±0.004" in lines
    assert "refresh_s = 0.8  # default" in lines
    assert "dark_lux = 3  # set" in lines
    assert "# bright_lux: not measured  # lamp was off" in lines
    assert load_profile(path) == profile


def test_missing_keys_are_defaults(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text("", encoding="utf-8")
    assert load_profile(path) == RobotProfile()
    path.write_text('collision_axes = ["back", "left"]\nlocator_scale = 2\n', encoding="utf-8")
    assert load_profile(path) == RobotProfile(collision_axes=("back", "left"), locator_scale=2.0)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("speed", "1"),
        ("profile", "{ cm_s_per_unit = 1.0 }"),
        ("cm_s_per_unit", "0"),
        ("cm_s_per_unit", "nan"),
        ("cm_s_per_unit", "inf"),
        ("cm_s_per_unit", "true"),
        ("cm_s_per_unit", '"fast"'),
        pytest.param("refresh_s", f"1{'0' * 400}", id="a number that no float holds"),
        ("write_with_response", "1"),
        ("least_speed_units", "0"),
        ("least_speed_units", "256"),
        ("least_speed_units", "20.0"),
        ("collision_threshold", "false"),
        ("least_interval_s", "-0.025"),
        ("motion_latency_s", "-1e-9"),
        ("drift_rad_per_cm", "-inf"),
        ("reply_flags", "0x38"),
        ("reply_flags", "0xB9"),
        ("reply_flags", "-1"),
        ("collision_axes", '["right", "left"]'),
        ("collision_axes", '["right", 3]'),
        ("collision_axes", '"right"'),
        ("collision_axes", "[[1], [2]]"),
        ("collision_dead_s", "2.6"),
        ("dark_lux", '"none"'),
        ("dark_lux", "-1"),
    ],
)
def test_a_bad_key_or_value_is_named_with_its_file(tmp_path: Path, key: str, value: str) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(f"{key} = {value}\n", encoding="utf-8")
    with pytest.raises(RequestError) as caught:
        load_profile(path)
    assert str(path) in str(caught.value)
    assert f"`{key}`" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_levels_that_do_not_differ_are_refused() -> None:
    for dark, bright in ((5.0, 5.0), (6.0, 5.0)):
        with pytest.raises(RequestError, match="below"):
            RobotProfile(dark_lux=dark, bright_lux=bright)


def test_files_that_cannot_be_read_or_written_say_so(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="No such file"):
        load_profile(tmp_path / "absent.toml")
    for rubbish in (b"a = = 1", b"\xff\xfe"):
        (tmp_path / "rubbish.toml").write_bytes(rubbish)
        with pytest.raises(RequestError, match="is not TOML"):
            load_profile(tmp_path / "rubbish.toml")
    with pytest.raises(RequestError, match="choose another file"):
        save_profile(RobotProfile(), tmp_path / "absent" / "robot.toml")
    good = tmp_path / "good.toml"
    save_profile(RobotProfile(), good)
    before = good.read_bytes()
    with pytest.raises(RequestError, match="no `speed`"):
        save_profile(RobotProfile(refresh_s=0.5), good, {"speed": "?"})
    assert good.read_bytes() == before


@given(scale=st.floats(0.1, 2.0), least=st.integers(1, 200), share=st.floats(0.0, 1.0))
def test_a_speed_takes_the_nearest_byte_that_rolls(scale: float, least: int, share: float) -> None:
    profile = RobotProfile(cm_s_per_unit=scale, least_speed_units=least)
    speed = share * 255 * scale
    nearest = min(range(256), key=lambda units: (abs(units * scale - speed), units % 2))
    wanted = max(1, nearest) if speed > 0 else 0
    if speed > 0 and wanted < least:
        with pytest.raises(DriveError, match=f"at least {least * scale:.4g} cm/s") as caught:
            profile.speed_units(speed)
        assert caught.value.value == speed
    else:
        assert abs(profile.speed_units(speed) * scale - speed) <= abs(wanted * scale - speed) + 1e-9
    assert profile.speed_units(profile.least_speed_cm_s) == least
    assert profile.speed_units(0.0) == 0


# The twin behaves as its profile says, whatever the driver believes.

RASH = RobotProfile(command_pacing_s=0.0, least_interval_s=0.001)


def roll(bench, script, **options) -> None:
    async def main() -> None:
        async with bench(**{"profile": RASH, **options}) as b:
            await script(b)

    run(main(), virtual=True)


def now_s() -> float:
    return asyncio.get_running_loop().time()


@pytest.mark.parametrize("scale", [0.3, 0.59, 1.1])
def test_a_speed_byte_is_worth_what_the_profile_says(bench, scale: float) -> None:
    async def script(b) -> None:
        await b.robot.drive(0.0, 59.0 * 0.5)  # 50 units to the driver
        await asyncio.sleep(1.5)
        b.body.advance(now_s())
        assert b.body.speed_cm_s == pytest.approx(50 * scale)

    roll(bench, script, truth=RobotProfile(cm_s_per_unit=scale), position_cm=(-50.0, 0.0), facing_rad=0.0)


def test_the_least_speed_byte_rolls_and_the_one_below_does_not(bench) -> None:
    async def script(b) -> None:
        for units, rolls in ((19, False), (20, True), (0, False), (19, False)):
            await b.robot.drive(0.0, units * 0.59)
            await asyncio.sleep(1.0)
            b.body.advance(now_s())
            assert (b.body.speed_cm_s > 0) is rolls

    roll(bench, script, truth=RobotProfile(least_speed_units=20), position_cm=(-50.0, 0.0), facing_rad=0.0)


@pytest.mark.parametrize(
    ("interval_s", "least_s", "holds"), [(0.02, 0.025, False), (0.025, 0.025, True), (0.02, 0.01, True)]
)
def test_a_stream_faster_than_the_least_interval_breaks_the_link(bench, interval_s, least_s, holds) -> None:
    async def script(b) -> None:
        await b.robot.start_stream(interval_s)
        await asyncio.sleep(5.0)
        assert (b.lost == []) is holds
        assert b.virtual.is_connected is holds
        # It went well for a moment, as it does, and the robot can be had again.
        assert len(b.samples) == pytest.approx((5.0 if holds else 1.0) / interval_s, abs=2)
        if not holds:
            await b.robot.connect()
            await b.robot.start_stream(least_s)
            await asyncio.sleep(5.0)
            assert b.virtual.is_connected

    roll(bench, script, truth=RobotProfile(least_interval_s=least_s))


def test_a_stream_slowed_down_in_time_keeps_the_link(bench) -> None:
    async def script(b) -> None:
        for interval_s in (0.02, 0.05, 0.01, 0.1):
            await b.robot.start_stream(interval_s)
            await asyncio.sleep(0.5)
        await b.robot.start_stream(0.01)
        await b.robot.stop_stream()
        await asyncio.sleep(5.0)
        assert b.lost == []

    roll(bench, script)


@pytest.mark.parametrize("late_s", [0.0, 0.13])
def test_motion_begins_and_ends_late(bench, late_s: float) -> None:
    async def script(b) -> None:
        # Without ways through the air, a command arrives when it is given.
        told_s = now_s()
        await b.robot.drive(0.0, 29.5)
        for _ in range(60):
            await asyncio.sleep(0.013)
            b.body.advance(now_s())
            rolled_s = max(0.0, now_s() - told_s - late_s)
            # To 29.5 cm/s at 80 cm/s², then evenly.
            ramp_s = min(rolled_s, 29.5 / 80.0)
            assert b.body.distance_cm == pytest.approx(40.0 * ramp_s**2 + 29.5 * (rolled_s - ramp_s), abs=1e-4)
        told_s, rolled_cm = now_s(), b.body.distance_cm
        await b.robot.stop()
        await asyncio.sleep(1.0)
        b.body.advance(now_s())
        assert b.body.distance_cm - rolled_cm == pytest.approx(29.5 * late_s + 29.5**2 / 160.0, abs=1e-3)

    roll(bench, script, truth=RobotProfile(motion_latency_s=late_s), position_cm=(-50.0, 0.0), facing_rad=0.0)


@pytest.mark.parametrize("late_s", [0.0, 0.02, 0.05, 0.12, 0.3])
def test_light_is_told_late_to_the_instant(bench, late_s: float) -> None:
    async def script(b) -> None:
        began_s = now_s()
        await b.robot.start_stream(0.05)
        await asyncio.sleep(3.0)
        # The light is the time itself; what is older than the stream was sensed when it began.
        told = [sample.light_lux for sample in b.samples]
        sensed = [max(began_s, sample.t_host_s - late_s) for sample in b.samples]
        assert len(told) >= 59
        assert told == pytest.approx(sensed, abs=1e-4)
        # A second stream tells nothing of the first.
        await b.robot.stop_stream()
        await asyncio.sleep(3.0)
        b.samples.clear()
        began_s = now_s()
        await b.robot.start_stream(0.1)
        await asyncio.sleep(1.0)
        told = [sample.light_lux for sample in b.samples]
        assert told == pytest.approx([max(began_s, each.t_host_s - late_s) for each in b.samples], abs=1e-4)

    def clock_lux(x: np.ndarray, _: np.ndarray) -> np.ndarray:
        return np.full_like(x, now_s())

    truth = RobotProfile(light_latency_s=late_s)
    roll(bench, script, truth=truth, light_at=clock_lux)


@pytest.mark.parametrize("drift", [0.004, -0.01])
def test_a_run_bends_clockwise_by_the_drift(bench, drift: float) -> None:
    async def script(b) -> None:
        await b.robot.drive(0.0, 29.5)
        await asyncio.sleep(2.0)
        b.body.advance(now_s())
        # An arc of curvature -drift (clockwise) that leaves along x.
        way = b.body.distance_cm
        assert way > 40.0
        x_cm, y_cm = math.sin(drift * way) / drift, -(1 - math.cos(drift * way)) / drift
        assert (b.body.x_cm + 50.0, b.body.y_cm) == pytest.approx((x_cm, y_cm), abs=2e-3)

    roll(bench, script, truth=RobotProfile(drift_rad_per_cm=drift), position_cm=(-50.0, 0.0), facing_rad=0.0)


def test_the_locator_is_off_by_its_scale(bench) -> None:
    async def script(b) -> None:
        await b.robot.start_stream(0.05)
        await b.robot.drive(0.0, 29.5)
        await asyncio.sleep(2.0)
        await b.robot.stop()
        await asyncio.sleep(1.0)
        b.body.advance(now_s())
        assert b.samples[-1].y_cm * 1.25 == pytest.approx(b.body.distance_cm, abs=1e-3)

    roll(bench, script, truth=RobotProfile(locator_scale=1.25), position_cm=(-50.0, 0.0), facing_rad=0.0)


def test_the_body_gets_the_profiles_errors_and_keeps_its_own() -> None:
    own = BodySettings(speed_error=0.07, locator_error=0.01)
    made = body_settings(RobotProfile(drift_rad_per_cm=-2e-3, locator_scale=0.8), own)
    assert (made.speed_error, made.locator_error) == (0.07, 0.01)
    assert (made.drift_bias_rad_per_cm, made.locator_bias) == pytest.approx((-2e-3, 0.25))
    assert body_settings(RobotProfile(), own) == own


@pytest.mark.parametrize("axes", [("right", "forward"), ("forward", "left"), ("back", "right"), ("left", "back")])
def test_collisions_are_reported_along_the_profiles_axes(bench, axes: tuple[str, str]) -> None:
    async def script(b) -> None:
        reports: list[Collision] = []
        b.robot._link.on_notification = lambda packet: (
            reports.append(Collision.decode(packet.data)) if packet.cid == commands.COLLISION.cid else None
        )
        # Up and to the right into the right wall, whose normal points to arena angle π: facing 0.5 rad, the
        # push comes from 0.5 rad left of dead ahead, so from behind the wall it goes back and to the left.
        await b.robot.drive(0.0, 40.0)
        await asyncio.sleep(1.6)
        (report,) = reports
        push = {"forward": -math.cos(0.5), "right": -math.sin(0.5)}
        push |= {"back": -push["forward"], "left": -push["right"]}
        size_g = math.hypot(report.x_g, report.y_g)
        assert (report.x_g / size_g, report.y_g / size_g) == pytest.approx([push[axis] for axis in axes], abs=2e-3)
        assert report.axis == (1 if abs(push[axes[0]]) > abs(push[axes[1]]) else 2)

    roll(bench, script, truth=RobotProfile(collision_axes=axes), position_cm=(20.0, 0.0), facing_rad=0.5)


@pytest.mark.parametrize("flags", [0x09, 0x19, 0x29, 0x39])
def test_answers_carry_the_profiles_flags(bench, flags: int) -> None:
    async def script(b) -> None:
        heard = []
        feed = b.robot._link.parser.feed
        b.robot._link.parser.feed = lambda chunk: heard.extend(found := feed(chunk)) or found
        await b.robot.stop()
        await b.robot.battery_v()
        drive, battery = heard
        assert (drive.flags, drive.did, drive.error) == (flags, 0x16, 0)
        assert drive.target == (0x01 if flags & 0x10 else None)
        assert drive.source == (0x12 if flags & 0x20 else None)
        assert battery.flags == 0x09

    roll(bench, script, truth=RobotProfile(reply_flags=flags))
