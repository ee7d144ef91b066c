"""A light followed for a while, and which of all lights that were followed is the LED.

A glint may be as bright as the LED, as small, and move as fast; in a single frame nothing tells the two apart. Over
time much does: the LED sits on a ball, which hides the floor under it, and a glint does not; the LED shines brighter
over light than in the dark; a robot moves, and is at one place at a time. So lights are followed side by side, and what
the LED was is decided at the end, as the chain of trails, one after the other, for which most speaks.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tracking.hueplane import SpotRadius
from tracking.motion import PixelMotion
from tracking.shell import ShellField
from tracking.sighting import Sighting

Plane = NDArray[np.uint8] | NDArray[np.float32]

# A shell that differs from the floor by this share of its light is seen beyond doubt.
_SURELY_HIDDEN = 0.2
# So many frames over light and in the dark tell whether a light blinks with the shape.
_BLINKS = 8
# What speaks for a light of which nothing is known, and what is left for one that never moved (in parts of 1 a frame).
_UNKNOWN, _STILL = 0.15, 0.3
# How far a light must get to have moved, in radii of its spot.
_MOVED_RADII = 4.0
# By how much (frames of a light that surely is the LED) another trail must be better to be believed as well.
_CHANGE = 3.0
# Frames by which trails may overlap that are the same LED's: the one that was led astray ends late.
_OVERLAP = 12
# Lights that run into each other are parted to about so much, within so many radii.
_MIXED_PX2, _MIXED_RADII = 1.0, 3.0
_REPEATED_PX = 0.05
_MOST_BLINK = 15.0
# Fewer sightings do not tell how bright a light is.
_FEWEST_LIKE = 10


@dataclass(frozen=True, slots=True, eq=False)
class Kept:
    """A patch of luma that is worth another look once the shell is known."""

    number: int
    patch: Plane
    left: int
    top: int
    lessons: int


@dataclass(slots=True, eq=False)
class Trail:
    """One light, followed from frame to frame.

    ``numbers`` and ``seen`` are its frames and sightings, in order; ``lit`` (0..1) how bright the floor was there;
    ``cuts`` the places in these lists where it parted from another light, after which it may be the other one;
    ``apart_px`` how far the next light is, infinite if none is near; ``repeated``: the last picture was a repeated one.
    """

    motion: PixelMotion
    radius: SpotRadius
    colour_radius: SpotRadius
    shell: ShellField
    last_s: float
    numbers: list[int] = field(default_factory=list[int])
    seen: list[Sighting] = field(default_factory=list[Sighting])
    lit: list[float] = field(default_factory=list[float])
    cuts: list[int] = field(default_factory=list[int])
    kept: list[Kept] = field(default_factory=list[Kept])
    apart_px: float = math.inf
    repeated: bool = False

    def add(self, number: int, t_s: float, sighting: Sighting, lit: float) -> None:
        """Take in a sighting."""
        self.numbers.append(number)
        self.seen.append(sighting)
        self.lit.append(lit)
        self.last_s = t_s

    def meet(self, apart_px: float) -> None:
        """Note how far the next light is, infinitely far if none is near; where they part, there is a cut."""
        if math.isfinite(self.apart_px) and math.isinf(apart_px) and self.seen:
            self.cuts.append(len(self.seen))
        self.apart_px = apart_px

    @property
    def mixed_px2(self) -> float:
        """What another light that is near adds to the variance of a position."""
        return _MIXED_PX2 * math.exp(-0.5 * (self.apart_px / (_MIXED_RADII * self.radius.sigma_px)) ** 2)

    def move(self, sighting: Sighting) -> None:
        """Let the motion follow a sighting.

        A picture that is the one before it once more, as a camera repeats it that has none in time, says nothing.
        """
        motion, (x, y) = self.motion, sighting.position
        if self.seen and not self.repeated:
            last_x, last_y = self.seen[-1].position
            still = math.hypot(x - last_x, y - last_y) < _REPEATED_PX
            self.repeated = still and math.hypot(motion.x - x, motion.y - y) > 20.0 * _REPEATED_PX
            if self.repeated:
                return
        self.repeated = False
        motion.update(x, y, 0.25 + 9.0 * self.mixed_px2)

    def like_it(self, sighting: Sighting) -> bool:
        """Whether a spot is not much fainter than this light at its faintest, nor brighter than an LED can blink."""
        if len(self.seen) < _FEWEST_LIKE:
            return True
        faintest = float(np.percentile([seen.amplitude for seen in self.seen[-2000:]], 5))
        return 0.4 * faintest < sighting.amplitude < _MOST_BLINK * faintest

    def worth(self) -> float:
        """What speaks for it as a whole."""
        return sum(piece.worth for piece in pieces([self]))


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """The part ``first`` to ``last`` (without) of a trail between two cuts; ``worth``: what speaks for it."""

    trail: Trail
    first: int
    last: int
    worth: float

    @property
    def starts(self) -> int:
        """The first frame's number."""
        return self.trail.numbers[self.first]

    @property
    def ends(self) -> int:
        """The last frame's number."""
        return self.trail.numbers[self.last - 1]


def pieces(trails: Sequence[Trail]) -> Iterator[Piece]:
    """Cut trails where they parted from others, and judge each piece."""
    for trail in trails:
        moved = _moved(trail)
        bounds = sorted({0, *trail.cuts, len(trail.seen)})
        for first, last in itertools.pairwise(bounds):
            each = (_UNKNOWN + _ball(trail.seen[first:last]) + _blink(trail, first, last)) * (1.0 if moved else _STILL)
            yield Piece(trail, first, last, each * (last - first))


def choose(trails: Sequence[Trail], times_s: Sequence[float], width: int) -> list[Piece]:
    """Choose the pieces of trails that are the LED's: those that follow one another and for which most speaks.

    Args:
        trails: all lights that were followed.
        times_s: the frames' times.
        width: the picture's, px; a robot comes along by no more than half of it a second.

    Returns:
        The pieces in order of time. They overlap by a few frames at most.
    """
    known = sorted(pieces(trails), key=lambda piece: (piece.ends, piece.starts))
    total = [piece.worth for piece in known]
    before: list[int | None] = [None] * len(known)
    for this, piece in enumerate(known):
        for other, earlier in enumerate(known[:this]):
            if (
                earlier.ends >= piece.starts + min(_OVERLAP, len(piece.trail.seen) // 2)
                or earlier.starts >= piece.starts
            ):
                continue
            if earlier.trail is piece.trail:
                change = 0.0
            elif _in_reach(earlier, piece, times_s, width):
                change = _CHANGE
            else:
                continue
            if total[other] - change + piece.worth > total[this]:
                total[this], before[this] = total[other] - change + piece.worth, other
    chain: list[Piece] = []
    at = int(np.argmax(total)) if known else None
    while at is not None:
        chain.append(known[at])
        at = before[at]
    return chain[::-1]


def _in_reach(earlier: Piece, later: Piece, times_s: Sequence[float], width: int) -> bool:
    x0, y0 = earlier.trail.seen[earlier.last - 1].position
    x1, y1 = later.trail.seen[later.first].position
    gap_s = max(0.0, times_s[later.starts] - times_s[earlier.ends])
    return math.hypot(x1 - x0, y1 - y0) <= 80.0 + 0.5 * width * gap_s


def _moved(trail: Trail) -> bool:
    places = np.array([sighting.position for sighting in trail.seen])
    return len(places) > 0 and bool(np.ptp(places, axis=0).max() > _MOVED_RADII * trail.radius.sigma_px)


def _ball(seen: Sequence[Sighting]) -> float:
    """How surely the light is on a robot, 0..1: it has the LED's colour, or a ball hides the floor under it."""
    if seen[0].colour is not None:
        return 1.0
    hidden = [sighting.hidden for sighting in seen if sighting.flat] or [sighting.hidden for sighting in seen]
    return min(1.0, abs(float(np.median(hidden))) / _SURELY_HIDDEN)


def _blink(trail: Trail, first: int, last: int) -> float:
    """How surely the light is brighter over light than in the dark, 0..1: whether it doubles."""
    lit = np.array(trail.lit[first:last]) > 0.5
    if min(lit.sum(), (~lit).sum()) < _BLINKS:
        return 0.0
    height = np.array([sighting.amplitude for sighting in trail.seen[first:last]])
    ratio = float(np.median(height[lit]) / np.median(height[~lit]))
    return min(1.0, max(0.0, math.log2(ratio)))
