"""What may go wrong with the twin: by schedule and by hand, seen through the real client."""

from __future__ import annotations

import asyncio
import itertools
import math

import numpy as np
import pytest
from bleak import BleakClient, BleakScanner
from shapely.geometry import box

from lab.base.errors import RequestError
from lab.clock import run
from robot.commands import BatteryState
from robot.errors import RadioError, RobotError
from robot.profile import RobotProfile
from robot.virtual.body import Body
from robot.virtual.bolt import VirtualBolt
from robot.virtual.faults import KINDS, Fault, schedule
from robot.virtual.radio import AirSettings, VirtualRadio
from robot.virtual.spells import Spells

# Patient with a silent stream, so that a test can look at the silence.
PATIENT = RobotProfile(silence_s=1000.0, keep_alive_s=1000.0, reply_timeout_s=2.0)


def live(bench, script, **options) -> None:
    async def main() -> None:
        async with bench(**options) as b:
            await script(b)

    run(main(), virtual=True)


def now_s() -> float:
    return asyncio.get_running_loop().time()


async def heard(b, for_s: float = 1.0) -> bool:
    found = await BleakScanner.discover(for_s, backend=b.radio.scanner_backend)
    return "SB-1234" in {device.name for device in found}


def gaps(b, more_than_s: float) -> list[tuple[float, float]]:
    """Begin and end of each time without a sample."""
    times = [sample.t_host_s for sample in b.samples]
    return [(a, z) for a, z in itertools.pairwise(times) if z - a > more_than_s]


def test_a_dropped_link_is_told_at_once_and_the_robot_advertises_after_a_while(bench) -> None:
    async def script(b) -> None:
        b.virtual.drop_link(5.0)
        await asyncio.sleep(0.01)
        assert b.lost == ["it disconnected"]
        assert not b.virtual.is_connected
        assert not await heard(b, 4.5)
        assert await heard(b)
        await b.robot.connect()
        b.virtual.drop_link()
        await asyncio.sleep(0.01)
        assert len(b.lost) == 2
        assert await heard(b, 0.5)

    live(bench, script)


def test_the_reason_of_a_dropped_link_is_the_supervision_time_out(bench) -> None:
    async def script(b) -> None:
        connection = await b.radio.connect(b.virtual.address, 5.0)
        reasons: list[int] = []
        connection.on("disconnection", reasons.append)
        b.virtual.drop_link()
        await asyncio.sleep(0.1)
        connection = await b.radio.connect(b.virtual.address, 5.0)
        connection.on("disconnection", reasons.append)
        b.virtual.vanish(20.0)
        await asyncio.sleep(19.9)
        assert reasons == [0x08]
        await asyncio.sleep(0.2)
        assert reasons == [0x08, 0x08]

    live(bench, script, connect=False)


def test_a_vanished_robot_says_nothing_and_is_back_in_the_end(bench) -> None:
    async def script(b) -> None:
        await b.robot.start_stream(0.05)
        await asyncio.sleep(1.01)
        b.virtual.vanish(30.0)
        before = len(b.samples)
        with pytest.raises(RobotError):
            await b.robot.battery_v()
        assert len(b.samples) == before
        assert not await heard(b, 20.0)
        assert b.lost == []
        await asyncio.sleep(10.0)
        assert b.lost == ["it disconnected"]
        assert await heard(b, 1.0)
        await b.robot.connect()
        assert await b.robot.battery_v() > 3.4

    live(bench, script, profile=PATIENT)


def test_a_vanished_robot_let_go_by_both_ends_leaves_no_link_behind(bench) -> None:
    async def script(b) -> None:
        # The robot hangs up for want of the words, unheard; the client learns of it when it is back.
        lost = asyncio.Event()
        async with BleakClient(b.virtual.address, lambda _: lost.set(), backend=b.radio.client_backend) as client:
            b.virtual.vanish(30.0)
            await asyncio.sleep(15.0)
            assert not b.virtual.is_connected
            assert client.is_connected
            await asyncio.sleep(15.1)
            assert lost.is_set()
            assert not client.is_connected
        # The client hangs up, unheard; the robot learns of it when it is back.
        await b.robot.connect()
        b.virtual.vanish(30.0)
        await b.robot.disconnect()
        await asyncio.sleep(15.0)
        assert b.virtual.is_connected
        await asyncio.sleep(16.0)
        assert not b.virtual.is_connected
        await b.robot.connect()
        assert b.robot.bad_frames == 0

    live(bench, script, connect=False)


def test_the_driver_takes_a_vanished_robot_for_lost(bench) -> None:
    async def script(b) -> None:
        lost: asyncio.Future[float] = asyncio.get_running_loop().create_future()
        await b.robot.start_stream(0.05)
        b.virtual.vanish(20.0)
        gone_s = now_s()
        b.robot.on_lost = lambda _: lost.set_result(now_s())
        async with asyncio.timeout(10.0):
            # Three seconds of silence, looked for every one and a half.
            assert await lost - gone_s == pytest.approx(3.0, abs=1.7)
        with pytest.raises(RobotError):
            await b.robot.stop()

    live(bench, script)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_share_of_the_notifications_is_lost_for_a_while(bench, share: float) -> None:
    async def script(b) -> None:
        await b.robot.start_stream(0.05)
        await asyncio.sleep(5.01)
        whole = len(b.samples)
        assert whole == 100
        b.virtual.lose(share, 100.0)
        await asyncio.sleep(100.0)
        arrived = len(b.samples) - whole
        # Five standard deviations of 2000 draws.
        assert arrived == pytest.approx(2000 * (1 - share), abs=5 * math.sqrt(2000 * share * (1 - share)) + 1)
        before = len(b.samples)
        await asyncio.sleep(5.0)
        assert len(b.samples) - before == pytest.approx(100, abs=1)

    live(bench, script, profile=PATIENT)


def test_a_stuck_sensor_keeps_its_reading_and_works_again(bench) -> None:
    async def script(b) -> None:
        await b.robot.start_stream(0.05)
        await b.robot.drive(0.0, 20.0)
        b.virtual.stick_sensor(2.0)
        stuck_s = now_s()
        await asyncio.sleep(4.0)
        for sample in b.samples:
            bright = sample.y_cm > 10.3 and sample.t_host_s > stuck_s + 2.001
            assert sample.light_lux == (120.0 if bright else 20.0) or 9.7 < sample.y_cm < 10.3
        crossed = next(sample for sample in b.samples if sample.y_cm > 10.3)
        assert (crossed.light_lux, b.samples[-1].light_lux) == (20.0, 120.0)
        assert crossed.t_host_s < stuck_s + 1.5

    live(bench, script, position_cm=(-10.0, 0.0), facing_rad=0.0)


def test_a_stalled_robot_stands_until_it_is_free(bench) -> None:
    async def script(b) -> None:
        await b.robot.drive(0.0, 14.75)  # 25 units
        await asyncio.sleep(1.0)
        b.virtual.stall(3.0)
        stood_cm = b.body.distance_cm
        await asyncio.sleep(2.9)
        b.body.advance(now_s())
        assert b.body.distance_cm == stood_cm
        await asyncio.sleep(1.1)
        b.body.advance(now_s())
        # Off again by the old command, at 80 cm/s²; a second after the end it has come this far.
        assert b.body.distance_cm - stood_cm == pytest.approx(14.75 * 1.0 - 14.75**2 / 160.0, abs=1e-3)
        assert b.bumps == []

    live(bench, script, position_cm=(-50.0, 0.0), facing_rad=0.0)


def test_a_low_battery_shows_and_can_be_charged(bench) -> None:
    async def script(b) -> None:
        full_v = await b.robot.battery_v()
        b.virtual.drain(0.02, 10.0)
        assert await b.robot.battery_v() == pytest.approx(3.4 + 0.02 * 0.7, abs=0.006)
        assert await b.robot.battery_state() == BatteryState.CRITICAL
        await asyncio.sleep(10.0)
        assert await b.robot.battery_v() == pytest.approx(full_v, abs=0.006)
        b.virtual.drain(0.2, math.inf)
        assert await b.robot.battery_state() == BatteryState.LOW
        await asyncio.sleep(100.0)
        assert await b.robot.battery_state() == BatteryState.LOW

    live(bench, script)


FAULTS = [
    Fault("vanish", 50.0, 2.0),
    Fault("loss", 10.0, 5.0, 0.4),
    Fault("stall", 20.0, 2.0),
    Fault("stuck_sensor", 30.0, 5.0),
    Fault("low_battery", 40.0, charge=0.5),
]


def diary(bench, seed: int) -> list[tuple[float, float, float]]:
    """What a driver sees of a robot to which all this happens."""
    seen: list[tuple[float, float, float]] = []

    async def main() -> None:
        air = AirSettings(latency_s=0.01, jitter_s=0.02)
        async with bench(air=air, seed=seed, profile=PATIENT, position_cm=(-50.0, 0.0), facing_rad=0.0) as b:
            schedule(FAULTS, b.virtual)
            await b.robot.start_stream(0.05)
            await asyncio.sleep(16.0)
            for heading_rad in (0.0, 2.0, 4.0):
                await b.robot.drive(heading_rad, 10.0)
                await asyncio.sleep(10.0)
            await b.robot.stop()
            seen.extend((sample.t_host_s, sample.light_lux, sample.y_cm) for sample in b.samples)
            seen.append((now_s(), await b.robot.battery_v(), len(b.bumps)))
            await asyncio.sleep(60.0 - (now_s() - b.virtual.started_s))
            seen.append((now_s(), len(b.lost), len(b.samples)))

    run(main(), virtual=True)
    return seen


def test_the_same_seed_gives_the_same_faults_to_the_last_sample(bench) -> None:
    first, again, other = diary(bench, 1), diary(bench, 1), diary(bench, 2)
    assert first == again
    assert first != other
    assert len(first) > 800


def test_scheduled_faults_come_in_their_time(bench) -> None:
    async def script(b) -> None:
        await b.robot.start_stream(0.05)
        schedule(FAULTS, b.virtual)
        schedule([Fault("disconnect", 60.0, 3.0)], b.virtual)
        started_s = b.virtual.started_s
        assert now_s() - started_s < 5.0
        at: dict[str, list[float]] = {"held": [], "stuck": [], "low": []}
        while now_s() < started_s + 49.8:
            await asyncio.sleep(0.1)
            states = {"held": b.body.held, "stuck": b.body.stuck_lux is not None, "low": b.body.battery_charge <= 0.5}
            for name, is_so in states.items():
                at[name] += [now_s() - started_s] * is_so
        spans = {name: (times[0], times[-1]) for name, times in at.items()}
        wanted = {"held": (20.0, 22.0), "stuck": (30.0, 35.0), "low": (40.0, 49.9)}
        assert spans == {name: pytest.approx(span, abs=0.11) for name, span in wanted.items()}
        holes = gaps(b, 0.06)
        assert holes
        assert all(started_s + 9.9 < begin and end < started_s + 15.1 for begin, end in holes)
        await asyncio.sleep(started_s + 51.9 - now_s())
        assert b.lost == []
        await asyncio.sleep(0.2)
        assert b.lost == ["it disconnected"]
        await b.robot.connect()
        await asyncio.sleep(started_s + 60.1 - now_s())
        assert len(b.lost) == 2
        assert not await heard(b, 2.5)
        assert await heard(b, 1.0)

    live(bench, script, profile=PATIENT, position_cm=(-50.0, 0.0), facing_rad=0.0)


def test_of_spells_that_overlap_the_later_end_counts(bench) -> None:
    async def script(b) -> None:
        loop_s = now_s()
        b.virtual.stall(10.0)
        b.virtual.drain(0.3, 4.0)
        await asyncio.sleep(2.0)
        b.virtual.stall(3.0)
        b.virtual.drain(0.1, 4.0)
        free: dict[str, float] = {}
        while now_s() < loop_s + 12.0:
            await asyncio.sleep(0.1)
            if not b.body.held:
                free.setdefault("held", now_s() - loop_s)
            if b.body.battery_charge > 0.5:
                free.setdefault("low", now_s() - loop_s)
        assert free == {"held": pytest.approx(10.0, abs=0.11), "low": pytest.approx(6.0, abs=0.11)}

    live(bench, script)


def test_a_robot_switched_off_is_rid_of_its_faults(bench) -> None:
    async def script(b) -> None:
        schedule([Fault("stall", 30.0)], b.virtual)
        b.virtual.stall(math.inf)
        b.virtual.stick_sensor(100.0)
        b.virtual.vanish(50.0)
        await b.virtual.close()
        await asyncio.sleep(0.1)
        assert b.lost == ["it disconnected"]
        assert (b.body.held, b.body.stuck_lux) == (False, None)
        await b.virtual.start()
        # Faults count from the new start, and none of the old are left.
        assert now_s() - b.virtual.started_s < 0.1
        await asyncio.sleep(60.0)
        assert not b.body.held
        await b.robot.connect()
        assert await b.robot.battery_v() > 3.4

    live(bench, script)


def test_a_robot_that_is_off_has_no_radio_to_fail(bench) -> None:
    async def script(b) -> None:
        await b.virtual.close()
        for strike in (b.virtual.drop_link, lambda: b.virtual.vanish(1.0), lambda: b.virtual.lose(0.5, 1.0)):
            strike()
        with pytest.raises(RadioError, match="start it first"):
            schedule([Fault("stall", 1.0)], b.virtual)

    live(bench, script, connect=False)


def test_loss_without_a_generator_is_refused_before_the_run() -> None:
    async def main() -> None:
        radio = VirtualRadio()
        await radio.start()
        body = Body(box(0, 0, 9, 9), lambda x, _: x, np.random.default_rng(1))
        twin = VirtualBolt(radio, body)
        await twin.start()
        with pytest.raises(RequestError, match="random generator"):
            schedule([Fault("stall", 1.0), Fault("loss", 2.0)], twin)
        with pytest.raises(RequestError, match="random generator"):
            twin.lose(0.1, 1.0)
        schedule([Fault("loss", 0.0, share=0.0), Fault("stall", 1.0)], twin)
        await asyncio.sleep(2.0)
        assert body.held
        await twin.close()
        await radio.close()

    run(main(), virtual=True)


def test_faults_are_checked(bench) -> None:
    assert set(KINDS) == {"loss", "disconnect", "vanish", "stuck_sensor", "stall", "low_battery"}
    for wrong in (
        {"kind": "fire"},
        {"at_s": -1.0},
        {"at_s": math.inf},
        {"for_s": 0.0},
        {"for_s": math.nan},
        {"share": 1.1},
        {"charge": -0.1},
    ):
        with pytest.raises(RequestError, match="virtual fault"):
            Fault(**{"kind": "loss", "at_s": 1.0, **wrong})

    async def script(b) -> None:
        for strike in (lambda: b.virtual.lose(1.5, 1.0), lambda: b.virtual.drain(2.0, 1.0)):
            with pytest.raises(RequestError, match="0 to 1"):
                strike()

    live(bench, script)


def test_spells_end_once() -> None:
    async def main() -> None:
        ended: list[float] = []
        spells = Spells()
        spells.begin("one", 1.0, lambda: ended.append(now_s()))
        spells.begin("one", 1.0, lambda: ended.append(-1.0))
        spells.after(5.0, lambda: ended.append(-2.0))
        began_s = now_s()
        await asyncio.sleep(2.0)
        assert ended == [pytest.approx(began_s + 1.0)]
        spells.begin("two", math.inf, lambda: ended.append(now_s()))
        spells.close()
        spells.close()
        await asyncio.sleep(10.0)
        assert ended == [pytest.approx(began_s + 1.0), pytest.approx(began_s + 2.0)]

    run(main(), virtual=True)
