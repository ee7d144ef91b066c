"""What the rest of the lab knows of a robot: one Protocol and the records that cross it.

Robot frame: its origin and its forward direction are wherever the robot stood and faced when it was
connected, or connected again. Headings are radians, clockwise from forward; x is to the right, y
forward, so a heading h points along (sin h, cos h).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable


@dataclass(frozen=True, slots=True)
class Sample:
    """One streamed reading of the light sensor and of the odometer.

    ``t_host_s`` is the event loop's clock when the frame arrived. ``light_lux`` is the ambient light,
    ``x_cm`` and ``y_cm`` the locator in the robot's frame, ``speed_cm_s`` the speed by the odometer (>= 0).
    """

    t_host_s: float
    light_lux: float
    x_cm: float
    y_cm: float
    speed_cm_s: float


@dataclass(frozen=True, slots=True)
class Attitude:
    """How the robot is tilted and turned, by its gyroscope.

    ``t_host_s`` is the event loop's clock when the frame arrived; the angles are the robot's own, about its
    right-handed axes with z up, so ``yaw_rad`` runs against headings: it is minus the heading, in (-π, π].
    """

    t_host_s: float
    pitch_rad: float
    roll_rad: float
    yaw_rad: float


@dataclass(frozen=True, slots=True)
class Bump:
    """The robot ran into the wall.

    ``normal_heading_rad`` is the heading, in the robot's frame, that points from the wall straight back
    into the arena, in [0, 2π).
    """

    t_host_s: float
    normal_heading_rad: float


@dataclass(frozen=True, slots=True)
class Identity:
    """Who the robot is: advertised name, Bluetooth address, firmware as "major.minor.build", battery in volts."""

    name: str
    address: str
    firmware: str
    battery_v: float


@runtime_checkable
class RobotDevice(Protocol):
    """A robot that rolls straight, feels the wall and streams the light below it.

    The three callbacks are called on the event loop, must return quickly and may be set at any time.
    ``on_lost`` is called at most once per connection, with the reason, and never after ``disconnect``;
    after a ``reconnect`` it may be called once more.
    """

    name: str
    on_sample: Callable[[Sample], None] | None
    on_bump: Callable[[Bump], None] | None
    on_lost: Callable[[str], None] | None

    async def connect(self) -> None:
        """Find the robot, connect, and set its frame: forward is where it faces now.

        Raises:
            RobotError: Bluetooth is off, or the robot is unknown, unreachable or refuses.
        """
        ...

    async def reconnect(self, give_up_s: float = 60.0) -> int:
        """Win a lost robot back: stopped, streaming and lit as before, but in a new frame, as after ``connect``.

        Returns:
            How many attempts it took; 0 when the link is there.

        Raises:
            ReconnectError: It did not come back within ``give_up_s``.
        """
        ...

    async def disconnect(self) -> None:
        """Stop the robot and let it go. Does nothing when it is not connected."""
        ...

    async def identity(self) -> Identity:
        """Name, address, firmware and battery."""
        ...

    async def battery_v(self) -> float:
        """Battery voltage, V."""
        ...

    async def drive(self, heading_rad: float, speed_cm_s: float) -> None:
        """Roll along ``heading_rad`` at ``speed_cm_s`` until told otherwise; returns once acknowledged.

        Raises:
            DriveError: The speed is beyond what the robot can do.
        """
        ...

    async def stop(self) -> None:
        """Come to rest, facing as before."""
        ...

    async def set_led(self, level: float, rgb: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> None:
        """Light the whole matrix at ``level`` from 0 (off) to 1 (full); ``rgb``: its colour at 1, red by default."""
        ...

    async def start_stream(self, interval_s: float) -> None:
        """Deliver a ``Sample`` every ``interval_s`` (whole milliseconds) to ``on_sample``."""
        ...

    async def stop_stream(self) -> None:
        """Deliver no more samples."""
        ...
