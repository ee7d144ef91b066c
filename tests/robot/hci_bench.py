"""A virtual BOLT served over HCI on TCP, and the ways to it, for the tests of the server."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass

import numpy as np
from shapely.geometry import box

from robot.bolt import Bolt
from robot.profile import RobotProfile
from robot.virtual.body import Body, BodySettings
from robot.virtual.bolt import VirtualBolt
from robot.virtual.hci_client import HciRadio
from robot.virtual.hci_server import HciServer
from robot.virtual.radio import VirtualRadio

NAME, ADDRESS = "SB-C0DE", "D0:5F:B8:00:C0:DE"
# Answers come by loopback: no need to be polite to a real radio.
BRISK = RobotProfile(command_pacing_s=0.0)


@dataclass
class Served:
    server: HciServer
    virtual: VirtualBolt
    body: Body


@contextlib.asynccontextmanager
async def served(*, robots: int = 1):
    """A robot at the arena's centre that faces +x; bright on the right of x = 10 cm, dark on the left."""
    radio = VirtualRadio(rng=np.random.default_rng(3))
    await radio.start()
    still = BodySettings(speed_error=0.0, drift_rad_per_cm=0.0, locator_error=0.0, light_noise_lux=0.0)
    twins: list[VirtualBolt] = []
    for n in range(robots):
        body = Body(
            box(-56.35, -41.35, 56.35, 41.35),
            lambda x, y: np.where(x > 10.0, 120.0, 20.0),
            np.random.default_rng(5),
            still,
            position_cm=(0.0, 0.0),
            facing_rad=0.0,
        )
        twin = VirtualBolt(radio, body, NAME if n == 0 else f"SB-{n:04X}")
        await twin.start()
        twins.append(twin)
    server = HciServer(radio, "127.0.0.1", 0)
    try:
        async with asyncio.timeout(60.0):
            await server.start()
            yield Served(server, twins[0], twins[0].body)
    finally:
        await server.close()
        await radio.close()


@contextlib.asynccontextmanager
async def antenna(endpoint: str):
    radio = HciRadio(endpoint)
    await radio.start()
    try:
        yield radio
    finally:
        await radio.close()


def bolt_on(radio: HciRadio, name: str = NAME, profile: RobotProfile = BRISK) -> Bolt:
    return Bolt(name, backend=radio.client_backend, scanner_backend=radio.scanner_backend, profile=profile)


async def until(condition, timeout_s: float = 10.0) -> None:
    async with asyncio.timeout(timeout_s):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.01)
