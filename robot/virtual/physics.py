"""The numbers that make a virtual robot's body what it is, and what it feels when it meets something."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Protocol

from lab.base.errors import RequestError

_ABOVE_0 = frozenset({"acceleration_cm_s2", "turn_rate_rad_s", "drive_timeout_s", "battery_rest_s", "battery_roll_s"})
_SIGNED = frozenset({"drift_bias_rad_per_cm", "locator_bias"})


@dataclass(frozen=True, slots=True)
class BodySettings:
    """Physics of the virtual robot.

    Attributes:
        acceleration_cm_s2: Rate at which the speed rises and falls.
        turn_rate_rad_s: Rate at which it turns on the spot before it rolls off.
        speed_error: Standard deviation of the relative speed error, drawn anew for each run.
        drift_rad_per_cm: Standard deviation of the path's curvature, drawn anew for each run: the gyro
            believes that it goes straight.
        drift_bias_rad_per_cm: Curvature that every run has besides, clockwise positive.
        locator_error: Standard deviation of the odometer's relative scale error, drawn once.
        locator_bias: Systematic part of that error: the odometer reports the true way times
            (1 + bias + random); above -1.
        bump_angle_rad: Standard deviation of the error in the felt direction of a wall.
        drive_timeout_s: It stops by itself this long after the last drive command.
        light_noise_lux: Standard deviation of one light reading.
        footprint_cm: Radius of the disc over which the light sensor averages.
        led_leak_lux: Light that the own LED, at full level, adds to a reading.
        battery_full_v: Voltage at the start.
        battery_empty_v: Voltage at which it is empty.
        battery_rest_s: Time at rest that empties it.
        battery_roll_s: Rolling time that empties it.
    """

    acceleration_cm_s2: float = 80.0
    turn_rate_rad_s: float = 8.0
    speed_error: float = 0.02
    drift_rad_per_cm: float = 2e-4
    drift_bias_rad_per_cm: float = 0.0
    locator_error: float = 0.005
    locator_bias: float = 0.0
    bump_angle_rad: float = 0.03
    drive_timeout_s: float = 2.0
    light_noise_lux: float = 1.0
    footprint_cm: float = 0.5
    led_leak_lux: float = 0.0
    battery_full_v: float = 4.1
    battery_empty_v: float = 3.4
    battery_rest_s: float = 36_000.0
    battery_roll_s: float = 9_000.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = float(getattr(self, field.name))
            least = -math.inf if field.name in _SIGNED else 0.0
            if not math.isfinite(value) or value < least or (field.name in _ABOVE_0 and value == 0):
                wanted = "finite" if field.name in _SIGNED else "above 0" if field.name in _ABOVE_0 else "0 or more"
                raise RequestError(f"virtual robot: `{field.name}` must be {wanted}, got {value:g}")
        if self.locator_bias <= -1:
            raise RequestError(f"virtual robot: `locator_bias` must be above -1, got {self.locator_bias:g}")


@dataclass(frozen=True, slots=True)
class Impact:
    """The ball met a wall or another ball at ``t_s``.

    ``normal_heading_rad`` is the felt heading, in the robot's frame, from what it met back to it, in
    [0, 2π); ``heading_rad`` the heading it rolled along; ``speed_cm_s`` the speed at which they closed.
    """

    t_s: float
    normal_heading_rad: float
    heading_rad: float
    speed_cm_s: float


class Together(Protocol):
    """What moves a ball on together with others."""

    def advance(self, t_s: float) -> None:
        """Move all of them on to the instant ``t_s``."""
        ...
