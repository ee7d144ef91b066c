"""The one world that the virtual devices share: the projector lights it, the robot rolls in it, the camera films it."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.settings import Settings
from projector.virtual import LightSettings, VirtualProjector
from robot.bolt import Bolt
from robot.profile import RobotProfile
from robot.virtual.body import Body, BodySettings
from robot.virtual.bolt import VirtualBolt
from robot.virtual.radio import VirtualRadio
from tracking.virtual import CameraSettings, RobotView, VirtualCamera

ROBOT_NAME = "SB-7E57"
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class World:
    """The virtual devices, wired to each other; ``radio`` is the air that the robot advertises in."""

    robot: Bolt
    radio: VirtualRadio
    projector: VirtualProjector
    camera: VirtualCamera | None
    body: Body


@asynccontextmanager
async def virtual_world(
    settings: Settings, seed: np.random.SeedSequence, profile: RobotProfile, *, name: str = ROBOT_NAME
) -> AsyncGenerator[World]:
    """Make the virtual bench that ``settings`` describe; everything random in it follows from ``seed``.

    Raises:
        RequestError: ``name`` is not a BOLT's.
    """
    body_rng, camera_rng = (np.random.default_rng(child) for child in seed.spawn(2))
    physics = settings.virtual
    projector = VirtualProjector(
        settings.projector_optics.pinhole(),
        LightSettings(
            ambient_lux=physics.ambient_lux,
            black_lux=physics.black_lux,
            white_lux=physics.white_lux,
            blur_px=physics.blur_px,
        ),
    )
    sensor_height_cm = settings.sensor.height_cm

    def light_at_sensor(x_cm: Floats, y_cm: Floats) -> Floats:
        return projector.light_at(x_cm, y_cm, sensor_height_cm)

    body = Body(
        settings.arena.reachable,
        light_at_sensor,
        body_rng,
        BodySettings(
            speed_error=physics.speed_error_sigma,
            drift_rad_per_cm=physics.heading_drift_rad_per_cm,
            light_noise_lux=physics.light_noise_lux,
            footprint_cm=physics.footprint_cm,
        ),
    )

    def robots_at(t_s: float) -> list[RobotView]:
        body.advance(t_s)
        vx_cm_s = body.speed_cm_s * math.cos(body.facing_rad)
        vy_cm_s = body.speed_cm_s * math.sin(body.facing_rad)
        return [RobotView(body.x_cm, body.y_cm, body.led_level, vx_cm_s, vy_cm_s, settings.led.height_cm)]

    camera = None
    if settings.camera == "virtual":
        camera = VirtualCamera(
            settings.camera_optics.pinhole(),
            projector.light_at,
            robots_at,
            camera_rng,
            CameraSettings(
                rate_hz=physics.camera_rate_hz,
                noise_sigma=physics.camera_noise,
                drop_probability=physics.camera_drop_probability,
                ambient_lux=physics.ambient_lux,
            ),
            light_from_cm=projector.pinhole.centre_cm.tolist(),
        )
    radio = VirtualRadio()
    await radio.start()
    try:
        twin = VirtualBolt(radio, body, name)
        await twin.start()
        try:
            robot = Bolt(name, backend=radio.client_backend, scanner_backend=radio.scanner_backend, profile=profile)
            yield World(robot, radio, projector, camera, body)
        finally:
            await twin.close()
    finally:
        await radio.close()
