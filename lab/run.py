"""One run in progress: samples as they come, and the crossings that they confirm."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field

import pandas as pd

from robot.crossings import Crossing, CrossingDetector
from robot.device import Sample

STALL_CM = 0.5
_STALL_S = 2.0  # longer than any turn on the spot


@dataclass(slots=True)
class Run:
    """A straight roll from wall to wall, as the robot's stream tells it.

    Attributes:
        line: its number.
        t_start_s: when it was told to drive, on the host's clock.
        speed_cm_s: the speed it was told.
        by_odometry: whether distances come from the wheels; else from time × speed.
        detector: fresh, with the session's levels.
        samples: what the stream brought.
        crossings: confirmed so far.
        rolled_cm: path by the wheels.
        t_rolling_s: when it passed half its speed, the origin of distances by time; None until then.
        moved_s, moved_cm: when and where it was last seen to have moved on.
    """

    line: int
    t_start_s: float
    speed_cm_s: float
    by_odometry: bool
    detector: CrossingDetector
    samples: list[Sample] = field(default_factory=list[Sample])
    crossings: list[Crossing] = field(default_factory=list[Crossing])
    rolled_cm: float = 0.0
    t_rolling_s: float | None = None
    moved_s: float = 0.0
    moved_cm: float = 0.0

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
        if self.rolled_cm > self.moved_cm + STALL_CM:
            self.moved_s, self.moved_cm = sample.t_host_s, self.rolled_cm
        self.samples.append(sample)
        self._keep(self.detector.feed(sample.t_host_s, self.path_cm(sample.t_host_s), sample.light_lux))

    @property
    def stalled(self) -> bool:
        """Whether it has not moved for longer than a turn takes: it pushes against a wall, or is held."""
        return bool(self.samples) and self.samples[-1].t_host_s - self.moved_s > _STALL_S

    def finish(self, t_s: float) -> None:
        """End the run: a chord that is still open is closed here."""
        self._keep(self.detector.finish(t_s, self.path_cm(t_s)))

    def _keep(self, crossing: Crossing | None) -> None:
        if crossing is not None:
            self.crossings.append(crossing)

    def light(self) -> pd.DataFrame:
        """The raw samples: t_host_s, light_lux, x_cm, y_cm, speed_cm_s."""
        return pd.DataFrame([asdict(sample) for sample in self.samples], columns=list(Sample.__slots__))
