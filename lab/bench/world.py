"""The one world that the virtual devices share: the projector lights it, the robots roll in it, the camera films it."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.base.colours import led_yuv
from lab.settings.sections import BALL_RADIUS_CM
from lab.settings.settings import Settings
from projector.virtual import LightSettings, VirtualProjector
from robot.bolt import Bolt
from robot.profile import RobotProfile, load_profile
from robot.selfguided import SelfGuided
from robot.virtual.body import Body, BodySettings
from robot.virtual.bolt import VirtualBolt, body_settings
from robot.virtual.crowd import Crowd, draw_places
from robot.virtual.faults import Fault, schedule
from robot.virtual.radio import AirSettings, VirtualRadio
from robot.virtual.selfguided import VirtualSelfGuided
from tracking.virtual import CameraSettings, RobotView, VirtualCamera

_FIRST_NAME = 0x7E57
_GUEST_NAME = "CL-7E57"
Floats = NDArray[np.float64]


def robot_name(number: int) -> str:
    """The advertised name of the virtual bench's ``number``-th robot, from 0."""
    return f"SB-{_FIRST_NAME + number:04X}"


@dataclass(frozen=True, slots=True)
class World:
    """The virtual devices, wired to each other; ``radio`` is the air that the robots advertise in.

    ``guest`` is the robot that estimates by itself, where the settings ask for one; then ``robots`` is empty.
    """

    robots: tuple[Bolt, ...]
    guest: SelfGuided | None
    radio: VirtualRadio
    projector: VirtualProjector
    camera: VirtualCamera | None
    bodies: tuple[Body, ...]

    @property
    def robot(self) -> Bolt:
        """The first robot."""
        return self.robots[0]


@asynccontextmanager
async def virtual_world(
    settings: Settings, seed: np.random.SeedSequence, profile: RobotProfile, *, name: str | None = None
) -> AsyncGenerator[World]:
    """Make the virtual bench that ``settings`` describe; everything random in it follows from ``seed``.

    Args:
        settings: the session's.
        seed: of all that is random.
        profile: what the driver takes the robots for.
        name: the first robot's, instead of SB-7E57.

    Raises:
        RequestError: ``name`` is not a BOLT's, or the robots' hidden profile cannot be read.
    """
    body_seed, camera_seed, air_seed = seed.spawn(3)
    physics = settings.virtual
    camera_optics, projector_optics = settings.true_optics()
    projector = VirtualProjector(
        projector_optics,
        LightSettings(
            ambient_lux=physics.ambient_lux,
            black_lux=physics.black_lux,
            white_lux=physics.white_lux,
            blur_px=physics.blur_px,
        ),
    )
    twin_profile = load_profile(physics.robot_profile) if physics.robot_profile is not None else profile
    bodies = _bodies(settings, projector, body_seed, twin_profile)

    def robots_at(t_s: float) -> list[RobotView]:
        return [_view(body, t_s, settings.led.height_cm) for body in bodies]

    camera = None
    if settings.camera == "virtual":
        camera = VirtualCamera(
            camera_optics,
            projector.light_at,
            robots_at,
            np.random.default_rng(camera_seed),
            CameraSettings(
                rate_hz=physics.camera_rate_hz,
                noise_sigma=physics.camera_noise,
                drop_probability=physics.camera_drop_probability,
                ambient_lux=physics.ambient_lux,
            ),
            light_from_cm=projector.pinhole.centre_cm.tolist(),
        )
    air = AirSettings(latency_s=physics.link_latency_s, jitter_s=physics.link_jitter_s, lost_share=physics.link_loss)
    radio = VirtualRadio(air, rng=np.random.default_rng(air_seed))
    await radio.start()
    async with AsyncExitStack() as stack:
        stack.push_async_callback(radio.close)
        client, scanner = radio.client_backend, radio.scanner_backend
        guest: SelfGuided | None = None
        robots: list[Bolt] = []
        if settings.robots[0] == "onboard:virtual":
            await _switch_on(VirtualSelfGuided(radio, bodies[0], _GUEST_NAME), stack)
            guest = SelfGuided(_GUEST_NAME, backend=client, scanner_backend=scanner, profile=profile)
        else:
            for number, body in enumerate(bodies):
                called = name if name is not None and number == 0 else robot_name(number)
                twin = VirtualBolt(radio, body, called, profile=twin_profile)
                await _switch_on(twin, stack)
                schedule(_faults(settings, number), twin)
                robots.append(Bolt(called, backend=client, scanner_backend=scanner, profile=profile))
        yield World(tuple(robots), guest, radio, projector, camera, bodies)


async def _switch_on(twin: VirtualBolt | VirtualSelfGuided, stack: AsyncExitStack) -> None:
    await twin.start()
    stack.push_async_callback(twin.close)


def _bodies(
    settings: Settings, projector: VirtualProjector, seed: np.random.SeedSequence, profile: RobotProfile
) -> tuple[Body, ...]:
    """The robots' bodies, apart from each other on the floor that the projector lights."""
    physics, count = settings.virtual, len(settings.robots)
    sensor_height_cm = settings.sensor.height_cm

    def light_at_sensor(x_cm: Floats, y_cm: Floats) -> Floats:
        return projector.light_at(x_cm, y_cm, sensor_height_cm)

    made = body_settings(
        profile,
        BodySettings(
            speed_error=physics.speed_error_sigma,
            drift_rad_per_cm=physics.heading_drift_rad_per_cm,
            light_noise_lux=physics.light_noise_lux,
            footprint_cm=physics.footprint_cm,
        ),
    )
    reachable = settings.arena.reachable
    if count == 1:
        return (Body(reachable, light_at_sensor, np.random.default_rng(seed), made),)
    draws, *seeds = seed.spawn(count + 1)
    places = draw_places(reachable, count, np.random.default_rng(draws), BALL_RADIUS_CM)
    bodies = tuple(
        Body(reachable, light_at_sensor, np.random.default_rng(child), made, position_cm=position_cm)
        for child, position_cm in zip(seeds, places, strict=True)
    )
    Crowd(bodies, BALL_RADIUS_CM)
    return bodies


def _view(body: Body, t_s: float, led_height_cm: float) -> RobotView:
    """A body as the camera sees it."""
    body.advance(t_s)
    vx_cm_s = body.speed_cm_s * math.cos(body.facing_rad)
    vy_cm_s = body.speed_cm_s * math.sin(body.facing_rad)
    luma, u, v = led_yuv(body.led_rgb)
    hue = (u / luma, v / luma) if luma > 0 else (0.0, 0.0)
    return RobotView(body.x_cm, body.y_cm, luma, vx_cm_s, vy_cm_s, led_height_cm, led_uv=hue)


def _faults(settings: Settings, number: int) -> list[Fault]:
    """What is to befall the ``number``-th robot."""
    return [
        Fault(fault.kind, fault.at_s, fault.for_s, fault.share)
        for fault in settings.virtual.faults
        if fault.robot == number
    ]
