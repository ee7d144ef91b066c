from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import Callable

import pytest

from lab.clock import run
from robot import commands
from robot.bolt import Bolt
from robot.device import Attitude
from robot.errors import DriveError, LinkLostError, NotConnectedError, ReconnectError, RobotNotFoundError
from robot.profile import RobotProfile
from robot.virtual.bolt import BoltSettings
from robot.virtual.radio import AirSettings

SET_UP = 14
"""Commands of a set-up that arms a stream and an LED: three stops and a wake, ten others."""


def now_s() -> float:
    return asyncio.get_running_loop().time()


def heard_by(bench, at_each: Callable[[int], None] = lambda n: None) -> list:
    """Every (command, data) that reaches the virtual robot from now on; ``at_each`` is called with their count."""
    seen: list = []
    firmware = bench.virtual._firmware
    handle = firmware.handle

    def spy(packet) -> None:
        seen.append(((packet.did, packet.cid), packet.data))
        handle(packet)
        at_each(len(seen))

    firmware.handle = spy
    return seen


async def lose(bench, break_it: Callable[[], None]) -> str:
    """Break the link and wait until that is told."""
    told: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    def on_lost(reason: str) -> None:
        bench.lost.append(reason)
        if not told.done():
            told.set_result(reason)

    bench.robot.on_lost = on_lost
    break_it()
    async with asyncio.timeout(5.0):
        return await told


def attempts_of(bench) -> list[float]:
    """When each attempt to connect began and the robot was not found."""
    begun: list[float] = []
    opened = bench.robot._link.open

    async def spy() -> None:
        begun.append(now_s())
        await opened()

    bench.robot._link.open = spy
    return begun


def test_it_takes_up_what_it_did_but_rolling(bench) -> None:
    async def main() -> None:
        attitudes: list[Attitude] = []
        async with bench(position_cm=(-40.0, 0.0), facing_rad=1.0) as b:
            b.robot.on_attitude = attitudes.append
            await b.robot.set_led(0.5)
            await b.robot.start_stream(0.1, attitude=True)
            await b.robot.drive(1.0, 20.0)
            await asyncio.sleep(1.0)
            for round_number in (1, 2):
                seen = heard_by(b)
                assert await lose(b, b.virtual.drop_link) == "it disconnected"
                way_cm, lost_s = b.body.distance_cm, now_s()
                assert await b.robot.reconnect() == 1
                # Sooner than its own time-out: the first word that it heard was to stop, facing as it did.
                heading = round(math.degrees(1.0)) if round_number == 1 else 0
                assert seen[0] == (commands.DRIVE.key, bytes((0, 0, heading, 0)))
                assert now_s() - lost_s < 2.0
                assert b.body.speed_cm_s == 0.0
                if round_number == 1:
                    assert way_cm < b.body.distance_cm < way_cm + 20.0 * 0.8
                    assert [key for key, _ in seen] == [
                        *(commands.DRIVE.key, commands.WAKE.key, commands.DRIVE.key, commands.STREAM.key),
                        *(commands.STABILISATION.key, commands.LOCATOR_FLAGS.key, commands.RESET_YAW.key),
                        *(commands.RESET_LOCATOR.key, commands.COLLISION_SETUP.key, commands.STREAM.key),
                        *(commands.STREAM_EXTENDED.key, commands.STREAM.key, commands.MATRIX_COLOUR.key),
                    ]
                assert b.body.led_level == pytest.approx(128 / 255)
                count = len(b.samples)
                del attitudes[:]
                await asyncio.sleep(2.0)
                assert len(b.samples) - count == pytest.approx(20, abs=1)
                assert len(attitudes) == len(b.samples) - count
                # A new frame, here and now.
                assert (b.samples[-1].x_cm, b.samples[-1].y_cm, attitudes[-1].yaw_rad) == (0.0, 0.0, 0.0)
                # Once a connection.
                assert len(b.lost) == round_number
            facing_rad, way_cm = b.body.facing_rad, b.body.distance_cm
            await b.robot.drive(0.0, 20.0)
            await asyncio.sleep(1.0)
            await b.robot.stop()
            await asyncio.sleep(1.0)
            assert b.body.facing_rad == pytest.approx(facing_rad)
            assert b.samples[-1].y_cm == pytest.approx(b.body.distance_cm - way_cm, abs=1e-3)

    run(main(), virtual=True)


def test_what_was_not_asked_for_is_not_taken_up(bench) -> None:
    async def main() -> None:
        async with bench() as b:
            await b.robot.start_stream(0.1)
            await b.robot.stop_stream()
            await lose(b, b.virtual.drop_link)
            seen = heard_by(b)
            await b.robot.reconnect()
            assert {key for key, _ in seen}.isdisjoint({commands.STREAM_EXTENDED.key, commands.MATRIX_COLOUR.key})
            await asyncio.sleep(10.0)
            assert b.samples == []
            assert len(b.lost) == 1
            # Nor after a farewell and a new beginning.
            await b.robot.start_stream(0.1)
            await b.robot.disconnect()
            await b.robot.connect()
            await lose(b, b.virtual.drop_link)
            count = len(b.samples)
            await b.robot.reconnect()
            await asyncio.sleep(5.0)
            assert len(b.samples) == count

    run(main(), virtual=True)


def test_raw_motors_are_off_before_anything_else(bench) -> None:
    async def main() -> None:
        async with bench() as b:
            await b.robot.raw_motors(40, 40)
            seen = heard_by(b)
            await lose(b, b.virtual.drop_link)
            await b.robot.reconnect()
            assert seen[0] == (commands.RAW_MOTORS.key, bytes(4))
            assert seen[1][0] == commands.DRIVE.key
            assert (commands.STABILISATION.key, b"\x01") in seen
            assert b.body.speed_cm_s == 0.0

    run(main(), virtual=True)


@pytest.mark.parametrize("away_s", [3.0, 10.0, 40.0])
@pytest.mark.parametrize("told", [False, True])
def test_a_robot_that_was_away_for_a_while_comes_back(bench, away_s: float, told: bool) -> None:
    async def main() -> None:
        async with bench(position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            await b.robot.start_stream(0.05)
            await b.robot.drive(0.0, 10.0)
            await asyncio.sleep(1.0)
            back_s = now_s() + away_s
            await lose(b, lambda: b.virtual.drop_link(away_s) if told else b.virtual.vanish(away_s))
            attempts = await b.robot.reconnect()
            assert 1 <= attempts <= 4
            # Heard as soon as it advertises, but for a pause and the set-up.
            assert now_s() - max(back_s, 0) <= 8.0 + 3.0
            count = len(b.samples)
            await asyncio.sleep(1.0)
            assert len(b.samples) == pytest.approx(count + 20, abs=2)
            assert len(b.lost) == 1

    run(main(), virtual=True)


def test_it_pauses_longer_each_time_and_gives_up_in_time(bench) -> None:
    async def main() -> None:
        async with bench(profile=RobotProfile(scan_timeout_s=1.0)) as b:
            begun = attempts_of(b)
            await lose(b, b.virtual.drop_link)
            await b.virtual.close()
            before = asyncio.all_tasks()
            start_s = now_s()
            with pytest.raises(ReconnectError, match="SB-1234 did not come back in 40 s and 8 attempts: ") as caught:
                await b.robot.reconnect(40.0)
            assert (caught.value.attempts, caught.value.give_up_s) == (8, 40.0)
            assert "no robot called SB-1234" in caught.value.reason
            assert "\n" not in str(caught.value)
            assert isinstance(caught.value.__cause__, RobotNotFoundError)
            pauses = [q - p - 1.0 for p, q in itertools.pairwise(begun)]
            assert pauses == pytest.approx([0.5, 1.0, 2.0, 4.0, 8.0, 8.0, 8.0], abs=1e-3)
            assert now_s() - start_s <= 40.0
            assert asyncio.all_tasks() == before
            # In the middle of an attempt too.
            start_s = now_s()
            with pytest.raises(ReconnectError, match=r"in 0\.7 s and 1 attempt: .*out of time"):
                await b.robot.reconnect(0.7)
            assert now_s() - start_s == pytest.approx(0.7, abs=0.01)
            assert asyncio.all_tasks() == before
            with pytest.raises(NotConnectedError):
                await b.robot.stop()
            assert len(b.lost) == 1

    run(main(), virtual=True)


def test_a_radio_that_is_switched_off_and_on_again_is_waited_for(bench) -> None:
    async def main() -> None:
        async with bench() as b:
            await b.robot.set_led(1.0)
            central = b.radio._central
            await lose(b, b.virtual.drop_link)
            b.radio._central = None
            waiting = asyncio.ensure_future(b.robot.reconnect())
            await asyncio.sleep(10.0)
            assert not waiting.done()
            b.radio._central = central
            assert await waiting > 3
            assert await b.robot.battery_v() > 3

    run(main(), virtual=True)


@pytest.mark.parametrize("nth", range(1, SET_UP))
@pytest.mark.parametrize("silently", [False, True])
def test_one_that_drops_again_during_set_up_is_tried_again(bench, nth: int, silently: bool) -> None:
    async def main() -> None:
        async with bench() as b:
            await b.robot.set_led(1.0)
            await b.robot.start_stream(0.05)
            await lose(b, b.virtual.drop_link)

            def drop(count: int) -> None:
                if count == nth:
                    b.virtual.vanish(2.0) if silently else b.virtual.drop_link()

            heard_by(b, drop)
            attempts = await b.robot.reconnect()
            assert 1 <= attempts <= 3
            if attempts == 1:
                # It broke with the last answer, or was back before it was missed.
                assert silently or nth == SET_UP - 1
                return
            assert len(b.lost) == 1
            assert b.body.led_level == 1.0
            count = len(b.samples)
            await asyncio.sleep(1.0)
            assert len(b.samples) == pytest.approx(count + 20, abs=2)

    run(main(), virtual=True)


@pytest.mark.parametrize("cut_ms", [0, 1, 20, 60, 120, 180, 250, 333, 600, 800, 1000, 1250, 1500, 2000, 5000])
@pytest.mark.parametrize("away_s", [0.0, 1.0])
def test_a_reconnect_that_is_cancelled_leaves_nothing(bench, cut_ms: int, away_s: float) -> None:
    async def main() -> None:
        async with bench(air=AirSettings(latency_s=0.01)) as b:
            await b.robot.start_stream(0.05)
            await b.robot.set_led(1.0)
            await asyncio.sleep(0.5)
            await lose(b, lambda: b.virtual.drop_link(away_s))
            await asyncio.sleep(0.2)
            before = asyncio.all_tasks()
            coming = asyncio.ensure_future(b.robot.reconnect())
            await asyncio.sleep(cut_ms / 1000)
            coming.cancel()
            await asyncio.wait([coming])
            if not coming.cancelled():
                assert coming.result() >= 1
                return
            await asyncio.sleep(0.5)
            assert asyncio.all_tasks() == before
            assert not b.virtual.is_connected
            assert len(b.lost) == 1
            count = len(b.samples)
            await asyncio.sleep(2.0)
            assert len(b.samples) == count
            # And nothing is in the way of the next.
            assert await b.robot.reconnect() >= 1
            assert b.body.led_level == 1.0

    run(main(), virtual=True)


def test_one_that_fell_asleep_is_woken(bench) -> None:
    async def main() -> None:
        async with bench(manners=BoltSettings()) as b:
            # It forgets its sleep on a new connection unless it is held to it.
            boot = b.virtual._firmware.boot

            def doze() -> None:
                boot()
                b.virtual._firmware.asleep = True

            b.virtual._firmware.boot = doze
            assert await lose(b, b.virtual._firmware.fall_asleep) == "it fell asleep"
            assert await b.robot.reconnect() == 1
            assert not b.virtual.asleep
            assert await b.robot.battery_v() > 3

    run(main(), virtual=True)


@pytest.mark.parametrize("after_s", [0.1, 0.4, 1.0, 3.0])
def test_a_farewell_ends_it(bench, after_s: float) -> None:
    async def main() -> None:
        async with bench() as b:
            await lose(b, lambda: b.virtual.drop_link(for_s=0.5))
            coming = asyncio.ensure_future(b.robot.reconnect())
            await asyncio.sleep(after_s)
            settled = coming.done()
            await b.robot.disconnect()
            if not settled:
                with pytest.raises(ReconnectError):
                    await coming
            await asyncio.sleep(15.0)
            assert not b.virtual.is_connected
            assert len(b.lost) == 1

    run(main(), virtual=True)


def test_what_is_connected_needs_no_attempt_and_no_time_is_no_time() -> None:
    async def main() -> None:
        for wrong in (0.0, -1.0, math.inf, math.nan):
            with pytest.raises(DriveError, match="ask for a time above 0"):
                await Bolt("SB-1234").reconnect(wrong)

    run(main(), virtual=True)


def test_a_connected_robot_is_left_alone(bench) -> None:
    async def main() -> None:
        async with bench() as b:
            seen = heard_by(b)
            assert await b.robot.reconnect() == 0
            assert seen == []

    run(main(), virtual=True)


@pytest.mark.parametrize("again", [False, True])
def test_one_that_breaks_with_the_last_answer_of_the_set_up_is_not_taken_for_connected(bench, again: bool) -> None:
    """Nobody would ever be told: those who tell are not at work yet, and those who ask have been answered."""

    async def main() -> None:
        async with bench() as b:
            await lose(b, b.virtual.drop_link)
            link, last = b.robot._link, [True]
            ask = link.ask

            async def broken(request, **options) -> bytes:
                answer = await ask(request, **options)
                if request.command is commands.COLLISION_SETUP and last:
                    last.clear()
                    link.fail("it went in that very turn")
                return answer

            link.ask = broken
            if again:
                assert await b.robot.reconnect() == 2
                assert await b.robot.battery_v() > 3
            else:
                with pytest.raises(LinkLostError, match="broke while it was set up"):
                    await b.robot.connect()
            assert len(b.lost) == 1

    run(main(), virtual=True)
