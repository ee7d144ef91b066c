"""The numbers that a BOLT is driven by. Every assumption about the hardware that may have to change is here."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from lab.base.errors import RequestError
from robot.errors import DriveError


@dataclass(frozen=True, slots=True)
class RobotProfile:
    """Scales, rates and time-outs of one robot.

    Attributes:
        cm_s_per_unit: Speed of one unit of the drive command's speed byte; 255 units are about 1.5 m/s.
            Depends on the floor: calibrate.
        command_pacing_s: Least time between two commands.
        reply_timeout_s: How long an answer is awaited.
        refresh_s: A rolling robot is told again this often; it stops by itself about 2 s after the last word.
        keep_alive_s: Longest silence towards the robot; its inactivity timer must not run out.
        scan_timeout_s: How long a name is looked for.
        connect_timeout_s: How long a connection may take.
        silence_s: A stream silent for this long counts as a lost link.
        write_with_response: Ask the radio to acknowledge each write.
        collision_threshold: Threshold (0-255) of the collision detector, for both axes and their speed
            terms alike, since sources disagree on the order of two of those four bytes.
        collision_dead_s: Time after a collision in which no other is reported.
    """

    cm_s_per_unit: float = 0.59
    command_pacing_s: float = 0.075
    reply_timeout_s: float = 10.0
    refresh_s: float = 0.8
    keep_alive_s: float = 8.0
    scan_timeout_s: float = 10.0
    connect_timeout_s: float = 20.0
    silence_s: float = 3.0
    write_with_response: bool = True
    collision_threshold: int = 60
    collision_dead_s: float = 0.2

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            least = 0.0 if field.name in ("command_pacing_s", "collision_dead_s") else math.ulp(0.0)
            if field.name != "write_with_response" and not (math.isfinite(value) and value >= least):
                raise RequestError(f"robot profile: `{field.name}` must be a number above 0, got {value}")
        if not 0 < self.collision_threshold <= 255:
            raise RequestError(f"robot profile: `collision_threshold` must be 1 to 255, got {self.collision_threshold}")
        if self.collision_dead_s > 2.55:
            raise RequestError("robot profile: `collision_dead_s` must be at most 2.55 s, one byte of 10 ms")

    @property
    def max_speed_cm_s(self) -> float:
        """Speed of the highest value of the speed byte."""
        return 255 * self.cm_s_per_unit

    def speed_units(self, speed_cm_s: float) -> int:
        """The speed byte nearest to ``speed_cm_s``; at least 1 for any speed above 0.

        Raises:
            DriveError: The speed is negative, not a number or beyond ``max_speed_cm_s``.
        """
        if not 0 <= speed_cm_s <= self.max_speed_cm_s:
            raise DriveError(
                f"a speed of {speed_cm_s:g} cm/s is out of reach: ask for 0 to {self.max_speed_cm_s:.0f} cm/s",
                value=speed_cm_s,
            )
        if speed_cm_s == 0:
            return 0
        return max(1, round(speed_cm_s / self.cm_s_per_unit))
