"""From the acceleration of a collision to the wall's normal, and back for the virtual robot.

Assumption, in this file alone, since no source states it: the collision report gives the acceleration
that the robot felt in its own body axes, x to its right and y along the way it faces, so the vector
points from the wall back into the arena. Should a robot report otherwise, change these two functions.
"""

from __future__ import annotations

import math

TURN = 2.0 * math.pi


def wall_normal_heading(x_g: float, y_g: float, heading_rad: float) -> float:
    """Heading, in the robot's frame, from the wall straight back into the arena.

    Args:
        x_g: Acceleration to the robot's right, g.
        y_g: Acceleration along the way it faces, g.
        heading_rad: Heading that it rolled along, clockwise in its frame.

    Returns:
        The heading in [0, 2π). An acceleration of nothing at all counts as a wall met head on.
    """
    if x_g == 0.0 and y_g == 0.0:
        return (heading_rad + math.pi) % TURN
    # Clockwise from the way it faces: right is +90°.
    return (heading_rad + math.atan2(x_g, y_g)) % TURN


def collision_acceleration(normal_heading_rad: float, heading_rad: float, size_g: float) -> tuple[float, float]:
    """The inverse: (x_g, y_g) that a robot rolling along ``heading_rad`` reports for a wall with that normal."""
    angle = normal_heading_rad - heading_rad
    return size_g * math.sin(angle), size_g * math.cos(angle)
