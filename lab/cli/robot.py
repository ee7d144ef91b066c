"""`chordlab robot`: the robot alone."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from dataclasses import asdict
from itertools import pairwise
from typing import Annotated

import numpy as np
import typer

from lab.cli.output import JsonFlag, emit, say, show_table
from lab.clock import run
from lab.settings import load_settings
from lab.world import virtual_world
from robot.bolt import Bolt, scan
from robot.device import Sample
from robot.profile import RobotProfile

app = typer.Typer(help="The robot alone: find it, ask it, drive it.", no_args_is_help=True)

NameArgument = Annotated[
    str, typer.Argument(metavar="NAME", help="The advertised name, such as SB-1234, or `virtual`.")
]


@app.command("scan")
def scan_robots(
    seconds: Annotated[float, typer.Option(min=0.5, max=120, help="How long to listen.")] = 5.0,
    as_json: JsonFlag = False,
) -> None:
    """List the robots in range.

    Example: chordlab robot scan --seconds 5
    """
    heard = run(scan(seconds), virtual=False)
    if as_json:
        emit({"robots": [asdict(robot) for robot in heard]})
    elif heard:
        rows = [(robot.name, robot.address, f"{robot.rssi_dbm} dBm") for robot in heard]
        show_table("Robots in range", ("name", "address", "signal"), rows)
    else:
        say("no robot heard; wake it by lifting it off its charger, and bring it nearer")


@app.command("info")
def info(name: NameArgument, as_json: JsonFlag = False) -> None:
    """Connect, and print firmware, address and battery.

    Example: chordlab robot info virtual
    """

    async def ask() -> dict[str, object]:
        async with _connected(name) as robot:
            return asdict(await robot.identity())

    identity = run(ask(), virtual=name == "virtual")
    if as_json:
        emit(identity)
    else:
        for key, value in identity.items():
            say(f"{key}: {value}")


@app.command("drive")
def drive(
    name: NameArgument,
    heading: Annotated[float, typer.Option(min=-360, max=360, help="Degrees, clockwise from where it faces.")] = 0.0,
    speed: Annotated[float, typer.Option(min=1, max=150, help="cm/s.")] = 25.0,
    seconds: Annotated[float, typer.Option(min=0.1, max=60, help="How long.")] = 1.0,
    as_json: JsonFlag = False,
) -> None:
    """Roll straight for a while and stop; says how far it got by its own odometer.

    Example: chordlab robot drive virtual --heading 90 --speed 20 --seconds 1
    """
    track: list[Sample] = []
    bumps: list[float] = []

    async def roll() -> None:
        async with _connected(name) as robot:
            robot.on_sample = track.append
            robot.on_bump = lambda bump: bumps.append(bump.normal_heading_rad)
            await robot.start_stream(0.05)
            await robot.drive(math.radians(heading), speed)
            await asyncio.sleep(seconds)
            await robot.stop()
            await asyncio.sleep(0.5)

    run(roll(), virtual=name == "virtual")
    rolled_cm = sum(math.hypot(b.x_cm - a.x_cm, b.y_cm - a.y_cm) for a, b in pairwise(track))
    light = float(np.mean([sample.light_lux for sample in track])) if track else math.nan
    if as_json:
        emit({"rolled_cm": rolled_cm, "samples": len(track), "mean_light_lux": light, "bumps": len(bumps)})
    else:
        say(f"rolled {rolled_cm:.1f} cm, {len(track)} light samples, mean {light:.0f} lux, {len(bumps)} bumps")


@asynccontextmanager
async def _connected(name: str) -> AsyncGenerator[Bolt]:
    """A connected robot, real or virtual; stopped and let go on every way out."""
    if name == "virtual":
        settings = load_settings(None, {"camera": "none"})
        seed = np.random.SeedSequence(settings.seed)
        async with virtual_world(settings, seed, RobotProfile()) as world, _held(world.robot) as robot:
            yield robot
    else:
        async with _held(Bolt(name)) as robot:
            yield robot


@asynccontextmanager
async def _held(robot: Bolt) -> AsyncGenerator[Bolt]:
    await robot.connect()
    try:
        yield robot
    finally:
        await robot.disconnect()
