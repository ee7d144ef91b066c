"""From the acceleration of a collision to the wall's normal, and back for the virtual robot.

Assumption, in this file alone, since no source states it: the collision report gives the acceleration
that the robot felt in its own body axes, so the vector points from the wall back into the arena. Along
which axes, and which way round, is the profile's ``collision_axes``, since a few bumps by hand tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from lab.base.errors import RequestError

TURN = 2.0 * math.pi
AXES: tuple[str, str] = ("right", "forward")
"""What the report's x and y point along unless a robot has shown otherwise."""

# Each axis as its part to the right and its part forward.
_PARTS = {"right": (1, 0), "left": (-1, 0), "forward": (0, 1), "back": (0, -1)}


def check_axes(axes: Sequence[str]) -> None:
    """Make sure that ``axes`` name one sideways and one lengthwise axis, in either order.

    Raises:
        RequestError: They do not.
    """
    known = len(axes) == 2 and all(axis in tuple(_PARTS) for axis in axes)
    if not known or _PARTS[axes[0]][0] ** 2 == _PARTS[axes[1]][0] ** 2:
        raise RequestError(
            f'collision axes must be one of "right", "left" and one of "forward", "back", got {list(axes)}'
        )


def _in_turn(angle_rad: float) -> float:
    """The angle in [0, 2π). The remainder of a tiny negative one rounds to 2π itself, hence twice."""
    return angle_rad % TURN % TURN


def wall_normal_heading(x_g: float, y_g: float, heading_rad: float, axes: tuple[str, str] = AXES) -> float:
    """Heading, in the robot's frame, from the wall straight back into the arena.

    Args:
        x_g: Acceleration along the first of ``axes``, g.
        y_g: Acceleration along the second, g.
        heading_rad: Heading that it rolled along, clockwise in its frame.
        axes: What x and y point along, as seen by the robot.

    Returns:
        The heading in [0, 2π). An acceleration of nothing at all counts as a wall met head on.
    """
    if x_g == 0.0 and y_g == 0.0:
        return _in_turn(heading_rad + math.pi)
    (x_right, x_forward), (y_right, y_forward) = _PARTS[axes[0]], _PARTS[axes[1]]
    right_g, forward_g = x_right * x_g + y_right * y_g, x_forward * x_g + y_forward * y_g
    # Clockwise from the way it faces: right is +90°.
    return _in_turn(heading_rad + math.atan2(right_g, forward_g))


def collision_acceleration(
    normal_heading_rad: float, heading_rad: float, size_g: float, axes: tuple[str, str] = AXES
) -> tuple[float, float]:
    """The inverse: (x_g, y_g) that a robot rolling along ``heading_rad`` reports for a wall with that normal."""
    angle = normal_heading_rad - heading_rad
    right_g, forward_g = size_g * math.sin(angle), size_g * math.cos(angle)
    (x_right, x_forward), (y_right, y_forward) = _PARTS[axes[0]], _PARTS[axes[1]]
    return x_right * right_g + x_forward * forward_g, y_right * right_g + y_forward * forward_g
