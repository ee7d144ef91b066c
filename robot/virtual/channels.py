"""Where each value that a virtual BOLT streams comes from."""

from __future__ import annotations

import math
from collections.abc import Callable

from robot import commands
from robot.virtual.body import Body

_M_PER_CM = 0.01


def channels_of(body: Body, light_lux: Callable[[], float]) -> dict[str, Callable[[], float]]:
    """What reads each channel, by its name; what the body has no sense for reads 0.

    Yaw is counter-clockwise, as the robot's z axis points up.

    Args:
        body: The robot's.
        light_lux: What its light sensor tells now.
    """

    def still() -> float:
        return 0.0

    def velocity(part: Callable[[float], float]) -> Callable[[], float]:
        return lambda: _M_PER_CM * body.locator_speed_cm_s * part(body.heading_rad)

    def yaw_deg() -> float:
        return -math.degrees(math.remainder(body.heading_rad, 2 * math.pi))

    channels = dict.fromkeys((*commands.PRIMARY_CHANNELS, *commands.EXTENDED_CHANNELS), still)
    channels.update(
        quaternion_z=lambda: math.sin(math.radians(yaw_deg()) / 2),
        quaternion_w=lambda: math.cos(math.radians(yaw_deg()) / 2),
        yaw_deg=yaw_deg,
        acceleration_z_g=lambda: 1.0,
        acceleration_g=lambda: 1.0,
        locator_x_m=lambda: _M_PER_CM * body.locator_cm[0],
        locator_y_m=lambda: _M_PER_CM * body.locator_cm[1],
        velocity_x_m_s=velocity(math.sin),
        velocity_y_m_s=velocity(math.cos),
        speed_m_s=lambda: _M_PER_CM * body.locator_speed_cm_s,
        core_time=lambda: body.t_s,
        ambient_lux=light_lux,
    )
    return channels
