from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable

import pytest

from lab.clock import run
from robot import commands
from robot.bolt import Bolt
from robot.commands import Request
from robot.errors import (
    BluetoothUnavailableError,
    CommandError,
    LinkLostError,
    NotABoltError,
    NotConnectedError,
    ReplyTimeoutError,
    RobotNotFoundError,
    RobotUnreachableError,
)
from robot.link import ANTI_DOS_UUID, COMMANDS_UUID
from robot.profile import RobotProfile
from robot.virtual.bolt import SERVICES, BoltSettings
from robot.virtual.radio import AirSettings, GattService


def now_s() -> float:
    return asyncio.get_running_loop().time()


def lost_at(bench) -> list[tuple[float, str]]:
    """When the loss of the robot is told, and why."""
    told: list[tuple[float, str]] = []
    bench.robot.on_lost = lambda reason: told.append((asyncio.get_running_loop().time(), reason))
    return told


def swallowing(bench, swallows: Callable[[int], bool], *, obeyed: bool = False) -> list:
    """Let the robot take no notice of its n-th command, or not answer it, where ``swallows(n)``; what it obeys."""
    seen: list = []
    firmware = bench.virtual._firmware
    handle, send = firmware.handle, firmware._send
    count = itertools.count(1)

    def spy(packet) -> None:
        lost = swallows(next(count))
        if not lost or obeyed:
            seen.append((now_s(), packet))
            firmware._send = (lambda frame: None) if lost else send
            handle(packet)
            firmware._send = send

    firmware.handle = spy
    return seen


def heard_by(bench) -> list:
    """Every (time, packet) that the virtual robot obeys from now on."""
    return swallowing(bench, lambda _: False)


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
            with pytest.raises(BluetoothUnavailableError, match=r"powered off.*switch it on") as off:
                await other.connect()
            assert "\n" not in f"{caught.value}{off.value}"

    run(main(), virtual=True)


def test_a_robot_that_somebody_else_holds_is_not_heard_and_the_message_says_so(bench) -> None:
    async def main() -> None:
        async with bench() as b:
            backends = {"backend": b.radio.client_backend, "scanner_backend": b.radio.scanner_backend}
            second = Bolt("SB-1234", profile=RobotProfile(scan_timeout_s=2.0), **backends)
            with pytest.raises(
                RobotNotFoundError, match=r"connected elsewhere does not advertise.*close other"
            ) as caught:
                await second.connect()
            assert caught.value.seen == ()
            assert "\n" not in str(caught.value)
            # The one that holds it notices nothing.
            assert await b.robot.battery_v() > 3
            await b.robot.disconnect()
            await second.connect()
            with pytest.raises(RobotNotFoundError):
                await b.robot.connect()
            await second.disconnect()
            assert b.lost == []

    run(main(), virtual=True)


@pytest.mark.parametrize("missing", [ANTI_DOS_UUID, COMMANDS_UUID])
def test_another_kind_of_peripheral_is_told_and_let_go(bench, missing: str) -> None:
    async def main() -> None:
        async with bench(connect=False) as b:
            services = tuple(
                GattService(service.uuid, tuple(each for each in service.characteristics if each.uuid != missing))
                for service in SERVICES
            )
            lamp = await b.radio.add_peripheral("SB-1A3B", "D0:5F:B8:00:1A:3B", services)
            await lamp.start()
            backends = {"backend": b.radio.client_backend, "scanner_backend": b.radio.scanner_backend}
            with pytest.raises(NotABoltError, match=r"is no Sphero BOLT.*`chordlab robot scan`") as caught:
                await Bolt("SB-1A3B", **backends).connect()
            assert (caught.value.address, caught.value.missing) == ("D0:5F:B8:00:1A:3B", missing)
            assert "\n" not in str(caught.value)
            await asyncio.sleep(0.1)
            assert not lamp.is_connected

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


@pytest.mark.parametrize("cut_s", [0.0, 0.001, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5])
def test_a_connection_that_is_cancelled_leaves_nobody_connected(bench, cut_s: float) -> None:
    async def main() -> None:
        async with bench(connect=False, air=AirSettings(latency_s=0.01)) as b:
            before = asyncio.all_tasks()
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(cut_s):
                    await b.robot.connect()
            await asyncio.sleep(1.0)
            assert not b.virtual.is_connected
            assert asyncio.all_tasks() == before
            await b.robot.connect()
            assert await b.robot.battery_v() > 3

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


def test_a_link_that_breaks_under_a_question_says_so(bench) -> None:
    async def main() -> None:
        async with bench(air=AirSettings(latency_s=0.05)) as b:
            asking = asyncio.ensure_future(b.robot.battery_v())
            await asyncio.sleep(0.14)
            b.virtual.drop_link()
            with pytest.raises(LinkLostError, match="lost the link to SB-1234"):
                await asking

    run(main(), virtual=True)


@pytest.mark.parametrize("interval_s", [0.025, 0.05, 0.3, 1.0])
@pytest.mark.parametrize("phase_s", [0.0, 0.31, 0.79, 1.13])
@pytest.mark.parametrize("rolls", [False, True])
def test_a_streaming_robot_that_vanishes_is_noticed_within_3_s(bench, interval_s, phase_s, rolls) -> None:
    async def main() -> None:
        async with bench(position_cm=(-50.0, 0.0), facing_rad=0.0, air=AirSettings(latency_s=0.02)) as b:
            told = lost_at(b)
            await b.robot.start_stream(interval_s)
            if rolls:
                await b.robot.drive(0.0, 10.0)
            await asyncio.sleep(2.0 + phase_s)
            b.virtual.vanish(for_s=30.0)
            await asyncio.sleep(29.0)
            ((lost_s, _),) = told
            assert lost_s - b.samples[-1].t_host_s <= 3.0
            # A robot that nobody refreshes any more is at rest.
            b.body.advance(lost_s)
            assert b.body.speed_cm_s == 0.0

    run(main(), virtual=True)


@pytest.mark.parametrize("phase_s", [0.0, 0.1, 0.5, 0.79, 1.0])
def test_a_rolling_robot_that_vanishes_is_noticed_by_the_missing_reply(bench, phase_s: float) -> None:
    async def main() -> None:
        async with bench(position_cm=(-50.0, 0.0), facing_rad=0.0, air=AirSettings(latency_s=0.02)) as b:
            told = lost_at(b)
            await b.robot.drive(0.0, 10.0)
            await asyncio.sleep(1.6 + phase_s)
            gone_s = now_s()
            b.virtual.vanish(for_s=30.0)
            await asyncio.sleep(20.0)
            ((lost_s, reason),) = told
            assert lost_s - gone_s <= 3.0
            assert "did not answer `drive`" in reason

    run(main(), virtual=True)


def test_a_robot_that_does_not_hear_a_new_command_is_noticed_too(bench) -> None:
    async def main() -> None:
        async with bench() as b:
            told = lost_at(b)
            await asyncio.sleep(1.0)
            gone_s = now_s()
            b.virtual.vanish(for_s=30.0)
            with pytest.raises(ReplyTimeoutError, match="did not answer `drive` within 3 s"):
                await b.robot.drive(0.0, 10.0)
            ((lost_s, _),) = told
            assert lost_s - gone_s <= 3.0 + 1e-6
            with pytest.raises(NotConnectedError):
                await b.robot.stop()

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


@pytest.mark.parametrize("nth", [2, 3, 5, 7])
@pytest.mark.parametrize("obeyed", [False, True])
def test_a_robot_that_swallows_every_nth_command_or_answer_still_works(bench, nth: int, obeyed: bool) -> None:
    async def main() -> None:
        async with bench(connect=False, position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            seen = swallowing(b, lambda n: n % nth == 0, obeyed=obeyed)
            for step in (
                b.robot.connect, b.robot.identity, lambda: b.robot.start_stream(0.05), lambda: b.robot.set_led(0.5),
                b.robot.battery_state, lambda: b.robot.drive(0.0, 10.0),
            ):  # fmt: skip
                async with asyncio.timeout(15.0):
                    await step()
            start_cm, start_s = b.body.distance_cm, now_s()
            await asyncio.sleep(8.0)
            # It was never without a command for so long that it stopped by itself.
            b.body.advance(now_s())
            assert b.body.distance_cm - start_cm == pytest.approx((now_s() - start_s) * 10.0, rel=0.1)
            async with asyncio.timeout(3.5):
                await b.robot.stop()
            await asyncio.sleep(1.0)
            b.body.advance(now_s())
            assert b.body.speed_cm_s == 0.0
            assert b.lost == []
            assert 0xFF not in {packet.seq for _, packet in seen}

    run(main(), virtual=True)


def test_a_robot_that_swallows_everything_keeps_nobody_waiting(bench) -> None:
    async def main() -> None:
        async with bench(profile=RobotProfile(reply_timeout_s=4.0)) as b:
            told = lost_at(b)
            swallowing(b, lambda n: True)
            start_s = now_s()
            asked = (b.robot.battery_v(), b.robot.set_led(1.0), b.robot.charger_state(), b.robot.identity())
            answers = await asyncio.gather(*asked, return_exceptions=True)
            assert [type(answer) for answer in answers] == [ReplyTimeoutError] * 4
            assert now_s() - start_s == pytest.approx(4.0, abs=0.01)
            assert told == []
            with pytest.raises(ReplyTimeoutError):
                await b.robot.stop()
            assert now_s() - start_s <= 7.0 + 1e-6
            assert len(told) == 1
            await b.robot.disconnect()

    run(main(), virtual=True)


def test_a_drive_whose_answer_was_lost_is_not_sent_after_a_stop(bench) -> None:
    async def main() -> None:
        async with bench(position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            seen = swallowing(b, lambda n: n == 1, obeyed=True)
            driving = asyncio.ensure_future(b.robot.drive(0.0, 20.0))
            await asyncio.sleep(0.5)
            await b.robot.stop()
            # What it overtook ends quietly, and is neither sent again nor repeated.
            await driving
            await asyncio.sleep(10.0)
            assert [packet.data[0] for _, packet in seen if packet.cid == commands.DRIVE.cid] == [34, 0]
            assert b.body.speed_cm_s == 0.0
            assert b.lost == []

    run(main(), virtual=True)


def test_a_damaged_notification_is_dropped_with_a_warning(bench, caplog) -> None:
    async def main() -> None:
        async with bench() as b:
            # Whoever asked for no stream makes nothing of a frame.
            b.virtual._firmware.notify(commands.SENSOR_DATA, bytes(20))
            await b.robot.start_stream(1.0)
            b.virtual._firmware.notify(commands.SENSOR_DATA, bytes(6))
            b.virtual._firmware.notify(commands.CHARGER_CHANGED, b"\x02")
            await asyncio.sleep(0.1)
            assert b.samples == []
            assert caplog.text.count("dropped") == 1
            assert "dropped a notification of SB-1234" in caplog.text
            assert await b.robot.battery_v() > 3

    run(main(), virtual=True)


def test_a_profile_of_no_pauses_at_all_lets_the_clock_run(bench) -> None:
    async def main() -> None:
        profile = RobotProfile(command_pacing_s=0.0, keep_alive_s=1e-12, refresh_s=1e-12)
        async with bench(profile=profile) as b:
            heard = heard_by(b)
            await b.robot.drive(0.0, 10.0)
            await asyncio.sleep(0.5)
            assert 10 < len(heard) <= 600
            assert b.lost == []

    run(main(), virtual=True)
