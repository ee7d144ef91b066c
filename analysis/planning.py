"""How long a session will take: from crossing lines to arena runs, seconds, charges and gigabytes.

Uniform isotropic lines of a convex arena (perimeter P_a, area A_a) are π A_a/P_a long on average (Cauchy) and cross a
shape in the share L/P_a (Crofton), with L the measure of the lines that cross it: its hull's perimeter, for a shape in
one piece. A relative error r of A takes (σ_0/r)² crossing lines, with σ_0 the exact standard deviation for one line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import nbinom
from shapely.geometry import Polygon

from analysis.quadrature import Moments
from lab.base.errors import RequestError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_LIKELY = 0.9  # share of sessions that need no more


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast robots roll lines.

    Attributes:
        reachable_area_cm2: of the floor that a robot's centre can reach.
        reachable_perimeter_cm: of the same.
        speed_cm_s: cruising speed.
        pause_s: lost at each run's end: turning, gathering speed, commands.
        robots: on the floor at once.
        diameter_cm: of a robot; robots nearer than that have met.
    """

    reachable_area_cm2: float
    reachable_perimeter_cm: float
    speed_cm_s: float
    pause_s: float
    robots: int = 1
    diameter_cm: float = 7.3

    @classmethod
    def on(cls, reachable: Polygon, speed_cm_s: float, pause_s: float, *, robots: int, diameter_cm: float) -> Pace:
        """The pace on a convex floor.

        Raises:
            RequestError: the speed is not above 0, the pause below 0, or there is no robot.
        """
        if not (speed_cm_s > 0 and pause_s >= 0 and robots >= 1):
            raise RequestError(f"{robots} robot(s) at {speed_cm_s:g} cm/s do not roll: give 1 or more, above 0 cm/s")
        return cls(reachable.area, reachable.length, speed_cm_s, pause_s, robots, diameter_cm)

    @property
    def mean_run_cm(self) -> float:
        """Mean length of a run from wall to wall, πA/P."""
        return math.pi * self.reachable_area_cm2 / self.reachable_perimeter_cm

    @property
    def run_s(self) -> float:
        """Mean time from the start of a run to the next one's, of a robot alone."""
        return self.mean_run_cm / self.speed_cm_s + self.pause_s

    @property
    def meetings_per_s(self) -> float:
        """How often one robot meets another: density × 2·diameter × mean relative speed 4v/π, as in a gas of discs."""
        width_cm = 2 * self.diameter_cm * (self.robots - 1)
        return width_cm * 4 / math.pi * self.speed_cm_s / self.reachable_area_cm2

    @property
    def whole_runs_per_s(self) -> float:
        """Runs from wall to wall that no other robot cut short, all robots together."""
        return self._pace[0]

    @property
    def paths_per_s(self) -> float:
        """Path of all robots, in mean runs: what runs come to if those that were cut are joined again."""
        return self._pace[1]

    @property
    def _pace(self) -> tuple[float, float]:
        rate = self.meetings_per_s
        rolling_s = self.mean_run_cm / self.speed_cm_s
        if rate == 0:
            return self.robots / self.run_s, self.robots / self.run_s
        # Legs from a wall and legs from a meeting in mid-arena, half as long; each is whole if nobody is met.
        from_wall, from_meeting = math.exp(-rate * rolling_s), math.exp(-rate * rolling_s / 2)
        share = from_meeting / (1 - from_wall + from_meeting)
        way_s = (share * (1 - from_wall) + (1 - share) * (1 - from_meeting)) / rate
        legs_per_s = self.robots / (way_s + self.pause_s)
        return legs_per_s * share * from_wall, legs_per_s * way_s / rolling_s


@dataclass(frozen=True, slots=True)
class Need:
    """What so many crossing lines ask for; "likely" is enough for 90 sessions of 100.

    Attributes:
        lines: crossing lines, the median where sessions differ.
        lines_likely: crossing lines that are enough for 90 sessions of 100.
        runs: arena runs, the median.
        runs_likely: the same for 90 sessions of 100.
        seconds: of rolling.
        seconds_likely: the same for 90 sessions of 100.
    """

    lines: int
    lines_likely: int
    runs: int
    runs_likely: int
    seconds: float
    seconds_likely: float


def need_of(lines: int, share: float, pace: Pace, *, likely: int | None = None, whole: bool = False) -> Need:
    """What ``lines`` crossing lines take where ``share`` of the runs cross the shape.

    ``likely`` are the lines that are enough for 90 sessions of 100, where sessions differ. ``whole``: only runs that
    no other robot cut short will do, as for recognition line by line.

    Raises:
        RequestError: the share does not lie above 0 and up to 1, or there are no lines.
    """
    if not 0 < share <= 1 or lines < 1:
        raise RequestError(f"{lines} crossing lines at a share of {share:g} cannot be planned: both are above 0")
    likely = lines if likely is None else likely
    per_s = pace.whole_runs_per_s if whole else pace.paths_per_s
    runs = lines + int(nbinom.median(lines, share)) if share < 1 else lines
    most = likely + int(nbinom.ppf(_LIKELY, likely, share)) if share < 1 else likely
    return Need(lines, likely, runs, most, runs / per_s, most / per_s)


def lines_for_precision(moments: Moments, precision: float) -> tuple[int, int]:
    """Crossing lines after which A, and P, has this relative standard deviation: (σ_0/r)².

    Raises:
        RequestError: the precision does not lie between 0 and 1.
    """
    if not 0 < precision < 1:
        raise RequestError(f"a relative precision lies between 0 and 1, not {precision:g}; 0.05 is 5 %")
    area, perimeter = (
        max(1, math.ceil((sigma / precision) ** 2)) for sigma in (moments.sigma_area_rel, moments.sigma_perimeter_rel)
    )
    return area, perimeter


def sessions_until(log_likelihood: Floats, n: Ints, own: NDArray[np.bool_], confidence: float) -> Floats:
    """After how many lines each simulated session's leading posterior reaches ``confidence``: (sessions,).

    Args:
        log_likelihood: (sessions, points, entries) of the lines so far.
        n: (points,) numbers of lines.
        own: (entries,) whether an entry is the true one or its twin.
        confidence: of the posterior, equal priors.

    Returns:
        Numbers of lines, whoever leads; infinite where no point reaches it.
    """
    rivals = log_likelihood[..., ~own]
    twins = logsumexp(log_likelihood[..., own], axis=-1, keepdims=True)
    joint = np.concatenate([twins, rivals], axis=-1)
    leading = np.exp(joint.max(axis=-1) - logsumexp(joint, axis=-1))
    reached = leading >= confidence
    return np.where(reached.any(axis=1), n[reached.argmax(axis=1)].astype(float), np.inf)


def middle_and_likely(lines: Floats) -> tuple[int | None, int | None]:
    """Median and 90 % quantile of numbers of lines; None where so many sessions have none."""
    found = np.quantile(lines, [0.5, _LIKELY], method="higher")
    middle, likely = (int(value) if np.isfinite(value) else None for value in found)
    return middle, likely
