"""A robot driven at random through random faults: nobody waits for ever, and nothing rolls on or runs on."""

from __future__ import annotations

import asyncio
import math

import numpy as np
import pytest

from lab.clock import run
from robot.errors import ReconnectError, RobotError
from robot.profile import RobotProfile
from robot.virtual.radio import AirSettings

SESSION_S = 240.0
# The longest that a command may take: the profile's patience with an answer.
PATIENCE_S = RobotProfile().reply_timeout_s + 0.1


@pytest.mark.parametrize("seed", [*range(4), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(4, 24))])
def test_a_robot_driven_through_faults_obeys_or_says_why_not(bench, seed: int) -> None:
    rng = np.random.default_rng(seed)

    async def main() -> None:
        air = AirSettings(latency_s=0.01, jitter_s=0.02, lost_share=float(rng.choice([0.0, 0.1])))
        async with bench(air=air) as b:
            loop = asyncio.get_running_loop()
            robot, twin = b.robot, b.virtual
            connections = 1
            commands = (
                lambda: robot.drive(rng.uniform(0, math.tau), rng.uniform(0, 30)),
                lambda: robot.drive(rng.uniform(0, math.tau), rng.uniform(0, 30)),
                robot.stop,
                lambda: robot.set_led(rng.uniform()),
                lambda: robot.raw_motors(int(rng.integers(-60, 60)), int(rng.integers(-60, 60))),
                lambda: robot.start_stream(rng.choice([0.03, 0.05, 0.2]), attitude=bool(rng.integers(2))),
                robot.stop_stream,
                robot.battery_state,
                lambda: robot.aim(rng.uniform(0, math.tau)),
            )
            faults = (
                twin.drop_link,
                lambda: twin.drop_link(rng.uniform(0, 5)),
                lambda: twin.vanish(rng.uniform(0, 8)),
                lambda: twin.lose(rng.uniform(0, 1), rng.uniform(0, 4)),
                twin._firmware.fall_asleep,
            )
            before = asyncio.all_tasks()
            while loop.time() < SESSION_S:
                if rng.uniform() < 0.08:
                    faults[rng.integers(len(faults))]()
                asked = [commands[rng.integers(len(commands))]() for _ in range(rng.integers(1, 3))]
                begun_s = loop.time()
                answers = await asyncio.gather(*asked, return_exceptions=True)
                assert loop.time() - begun_s <= 3 * PATIENCE_S
                assert [a for a in answers if isinstance(a, BaseException) and not isinstance(a, RobotError)] == []
                await asyncio.sleep(rng.uniform(0, 2))
                if len(b.lost) == connections:
                    try:
                        assert await robot.reconnect(30.0) >= 1
                    except ReconnectError:
                        break
                    connections += 1
                assert len(b.lost) in (connections - 1, connections)
            await robot.disconnect()
            gone_s = loop.time()
            await asyncio.sleep(10.0)
            assert {task for task in asyncio.all_tasks() - before if not task.done()} == set()
            assert not twin.is_connected
            b.body.advance(gone_s + 3.0)
            assert b.body.speed_cm_s == 0.0
            assert connections > 2

    run(main(), virtual=True)
