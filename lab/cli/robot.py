"""`chordlab robot`: the robot alone."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lab.base.errors import RequestError
from lab.cli.completing import shapes
from lab.cli.output import JsonFlag, emit, say, show_table

if TYPE_CHECKING:
    from robot.bolt import Bolt, Heard
    from robot.device import Sample
    from robot.virtual.hci_client import HciRadio


app = typer.Typer(help="The robot alone: find it, ask it, drive it.", no_args_is_help=True)

NameArgument = Annotated[
    str,
    typer.Argument(
        metavar="NAME", help="The advertised name, such as SB-1234, or `virtual`.", autocompletion=lambda: ["virtual"]
    ),
]
HciOption = Annotated[
    str | None,
    typer.Option("--hci", metavar="HOST:PORT", help="Look in the air that `chordlab robot virtual` serves there."),
]


@app.command("scan")
def scan_robots(
    seconds: Annotated[float, typer.Option(min=0.5, max=120, help="How long to listen.")] = 5.0,
    hci: HciOption = None,
    as_json: JsonFlag = False,
) -> None:
    """List the robots in range.

    Example: chordlab robot scan --seconds 5
    """
    from lab.clock import run
    from robot.bolt import scan

    async def listen() -> list[Heard]:
        async with _air(hci) as radio:
            return await scan(seconds, radio.scanner_backend if radio is not None else None)

    heard = run(listen(), virtual=False)
    if as_json:
        emit({"robots": [asdict(robot) for robot in heard]})
    elif heard:
        rows = [(robot.name, robot.address, f"{robot.rssi_dbm} dBm") for robot in heard]
        show_table("Robots in range", ("name", "address", "signal"), rows)
    else:
        say("no robot heard; wake it by lifting it off its charger, and bring it nearer")


@app.command("info")
def info(name: NameArgument, hci: HciOption = None, as_json: JsonFlag = False) -> None:
    """Connect, and print firmware, address and battery.

    Example: chordlab robot info virtual
    """
    from lab.clock import run

    async def ask() -> dict[str, object]:
        async with _connected(name, hci) as robot:
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
    hci: HciOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Roll straight for a while and stop. It says how far it got by its own odometer.

    Example: chordlab robot drive virtual --heading 90 --speed 20 --seconds 1
    """
    import numpy as np

    from lab.clock import run

    track: list[Sample] = []
    bumps: list[float] = []

    async def roll() -> None:
        async with _connected(name, hci) as robot:
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


@app.command("virtual")
def virtual(
    hci: Annotated[
        str | None,
        typer.Option("--hci", metavar="HOST:PORT", help="Where to serve; port 0: a free one; none: 127.0.0.1:6402."),
    ] = None,
    name: Annotated[str, typer.Option(help="The robot's name: SB- and four hexadecimal digits.")] = "SB-1234",
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Stop after this long; none: at Ctrl-C.")] = None,
    shape: Annotated[
        str | None,
        typer.Option(
            metavar="SHAPE", help="What is projected on its arena; none: a dark floor.", autocompletion=shapes
        ),
    ] = None,
    settings_file: Annotated[
        Path | None,
        typer.Option("--settings", metavar="SESSION.toml", help="Its arena, light, hidden profile and faults."),
    ] = None,
    allow_remote: Annotated[
        bool, typer.Option("--allow-remote", help="Allow a HOST that other machines reach; HCI knows no password.")
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Serve a virtual BOLT to other processes. In real time, to Bluetooth clients: HCI over TCP.

    Example: chordlab robot virtual --shape eiffel --name SB-1234
    """
    import numpy as np

    from lab.bench.pictures import check_on_floor, draw_pictures
    from lab.bench.world import virtual_world
    from lab.clock import run
    from lab.settings.load import load_settings
    from projector.dictionary import shape_from
    from robot.virtual.bolt import address_of
    from robot.virtual.hci_server import DEFAULT_ENDPOINT, HciServer, parse_endpoint

    host, port = parse_endpoint(hci or DEFAULT_ENDPOINT)
    address = address_of(name)
    drawn = shape_from(shape) if shape is not None else None
    settings = load_settings(settings_file, {"camera": "none"}, simulate=True)
    if settings.robots[0].startswith("onboard:"):
        raise RequestError(
            f"{settings_file}: robot = {settings.robots[0]!r} is no BOLT; set it to virtual to serve one"
        )
    if drawn is not None:
        check_on_floor(drawn, settings.arena)

    async def serve() -> None:
        seed = np.random.SeedSequence(settings.seed)
        async with virtual_world(settings, seed, settings.profile(), name=name) as world:
            if drawn is not None:
                optics = settings.projector_optics.pinhole()
                height_cm, size = settings.sensor.height_cm, optics.image_size
                world.projector.show(draw_pictures(drawn.geometry, settings.arena, optics, height_cm, size).shape)
            # The first look at the light takes some 0.3 s to prepare; taken later, the stream would lack them.
            world.projector.light_at(np.zeros(1), np.zeros(1), settings.sensor.height_cm)
            server = HciServer(world.radio, host, port, anywhere=allow_remote)
            await server.start()
            try:
                if as_json:
                    served = {"name": name, "address": address, "hci": server.endpoint, "port": server.port}
                    emit({**served, "shape": shape})
                else:
                    say(f"{name} ({address}) advertises at {server.endpoint}, HCI over TCP")
                async with asyncio.timeout(seconds):
                    await asyncio.Event().wait()
            except TimeoutError:
                return
            finally:
                await server.close()

    # Ctrl-C is how this is meant to end.
    with suppress(KeyboardInterrupt):
        run(serve(), virtual=False)


@asynccontextmanager
async def _air(hci: str | None) -> AsyncGenerator[HciRadio | None]:
    """The served air at ``hci``; None is the real one."""
    from robot.virtual.hci_client import HciRadio

    if hci is None:
        yield None
        return
    radio = HciRadio(hci)
    await radio.start()
    try:
        yield radio
    finally:
        await radio.close()


@asynccontextmanager
async def _connected(name: str, hci: str | None) -> AsyncGenerator[Bolt]:
    """A connected robot, real, virtual or served; stopped and let go on every way out."""
    import numpy as np

    from lab.bench.world import virtual_world
    from lab.settings.load import load_settings
    from robot.bolt import Bolt
    from robot.profile import RobotProfile

    if name == "virtual":
        if hci is not None:
            raise RequestError("`virtual` is a robot of this process; with --hci, name the one that is served there")
        settings = load_settings(None, {"camera": "none"})
        seed = np.random.SeedSequence(settings.seed)
        async with virtual_world(settings, seed, RobotProfile()) as world, _held(world.robot) as robot:
            yield robot
    else:
        async with _air(hci) as radio:
            backend, scanner = (radio.client_backend, radio.scanner_backend) if radio is not None else (None, None)
            async with _held(Bolt(name, backend=backend, scanner_backend=scanner)) as robot:
                yield robot


@asynccontextmanager
async def _held(robot: Bolt) -> AsyncGenerator[Bolt]:
    await robot.connect()
    try:
        yield robot
    finally:
        await robot.disconnect()
