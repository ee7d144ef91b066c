"""One run: samples as they come, the crossings that they confirm, and how it ended."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from robot.crossings import Crossing, CrossingDetector
from robot.device import Sample
from robot.edge import EdgePoint, RingedDetector
from robot.turning import Leg, LegEnd

EDGES = ("bump", "edge")
"""The ends of a run that came as far as runs go."""
_MOVED_CM = 0.5
_STALL_S = 2.0  # longer than any turn on the spot


@dataclass(slots=True)
class Run:
    """A straight roll of one robot, from edge to edge if all goes well, as its stream tells it.

    Attributes:
        line: its number.
        robot: who rolls.
        leg: what it is to do.
        t_start_s: when it was told to drive, on the host's clock.
        speed_cm_s: the speed it was told.
        by_odometry: whether distances come from the wheels; else from time × speed.
        detector: fresh, with the session's levels; one that knows rings where light marks the edge.
        run_up_cm: way from the edge to where it starts, along it, where the edge was felt by light.
        longest_cm: length of the arena's longest line, which bounds the way of one that grazes such an edge.
        samples: what the stream brought.
        crossings: confirmed so far; a run that starts or ends in the light has one there.
        rolled_cm: path by the wheels.
        t_rolling_s: when it passed half its speed, the origin of distances by time; None until then.
        moved_s, moved_cm: when and where it was last seen to have moved on.
        left, entered: where it left the ring of light, and where it entered it again.
        at_rest: the first sample after a bump: the wall lies there, not at the last sample before.
        t_end_s: when it ended.
        ended: how: ``bump`` or ``edge`` (a ring of light) at the edge, ``stop`` where the leg wanted it, ``contact``
            with another robot, ``stall``, ``timeout``, ``link``; empty while it rolls.
        normal_heading_rad: heading from where it ended into the arena, where that is known.
        starts_lit, ends_lit: whether its first or last crossing is no edge of the shape, but its own end.
    """

    line: int
    robot: str
    leg: Leg
    t_start_s: float
    speed_cm_s: float
    by_odometry: bool
    detector: CrossingDetector | RingedDetector
    run_up_cm: float = 0.0
    longest_cm: float = math.inf
    samples: list[Sample] = field(default_factory=list[Sample])
    crossings: list[Crossing] = field(default_factory=list[Crossing])
    rolled_cm: float = 0.0
    t_rolling_s: float | None = None
    moved_s: float = 0.0
    moved_cm: float = 0.0
    left: EdgePoint | None = None
    entered: EdgePoint | None = None
    at_rest: Sample | None = None
    t_end_s: float = math.nan
    ended: str = ""
    normal_heading_rad: float | None = None
    starts_lit: bool = False
    ends_lit: bool = False

    @property
    def at_edge(self) -> bool:
        """Whether it came as far as runs go."""
        return self.ended in EDGES

    @property
    def is_line(self) -> bool:
        """Whether it is a line of the statistics: from edge to edge."""
        return self.leg.measures and self.at_edge

    @property
    def length_cm(self) -> float:
        """Way within the edges so far, by the wheels."""
        if not self.samples:
            return 0.0
        first, last = self.samples[0], self.at_rest or self.samples[-1]
        x_cm, y_cm = (self.left.x_cm, self.left.y_cm) if self.left is not None else (first.x_cm, first.y_cm)
        end = self.entered or last
        seen_cm = math.hypot(end.x_cm - x_cm, end.y_cm - y_cm)
        before_cm = 0.0 if self.left is not None else self.run_up_cm
        return seen_cm + max(0.0, min(before_cm, self.longest_cm - seen_cm))

    def path_cm(self, t_s: float) -> float:
        """Distance along the run: time since it rolls × speed, or what the wheels counted up to the last sample."""
        if self.by_odometry:
            return self.rolled_cm
        return self.speed_cm_s * (t_s - self.t_rolling_s) if self.t_rolling_s is not None else 0.0

    def feed(self, sample: Sample) -> None:
        """Take the next sample."""
        if self.samples:
            last = self.samples[-1]
            self.rolled_cm += math.hypot(sample.x_cm - last.x_cm, sample.y_cm - last.y_cm)
            half_cm_s = self.speed_cm_s / 2
            if self.t_rolling_s is None and last.speed_cm_s < half_cm_s <= sample.speed_cm_s:
                # A ball that gathers speed evenly is, once at full speed, where it would be had it started at
                # full speed at the moment when it passed half of it.
                part = (half_cm_s - last.speed_cm_s) / (sample.speed_cm_s - last.speed_cm_s)
                self.t_rolling_s = last.t_host_s + part * (sample.t_host_s - last.t_host_s)
        else:
            self.moved_s = sample.t_host_s
        if self.rolled_cm > self.moved_cm + _MOVED_CM:
            self.moved_s, self.moved_cm = sample.t_host_s, self.rolled_cm
        found = self._detect(sample)
        self.starts_lit = self.starts_lit or bool(found and not self.samples)
        self.crossings.extend(found)
        self.samples.append(sample)

    def _detect(self, sample: Sample) -> tuple[Crossing, ...]:
        """The crossings that a sample confirms; takes note of the ring."""
        t_s, s_cm, light_lux = sample.t_host_s, self.path_cm(sample.t_host_s), sample.light_lux
        if isinstance(self.detector, CrossingDetector):
            crossing = self.detector.feed(t_s, s_cm, light_lux)
            return () if crossing is None else (crossing,)
        seen = self.detector.feed(t_s, s_cm, sample.x_cm, sample.y_cm, light_lux)
        if seen.edge is not None and seen.edge.into_ring:
            self.entered = seen.edge
        elif seen.edge is not None:
            self.left = seen.edge
        return seen.crossings

    @property
    def stalled(self) -> bool:
        """Whether it has not moved for longer than a turn takes: it pushes against a wall, or is held."""
        return bool(self.samples) and self.samples[-1].t_host_s - self.moved_s > _STALL_S

    @property
    def arrived(self) -> bool:
        """Whether it has come as far as its leg goes, where that is a distance."""
        return self.leg.stop_after_cm is not None and self.length_cm >= self.leg.stop_after_cm

    def finish(self, t_s: float, ended: str) -> None:
        """End the run: a chord that is still open is closed here."""
        self.t_end_s, self.ended = t_s, ended
        if isinstance(self.detector, CrossingDetector):
            crossing = self.detector.finish(t_s, self.path_cm(t_s))
            found = () if crossing is None else (crossing,)
        else:
            found = self.detector.finish(t_s, self.path_cm(t_s))
        self.ends_lit = bool(found)
        self.crossings.extend(found)

    def as_leg_end(self) -> LegEnd:
        """What whoever chooses the next leg must know of it."""
        return LegEnd(self.leg, self.length_cm, self.normal_heading_rad, self.at_edge)

    def record(self) -> dict[str, Any]:
        """What the log keeps of it, but for what it adds to the sums."""
        took_s = self.t_end_s - self.t_start_s
        return {
            "line": self.line,
            "robot": self.robot,
            "t_start_s": self.t_start_s,
            "t_rolling_s": self.t_rolling_s,
            "t_end_s": self.t_end_s,
            "length_cm": self.length_cm,
            "end_cm": self.path_cm(self.t_end_s),
            "speed_cm_s": self.rolled_cm / took_s if took_s > 0 else 0.0,
            "heading_rad": self.leg.heading_rad,
            "normal_heading_rad": self.normal_heading_rad,
            "ended": self.ended,
            "starts_lit": self.starts_lit,
            "ends_lit": self.ends_lit,
            "whole": self.is_line,
            "crossings": [[crossing.t_s, crossing.s_cm, crossing.entering] for crossing in self.crossings],
        }

    def light(self) -> pd.DataFrame:
        """The raw samples: t_host_s, light_lux, x_cm, y_cm, speed_cm_s."""
        columns = {name: [getattr(sample, name) for sample in self.samples] for name in Sample.__slots__}
        return pd.DataFrame(columns, dtype=float)
