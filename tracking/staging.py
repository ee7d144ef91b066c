"""What a drawn film shows: how robots roll and blink, the light on the floor, the camera above it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from shapely import contains_xy
from shapely.geometry import MultiPolygon, Polygon

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from tracking.synthetic import LightAt, RobotView

Floats = NDArray[np.float64]
Robots = Callable[[float], Sequence[RobotView]]
Level = Callable[[float, float, float], float]
Shape = Polygon | MultiPolygon

_GRID_CM = 0.05


def default_optics(size: tuple[int, int] = (1280, 720), *, px_per_cm: float = 4.0) -> Pinhole:
    """A camera 205 cm up, a degree or so off the plumb line, with a little distortion; ``px_per_cm`` at the LED."""
    height_cm, led_cm = 205.0, 7.3
    field_width_cm = size[0] / px_per_cm * height_cm / (height_cm - led_cm)
    return Pinhole.looking_down(
        size,
        height_cm=height_cm,
        field_width_cm=field_width_cm,
        tilt_rad=(0.02, -0.015),
        distortion=(-0.04, 0.0, 0.0, 0.0, 0.0),
    )


def rolling(points_cm: ArrayLike, speed_cm_s: float, level: Level | None = None) -> Robots:
    """One robot that rolls from point to point (n, 2) at an even pace, and stays at the last.

    ``level``: (x_cm, y_cm, t_s) -> the LED's level, 0..1; by default it shines.

    Raises:
        RequestError: there are fewer than two points, or the speed is not above 0.
    """
    points = np.asarray(points_cm, dtype=float).reshape(-1, 2)
    if len(points) < 2 or speed_cm_s <= 0.0:
        raise RequestError("a path needs two points or more and a speed above 0 cm/s")
    legs = np.diff(points, axis=0)
    lengths = np.hypot(*legs.T)
    ends_s = np.cumsum(lengths) / speed_cm_s

    def robots(t_s: float) -> list[RobotView]:
        leg = int(np.searchsorted(ends_s, t_s, side="right"))
        if leg >= len(legs):
            (x_cm, y_cm), (vx, vy) = points[-1], (0.0, 0.0)
        else:
            vx, vy = legs[leg] / lengths[leg] * speed_cm_s
            since_s = t_s - (ends_s[leg - 1] if leg else 0.0)
            x_cm, y_cm = points[leg] + np.array([vx, vy]) * since_s
        x_cm, y_cm = float(x_cm), float(y_cm)
        shines = 1.0 if level is None else level(x_cm, y_cm, t_s)
        return [RobotView(x_cm, y_cm, shines, float(vx), float(vy))]

    return robots


def together(*robots: Robots) -> Robots:
    """Several robots in one film, numbered as they are given."""
    return lambda t_s: [view for one in robots for view in one(t_s)]


def wander(rng: np.random.Generator, arena_cm: tuple[float, float], *, length_cm: float) -> Floats:
    """Way points (n, 2) of straight runs from wall to wall of an arena (width, depth), at least ``length_cm`` in all.

    Each leaves its wall by Lambert's law.
    """
    half: Floats = np.asarray(arena_cm, dtype=float) / 2.0
    inward = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])  # from the left, lower, right, upper wall
    place: Floats = np.array([-half[0], rng.uniform(-1.0, 1.0) * half[1]])
    wall, gone_cm = 0, 0.0
    points = [place]
    while gone_cm < length_cm:
        normal = inward[wall]
        sine = rng.uniform(-0.95, 0.95)
        heading = math.sqrt(1.0 - sine * sine) * normal + sine * np.array([-normal[1], normal[0]])
        # The nearest wall ahead: where ±half is reached along each axis.
        with np.errstate(divide="ignore"):
            reach = (np.sign(heading) * half - place) / heading
        axis = int(np.argmin(np.where(np.abs(heading) > 1e-9, reach, np.inf)))
        place = np.clip(place + heading * reach[axis], -half, half)
        wall = axis + 2 * int(heading[axis] > 0.0)
        points.append(place)
        gone_cm += float(reach[axis])
    return np.asarray(points)


def light_of(
    shape: Shape,
    *,
    lit_lux: float = 120.0,
    dark_lux: float = 20.0,
    blur_cm: float = 0.15,
    light_from_cm: Sequence[float] = (0.0, 0.0, 250.0),
) -> LightAt:
    """The light of a projector that throws ``shape`` (cm, on the floor) on a dim floor.

    ``blur_cm``: standard deviation of its edge; ``light_from_cm``: where it hangs, which says where the light passes
    above the floor.
    """
    low_x, low_y, high_x, high_y = (float(value) for value in shape.bounds)
    rim_cm = 5.0 * blur_cm + 1.0
    corner = np.array([low_x - rim_cm, low_y - rim_cm])
    size = np.ceil((np.array([high_x, high_y]) + rim_cm - corner) / _GRID_CM).astype(int) + 1
    mask = np.zeros((int(size[1]), int(size[0])), dtype=np.float32)
    parts = shape.geoms if isinstance(shape, MultiPolygon) else [shape]
    for part in parts:
        rings = [part.exterior, *part.interiors]
        # Sixteenths of a grid step, on which OpenCV fills outlines.
        outlines = [np.rint((np.asarray(ring.coords) - corner) / _GRID_CM * 16.0).astype(np.int32) for ring in rings]
        piece = np.zeros_like(mask)
        cv2.fillPoly(piece, outlines, 1.0, cv2.LINE_8, 4)
        mask = np.maximum(mask, piece)
    soft = np.asarray(cv2.GaussianBlur(mask, (0, 0), max(0.5, blur_cm / _GRID_CM)), dtype=np.float32)
    eye = np.asarray(light_from_cm, dtype=float)

    def light_at(x_cm: Floats, y_cm: Floats, height_cm: float) -> Floats:
        spread = eye[2] / (eye[2] - height_cm)
        across = (eye[0] + (x_cm - eye[0]) * spread - corner[0]) / _GRID_CM
        up = (eye[1] + (y_cm - eye[1]) * spread - corner[1]) / _GRID_CM
        # One column of points, cut into pieces that OpenCV's 16-bit sizes can hold.
        share = np.concatenate(
            [
                cv2.remap(soft, a, u, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT).ravel()
                for a, u in _pieces(across.astype(np.float32), up.astype(np.float32))
            ]
        )
        return dark_lux + (lit_lux - dark_lux) * share.astype(float)

    return light_at


def blink_in(shape: Shape, *, bright: float = 1.0, dim: float = 0.25) -> Level:
    """The LED's level of a robot that shines brightly in the shape and dimly outside, as a BOLT with its light on."""
    return lambda x_cm, y_cm, _t_s: bright if bool(contains_xy(shape, x_cm, y_cm)) else dim


def _pieces(across: NDArray[np.float32], up: NDArray[np.float32]) -> list[tuple[NDArray[np.float32], ...]]:
    step = 30_000
    return [(across[i : i + step, None], up[i : i + step, None]) for i in range(0, max(len(across), 1), step)]
