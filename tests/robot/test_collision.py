from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.base.errors import RequestError
from robot.collision import check_axes, collision_acceleration, wall_normal_heading

SIDEWAYS, LENGTHWISE = ("right", "left"), ("forward", "back")
ALL_AXES = [axes for pair in itertools.product(SIDEWAYS, LENGTHWISE) for axes in (pair, pair[::-1])]
ANGLES = st.floats(-10.0, 10.0)
# Quarter turns, clockwise from the way the robot faces.
QUARTERS = {"forward": 0, "right": 1, "back": 2, "left": 3}


def along(heading_rad: float) -> np.ndarray:
    """The unit vector (right, forward) of the robot's frame that a heading points along."""
    return np.array([math.sin(heading_rad), math.cos(heading_rad)])


def felt(normal_rad: float, heading_rad: float, size_g: float, axes: tuple[str, str]) -> list[float]:
    """What an accelerometer with these axes reads when the push comes along the normal: two dot products."""
    push_g = size_g * along(normal_rad)
    return [float(push_g @ along(heading_rad + QUARTERS[axis] * math.pi / 2)) for axis in axes]


@pytest.mark.parametrize("axes", ALL_AXES)
@given(normal=ANGLES, heading=ANGLES, size=st.floats(0.02, 8.0))
def test_the_normal_is_where_the_push_comes_from(axes, normal: float, heading: float, size: float) -> None:
    x_g, y_g = felt(normal, heading, size, axes)
    found = wall_normal_heading(x_g, y_g, heading, axes)
    assert 0 <= found < 2 * math.pi
    assert along(found) == pytest.approx(along(normal), abs=1e-9)
    assert collision_acceleration(normal, heading, size, axes) == pytest.approx((x_g, y_g), abs=1e-9)


def test_without_axes_x_is_to_the_right_and_y_forward() -> None:
    assert wall_normal_heading(0.0, -1.0, 0.3) == pytest.approx(0.3 + math.pi)
    assert wall_normal_heading(1.0, 0.0, 0.3) == pytest.approx(0.3 + math.pi / 2)
    assert collision_acceleration(math.pi, 0.0, 2.0) == pytest.approx((0.0, -2.0), abs=1e-12)


@pytest.mark.parametrize("axes", ALL_AXES)
def test_no_push_at_all_is_a_wall_met_head_on(axes) -> None:
    assert wall_normal_heading(0.0, 0.0, 1.0, axes) == pytest.approx(1.0 + math.pi)


def test_axes_are_one_sideways_and_one_lengthwise() -> None:
    for axes in ALL_AXES:
        check_axes(axes)
    for wrong in (
        ("right", "left"),
        ("forward", "back"),
        ("right", "up"),
        ("right",),
        ("right", "forward", "back"),
        (),
    ):
        with pytest.raises(RequestError, match="one of"):
            check_axes(wrong)
