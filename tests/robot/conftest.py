"""A virtual robot on a virtual radio, for the tests of this package."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field

import numpy as np
import pytest
from shapely.geometry import box

from robot.bolt import Bolt
from robot.device import Bump, Sample
from robot.profile import RobotProfile
from robot.virtual.body import Body, BodySettings
from robot.virtual.bolt import BoltSettings, VirtualBolt, body_settings
from robot.virtual.radio import AirSettings, VirtualRadio

IDEAL = BodySettings(speed_error=0.0, drift_rad_per_cm=0.0, locator_error=0.0, bump_angle_rad=0.0, light_noise_lux=0.0)


@dataclass
class Bench:
    radio: VirtualRadio
    body: Body
    virtual: VirtualBolt
    robot: Bolt
    samples: list[Sample] = field(default_factory=list)
    bumps: list[Bump] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)


@contextlib.asynccontextmanager
async def _bench(
    *,
    air: AirSettings | None = None,
    manners: BoltSettings | None = None,
    profile: RobotProfile | None = None,
    truth: RobotProfile | None = None,
    physics: BodySettings = IDEAL,
    connect: bool = True,
    seed: int = 7,
    **body: object,
):
    rng = np.random.default_rng(seed)
    radio = VirtualRadio(air, rng=rng)
    await radio.start()
    physics = physics if truth is None else body_settings(truth, physics)
    reachable = box(-56.35, -41.35, 56.35, 41.35)
    ball = Body(
        reachable,
        **{"light_at": lambda x, y: np.where(x > 0, 120.0, 20.0), "position_cm": (0.0, 0.0), **body},
        rng=rng,
        settings=physics,
    )
    virtual = VirtualBolt(radio, ball, "SB-1234", manners, truth)
    await virtual.start()
    robot = Bolt("SB-1234", backend=radio.client_backend, scanner_backend=radio.scanner_backend, profile=profile)
    bench = Bench(radio, ball, virtual, robot)
    robot.on_sample, robot.on_bump, robot.on_lost = bench.samples.append, bench.bumps.append, bench.lost.append
    try:
        if connect:
            await robot.connect()
        yield bench
    finally:
        await robot.disconnect()
        await virtual.close()
        await radio.close()


@pytest.fixture
def ideal() -> BodySettings:
    return IDEAL


@pytest.fixture
def bench():
    return _bench
