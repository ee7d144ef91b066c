"""A stored robot as a device: its runs come when they came, on one timeline."""

import asyncio
import math

import numpy as np
import pytest

from lab.base.timeline import Timeline
from lab.clock import run
from robot.device import Identity, RobotDevice
from robot.errors import NotConnectedError, ReconnectError
from robot.feeledge import KnowsEdge
from robot.replayed import ReplayedRobot, RunsUsedUpError, StoredRun

WHO = Identity("SB-0001", "00:00", "6.0.46", 4.1)


def stored(number, t_start_s, *, ended="bump", took_s=1.0, gap_s=0.1, **others):
    """A run along y at 10 cm/s, a sample each 0.1 s, that ended ``took_s`` after it began."""
    t_s = t_start_s + np.arange(0.05, took_s, 0.1)
    rows = np.column_stack([t_s, 20.0 + np.arange(len(t_s)), 0 * t_s, 10.0 * (t_s - t_start_s), 10.0 + 0 * t_s])
    t_end_s = t_start_s + took_s
    return StoredRun(number, t_start_s, rows, t_end_s, ended, 1.5, t_over_s=t_end_s + gap_s, **others)


class Heard:
    """All that a robot tells."""

    def __init__(self, robot):
        self.samples, self.bumps, self.lost = [], [], []
        robot.on_sample, robot.on_bump, robot.on_lost = self.samples.append, self.bumps.append, self.lost.append


def played(runs, script, *, light=()):
    """What ``script(robot, heard, loop)`` returns, at virtual time."""

    async def main():
        robot = ReplayedRobot(WHO, runs, light, Timeline(), settle_s=0.3)
        heard = Heard(robot)
        await robot.connect()
        await robot.start_stream(0.05)
        try:
            return await asyncio.wait_for(script(robot, heard, asyncio.get_running_loop()), 1000)
        finally:
            await robot.disconnect()

    return run(main(), virtual=True)


def test_it_is_a_robot_that_knows_its_edge():
    robot = ReplayedRobot(WHO, [], [], Timeline())
    assert isinstance(robot, RobotDevice)
    assert isinstance(robot, KnowsEdge)
    assert robot.used_up


def test_a_run_comes_at_its_own_times_from_the_drive_command():
    async def script(robot, heard, loop):
        await asyncio.sleep(7.0)
        begun_s = loop.time()
        await robot.drive(0.3, 15.0)
        assert loop.time() == begun_s
        await asyncio.sleep(2.0)
        return begun_s, heard

    begun_s, heard = played([stored(0, 100.0)], script)
    assert [sample.t_host_s - begun_s for sample in heard.samples] == pytest.approx(np.arange(0.05, 1.0, 0.1), abs=1e-9)
    assert [sample.light_lux for sample in heard.samples] == list(range(20, 30))
    assert [bump.t_host_s - begun_s for bump in heard.bumps] == pytest.approx([1.0], abs=1e-9)
    assert heard.bumps[0].normal_heading_rad == 1.5


def test_stopping_takes_until_its_next_run_began():
    runs = [stored(0, 10.0, gap_s=0.25), stored(1, 11.25)]

    async def script(robot, heard, loop):
        starts = []
        for _ in runs:
            starts.append(loop.time())
            await robot.drive(0.0, 15.0)
            await asyncio.sleep(1.0)
            await robot.stop()
        assert robot.used_up
        with pytest.raises(RunsUsedUpError):
            await robot.drive(0.0, 15.0)
        return starts

    first_s, second_s = played(runs, script)
    assert second_s - first_s == pytest.approx(1.25, abs=1e-9)


def test_at_rest_it_stands_where_the_length_says():
    async def script(robot, heard, loop):
        await robot.drive(0.0, 15.0)
        await asyncio.sleep(1.0)
        await robot.stop()
        return heard.samples[-1]

    rest = played([stored(0, 0.0, rest_cm=(3.0, 4.0))], script)
    assert (rest.x_cm, rest.y_cm, rest.speed_cm_s) == (3.0, 4.0, 0.0)


def test_stopped_in_mid_run_it_falls_silent_at_once():
    async def script(robot, heard, loop):
        await robot.drive(0.0, 15.0)
        await asyncio.sleep(0.5)
        before_s, count = loop.time(), len(heard.samples)
        await robot.stop()
        assert loop.time() == before_s
        await asyncio.sleep(5.0)
        return len(heard.samples) - count, heard.bumps

    more, bumps = played([stored(0, 0.0, took_s=3.0)], script)
    assert more <= 2  # at rest
    assert not bumps


def test_a_link_that_broke_breaks_and_comes_back_when_it_did():
    runs = [stored(0, 0.0, ended="link", lost="out of range"), stored(1, 41.0)]

    async def script(robot, heard, loop):
        begun_s = loop.time()
        await robot.drive(0.0, 15.0)
        await asyncio.sleep(1.5)
        assert heard.lost == ["out of range"]
        with pytest.raises(NotConnectedError):
            await robot.stop()
        with pytest.raises(NotConnectedError):
            await robot.drive(0.0, 15.0)
        assert await robot.reconnect(60.0) == 1
        assert await robot.reconnect(60.0) == 0
        back_s = loop.time() - begun_s
        await robot.drive(0.0, 15.0)
        return back_s

    assert played(runs, script) == pytest.approx(41.0)


def test_one_without_runs_does_not_come_back():
    async def script(robot, heard, loop):
        await robot.drive(0.0, 15.0)
        await asyncio.sleep(2.0)
        with pytest.raises(ReconnectError, match="used up"):
            await robot.reconnect()

    played([stored(0, 0.0, ended="link")], script)


def test_one_that_was_set_down_anew_is_lost_once_it_has_stopped():
    runs = [stored(0, 0.0, lost="the session was cut here"), stored(1, 3.0)]

    async def script(robot, heard, loop):
        await robot.drive(0.0, 15.0)
        await asyncio.sleep(1.0)
        assert not heard.lost
        await robot.stop()
        return heard.lost

    assert played(runs, script) == ["the session was cut here"]


def test_where_no_end_is_seen_it_stands_still():
    """A run that ended by its light may not end so under other levels: then it looks stuck, which ends it."""

    async def script(robot, heard, loop):
        await robot.drive(0.0, 15.0)
        await asyncio.sleep(4.0)
        return heard.samples

    samples = played([stored(0, 0.0, ended="edge")], script)
    still = samples[10:]
    assert len(still) > 20
    assert {sample.speed_cm_s for sample in still} == {0.0}
    assert [sample.y_cm for sample in still] == pytest.approx([9.5] * len(still))


def test_plain_light_comes_in_order_after_the_picture_has_settled():
    async def script(robot, heard, loop):
        for field in range(3):
            robot.expose(field)
            await asyncio.sleep(0.3 + 3.5 * 0.05)
        return [sample.light_lux for sample in heard.samples]

    assert played([], script, light=[[1.0, 2.0, 3.0], [7.0, 8.0, 9.0]]) == [1.0, 2.0, 3.0, 7.0, 8.0, 9.0]


def test_the_felt_edge_gives_the_stored_normal_and_run_up():
    runs = [stored(0, 0.0, ended="edge", depth_cm=1.2), stored(1, 9.0)]

    async def script(robot, heard, loop):
        begun_s = loop.time()
        await robot.drive(0.0, 15.0)
        await asyncio.sleep(1.0)
        await robot.stop()
        felt = await robot.felt_edge()
        assert loop.time() - begun_s == pytest.approx(9.0)
        return felt

    felt = played(runs, script)
    assert felt.normal_heading_rad == 1.5
    assert felt.run_up_cm(1.5 + math.pi / 3) == pytest.approx(1.2 / 0.5)


def test_two_robots_keep_their_places_in_time():
    async def main():
        timeline = Timeline()
        robots = [ReplayedRobot(WHO, [stored(n, 50.0 + n)], [], timeline) for n in range(2)]
        heard = [Heard(robot) for robot in robots]
        for robot in robots:
            await robot.connect()
            await robot.start_stream(0.05)
        await asyncio.gather(*(robot.drive(0.0, 15.0) for robot in robots))
        await asyncio.sleep(3.0)
        for robot in robots:
            await robot.disconnect()
        return [own.bumps[0].t_host_s for own in heard]

    first_s, second_s = run(main(), virtual=True)
    assert second_s - first_s == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(("now_s", "begins_s"), [(3.0, 3.0), (2.0, 3.0), (-40.0, -40.0), (8.0, 8.0)])
def test_the_timeline_waits_a_little_and_jumps_over_the_rest(now_s, begins_s):
    timeline = Timeline()
    assert timeline.begin_s(100.0, 0.0) == 0.0
    assert timeline.begin_s(103.0, now_s) == begins_s
    assert timeline.due_s(104.0) == begins_s + 1.0
