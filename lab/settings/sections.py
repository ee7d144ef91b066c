"""The sections of a session's settings: floor, motion, sensor, link, LED, optics, end."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, PrivateAttr, field_validator
from shapely import Point, Polygon, box

from lab.base.colours import LED_COLOURS
from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from lab.settings.physics import Fraction, Positive, Section
from robot.turning import Policy, Weighting
from tracking.calibration import load_calibration

BALL_RADIUS_CM = 3.65  # a Sphero BOLT is 73 mm across
Extent = Annotated[float, Field(gt=0, le=10_000)]  # of a floor: a hundred metres


class ArenaSettings(Section):
    """The walled floor that the robot rolls on, centred at the origin."""

    kind: Literal["rectangle", "disc"] = "rectangle"
    """`rectangle` (width_cm by height_cm) or `disc` (radius_cm)."""
    width_cm: Extent = 120.0
    """Inner width between the walls, of a rectangle."""
    height_cm: Extent = 90.0
    """Inner height between the walls, of a rectangle."""
    radius_cm: Extent = 60.0
    """Inner radius of the wall, of a disc."""
    edge: Literal["bump", "dark_ring", "bright_ring"] = "bump"
    """What ends a run: a `bump` into the wall, or a ring of light along it: a `dark_ring` (around a dim floor) or a
    `bright_ring`."""
    ring_cm: Annotated[float, Field(ge=3, le=50)] = 10.0
    """Width of the ring along the wall, of an edge by light; wide enough to brake in."""

    @property
    def polygon(self) -> Polygon:
        """The floor between the walls, cm."""
        if self.kind == "disc":
            return Point(0, 0).buffer(self.radius_cm, quad_segs=90)
        return box(-self.width_cm / 2, -self.height_cm / 2, self.width_cm / 2, self.height_cm / 2)

    @property
    def reachable(self) -> Polygon:
        """Where the ball's centre can be: a ball's radius inside the walls, cm."""
        inner = self.polygon.buffer(-BALL_RADIUS_CM, join_style="mitre")
        if inner.is_empty:
            raise RequestError(f"the arena is too small for a ball of {2 * BALL_RADIUS_CM:g} cm; widen [arena]")
        return inner

    @property
    def lines_within(self) -> Polygon:
        """Where the runs lie: ``reachable``, or what the ring leaves of the floor, cm."""
        if self.edge == "bump":
            return self.reachable
        inner = self.polygon.buffer(-self.ring_cm, join_style="mitre")
        if inner.is_empty:
            raise RequestError(
                f"the arena is too small for a ring of {self.ring_cm:g} cm; widen [arena] or lower ring_cm"
            )
        return inner

    @property
    def longest_line_cm(self) -> float:
        """Length of the longest line from edge to edge: the diagonal, or the diameter."""
        left, bottom, right, top = self.lines_within.bounds
        return right - left if self.kind == "disc" else math.hypot(right - left, top - bottom)

    @property
    def ring(self) -> Polygon | None:
        """The lit or dark band along the wall, cm; None where runs end at the wall itself."""
        if self.edge == "bump":
            return None
        return Polygon(self.polygon.exterior, [self.lines_within.exterior])


class MotionSettings(Section):
    """How the robot rolls and turns."""

    speed_cm_s: Annotated[float, Field(gt=0, le=150)] = 15.0
    """Cruising speed. The paper rolls at 1 cm/s; at most 150 cm/s."""
    turning: Policy = Policy.LAMBERT
    """How it turns: `lambert` (cosine law at the edge: isotropic uniform lines), `uniform` (biased, to show it), or
    `interior` (random interior stops: needs no wall direction, takes twice the way)."""
    weighting: Weighting = Weighting.NONE
    """`run_length` undoes what `uniform` does wrong, in a disc arena; refused elsewhere, where it would not."""
    cm_s_per_unit: Annotated[float, Field(gt=0, le=10)] | None = None
    """Speed of one unit of the drive command's speed byte on this floor; none: the robot profile's."""
    run_timeout_s: Positive = 60.0
    """A run without a bump for this long is given up: the robot is stuck or lifted."""
    length_from: Literal["time", "odometry"] = "time"
    """What chord lengths come from: elapsed time × speed, as in the paper, or the wheels. Both are recorded."""


class SensorSettings(Section):
    """The light sensor and its stream."""

    interval_s: Annotated[float, Field(ge=0.025, le=1)] = 0.05
    """Time between two light samples. Below 25 ms the radio link breaks."""
    height_cm: Positive = 6.0
    """Height of the light sensor above the floor: the plane for which shapes are projected."""


class LinkSettings(Section):
    """What a session does when the radio link or the battery gives out."""

    reconnect_s: Annotated[float, Field(ge=0, le=3600)] = 60.0
    """How long a robot whose link broke is called back before the session ends; 0: not at all."""
    battery_low_v: Annotated[float, Field(ge=3, le=4.2)] = 3.5
    """Below this voltage the session pauses, or a tired robot would roll crooked lines."""
    charge_wait_s: Annotated[float, Field(ge=0, le=86_400)] = 7200.0
    """How long a pause waits for a charged battery before the session ends."""


class LedSettings(Section):
    """The light on the robot that the camera follows."""

    dark_level: Fraction = 0.25
    """Brightness outside the shape. 0 blinks fully dark, as in the paper."""
    lit_level: Fraction = 1.0
    """Brightness inside the shape."""
    height_cm: Positive = 7.3
    """Height of the LED above the floor."""
    colours: tuple[str, ...] = tuple(LED_COLOURS)
    """Colours of the robots' LEDs, in their order: `red`, `green`, `blue`, `yellow`, `magenta`, `cyan`, `orange`,
    `violet`. By them the camera tells robots apart; the first ones lie farthest apart."""

    @field_validator("colours")
    @classmethod
    def _colours_are_known(cls, colours: tuple[str, ...]) -> tuple[str, ...]:
        for colour in colours:
            if colour not in LED_COLOURS:
                raise ValueError(f"{colour!r} is no LED colour; choose of {', '.join(LED_COLOURS)}")
        if not colours or len(set(colours)) < len(colours):
            raise ValueError("name each robot's LED colour once, in the order of the robots")
        return colours


class OpticsSettings(Section):
    """Where a camera or projector hangs: a calibration file, or a pose measured by hand."""

    calibration: Path | None = None
    """A calibration.json; the other fields are then not used."""
    image_size: tuple[Annotated[int, Field(ge=16, le=16384)], Annotated[int, Field(ge=16, le=16384)]] = (1280, 720)
    """Width and height of the picture in pixels."""
    height_cm: Positive = 205.0
    """Height of the optical centre above the floor."""
    field_width_cm: Positive = 175.0
    """Width of the floor that the picture covers."""
    centre_cm: tuple[float, float] = (0.0, 0.0)
    """The floor point under the optical centre."""
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    """Tilt away from the plumb line about the arena's x and y axes."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Lens distortion k1, k2, p1, p2, k3 (OpenCV's order)."""
    _held: Pinhole | None = PrivateAttr(default=None)

    def holding(self, optics: Pinhole) -> OpticsSettings:
        """The same by these optics, in the place of a file that is not to be read again."""
        held = self.model_copy(update={"calibration": None})
        held._held = optics
        return held

    def pinhole(self) -> Pinhole:
        """The optics. Raises RequestError for a calibration file that cannot be read."""
        if self._held is not None:
            return self._held
        if self.calibration is not None:
            return load_calibration(self.calibration).optics
        tilt_x, tilt_y = self.tilt_deg
        return Pinhole.looking_down(
            self.image_size,
            height_cm=self.height_cm,
            field_width_cm=self.field_width_cm,
            centre_cm=self.centre_cm,
            tilt_rad=(math.radians(tilt_x), math.radians(tilt_y)),
            distortion=self.distortion,
        )


class StopSettings(Section):
    """When a session ends."""

    lines: Annotated[int, Field(ge=1, le=10_000_000)] = 150
    """Number N of lines that cross the shape, at most."""
    until: Annotated[float, Field(gt=0.5, lt=1)] | None = None
    """Stop early once the leading name's posterior reaches this; none: go on to `lines`."""
    at_least: Annotated[int, Field(ge=1)] = 50
    """Never stop on the posterior before this many crossing lines."""
