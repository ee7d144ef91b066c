from __future__ import annotations

import asyncio
import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.base.errors import RequestError
from lab.clock import run
from robot import commands
from robot.bolt import Bolt, scan
from robot.collision import collision_acceleration, wall_normal_heading
from robot.commands import Request
from robot.device import RobotDevice
from robot.errors import (
    BluetoothUnavailableError,
    CommandError,
    DriveError,
    LinkLostError,
    NotConnectedError,
    ReplyTimeoutError,
    RobotNotFoundError,
    RobotUnreachableError,
)
from robot.packets import PacketParser
from robot.profile import RobotProfile
from robot.virtual.bolt import BoltSettings
from robot.virtual.radio import AirSettings


def drives(bench) -> list[tuple[float, int]]:
    """Record (time, speed byte) of every drive command that reaches the virtual robot."""
    seen: list[tuple[float, int]] = []
    firmware = bench.virtual._firmware
    handle = firmware.handle

    def spy(packet) -> None:
        if (packet.did, packet.cid) == commands.DRIVE.key:
            seen.append((asyncio.get_running_loop().time(), packet.data[0]))
        handle(packet)

    firmware.handle = spy
    return seen


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
            seen = drives(b)
            await b.robot.drive(0.0, 10.0)
            await asyncio.sleep(8.0)
            assert b.body.distance_cm == pytest.approx(80.0, abs=3.0)
            gaps = [q - p for (p, _), (q, _) in itertools.pairwise(seen)]
            assert max(gaps) <= 0.85
            assert len(seen) == 10
            await b.robot.stop()
            await asyncio.sleep(1.0)
            way_cm = b.body.distance_cm
            await asyncio.sleep(5.0)
            assert b.body.distance_cm == way_cm
            assert [units for _, units in seen[-2:]] == [17, 0]

    run(main(), virtual=True)


def test_disconnecting_stops_it(bench) -> None:
    async def main() -> None:
        async with bench(position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            await b.robot.set_led(1.0)
            await b.robot.drive(0.0, 20.0)
            await asyncio.sleep(1.0)
            seen = drives(b)
            await b.robot.disconnect()
            assert seen[-1][1] == 0
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


@given(normal=st.floats(0, 6.28), heading=st.floats(0, 6.28), size=st.floats(0.01, 8))
def test_the_two_readings_of_a_collision_agree(normal: float, heading: float, size: float) -> None:
    x_g, y_g = collision_acceleration(normal, heading, size)
    assert math.hypot(x_g, y_g) == pytest.approx(size)
    difference = math.remainder(wall_normal_heading(x_g, y_g, heading) - normal, 2 * math.pi)
    assert difference == pytest.approx(0.0, abs=1e-9)


def test_a_collision_without_a_direction_was_head_on() -> None:
    assert wall_normal_heading(0.0, 0.0, 1.0) == pytest.approx(1.0 + math.pi)
    # Thrown to its right while facing right (90°): the wall is behind, the way back is 180°.
    assert wall_normal_heading(1.0, 0.0, math.pi / 2) == pytest.approx(math.pi)


def test_it_is_kept_awake(bench) -> None:
    async def main() -> None:
        manners = BoltSettings(inactivity_s=9.0, sleep_notice_s=2.0)
        async with bench(manners=manners) as b:
            await asyncio.sleep(120.0)
            assert not b.virtual.asleep
            assert b.lost == []
            assert await b.robot.battery_v() > 3.0

    run(main(), virtual=True)


def test_will_sleep_is_answered_and_did_sleep_is_a_loss(bench) -> None:
    async def main() -> None:
        manners = BoltSettings(inactivity_s=5.0, sleep_notice_s=2.0)
        # A keep-alive so late that only the answer to the announcement keeps it awake.
        async with bench(manners=manners, profile=RobotProfile(keep_alive_s=1000.0)) as b:
            await asyncio.sleep(60.0)
            assert not b.virtual.asleep
            b.virtual._firmware.fall_asleep()
            await asyncio.sleep(1.0)
            assert b.lost == ["it fell asleep"]
            with pytest.raises(NotConnectedError, match="SB-1234 is not connected"):
                await b.robot.battery_v()

    run(main(), virtual=True)


def test_a_broken_link_is_told_once_and_can_be_made_again(bench) -> None:
    async def main() -> None:
        async with bench(position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            await b.robot.start_stream(0.05)
            await b.robot.drive(0.0, 10.0)
            await asyncio.sleep(1.0)
            b.virtual.drop_link()
            await asyncio.sleep(0.5)
            assert b.lost == ["it disconnected"]
            with pytest.raises(NotConnectedError):
                await b.robot.stop()
            # Nobody refreshes its command any more: it stops by itself.
            await asyncio.sleep(5.0)
            b.body.advance(asyncio.get_running_loop().time())
            assert b.body.speed_cm_s == 0.0
            await b.robot.connect()
            await b.robot.start_stream(0.05)
            count = len(b.samples)
            await asyncio.sleep(1.0)
            assert len(b.samples) == pytest.approx(count + 20, abs=1)
            await b.robot.disconnect()
            assert len(b.lost) == 1

    run(main(), virtual=True)


def test_a_link_that_breaks_under_a_question_says_so(bench) -> None:
    async def main() -> None:
        async with bench(air=AirSettings(latency_s=0.05)) as b:
            asking = asyncio.ensure_future(b.robot.battery_v())
            await asyncio.sleep(0.14)
            b.virtual.drop_link()
            with pytest.raises(LinkLostError, match="lost the link to SB-1234"):
                await asking

    run(main(), virtual=True)


def test_a_silent_stream_is_a_lost_link(bench) -> None:
    async def main() -> None:
        async with bench() as b:
            await b.robot.start_stream(0.05)
            await asyncio.sleep(1.0)
            b.virtual._firmware.stream_interval_s = 0.0
            start_s = asyncio.get_running_loop().time()
            b.robot.on_lost = lambda reason: b.lost.append(
                f"{reason} {asyncio.get_running_loop().time() - start_s:.1f}"
            )
            await asyncio.sleep(10.0)
            assert b.lost == ["no sample for 3 s 3.0"]

    run(main(), virtual=True)


def test_no_answer_and_refusals_are_told_apart(bench) -> None:
    async def main() -> None:
        async with bench(profile=RobotProfile(reply_timeout_s=2.0)) as b:
            with pytest.raises(CommandError, match="refused `stabilisation`: bad parameter") as caught:
                await b.robot._link.ask(Request(commands.STABILISATION, b"\x09"))
            assert (caught.value.code, caught.value.command, caught.value.robot) == (7, "stabilisation", "SB-1234")
            with pytest.raises(CommandError, match="wrong payload length"):
                await b.robot._link.ask(Request(commands.DRIVE, b"\x00"))
            b.virtual._firmware.handle = lambda packet: None
            with pytest.raises(ReplyTimeoutError, match="`battery voltage` within 2 s"):
                await b.robot.battery_v()
            # The keep-alive stays unanswered too.
            await asyncio.sleep(20.0)
            assert len(b.lost) == 1
            assert "did not answer `ping`" in b.lost[0]

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


def test_unknown_names_and_silent_radios_have_a_cure(bench) -> None:
    async def main() -> None:
        async with bench(connect=False) as b:
            backends = {"backend": b.radio.client_backend, "scanner_backend": b.radio.scanner_backend}
            other = Bolt("SB-FFFF", profile=RobotProfile(scan_timeout_s=2.0), **backends)
            with pytest.raises(RobotNotFoundError, match="heard only SB-1234") as caught:
                await other.connect()
            assert (caught.value.robot, caught.value.seen, caught.value.timeout_s) == ("SB-FFFF", ("SB-1234",), 2.0)
            lower = Bolt("sb-1234", **backends)
            await lower.connect()
            await lower.disconnect()
            await b.virtual.close()
            with pytest.raises(RobotNotFoundError, match="heard no robot at all"):
                await other.connect()
            await b.radio.close()
            with pytest.raises(BluetoothUnavailableError, match="powered off"):
                await other.connect()

    run(main(), virtual=True)


def test_a_robot_that_vanishes_after_it_was_heard_is_unreachable(bench) -> None:
    async def main() -> None:
        async with bench(connect=False, profile=RobotProfile(connect_timeout_s=3.0)) as b:
            connect = b.radio.connect

            async def vanish(address: str, timeout_s: float):
                await b.virtual._peripheral.hide()
                return await connect(address, timeout_s)

            b.radio.connect = vanish
            with pytest.raises(RobotUnreachableError, match="was heard but does not connect") as caught:
                await b.robot.connect()
            assert caught.value.address == "D0:5F:B8:00:12:34"
            b.radio.connect = connect
            await b.virtual._peripheral.advertise()
            await b.robot.connect()

    run(main(), virtual=True)


def test_a_refused_setup_leaves_nobody_connected(bench) -> None:
    async def main() -> None:
        async with bench(connect=False) as b:
            del b.virtual._firmware._handlers[commands.RESET_YAW.key]
            b.virtual._firmware._handlers[commands.RESET_YAW.key] = lambda _: (_ for _ in ()).throw(
                _refused(commands.BUSY)
            )
            with pytest.raises(CommandError, match="`reset yaw`: busy"):
                await b.robot.connect()
            await asyncio.sleep(0.1)
            assert not b.virtual.is_connected
            assert b.lost == []

    def _refused(code: int) -> Exception:
        from robot.virtual.firmware import _RefusedError

        return _RefusedError(code)

    run(main(), virtual=True)


def test_impossible_wishes_are_refused_before_the_radio(bench) -> None:
    async def main() -> None:
        async with bench() as b:
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
            await b.robot.set_led(0.25)
            assert b.body.led_level == pytest.approx(64 / 255)

    run(main(), virtual=True)


def test_a_damaged_notification_is_dropped_with_a_warning(bench, caplog) -> None:
    async def main() -> None:
        async with bench() as b:
            b.virtual._firmware.notify(commands.SENSOR_DATA, bytes(6))
            b.virtual._firmware.notify(commands.CHARGER_CHANGED, b"\x02")
            await asyncio.sleep(0.1)
            assert b.samples == []
            assert "dropped a notification of SB-1234" in caplog.text
            assert await b.robot.battery_v() > 3

    run(main(), virtual=True)


def test_profiles_hold_together() -> None:
    profile = RobotProfile()
    assert profile.speed_units(0.0) == 0
    assert profile.speed_units(0.01) == 1
    assert profile.speed_units(59.0) == 100
    assert profile.speed_units(profile.max_speed_cm_s) == 255
    for wrong in ({"refresh_s": 0.0}, {"collision_threshold": 300}, {"collision_dead_s": 3.0}, {"silence_s": math.nan}):
        with pytest.raises(RequestError, match=next(iter(wrong))):
            RobotProfile(**wrong)
    assert RobotProfile(command_pacing_s=0.0).command_pacing_s == 0.0


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


class _DeafLink:
    """A link that never changes: what its owner does has no effect on the next deadline."""

    is_open = True
    last_write_s = 0.0

    def __init__(self) -> None:
        self.asked = 0

    async def ask(self, request: Request) -> bytes:
        self.asked += 1
        return b""


def _counted(robot: Bolt, most: int) -> list[int]:
    """Let ``robot`` read the clock ``most`` times only, so that a busy loop fails instead of hanging."""
    loop = asyncio.get_running_loop()
    reads = [0]

    def now_s() -> float:
        reads[0] += 1
        if reads[0] > most:
            raise RuntimeError(f"busy at {loop.time()} s")
        return loop.time()

    robot._now_s = now_s
    return reads


async def _let_run(s: float, *tenders: asyncio.Task[None]) -> None:
    done, others = await asyncio.wait(tenders, timeout=s)
    for tender in others:
        tender.cancel()
    assert [str(tender.exception()) for tender in done] == []


def test_a_keep_alive_without_effect_does_not_stop_the_clock() -> None:
    async def main() -> None:
        robot = Bolt("SB-0000")
        link = robot._link = _DeafLink()
        _counted(robot, 20_000)
        await _let_run(10.0, asyncio.ensure_future(robot._tend()))
        # From 8 s on it is due in every turn, and a turn lasts at least a millisecond.
        assert 100 < link.asked <= 2_010

    run(main(), virtual=True)


@pytest.mark.parametrize("ahead_s", [0.0, 1e-16, 4e-10, 9e-10])
@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_two_deadlines_within_a_rounding_do_not_chase_each_other(ahead_s: float, turns: int) -> None:
    """A loop may wake its sleepers a clock's resolution early. One that then sleeps for the rest is woken
    at once when another is ready in that turn; two that do so in turn keep each other awake, and the clock still."""

    async def main() -> None:
        loop = asyncio.get_running_loop()
        first, second = Bolt("SB-0000"), Bolt("SB-0001")
        for robot in (first, second):
            robot._link = _DeafLink()
            robot._link.last_write_s = math.inf
            # Half a refresh is 0.4 s: awake at that instant, with the deadline just ahead.
            robot._refresh_at_s = 0.4 + ahead_s
            robot._speed_units = 1
            _counted(robot, 10_000)
        one = loop.create_task(first._tend())
        # Both are awake at 0.4 s, in turns of the loop that may differ.
        await asyncio.sleep(0.4)
        for _ in range(turns):
            await asyncio.sleep(0)
        two = loop.create_task(second._tend())
        await _let_run(4.7, one, two)
        assert loop.time() == pytest.approx(5.1, abs=0.01)
        # A repeat every 0.8 s from 0.4 s on.
        assert first._link.asked == second._link.asked == 6

    run(main(), virtual=True)


def test_the_watch_over_a_stream_does_not_chase_a_deadline_either() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        failed: list[float] = []
        tasks: list[asyncio.Task[None]] = []
        await asyncio.sleep(3.0)
        for n in range(2):
            robot = Bolt(f"SB-000{n}")
            link = robot._link = _DeafLink()
            link.fail = lambda reason: failed.append(loop.time())
            # A rounding before the silence is too long.
            robot._last_sample_s = 4e-10
            _counted(robot, 10_000)
            tasks.append(loop.create_task(robot._watch()))
            await asyncio.sleep(0)
        await asyncio.wait(tasks, timeout=5.0)
        assert failed == pytest.approx([3.0, 3.0], abs=0.01)

    run(main(), virtual=True)


def test_a_profile_of_no_pauses_at_all_lets_the_clock_run(bench) -> None:
    async def main() -> None:
        profile = RobotProfile(command_pacing_s=0.0, keep_alive_s=1e-12, refresh_s=1e-12)
        async with bench(profile=profile) as b:
            pinged = drives(b)
            await b.robot.drive(0.0, 10.0)
            await asyncio.sleep(0.5)
            assert 10 < len(pinged) <= 600
            assert b.lost == []

    run(main(), virtual=True)
