"""The virtual BOLT in motion, by its protocol: its way as it streams it, bumps, motors, and when it stops itself."""

import asyncio

import numpy as np
import pytest

from robot import commands
from robot.commands import Collision, Request
from tests.robot.plainclient import Client, session


def test_yaw_locator_and_speed_are_those_of_the_body(bench) -> None:
    async def script(b, client: Client) -> None:
        names = ("yaw_deg", "locator_x_m", "locator_y_m", "velocity_x_m_s", "velocity_y_m_s", "speed_m_s")
        layout = commands.layout_for(*names)
        await client.ask(commands.stream(100, layout.primary))
        await client.ask(commands.drive(50, np.pi / 2))
        await asyncio.sleep(1.25)
        yaw, x, y, vx, vy, speed = layout.decode(client.packets[-1].data)
        assert yaw == pytest.approx(-90.0)
        assert (vx, vy, speed) == pytest.approx((0.295, 0.0, 0.295), abs=1e-6)
        assert y == pytest.approx(0.0, abs=1e-6)
        assert 0.2 < x < 0.4
        # 50 units are 29.5 cm/s; the last frame is less than one interval old.
        assert b.body.distance_cm - 100 * x < 3.0

    session(bench, script, facing_rad=0.0)


def test_collisions_are_reported_only_when_asked_for(bench) -> None:
    async def script(b, client: Client) -> None:
        def collisions() -> list[Collision]:
            return [Collision.decode(p.data) for p in client.packets if (p.did, p.cid) == commands.COLLISION.key]

        async def ram(heading_rad: float) -> None:
            for _ in range(5):
                await client.ask(commands.drive(68, heading_rad))
                await asyncio.sleep(1.0)

        await ram(0.0)
        assert b.body.pressed
        assert collisions() == []
        await client.ask(commands.collision_setup(1, (60, 60, 60, 60), 0.1))
        await ram(np.pi)
        (report,) = collisions()
        # Head on: thrown back against the way it faces, and no stream was needed to say so.
        assert report.y_g < -0.5
        assert report.x_g == pytest.approx(0.0, abs=1e-3)
        assert (report.axis, report.speed_units) == (2, 68)
        assert report.t_robot_s < asyncio.get_running_loop().time()
        await client.ask(commands.collision_setup(0, (60, 60, 60, 60), 0.1))
        await ram(0.0)
        assert len(collisions()) == 1

    session(bench, script, facing_rad=0.0)


@pytest.mark.parametrize("motors", ["01 1e 02 1e", "02 14 01 28", "01 32 00 00", "00 09 01 32"])
def test_motors_that_differ_spin_it_on_the_spot(bench, motors: str) -> None:
    async def script(b, client: Client) -> None:
        data = bytes.fromhex(motors)
        await client.ask(Request(commands.RAW_MOTORS, data))
        told_s = asyncio.get_running_loop().time()
        await asyncio.sleep(0.5)
        b.body.advance(asyncio.get_running_loop().time())
        left, right = ((0, units, -units)[mode] for mode, units in (data[:2], data[2:]))
        turned_rad = 0.59 * (left - right) / 4.0 * (asyncio.get_running_loop().time() - told_s)
        assert np.exp(1j * b.body.heading_rad) == pytest.approx(np.exp(1j * turned_rad), abs=0.02)
        assert b.body.distance_cm == 0.0
        # It stops like one that drives: by command, or for want of one.
        await client.ask(Request(commands.RAW_MOTORS, bytes(4)))
        facing_rad = b.body.facing_rad
        await asyncio.sleep(1.0)
        b.body.advance(asyncio.get_running_loop().time())
        assert b.body.facing_rad == pytest.approx(facing_rad)

    session(bench, script, facing_rad=0.0)


def test_a_robot_that_hears_no_more_stops_by_itself(bench) -> None:
    async def script(b, client: Client) -> None:
        await client.ask(commands.drive(50, 0.0))
        await asyncio.sleep(1.5)
        await client.ask(commands.drive(50, 0.0))
        told_s = asyncio.get_running_loop().time()
        stood_s = np.inf
        while not np.isfinite(stood_s):
            await asyncio.sleep(0.01)
            now_s = asyncio.get_running_loop().time()
            b.body.advance(now_s)
            if b.body.speed_cm_s == 0.0:
                stood_s = now_s
        # Two seconds, and the brake from 29.5 cm/s at 80 cm/s².
        assert stood_s - told_s == pytest.approx(2.0 + 29.5 / 80.0, abs=0.02)

    session(bench, script, position_cm=(-50.0, 0.0), facing_rad=0.0)


def test_raw_motors_and_reverse_roll_it(bench) -> None:
    async def script(b, client: Client) -> None:
        await client.ask(Request(commands.RAW_MOTORS, bytes([1, 40, 1, 60])))
        await asyncio.sleep(0.5)
        assert b.body.x_cm > 2.0
        await client.ask(Request(commands.RAW_MOTORS, bytes([0, 0, 0, 0])))
        await asyncio.sleep(1.0)
        x_cm = b.body.x_cm
        await client.ask(commands.drive(50, 0.0, flags=0x01))
        await asyncio.sleep(1.5)
        assert b.body.x_cm < x_cm - 5.0
        await client.ask(Request(commands.RAW_MOTORS, bytes([2, 40, 2, 40])))

    session(bench, script, facing_rad=0.0)
