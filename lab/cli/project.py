"""`chordlab project`: hold a shape on the projector."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lab.base.errors import RequestError
from lab.cli.choosing import FontOption, ShapeArgument
from lab.cli.completing import projectors, settings_files
from lab.cli.output import JsonFlag, emit, say

if TYPE_CHECKING:
    from lab.bench.pictures import Picture
    from lab.settings.settings import Settings
    from projector.device import ProjectorDevice
    from projector.shape import Shape


class Ring(StrEnum):
    """The ring of light along the wall."""

    DARK = "dark"
    BRIGHT = "bright"


def project(
    shape: ShapeArgument,
    projector: Annotated[
        str | None,
        typer.Option(help="display:N, or image:DIR for a PNG; none: what the settings say.", autocompletion=projectors),
    ] = None,
    settings_file: Annotated[
        Path | None,
        typer.Option(
            "--settings",
            metavar="SESSION.toml",
            help="Arena, and where the projector hangs.",
            autocompletion=settings_files,
        ),
    ] = None,
    ring: Annotated[Ring | None, typer.Option(help="With a ring along the wall: dark or bright.")] = None,
    fiducials: Annotated[bool, typer.Option("--fiducials", help="With the markers of the rig check.")] = False,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Stop after this long; none: at Ctrl-C.")] = None,
    font: FontOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Hold a shape on the projector, at its true size. In the plane of the light sensor, until Ctrl-C.

    Example: chordlab project eiffel --projector display:1 --settings bench.toml
    """
    from lab.bench.pictures import check_on_floor
    from lab.clock import run
    from lab.settings.load import load_settings
    from projector.dictionary import shape_from
    from projector.opening import open_projector

    changes: dict[str, Any] = {"camera": "none"}
    if ring is not None:
        changes["arena.edge"] = f"{ring}_ring"
    settings = load_settings(settings_file, changes, simulate=True)
    device = projector or _device_of(settings_file)
    drawn = shape_from(shape, font=font)
    check_on_floor(drawn, settings.arena)
    light = open_projector(device, image_size=settings.projector_optics.pinhole().image_size)
    try:
        light.show(_picture(drawn, settings, light, fiducials=fiducials))
        if as_json:
            emit({"shape": drawn.name, "projector": device, "image_size": light.image_size, "shown_s": light.shown_s})
        else:
            say(f"{drawn.title} on {device}, {light.image_size[0]} x {light.image_size[1]} pixels")
        if device.startswith("display:"):
            with suppress(KeyboardInterrupt):  # how this is meant to end
                run(_hold(light, seconds), virtual=False)
    finally:
        light.close()


def _device_of(settings_file: Path | None) -> str:
    """The projector that the file names; a virtual one would show nothing to anybody."""
    from lab.settings.load import load_settings

    device = "virtual" if settings_file is None else load_settings(settings_file).projector
    if device == "virtual":
        raise RequestError("a virtual projector shows nothing to people; give --projector display:0, or image:DIR")
    return device


def _picture(shape: Shape, settings: Settings, light: ProjectorDevice, *, fiducials: bool) -> Picture:
    import numpy as np

    from lab.bench.pictures import draw_pictures
    from lab.bench.rigcheck import rig_picture

    hangs = settings.projector_optics
    if hangs.calibration is None:  # measured by hand: it holds for any display that fills the same field
        hangs = hangs.model_copy(update={"image_size": light.image_size})
    optics = hangs.pinhole()
    picture = draw_pictures(shape.geometry, settings.arena, optics, settings.sensor.height_cm, light.image_size).shape
    if fiducials:
        markers = rig_picture(settings.arena, settings.camera_optics.pinhole(), optics)
        picture = np.maximum(picture, markers)
    return picture


async def _hold(light: ProjectorDevice, seconds: float | None) -> None:
    """Keep the window up. Raises ProjectorError when it closes by itself."""
    from lab.bench.devices import keep_alive
    from projector.device import ProjectorError

    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await keep_alive(light)
            problem: str | None = getattr(light, "problem", None)
            if problem is not None:
                raise ProjectorError(problem)
