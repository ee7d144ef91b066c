"""The bench of a session: the devices that the settings name, opened, and closed on every way out."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from lab.bench.pictures import Picture, Pictures, check_on_floor, draw_pictures
from lab.bench.replayed import replayed_bench
from lab.bench.world import virtual_world
from lab.settings.settings import Settings
from projector.device import ProjectorDevice, ProjectorError
from projector.opening import open_projector
from projector.shape import Shape
from robot.bolt import Bolt
from robot.device import RobotDevice
from robot.selfguided import SelfGuided
from tracking.cameras import Camera, Frame
from tracking.opening import open_camera
from tracking.recorder import Recorder

SETTLE_S = 0.3  # a projector's latency, and a light sample or a frame under way, after the picture changes
_PUMP_EVERY_S = 0.5


@dataclass(frozen=True, slots=True)
class Bench:
    """Open devices. ``recorder`` is None for a session without a camera.

    ``robots`` is empty where the robot estimates by itself, and ``guest`` is that robot. ``cruising_cm_s`` is
    the speed that the robots will really be told: their command counts in whole units.
    """

    robots: tuple[RobotDevice, ...]
    guest: SelfGuided | None
    projector: ProjectorDevice
    camera: Camera | None
    recorder: Recorder | None
    pictures: Pictures
    cruising_cm_s: float

    def show(self, picture: Picture) -> None:
        """Put a picture on the projector, and tell a virtual camera that its scene has changed."""
        self.projector.show(picture)
        changed = getattr(self.camera, "scene_changed", None)
        if changed is not None:
            changed()

    def check_light(self) -> None:
        """Raise ProjectorError when the projector's window has closed by itself: the robot would roll in the dark."""
        problem: str | None = getattr(self.projector, "problem", None)
        if problem is not None:
            raise ProjectorError(problem)

    def devices(self) -> dict[str, Any]:
        """What the manifest keeps of the devices besides the robot's own identity."""
        return {
            "cruising_cm_s": self.cruising_cm_s,
            "projector": {"image_size": list(self.projector.image_size)},
            "camera": None
            if self.camera is None
            else {"name": self.camera.name, "size": list(self.camera.size), "rate_hz": self.camera.rate_hz},
        }


async def keep_alive(projector: ProjectorDevice) -> None:
    """Answer a window's events until it closes, or the desktop takes it for frozen; others need nothing."""
    pump = getattr(projector, "pump", None)
    while pump is not None:
        if not pump():
            return
        await asyncio.sleep(_PUMP_EVERY_S)


@asynccontextmanager
async def open_bench(
    settings: Settings,
    shape: Shape,
    seed: np.random.SeedSequence,
    *,
    on_frame: Callable[[Frame], None] | None = None,
) -> AsyncGenerator[Bench]:
    """Open the bench for one shape; ``on_frame`` is called with every frame of the camera.

    Raises:
        ShapeError: the shape does not fit the arena.
        RenderError: the projector cannot show all of it.
        ChordlabError: a device cannot be opened; the line says which and why.
    """
    check_on_floor(shape, settings.arena)
    optics = settings.projector_optics.pinhole()
    profile = settings.profile()
    guest: SelfGuided | None = None
    async with AsyncExitStack() as stack:
        if settings.replayed is not None:
            played = replayed_bench(settings.replayed, settings, optics.image_size, SETTLE_S)
            robots, projector, camera = played.robots, played.projector, played.camera
        elif settings.is_virtual:
            world = await stack.enter_async_context(virtual_world(settings, seed, profile))
            robots, guest, projector, camera = world.robots, world.guest, world.projector, world.camera
        else:
            addresses = {kind: address for kind, _, address in (robot.partition(":") for robot in settings.robots)}
            if "onboard" in addresses:
                robots, guest = (), SelfGuided(addresses["onboard"], profile=profile)
            else:
                robots = tuple(Bolt(robot.removeprefix("ble:"), profile=profile) for robot in settings.robots)
            projector = open_projector(settings.projector, image_size=optics.image_size)
            camera = None if settings.camera == "none" else open_camera(settings.camera)
        stack.callback(projector.close)
        window = asyncio.create_task(keep_alive(projector))
        stack.callback(window.cancel)
        pictures = draw_pictures(
            shape.geometry, settings.arena, optics, settings.sensor.height_cm, projector.image_size
        )
        for device in (*robots, *((guest,) if guest is not None else ())):
            stack.push_async_callback(device.disconnect)
        recorder = None
        if camera is not None:
            recorder = Recorder(camera, on_frame=on_frame)
            await recorder.start()
            stack.push_async_callback(recorder.stop)
            settings.camera_calibration().check_size(camera.size)
        cruising_cm_s = profile.cruising_cm_s(settings.motion.speed_cm_s)
        yield Bench(robots, guest, projector, camera, recorder, pictures, cruising_cm_s)
