from __future__ import annotations

import asyncio
import itertools
import math

import pytest

from lab.clock import run
from robot import commands
from robot.bolt import Bolt, scan
from robot.commands import BatteryState, ChargerState, Request
from robot.device import Attitude, RobotDevice
from robot.errors import DriveError, NotConnectedError, PayloadError
from robot.packets import PacketParser
from robot.profile import RobotProfile
from robot.virtual.radio import AirSettings


def heard_by(bench) -> list:
    """Every (time, packet) that reaches the virtual robot from now on."""
    seen: list = []
    firmware = bench.virtual._firmware
    handle = firmware.handle

    def spy(packet) -> None:
        seen.append((asyncio.get_running_loop().time(), packet))
        handle(packet)

    firmware.handle = spy
    return seen


def drives_in(seen) -> list[tuple[float, int]]:
    """(time, speed byte) of each drive command."""
    return [(t_s, packet.data[0]) for t_s, packet in seen if (packet.did, packet.cid) == commands.DRIVE.key]


def test_a_bolt_is_a_robot() -> None:
    assert isinstance(Bolt("SB-0000"), RobotDevice)


def test_connect_identify_and_let_go(bench) -> None:
    async def main() -> None:
        async with bench(connect=False) as b:
            (heard,) = await scan(1.0, b.radio.scanner_backend)
            assert (heard.name, heard.address) == ("SB-1234", "D0:5F:B8:00:12:34")
            assert heard.rssi_dbm < 0
            await b.robot.connect()
            await b.robot.connect()
            identity = await b.robot.identity()
            assert (identity.name, identity.address) == ("SB-1234", "D0:5F:B8:00:12:34")
            assert identity.firmware == "6.0.46"
            assert identity.battery_v == pytest.approx(b.body.battery_v, abs=0.01)
            # A robot that is connected does not advertise.
            assert await scan(1.0, b.radio.scanner_backend) == []
            await b.robot.disconnect()
            await b.robot.disconnect()
            await asyncio.sleep(0.1)
            assert not b.virtual.is_connected
            assert len(await scan(1.0, b.radio.scanner_backend)) == 1
            assert b.lost == []

    run(main(), virtual=True)


@pytest.mark.parametrize("mtu", [23, 185])
def test_a_stream_carries_light_way_and_speed(bench, mtu: int) -> None:
    async def main() -> None:
        async with bench(air=AirSettings(mtu=mtu), position_cm=(-20.0, 0.0), facing_rad=0.5) as b:
            await b.robot.start_stream(0.05)
            await b.robot.drive(0.5 - 2 * math.pi, 20.0)
            await asyncio.sleep(2.0)
            await b.robot.stop()
            await asyncio.sleep(1.0)
            await b.robot.stop_stream()
            count = len(b.samples)
            await asyncio.sleep(1.0)
            assert len(b.samples) == count
            gaps = [q.t_host_s - p.t_host_s for p, q in itertools.pairwise(b.samples)]
            assert gaps == pytest.approx([0.05] * len(gaps), abs=1e-6)
            assert {round(sample.light_lux) for sample in b.samples} >= {20, 120}
            last = b.samples[-1]
            # Headings go out in whole degrees: 0.5 rad is 28.648°, sent as 29°.
            heading_rad = math.radians(29)
            assert last.x_cm == pytest.approx(b.body.distance_cm * math.sin(heading_rad), abs=1e-3)
            assert last.y_cm == pytest.approx(b.body.distance_cm * math.cos(heading_rad), abs=1e-3)
            assert last.speed_cm_s == 0.0
            assert max(sample.speed_cm_s for sample in b.samples) == pytest.approx(0.59 * 34, abs=1e-3)
            assert b.body.y_cm == pytest.approx(0.0, abs=0.6)
            assert b.robot.bad_frames == 0

    run(main(), virtual=True)


def test_it_keeps_rolling_while_the_host_lives_and_stops_when_told(bench) -> None:
    async def main() -> None:
        async with bench(position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            seen = heard_by(b)
            await b.robot.drive(0.0, 10.0)
            await asyncio.sleep(8.0)
            assert b.body.distance_cm == pytest.approx(80.0, abs=3.0)
            gaps = [q - p for (p, _), (q, _) in itertools.pairwise(drives_in(seen))]
            assert max(gaps) <= 0.85
            assert len(drives_in(seen)) == 10
            await b.robot.stop()
            await asyncio.sleep(1.0)
            way_cm = b.body.distance_cm
            await asyncio.sleep(5.0)
            assert b.body.distance_cm == way_cm
            assert [units for _, units in drives_in(seen)[-2:]] == [17, 0]

    run(main(), virtual=True)


def test_disconnecting_stops_it(bench) -> None:
    async def main() -> None:
        async with bench(position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            await b.robot.set_led(1.0)
            await b.robot.drive(0.0, 20.0)
            await asyncio.sleep(1.0)
            seen = heard_by(b)
            await b.robot.disconnect()
            assert drives_in(seen)[-1][1] == 0
            b.body.advance(asyncio.get_running_loop().time() + 5.0)
            assert b.body.speed_cm_s == 0.0
            assert b.body.led_level == 0.0
            # It stopped because it was told, before its own time-out.
            assert b.body.distance_cm < 20.0 * 1.6

    run(main(), virtual=True)


def test_bumps_point_back_into_the_arena(bench) -> None:
    async def main() -> None:
        async with bench(position_cm=(0.0, 0.0), facing_rad=2.0) as b:
            for heading_rad in (0.0, 2.0, 3.0, 4.5, 1.0):
                before = len(b.bumps)
                await b.robot.drive(heading_rad, 40.0)
                await asyncio.sleep(6.0)
                if len(b.bumps) == before:
                    assert b.body.pressed
                    continue
                away_rad = b.bumps[-1].normal_heading_rad
                start = (b.body.x_cm, b.body.y_cm)
                assert max(abs(start[0]) - 56.35, abs(start[1]) - 41.35) == pytest.approx(0.0, abs=1e-6)
                await b.robot.drive(away_rad, 40.0)
                await asyncio.sleep(1.3)
                # Straight away from the wall: one coordinate stays, to a degree.
                moved = sorted(abs(now - then) for now, then in zip((b.body.x_cm, b.body.y_cm), start, strict=True))
                assert moved[1] > 15.0
                assert moved[0] < 0.02 * moved[1]
            assert len(b.bumps) >= 5
            assert b.lost == []

    run(main(), virtual=True)


def test_a_profile_says_what_locator_speed_and_stream_are_worth(bench) -> None:
    """The driver is told the robot's hidden truth: what it reports is then what the body did."""
    truth = RobotProfile(locator_scale=0.8, least_speed_units=20, least_interval_s=0.04)

    async def main() -> None:
        async with bench(truth=truth, profile=truth, position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            with pytest.raises(DriveError, match=r"ask for at least 11\.8 cm/s"):
                await b.robot.drive(0.0, 5.0)
            with pytest.raises(DriveError, match=r"0\.03 s is impossible: ask for 0\.04 to 65 s .*`least_interval_s`"):
                await b.robot.start_stream(0.03)
            await b.robot.start_stream(0.04)
            await b.robot.drive(0.0, 20.0)
            await asyncio.sleep(2.0)
            rolling = b.samples[-1]
            await b.robot.stop()
            await asyncio.sleep(1.0)
            assert b.body.locator_cm[1] == pytest.approx(b.body.distance_cm / 0.8)
            assert b.samples[-1].y_cm == pytest.approx(b.body.distance_cm, rel=1e-6)
            assert rolling.speed_cm_s == pytest.approx(34 * 0.59, rel=1e-6)
            assert b.lost == []

    run(main(), virtual=True)


@pytest.mark.parametrize("axes", [("forward", "left"), ("left", "back")])
def test_bumps_are_read_along_the_axes_of_the_profile(bench, axes) -> None:
    async def main() -> None:
        truth = RobotProfile(collision_axes=axes)
        # Facing up the arena; the wall to the right is met at a slant.
        async with bench(truth=truth, profile=truth, position_cm=(30.0, 0.0), facing_rad=math.pi / 2) as b:
            await b.robot.drive(math.radians(60), 40.0)
            await asyncio.sleep(3.0)
            # From the wall on the right, straight back is to the left: heading 270°.
            assert b.bumps[0].normal_heading_rad == pytest.approx(1.5 * math.pi, abs=0.01)

    run(main(), virtual=True)


def test_aiming_makes_where_it_looks_its_forward(bench) -> None:
    async def main() -> None:
        attitudes: list[Attitude] = []
        # Facing the arena angle 115°; a heading of 115°, clockwise, then looks along the arena's x.
        turn_rad = math.radians(115)
        async with bench(position_cm=(-30.0, -10.0), facing_rad=turn_rad) as b:
            b.robot.on_attitude = attitudes.append
            await b.robot.start_stream(0.05, attitude=True)
            await b.robot.drive(math.radians(30), 20.0)
            await asyncio.sleep(0.5)
            seen = heard_by(b)
            await b.robot.aim(turn_rad)
            assert math.remainder(b.body.facing_rad, math.tau) == pytest.approx(0.0, abs=1e-6)
            assert b.body.speed_cm_s == 0.0
            assert drives_in(seen)[0][1] == 0
            (on_s, on), (off_s, off) = [(t_s, p.data) for t_s, p in seen if (p.did, p.cid) == commands.LEDS.key]
            assert (on, off) == (b"\x38\x00\x00\xff", b"\x38\x00\x00\x00")
            # It turned while the light was on: yaw runs against headings.
            lit = [attitude for attitude in attitudes if on_s < attitude.t_host_s < off_s]
            assert math.radians(-31) < lit[0].yaw_rad < 0
            assert min(attitude.yaw_rad for attitude in lit) == pytest.approx(-turn_rad, abs=1e-3)
            await asyncio.sleep(0.2)
            assert attitudes[-1] == Attitude(b.samples[-1].t_host_s, 0.0, 0.0, 0.0)
            way_cm, y_cm = b.body.distance_cm, b.body.y_cm
            await b.robot.drive(0.0, 20.0)
            await asyncio.sleep(1.0)
            await b.robot.stop()
            await asyncio.sleep(1.0)
            assert b.samples[-1].y_cm == pytest.approx(b.body.distance_cm - way_cm, abs=1e-3)
            assert b.samples[-1].x_cm == pytest.approx(0.0, abs=1e-3)
            assert b.body.y_cm == pytest.approx(y_cm, abs=1e-6)
            await b.robot.drive(0.0, 20.0)
            await asyncio.sleep(6.0)
            # The wall across the arena's x is met head on.
            assert b.bumps[-1].normal_heading_rad == pytest.approx(math.pi, abs=1e-3)

    run(main(), virtual=True)


def test_the_light_of_an_aim_goes_out_whatever_happens(bench) -> None:
    async def main() -> None:
        async with bench(facing_rad=0.0) as b:
            seen = heard_by(b)
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.5):
                    await b.robot.aim(1.0)
            assert [p.data[1:] for _, p in seen if (p.did, p.cid) == commands.LEDS.key][-1] == bytes(3)
            b.virtual.drop_link()
            await asyncio.sleep(0.1)
            with pytest.raises(NotConnectedError):
                await b.robot.aim(1.0)

    run(main(), virtual=True)


def test_an_attitude_costs_no_sample(bench) -> None:
    async def main() -> None:
        attitudes: list[Attitude] = []
        async with bench(air=AirSettings(mtu=23), position_cm=(-20.0, 0.0)) as b:
            b.robot.on_attitude = attitudes.append
            await b.robot.start_stream(0.05)
            await asyncio.sleep(1.0)
            assert attitudes == []
            await b.robot.start_stream(0.1, attitude=True)
            await asyncio.sleep(1.0)
            await b.robot.start_stream(0.05)
            await asyncio.sleep(1.0)
            # One before the two requests that follow the first, none lost or misread at either change.
            assert len(attitudes) == pytest.approx(11, abs=1)
            assert len(b.samples) == pytest.approx(20 + 10 + 20, abs=3)
            assert {round(sample.light_lux) for sample in b.samples} == {20}
            assert {a.t_host_s for a in attitudes} <= {sample.t_host_s for sample in b.samples}
            assert b.robot.bad_frames == 0

    run(main(), virtual=True)


def test_raw_motors_roll_until_told_to_stop(bench) -> None:
    async def main() -> None:
        async with bench(position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            seen = heard_by(b)
            await b.robot.raw_motors(34, 34)
            await asyncio.sleep(4.0)
            # Repeated as a drive is, or it would have stopped after 2 s.
            b.body.advance(asyncio.get_running_loop().time())
            assert b.body.distance_cm == pytest.approx(4.0 * 20.0, abs=5.0)
            powered = [p.data for _, p in seen if (p.did, p.cid) == commands.RAW_MOTORS.key]
            assert powered == [b"\x01\x22\x01\x22"] * 5
            del seen[:]
            await b.robot.stop()
            asked = [((p.did, p.cid), p.data) for _, p in seen]
            # Off at once, then balanced, then at rest: a drive command does nothing without balance.
            assert asked == [
                (commands.RAW_MOTORS.key, bytes(4)),
                (commands.STABILISATION.key, b"\x01"),
                (commands.DRIVE.key, bytes(4)),
            ]
            await asyncio.sleep(1.0)
            way_cm = b.body.distance_cm
            await asyncio.sleep(5.0)
            assert b.body.distance_cm == way_cm
            way_cm, x_cm = b.body.distance_cm, b.body.x_cm
            await b.robot.raw_motors(-34, -34)
            await asyncio.sleep(3.0)
            await b.robot.stop()
            await asyncio.sleep(1.0)
            # Back, all the way.
            assert x_cm - b.body.x_cm == pytest.approx(b.body.distance_cm - way_cm, abs=1e-6)
            assert b.body.distance_cm - way_cm == pytest.approx(3.0 * 20.0, abs=10.0)
            del seen[:]
            await b.robot.raw_motors(0, -120)
            assert [p.data for _, p in seen] == [b"\x00", b"\x00\x00\x02\x78"]
            await b.robot.drive(1.0, 10.0)
            await b.robot.drive(2.0, 10.0)
            assert [(p.did, p.cid) for _, p in seen[2:]] == [
                commands.RAW_MOTORS.key,
                commands.STABILISATION.key,
                commands.DRIVE.key,
                commands.DRIVE.key,
            ]

    run(main(), virtual=True)


def test_lights_battery_and_charger(bench) -> None:
    async def main() -> None:
        async with bench() as b:
            seen = heard_by(b)
            await b.robot.set_lights(front=(1, 2, 3))
            await b.robot.set_lights(back=(4, 5, 6))
            await b.robot.set_lights((7, 8, 9), (10, 11, 12))
            await b.robot.set_lights()
            assert [bytes(p.data) for _, p in seen] == [
                bytes((0x07, 1, 2, 3)),
                bytes((0x38, 4, 5, 6)),
                bytes((0x3F, 7, 8, 9, 10, 11, 12)),
            ]
            await b.robot.set_led(0.0)
            await b.robot.set_pixel(7, 0, (255, 0, 0))
            assert b.body.led_level == pytest.approx(1 / 64)
            states = []
            for charge in (1.0, 0.2, 0.05):
                b.body.battery_charge = charge
                states.append(await b.robot.battery_state())
            assert states == [BatteryState.OK, BatteryState.LOW, BatteryState.CRITICAL]
            assert await b.robot.charger_state() is ChargerState.NOT_CHARGING
            b.virtual._firmware._handlers[commands.CHARGER_STATE.key] = lambda _: b"\x03"
            assert await b.robot.charger_state() is ChargerState.CHARGED
            b.virtual._firmware._handlers[commands.CHARGER_STATE.key] = lambda _: b"\x07"
            with pytest.raises(PayloadError, match="`charger state` carried 1 bytes"):
                await b.robot.charger_state()

    run(main(), virtual=True)


def test_questions_are_paced_numbered_and_matched(bench) -> None:
    async def main() -> None:
        async with bench(profile=RobotProfile(keep_alive_s=1000.0)) as b:
            seen: list[tuple[float, int]] = []
            firmware = b.virtual._firmware
            handle = firmware.handle

            def spy(packet) -> None:
                seen.append((asyncio.get_running_loop().time(), packet.seq))
                handle(packet)

            firmware.handle = spy
            words = [bytes([n % 256, 0xAB, 0x8D]) for n in range(600)]
            # The time-out covers the wait for one's turn, so the questions come in small crowds.
            for start in range(0, 600, 20):
                asked = [b.robot._link.ask(Request(commands.PING, word)) for word in words[start : start + 20]]
                assert await asyncio.gather(*asked) == words[start : start + 20]
            gaps = [q - p for (p, _), (q, _) in itertools.pairwise(seen)]
            assert min(gaps) >= 0.075 - 1e-9
            assert {number for _, number in seen} == set(range(255))

    run(main(), virtual=True)


def test_real_commands_never_carry_the_number_of_notifications(bench) -> None:
    async def main() -> None:
        async with bench() as b:
            seen = heard_by(b)
            await b.robot.start_stream(0.05)
            for n in range(100):
                await b.robot.drive(n / 10, 5.0 + n / 100)
                await b.robot.set_led(n / 100)
                assert await b.robot.battery_v() > 3
            await b.robot.stop()
            numbers = [packet.seq for _, packet in seen]
            assert len(numbers) > 300
            assert 0xFF not in numbers
            assert {(q - p) % 255 for p, q in itertools.pairwise(numbers)} == {1}
            assert min(q - p for (p, _), (q, _) in itertools.pairwise(seen)) >= 0.075 - 1e-9
            # The stream that came meanwhile, numbered 0xFF throughout, was taken for no answer.
            assert len(b.samples) > 300
            assert b.lost == []

    run(main(), virtual=True)


def test_impossible_wishes_are_refused_before_the_radio(bench) -> None:
    async def main() -> None:
        async with bench() as b:
            heard = heard_by(b)
            with pytest.raises(DriveError, match="out of reach: ask for 0 to 150 cm/s"):
                await b.robot.drive(0.0, 200.0)
            with pytest.raises(DriveError):
                await b.robot.drive(0.0, -1.0)
            with pytest.raises(DriveError):
                await b.robot.drive(math.nan, 10.0)
            with pytest.raises(DriveError, match="0 to 1"):
                await b.robot.set_led(1.5)
            with pytest.raises(DriveError, match="impossible"):
                await b.robot.start_stream(0.0)
            with pytest.raises(DriveError, match="impossible"):
                await b.robot.start_stream(math.inf)
            for wrong in ((-1, 0), (0, 8), (8, 0)):
                with pytest.raises(DriveError, match="off the matrix: ask for 0 to 7"):
                    await b.robot.set_pixel(*wrong, (1, 2, 3))
            with pytest.raises(DriveError, match="a light level of 256 does not exist"):
                await b.robot.set_pixel(0, 0, (0, 256, 0))
            with pytest.raises(DriveError, match="a light level of -1 does not exist"):
                await b.robot.set_lights(back=(0, 0, -1))
            with pytest.raises(DriveError, match="a motor power of 256 does not exist: ask for -255 to 255"):
                await b.robot.raw_motors(0, 256)
            with pytest.raises(DriveError, match="finite"):
                await b.robot.aim(math.nan)
            assert heard == []
            await b.robot.set_led(0.25)
            assert b.body.led_level == pytest.approx(64 / 255)

    run(main(), virtual=True)


def test_the_parser_is_fresh_after_each_connection(bench) -> None:
    async def main() -> None:
        async with bench() as b:
            first = b.robot._link.parser
            first.feed(b"\x8d\x01\x02")
            await b.robot.disconnect()
            await b.robot.connect()
            assert b.robot._link.parser is not first
            assert isinstance(first, PacketParser)
            assert b.robot.bad_frames == 0

    run(main(), virtual=True)
