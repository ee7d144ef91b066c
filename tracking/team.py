"""Several robots under a still camera, each followed to the same fraction of a pixel as one that is alone.

The film is read twice. The first reading finds all lights, to a pixel, and says whose they are (``identity``). In the
second one each robot has a follower of its own, which is told in every frame where its LED is to a pixel and of what
colour: no second robot can pull it away.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking.follow import LedFollower
from tracking.identity import Identity, LedMark, identify
from tracking.lights import Light, LitFloor, find_lights
from tracking.sighting import Sighting
from tracking.video import VideoFrame

Floats = NDArray[np.float64]
Film = Callable[[], Iterable[VideoFrame]]

_AGREE_PX = 6.0  # farther from the light that was identified, a sighting is of something else
_SPARE = 3  # lights that are no robot's: reflections, sorted out by how long they last


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """One robot's part of a film: one sighting a frame, None where not seen, and how surely (0..1) it is this one."""

    sightings: list[Sighting | None]
    certainty: Floats


def follow_team(
    film: Film,
    floor: LitFloor,
    robots: int,
    marks: Sequence[LedMark] | None = None,
    progress: Callable[[int], None] | None = None,
) -> tuple[Floats, list[Member]]:
    """Follow several robots through a film of a still scene.

    Args:
        film: opens the film; it is read twice, and must give the same frames.
        floor: what lies beneath.
        robots: how many there are.
        marks: what each is known by; see ``identify``.
        progress: called with the number of frames done, half a frame for each reading.

    Returns:
        The frames' times (n,) and one member a robot.

    Raises:
        RequestError: the marks are not one a robot.
    """
    times: list[float] = []
    lights: list[list[Light]] = []
    for frame in film():
        lights.append(find_lights(frame, floor, robots + _SPARE))
        times.append(frame.t_s)
        if progress is not None:
            progress(len(times) // 2)
    t_s = np.asarray(times, dtype=float)
    # A stuck or backward clock must not turn the motion around.
    rising = np.maximum.accumulate(t_s)
    identities = identify(rising.tolist(), lights, robots, marks)
    scouts = [_Scout(identity, floor) for identity in identities]
    for number, frame in enumerate(film()):
        for scout in scouts:
            scout.step(number, float(rising[number]), frame)
        if progress is not None:
            progress((len(times) + number) // 2)
    return t_s, [scout.member(len(times)) for scout in scouts]


class _Scout:
    """Looks closely at one robot, whose light is known to a pixel."""

    def __init__(self, identity: Identity, floor: LitFloor) -> None:
        self._identity = identity
        self._follower = LedFollower(floor.background, hue_rad=identity.hue_rad if floor.in_colour else math.nan)
        self._frames: list[int] = []

    def step(self, number: int, t_s: float, frame: VideoFrame) -> None:
        """Look at one frame, where the robot's light shines in it."""
        light = self._identity.lights.get(number)
        if light is not None:
            self._follower.step(t_s, frame.luma, frame.chroma, at=(light.x_px, light.y_px))
            self._frames.append(number)

    def member(self, frames: int) -> Member:
        """What was seen, without what is not where the light was identified."""
        sightings: list[Sighting | None] = [None] * frames
        certainty = np.zeros(frames)
        for number, sighting in zip(self._frames, self._follower.finish(), strict=True):
            if sighting is not None and _agree(sighting, self._identity.lights[number]):
                sightings[number] = sighting
                certainty[number] = self._identity.certainty[number]
        return Member(sightings, certainty)


def _agree(sighting: Sighting, light: Light) -> bool:
    x, y = sighting.position
    return math.hypot(x - light.x_px, y - light.y_px) <= _AGREE_PX
