"""A robot never rolls on without a host: whatever ends the host, the body is at rest within its drive time-out."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from shapely.geometry import box

from lab.clock import run
from robot.bolt import Bolt
from robot.virtual.body import Body, BodySettings
from robot.virtual.bolt import VirtualBolt
from robot.virtual.radio import VirtualRadio

SPEED_CM_S = 20.0


def assert_it_comes_to_rest(body: Body, since_s: float) -> None:
    """At rest once the time-out, counted from the last command heard, and the braking are over; and for good."""
    settings = body.settings
    rest_s = since_s + settings.drive_timeout_s + SPEED_CM_S / settings.acceleration_cm_s2 + 0.01
    body.advance(rest_s)
    assert body.speed_cm_s == 0.0
    way_cm = body.distance_cm
    body.advance(rest_s + 60.0)
    assert body.distance_cm == way_cm > 20.0


def now_s() -> float:
    return asyncio.get_running_loop().time()


@pytest.mark.parametrize("streams", [False, True])
@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize("end", ["radio gone", "host hangs", "link drops", "robot deaf"])
def test_it_stops_when_the_host_is_gone(bench, end: str, raw: bool, streams: bool) -> None:
    async def main() -> None:
        async with bench(position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            if streams:
                await b.robot.start_stream(0.05)
            await (b.robot.raw_motors(34, 34) if raw else b.robot.drive(0.0, SPEED_CM_S))
            await asyncio.sleep(2.5)
            if end == "radio gone":
                b.radio.controller_of(b.radio.central).vanish()
            elif end == "host hangs":
                for task in b.robot._tending._tasks:
                    task.cancel()
            elif end == "link drops":
                b.virtual.drop_link()
            else:
                b.virtual.vanish(for_s=60.0)
            gone_s = now_s()
            # Not advanced by hand before: the driver and the robot have had their time.
            await asyncio.sleep(0.5)
            assert_it_comes_to_rest(b.body, gone_s)

    run(main(), virtual=True)


def test_it_stops_on_an_exception(bench) -> None:
    async def main() -> None:
        async with bench(connect=False, position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            with pytest.raises(ZeroDivisionError):
                async with b.robot as robot:
                    assert robot is b.robot
                    await robot.drive(0.0, SPEED_CM_S)
                    await asyncio.sleep(2.5)
                    raised_s = now_s()
                    raise ZeroDivisionError
            await asyncio.sleep(0.1)
            assert not b.virtual.is_connected
            # It was told: there was no time-out to wait for.
            b.body.advance(raised_s + 0.5)
            assert b.body.speed_cm_s == 0.0
            assert_it_comes_to_rest(b.body, raised_s)

    run(main(), virtual=True)


@pytest.mark.parametrize("after_s", [0.0, 0.02, 0.08, 0.5, 0.8, 2.5])
def test_it_stops_when_whoever_drives_it_is_cancelled(bench, after_s: float) -> None:
    """Also in the middle of a command, when nobody knows whether the robot has heard it."""

    async def main() -> None:
        async with bench(position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            await b.robot.drive(0.0, SPEED_CM_S)
            await asyncio.sleep(2.0)

            async def weave() -> None:
                async with b.robot as robot:
                    while True:
                        await robot.drive(0.1, SPEED_CM_S)
                        await asyncio.sleep(0.4)
                        await robot.drive(0.0, SPEED_CM_S)
                        await asyncio.sleep(0.4)

            weaving = asyncio.ensure_future(weave())
            await asyncio.sleep(after_s)
            weaving.cancel()
            await asyncio.wait([weaving])
            assert weaving.cancelled()
            gone_s = now_s()
            await asyncio.sleep(0.1)
            assert not b.virtual.is_connected
            assert_it_comes_to_rest(b.body, gone_s)

    run(main(), virtual=True)


@pytest.mark.parametrize("cut_s", [0.0, 0.01, 0.075, 0.09])
def test_a_drive_that_is_cancelled_is_not_kept_up(bench, cut_s: float) -> None:
    """The one who gave the command is gone, the program is not: nothing repeats it."""

    async def main() -> None:
        async with bench(position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            await b.robot.drive(0.0, SPEED_CM_S)
            await asyncio.sleep(2.0)
            await b.robot.battery_v()
            driving = asyncio.ensure_future(b.robot.drive(0.5, SPEED_CM_S))
            await asyncio.sleep(cut_s)
            driving.cancel()
            await asyncio.wait([driving])
            gone_s = now_s()
            if driving.cancelled():
                await asyncio.sleep(0.5)
                assert_it_comes_to_rest(b.body, gone_s)
            assert b.lost == []

    run(main(), virtual=True)


def test_it_stops_when_the_program_ends_in_the_middle() -> None:
    """Without a word, as a traceback ends a script: its loop is gone, and so are the tasks that repeat the command."""
    physics = BodySettings(speed_error=0.0, drift_rad_per_cm=0.0)
    body = Body(
        box(-200, -50, 200, 50),
        lambda x, y: np.full(x.shape, 20.0),
        np.random.default_rng(1),
        physics,
        position_cm=(-150.0, 0.0),
        facing_rad=0.0,
    )
    ended_s = []

    async def script() -> None:
        radio = VirtualRadio()
        await radio.start()
        await VirtualBolt(radio, body, "SB-1234").start()
        robot = Bolt("SB-1234", backend=radio.client_backend, scanner_backend=radio.scanner_backend)
        await robot.connect()
        await robot.drive(0.0, SPEED_CM_S)
        await asyncio.sleep(4.0)
        ended_s.append(now_s())
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run(script(), virtual=True)
    assert_it_comes_to_rest(body, ended_s[0])
