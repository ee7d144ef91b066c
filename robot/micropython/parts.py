"""What ``Roamer`` is handed: the robot at hand, and its radio. For readers and type checkers; not needed on the robot.

Headings are radians, clockwise seen from above, in the robot's own frame: 0 is where it faced when it was switched on.
"""

from __future__ import annotations

from typing import Protocol


class Hardware(Protocol):
    """The robot at hand: ``robot.micropython.hardware`` on a robot.

    Attributes:
        top_speed_cm_s: The fastest that it rolls straight.
    """

    top_speed_cm_s: float

    def clock_ms(self) -> int:
        """Whole milliseconds since it was switched on."""
        ...

    def sleep_until(self, at_ms: int) -> None:
        """Wait; returns at once if ``at_ms`` is past."""
        ...

    def tend(self) -> None:
        """Called every 20 ms: what keeps it straight, or its motors from a time-out, belongs here."""
        ...

    def drive(self, heading_rad: float, speed_cm_s: float) -> None:
        """Turn on the spot, then roll straight until told otherwise; ``way_cm`` counts from 0."""
        ...

    def stop(self) -> None:
        """Come to rest."""
        ...

    def way_cm(self) -> float:
        """Path since ``drive``, cm, never decreasing; without odometer, speed × time since it rolled off."""
        ...

    def light(self) -> float:
        """The light at the sensor, in any unit that grows with it: the host learns dark and bright from it."""
        ...

    def bumped(self) -> float | None:
        """Heading from the wall straight back into the arena, once for each wall (or table's edge) met; else None.

        The better the direction, the truer the lines, but it may be felt coarsely: in simulations (a square in a
        rectangle) errors of up to 0.4 rad, about those of two switches, shifted area and perimeter by 0.2 %.
        """
        ...

    def battery_mv(self) -> int:
        """Battery voltage, mV; 0 if it is not measured."""
        ...


class Link(Protocol):
    """The radio: ``robot.micropython.ble`` on a robot."""

    def connected(self) -> bool:
        """Whether a host holds the link."""
        ...

    def command(self) -> bytes | None:
        """The oldest command not yet taken, or None."""
        ...

    def notify(self, uuid: str, record: bytes) -> None:
        """Tell the host, when there is one that listens."""
        ...
