"""The direction of an edge of light, felt with a small manoeuvre.

One sensor knows no direction, so the way in is felt (`feel_edge`): the robot has entered the ring at one point, leaves
it at another a little to the side, and the two points give the edge's direction. It comes to rest just inside
the arena, near the second point. Lambert's law from there gives the lines that meet the arena shrunk by that depth
(some 2 cm), uniform and isotropic: nothing is lost on a shape within, but runs through the outermost strip are
missing, and the mean run is some per cent longer than Cauchy's pi A/P of the whole arena.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from lab.base.errors import ChordlabError
from robot.device import Sample
from robot.edge import EdgeDetector, EdgeLevels, EdgePoint

_SIDEWAYS_RAD = math.pi / 4  # the way out leaves the way in by no more than this
# Ways out, in depths, that suffice on a straight edge; a longer one runs along the edge or away from it.
_FIRST_WAY_OUT, _SECOND_WAY_OUT = 1.5, 2.0
_INSIDE_CM = 10.0  # at the most, before the entry, where the robot came by: surely inside
_CLEAR_CM = 1.0  # rolled on past the edge, so that the ring is out of the sensor's sight when the next leg begins
_START_S = 3.0  # to turn on the spot, gather speed and answer


class EdgeError(ChordlabError):
    """The edge's normal was not felt; ``in_ring`` says whether the robot still stands in the ring."""

    def __init__(self, message: str, *, in_ring: bool) -> None:
        super().__init__(message)
        self.in_ring = in_ring


@dataclass(frozen=True, slots=True)
class FeltEdge:
    """What the manoeuvre found.

    Attributes:
        normal_heading_rad: Heading, in the robot's frame, from the edge straight into the arena, [0, 2 pi).
        left: Where the robot left the ring: the next line starts there.
        x_cm, y_cm: Where it rests, a little further inside.
        radius_cm: Radius of the edge if it is a circle.
    """

    normal_heading_rad: float
    left: EdgePoint
    x_cm: float
    y_cm: float
    radius_cm: float = math.inf

    @property
    def depth_cm(self) -> float:
        """How far from the edge the robot rests, square to it."""
        normal_rad = self.normal_heading_rad
        dx_cm, dy_cm = self.x_cm - self.left.x_cm, self.y_cm - self.left.y_cm
        return max(0.0, dx_cm * math.sin(normal_rad) + dy_cm * math.cos(normal_rad))

    def run_up_cm(self, heading_rad: float) -> float:
        """The stretch of a line along ``heading_rad`` that lies between the edge and where the robot rests.

        Add it to what the robot then rolls for the line's length in the arena. Along a straight edge it grows
        beyond all bounds as the line grazes it; the arena's corners, which nobody knows, then cut it off.
        """
        inward = math.cos(heading_rad - self.normal_heading_rad)
        if not inward > 0:
            return 0.0
        if not math.isfinite(self.radius_cm):
            return self.depth_cm / inward
        # From where it rests to the centre, and the root of |centre - rest + b heading| = radius.
        to_x_cm = self.left.x_cm + self.radius_cm * math.sin(self.normal_heading_rad) - self.x_cm
        to_y_cm = self.left.y_cm + self.radius_cm * math.cos(self.normal_heading_rad) - self.y_cm
        ahead_cm = to_x_cm * math.sin(heading_rad) + to_y_cm * math.cos(heading_rad)
        within = self.radius_cm**2 - to_x_cm**2 - to_y_cm**2
        return max(0.0, math.sqrt(max(0.0, ahead_cm**2 + within)) - ahead_cm)


class Rover(Protocol):
    """A robot that can be told a short roll."""

    async def roll(
        self, heading_rad: float, speed_cm_s: float, until: Callable[[Sample], bool], timeout_s: float
    ) -> bool:
        """Roll along ``heading_rad`` until ``until`` says so of a sample or ``timeout_s`` is over, then come to rest.

        ``until`` is shown every sample from the command to the rest, also those after it has said yes. Returns
        whether it did.
        """
        ...


@runtime_checkable
class KnowsEdge(Protocol):
    """A robot that need not feel the edge of light that it stopped at: one that is played back."""

    async def felt_edge(self) -> FeltEdge | None:
        """What the manoeuvre found; None where it found nothing."""
        ...


class _Manoeuvre:
    """The rolls of one manoeuvre, and what the light said during them."""

    def __init__(self, rover: Rover, levels: EdgeLevels, detector: EdgeDetector, speed_cm_s: float) -> None:
        self._rover = rover
        self._levels = levels
        self._detector = detector
        self._speed_cm_s = speed_cm_s
        self._light_lux = math.nan
        self.x_cm = self.y_cm = math.nan
        self.left: EdgePoint | None = None

    @property
    def clear(self) -> bool:
        """Whether the ring was left, is behind by a little, and no other side of it is in sight."""
        left = self.left
        if left is None or math.hypot(self.x_cm - left.x_cm, self.y_cm - left.y_cm) < _CLEAR_CM:
            return False
        ring = self._levels.ring
        return self._light_lux <= ring.low_lux if self._levels.bright else self._light_lux >= ring.high_lux

    async def roll(self, heading_rad: float, path_cm: float, done: Callable[[], bool]) -> None:
        """Roll until ``done``, at the longest for ``path_cm``; `left` is where the ring was left last, if it was."""
        start: tuple[float, float] | None = None

        def until(sample: Sample) -> bool:
            nonlocal start
            start = start or (sample.x_cm, sample.y_cm)
            self.x_cm, self.y_cm, self._light_lux = sample.x_cm, sample.y_cm, sample.light_lux
            passage = self._detector.feed(sample.t_host_s, sample.x_cm, sample.y_cm, sample.light_lux)
            if passage is not None:
                self.left = None if passage.into_ring else passage
            too_far = math.hypot(self.x_cm - start[0], self.y_cm - start[1]) >= path_cm
            return done() or (too_far and self.left is None)

        await self._rover.roll(heading_rad, self._speed_cm_s, until, _START_S + 2.0 * path_cm / self._speed_cm_s)


async def feel_edge(
    rover: Rover,
    levels: EdgeLevels,
    entered: EdgePoint,
    heading_rad: float,
    speed_cm_s: float,
    *,
    span_cm: float = 4.0,
    radius_cm: float = math.inf,
    rolled_cm: float = math.inf,
    light_latency_s: float = 0.0,
) -> FeltEdge:
    """Find the edge's normal and come to rest just inside the arena.

    The robot, at rest in the ring, rolls on until it is deep enough (1.4 ``span_cm`` from where it entered), then
    back at an angle that takes it past its entry at ``span_cm``. If that way out is too long it runs along the
    edge; the mirrored one is then short. Should a corner spoil both, it heads for where it came from. The deepest
    point lies 1.1 times as deep as the first stop.
    At a corner of the arena the two points may lie on two walls; the corner is then cut, and the normal is that of
    the cut: the lines are those of an arena with small bevels (in a 112 x 82 cm rectangle some 3 % of them lie
    elsewhere than in the arena itself), and a heading into the other wall only makes a leg
    that goes nowhere, which a navigator draws again.

    Args:
        rover: The robot, at rest.
        levels: The session's levels.
        entered: Where it entered the ring.
        heading_rad: The heading along which it did, robot's frame.
        speed_cm_s: Speed of the manoeuvre; slow, for the light is sampled and braking takes its way.
        span_cm: Distance of the two points: longer is more exact on a straight wall, and cuts more off corners.
        radius_cm: Radius of the edge if it is a circle, to correct for its bend between the points.
        rolled_cm: How far it had rolled along ``heading_rad`` when it entered: somewhere back there is inside.
        light_latency_s: As for `EdgeDetector`.

    Raises:
        EdgeError: The robot is not in the ring, does not come out of it, or comes out where it went in.
    """
    detector = EdgeDetector(levels, light_latency_s=light_latency_s)
    way = _Manoeuvre(rover, levels, detector, speed_cm_s)
    deep_cm = span_cm / math.sin(_SIDEWAYS_RAD)

    def off_cm() -> float:
        return math.hypot(way.x_cm - entered.x_cm, way.y_cm - entered.y_cm)

    await way.roll(heading_rad, 2.0 * deep_cm, lambda: off_cm() >= deep_cm)
    depth_cm = off_cm()
    if not detector.in_ring or not depth_cm > 0:
        raise EdgeError(
            "the robot stopped outside the edge's ring: project a wider ring, or roll slower", in_ring=detector.in_ring
        )
    aside_rad = min(math.asin(min(1.0, span_cm / depth_cm)), _SIDEWAYS_RAD)
    inside_cm = min(_INSIDE_CM, rolled_cm / 2)
    inside_x_cm = entered.x_cm - inside_cm * math.sin(heading_rad)
    inside_y_cm = entered.y_cm - inside_cm * math.cos(heading_rad)
    for attempt in range(3):
        if attempt < 2:
            out_rad = heading_rad + math.pi + (aside_rad, -aside_rad)[attempt]
            far_cm = (_FIRST_WAY_OUT, _SECOND_WAY_OUT)[attempt] * depth_cm
        else:  # round a corner both may fail; a line to a point inside a convex arena always leads in
            home_x_cm, home_y_cm = inside_x_cm - way.x_cm, inside_y_cm - way.y_cm
            out_rad, far_cm = math.atan2(home_x_cm, home_y_cm), math.hypot(home_x_cm, home_y_cm)
        await way.roll(out_rad, far_cm, lambda: way.clear)
        if way.left is None or not way.clear or detector.in_ring:
            continue
        if math.hypot(way.left.x_cm - entered.x_cm, way.left.y_cm - entered.y_cm) < span_cm / 2:
            raise EdgeError(
                "the robot came out of the edge's ring where it went in, so that its direction is unknown: "
                "it stands inside the arena, let it head anywhere",
                in_ring=False,
            )
        # Halfway between back where it came from and the way that it went: inwards, even if both graze the edge.
        inward_rad = out_rad + math.remainder(heading_rad + math.pi - out_rad, math.tau) / 2
        return FeltEdge(_normal(entered, way.left, inward_rad, radius_cm), way.left, way.x_cm, way.y_cm, radius_cm)
    raise EdgeError(
        "the robot did not find out of the edge's ring: put it back into the arena; is it held, or the ring uneven?",
        in_ring=detector.in_ring,
    )


def _normal(entered: EdgePoint, left: EdgePoint, inwards_rad: float, radius_cm: float) -> float:
    """Heading of the normal at ``left``: across the line of the two points, to the side of ``inwards_rad``.

    On a circle it is turned on by half of the arc between them, towards the entry: normals meet at the centre.
    """
    across_x, across_y = left.y_cm - entered.y_cm, entered.x_cm - left.x_cm
    if across_x * math.sin(inwards_rad) + across_y * math.cos(inwards_rad) < 0:
        across_x, across_y = -across_x, -across_y
    chord_cm = math.hypot(across_x, across_y)
    high = math.sqrt(max(0.0, (radius_cm / chord_cm) ** 2 - 0.25)) if math.isfinite(radius_cm) else math.inf
    if math.isfinite(high):
        # From `left` to the middle of the chord, and on to the centre.
        across_x = (entered.x_cm - left.x_cm) / 2 + high * across_x
        across_y = (entered.y_cm - left.y_cm) / 2 + high * across_y
    return math.atan2(across_x, across_y) % math.tau
