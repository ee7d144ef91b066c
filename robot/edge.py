"""The arena's edge found by light instead of by a bump: a ring of light projected around the arena.

The ring is either **dark** (floor dim, shape bright, ring black) or **bright** (floor black, shape of middle
brightness, ring white). The lines then end where the ring begins: its inner outline is the polygon in which they are
uniform, and no ball's radius is taken off, for the sensor sits in the ball's middle.

One sensor knows no direction: `robot.feeledge` feels the way in with a small manoeuvre.

What the ring asks for: as wide as the way that the robot needs to stop, and some `span_cm` more; and, if it is
bright, a strip of bare floor between it and the shape, wider than what the sensor sees at once (its footprint) and
than the way between two samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from robot.crossings import Crossing, CrossingDetector, Levels, LevelsError, learn_levels


@dataclass(frozen=True, slots=True)
class EdgeLevels:
    """The light of floor, shape and ring.

    Attributes:
        shape: Floor against shape, for crossings.
        ring: For a dark ring, ring against floor; for a bright one, shape against ring, so that the shape is
            never taken for it.
        bright: The ring is the brightest of the three, else the darkest.
    """

    shape: Levels
    ring: Levels
    bright: bool


@dataclass(frozen=True, slots=True)
class EdgePoint:
    """A passage of the ring's inner outline, by the locator (robot's frame, cm)."""

    t_s: float
    x_cm: float
    y_cm: float
    into_ring: bool


def learn_edge_levels(floor_lux: ArrayLike, shape_lux: ArrayLike, ring_lux: ArrayLike) -> EdgeLevels:
    """Learn the three levels from samples (n,) taken under each; which kind of ring it is follows from them.

    Noise and thresholds are those of `robot.crossings.learn_levels`; non-finite samples are left out.

    Raises:
        LevelsError: Two of the levels do not separate, or there are too few samples of one.
    """
    shape = _separate("floor and shape", floor_lux, shape_lux)
    ring = np.asarray(ring_lux, dtype=float).ravel()
    ring = ring[np.isfinite(ring)]
    level = float(np.median(ring)) if ring.size else math.nan
    if shape.dark_lux < level <= shape.bright_lux:
        raise LevelsError(
            f"the edge's ring ({level:.1f} lux) must be darker than the floor ({shape.dark_lux:.1f} lux) or brighter "
            f"than the shape ({shape.bright_lux:.1f} lux): project it black, or white with a dimmer shape",
            dark_lux=shape.dark_lux,
            bright_lux=level,
            noise_lux=math.nan,
        )
    bright = level > shape.bright_lux
    edge = _separate("shape and ring", shape_lux, ring) if bright else _separate("ring and floor", ring, floor_lux)
    return EdgeLevels(shape, edge, bright)


def _separate(which: str, dark_lux: ArrayLike, bright_lux: ArrayLike) -> Levels:
    try:
        return learn_levels(dark_lux, bright_lux)
    except LevelsError as error:
        raise LevelsError(
            f"light of {which}: {error}",
            dark_lux=error.dark_lux,
            bright_lux=error.bright_lux,
            noise_lux=error.noise_lux,
        ) from None


class EdgeDetector:
    """Entries into the ring and exits from it, sample by sample, in constant memory.

    Decides and places as `CrossingDetector` does; the first sample only says on which side it begins. Samples
    whose light is not finite are passed over.

    ``light_latency_s`` is how much later than the locator the light is reported; the position is taken back by it.
    """

    __slots__ = ("_bright", "_last", "_latency_s", "_x", "_y")

    def __init__(self, levels: EdgeLevels, *, light_latency_s: float = 0.0) -> None:
        # A crossing is placed linearly in whatever coordinate comes with the light: one detector for each.
        self._x, self._y = CrossingDetector(levels.ring), CrossingDetector(levels.ring)
        self._bright = levels.bright
        self._latency_s = light_latency_s
        self._last: tuple[float, float, float] | None = None

    @property
    def in_ring(self) -> bool:
        """Whether the robot is in the ring, as far as confirmed; False before the first sample."""
        return self._last is not None and self._x.lit == self._bright

    def feed(self, t_s: float, x_cm: float, y_cm: float, light_lux: float) -> EdgePoint | None:
        """Take the next sample: its time, the locator's position and the light.

        Returns:
            The passage that this sample confirms, if any; it lies before the sample.
        """
        if not math.isfinite(light_lux):
            return None
        last, self._last = self._last, (t_s, x_cm, y_cm)
        late = self._latency_s / (t_s - last[0]) if last is not None and t_s > last[0] else 0.0
        if last is None:
            self._x.start(t_s, x_cm, light_lux)
            self._y.start(t_s, y_cm, light_lux)
            return None
        x = self._x.feed(t_s, x_cm - late * (x_cm - last[1]), light_lux)
        y = self._y.feed(t_s, y_cm - late * (y_cm - last[2]), light_lux)
        if x is None or y is None:
            return None
        return EdgePoint(x.t_s - self._latency_s, x.s_cm, y.s_cm, into_ring=x.entering == self._bright)


@dataclass(frozen=True, slots=True)
class Seen:
    """What a sample confirmed: crossings of the shape (none, or a whole chord), and a passage of the ring."""

    crossings: tuple[Crossing, ...]
    edge: EdgePoint | None


class RingedDetector:
    """Crossings of the shape in an arena that ends in a ring of light.

    On its way into a bright ring the light passes the shape's level, and a detector of the shape alone takes the
    ramp for an entry into the shape. So an entry is withheld until its exit is confirmed, and dropped if the ring
    is confirmed first; after the ring, nothing counts until bare floor has been seen. This holds however
    slantwise the ring is met, provided that bare floor lies between it and the shape.
    """

    __slots__ = ("_bare_lux", "_edge", "_entry", "_shape", "_watching")

    def __init__(self, levels: EdgeLevels, *, light_latency_s: float = 0.0) -> None:
        self._edge = EdgeDetector(levels, light_latency_s=light_latency_s)
        self._shape = CrossingDetector(levels.shape)
        self._bare_lux = levels.shape.low_lux if levels.bright else math.inf
        self._entry: Crossing | None = None
        self._watching: bool | None = None  # None before the first sample

    @property
    def lit(self) -> bool:
        """Whether the robot is in the shape, as far as known now (a bright ring's ramp looks like it at first)."""
        return self._entry is not None

    @property
    def in_ring(self) -> bool:
        """Whether the robot is in the ring."""
        return self._edge.in_ring

    def feed(self, t_s: float, s_cm: float, x_cm: float, y_cm: float, light_lux: float) -> Seen:
        """Take the next sample of a run: time, path along the run, the locator's position and the light."""
        edge = self._edge.feed(t_s, x_cm, y_cm, light_lux)
        if not math.isfinite(light_lux):
            return Seen((), None)
        crossings: tuple[Crossing, ...] = ()
        if self._watching is None:
            self._watching = not self._edge.in_ring
            if self._watching:
                self._entry = self._shape.start(t_s, s_cm, light_lux)
        elif self._watching:
            crossings = self._take(self._shape.feed(t_s, s_cm, light_lux))
        elif not self._edge.in_ring and light_lux <= self._bare_lux:
            self._watching = True
            self._entry = self._shape.start(t_s, s_cm, light_lux)
        if self._edge.in_ring:
            self._watching, self._entry = False, None
        return Seen(crossings, edge)

    def finish(self, t_s: float, s_cm: float) -> tuple[Crossing, ...]:
        """End the run: a chord that is open (it did not end in the ring) is closed here."""
        chord = self._take(self._shape.finish(t_s, s_cm)) if self._watching else ()
        self._watching, self._entry = False, None
        return chord

    def _take(self, crossing: Crossing | None) -> tuple[Crossing, ...]:
        if crossing is None:
            return ()
        entry, self._entry = self._entry, crossing if crossing.entering else None
        return (entry, crossing) if entry is not None and not crossing.entering else ()
