"""What a robot streams: which channels, how often, and the records that its frames become."""

from __future__ import annotations

import math
from dataclasses import dataclass

from robot import commands
from robot.commands import Request, StreamLayout
from robot.device import Attitude, Sample
from robot.errors import DriveError, PayloadError

_CM_PER_M = 100.0
_LONGEST_MS = 0xFFFF
# Locator for the way, velocity for the speed, light for the crossings: one frame of 28 bytes without escapes.
_ROLLING = ("locator_x_m", "locator_y_m", "velocity_x_m_s", "velocity_y_m_s", "ambient_lux")
_LAYOUT = commands.layout_for(*_ROLLING)
# On the wire the attitude comes first.
_LAYOUT_WITH_ATTITUDE = commands.layout_for("pitch_deg", "roll_deg", "yaw_deg", *_ROLLING)

OFF: Request = commands.stream(0, 0)
"""The request that ends the stream."""


@dataclass(frozen=True, slots=True)
class Stream:
    """A stream as it was asked for: its period, whether it carries the attitude, true cm per cm of the locator."""

    interval_ms: int
    attitude: bool
    locator_scale: float

    @classmethod
    def every(cls, interval_s: float, least_s: float, *, attitude: bool, locator_scale: float) -> Stream:
        """The stream with a frame every ``interval_s``, in whole milliseconds.

        Raises:
            DriveError: The interval is shorter than ``least_s``, which is all that the link holds, or longer
                than two bytes can say.
        """
        interval_ms = round(interval_s * 1000) if math.isfinite(interval_s) else 0
        least_ms = max(1, math.ceil(round(least_s * 1000, 6)))
        if not least_ms <= interval_ms <= _LONGEST_MS:
            raise DriveError(
                f"a stream every {interval_s:g} s is impossible: ask for {least_ms / 1000:g} to 65 s "
                "(the profile's `least_interval_s` is what this robot's link holds)",
                value=interval_s,
            )
        return cls(interval_ms, attitude, locator_scale)

    @property
    def layout(self) -> StreamLayout:
        """What a frame holds."""
        return _LAYOUT_WITH_ATTITUDE if self.attitude else _LAYOUT

    @property
    def requests(self) -> tuple[Request, Request, Request]:
        """What starts it: the old stream off, the extended mask, the primary mask with the period."""
        layout = self.layout
        return OFF, commands.stream_extended(layout.extended), commands.stream(self.interval_ms, layout.primary)

    def read(self, data: bytes, t_host_s: float) -> tuple[Sample, Attitude | None]:
        """The records of one frame that arrived at ``t_host_s``.

        Raises:
            PayloadError: The frame does not hold what was asked for, or a place or velocity that is no number.
        """
        attitude = None
        values = self.layout.decode(data)
        if self.attitude:
            pitch_deg, roll_deg, yaw_deg, *values = values
            attitude = Attitude(t_host_s, math.radians(pitch_deg), math.radians(roll_deg), math.radians(yaw_deg))
        x_m, y_m, velocity_x_m_s, velocity_y_m_s, light_lux = values
        # Light that is no number counts as lost; a place that is none would spoil the rest of the run.
        if not math.isfinite(x_m + y_m + velocity_x_m_s + velocity_y_m_s):
            raise PayloadError(commands.SENSOR_DATA.name, data, expected="finite numbers")
        scale = _CM_PER_M * self.locator_scale
        speed_cm_s = scale * math.hypot(velocity_x_m_s, velocity_y_m_s)
        return Sample(t_host_s, light_lux, scale * x_m, scale * y_m, speed_cm_s), attitude
