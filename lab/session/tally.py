"""The sums of a session: what its runs add up to, and the area and perimeter that follow.

One robot alone rolls whole lines, from edge to edge, and its on-board estimator adds them up. Several robots
cut each other's lines short; their sums (never their estimates) are merged in the weighted form that undoes
the cuts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pandas as pd

from analysis.estimate import Estimate, estimate_from_moments
from lab.base.errors import RequestError
from lab.session.run import EDGES, Run
from lab.settings.settings import Settings
from robot.cutlines import CutLine, estimate_interrupted
from robot.interrupted import InterruptedEstimator, path_per_cut
from robot.onboard import Estimator
from robot.turning import NOWHERE_CM, line_weight

# The weights of pairs follow the path per cut, which is only known as cuts happen. The sums are made anew
# when it has moved by this much, a few dozen times in the longest session.
_DRIFT = 0.02
_CUT_COLUMNS = ("starts_lit", "ends_lit", "end_cm", "ended")


class Estimates(Protocol):
    """What both kinds of sums answer; NaN while nothing is known. Lengths in cm."""

    def area(self) -> float:
        """Area, cm²."""
        ...

    def perimeter(self) -> float:
        """Perimeter, cm."""
        ...

    def sigma_area(self) -> float:
        """Standard error of the area, cm²."""
        ...

    def sigma_perimeter(self) -> float:
        """Standard error of the perimeter, cm."""
        ...

    def correlation(self) -> float:
        """Correlation of the two errors."""
        ...


@dataclass(frozen=True, slots=True)
class Line:
    """What one run adds: whether it counts, its weight, and its invariants (k, L1 in cm, L3 in cm³)."""

    counts: bool
    weight: float
    k: int
    l1_cm: float
    l3_cm3: float

    @classmethod
    def stored(cls, record: Mapping[str, Any]) -> Line:
        """What a run once added, from its record in the log."""
        return cls(*(record[name] for name in cls.__slots__))


class Tally(Protocol):
    """The sums of a session."""

    @property
    def n(self) -> int:
        """Counted lines that crossed the shape."""
        ...

    def add(self, run: Run) -> Line:
        """Take a finished run."""
        ...

    def take(self, record: Mapping[str, Any]) -> None:
        """Take a run from its record in the log: the sums are those that ``add`` made of it, bit for bit."""
        ...

    @property
    def estimates(self) -> Estimates:
        """The area and perimeter so far."""
        ...


class SoloTally:
    """Whole lines of one robot, each with the weight that its turning policy asks for."""

    def __init__(self, settings: Settings) -> None:
        self._motion = settings.motion
        self._estimator = Estimator()

    @property
    def n(self) -> int:
        """Counted lines that crossed the shape."""
        return self._estimator.lines

    @property
    def estimates(self) -> Estimates:
        """The area and perimeter so far."""
        return self._estimator

    def add(self, run: Run) -> Line:
        """Take a finished run; only those from edge to edge are lines of the statistics."""
        weight = line_weight(self._motion.turning, self._motion.weighting, run.rolled_cm) if run.is_line else 1.0
        line = Line(run.is_line, weight, *_invariants(run))
        self._take(line)
        return line

    def take(self, record: Mapping[str, Any]) -> None:
        """Take a run from its record in the log."""
        self._take(Line.stored(record))

    def _take(self, line: Line) -> None:
        if line.counts:
            self._estimator.add_line(line.k, line.l1_cm, line.l3_cm3, line.weight)


class SharedTally:
    """Runs of several robots that cut each other short. All count but those that ended with a broken link."""

    def __init__(self) -> None:
        self._lines: list[CutLine] = []
        self._merged = InterruptedEstimator(math.inf)
        self.n = 0

    @property
    def estimates(self) -> Estimates:
        """The area and perimeter so far."""
        return self._merged

    def add(self, run: Run) -> Line:
        """Take a finished run."""
        # One that never got away, from a wall or from another robot, is no line; nor is one whose end is unknown.
        counts = run.ended != "link" and run.length_cm > NOWHERE_CM
        line = Line(counts, 1.0, *_invariants(run))
        if counts:
            self._take(line, as_cut_line(run))
        return line

    def take(self, record: Mapping[str, Any]) -> None:
        """Take a run from its record in the log."""
        line = Line.stored(record)
        if line.counts:
            points = [(s_cm, entering) for _, s_cm, entering in record["crossings"]]
            self._take(line, _cut_line(points, *(record[name] for name in _CUT_COLUMNS)))

    def _take(self, line: Line, rolled: CutLine) -> None:
        self.n += line.k > 0
        self._lines.append(rolled)
        merged = self._merged
        rolled.into(merged)
        wanted_cm, used_cm = path_per_cut(merged.lit_cm, merged.cuts), merged.path_per_cut_cm
        if not (wanted_cm == used_cm or abs(wanted_cm - used_cm) <= _DRIFT * used_cm < math.inf):
            self._merged = estimate_interrupted(self._lines)


def as_cut_line(run: Run) -> CutLine:
    """A run without the crossings at its own ends, which are none of the shape's."""
    points = [(crossing.s_cm, crossing.entering) for crossing in run.crossings]
    return _cut_line(points, run.starts_lit, run.ends_lit, run.path_cm(run.t_end_s), run.ended)


def _cut_line(
    points: Sequence[tuple[float, bool]], starts_lit: bool, ends_lit: bool, end_cm: float, ended: str
) -> CutLine:
    own = points[int(starts_lit) : len(points) - int(ends_lit)]
    s_cm, entering = [s_cm for s_cm, _ in own], [entering for _, entering in own]
    return CutLine(s_cm, entering, starts_lit, end_cm, cut=ended not in EDGES)


def stored_estimate(lines: pd.DataFrame, crossings: pd.DataFrame) -> Estimate | None:
    """The estimate that a session's tables make again; None with fewer than two crossing lines.

    Args:
        lines: the ``lines`` table.
        crossings: the ``crossings`` table.
    """
    counted = lines[lines["counts"]]
    if lines["robot"].nunique() <= 1:
        crossed = counted[counted["k"] > 0]
        if len(crossed) < 2:
            return None
        # Lines of unequal weight: the ratios of weighted sums are those of the lines' weighted vectors.
        scale = crossed["weight"] / crossed["weight"].mean()
        moments = np.column_stack([scale * crossed[name] for name in ("k", "l1_cm", "l3_cm3")])
        return estimate_from_moments(len(crossed), moments.mean(axis=0), np.cov(moments, rowvar=False))
    try:
        found = estimate_interrupted(stored_cut_lines(counted, crossings))
    except ValueError as error:
        raise RequestError(f"the log's lines do not add up: {error}") from error
    if found.lines < 2:
        return None
    area_area, area_perimeter, perimeter_perimeter = found.covariance()
    covariance = np.array([[area_area, area_perimeter], [area_perimeter, perimeter_perimeter]])
    return Estimate(int((counted["k"] > 0).sum()), found.area(), found.perimeter(), covariance)


def stored_cut_lines(lines: pd.DataFrame, crossings: pd.DataFrame) -> list[CutLine]:
    """The stored form of ``as_cut_line``."""
    points: dict[int, list[tuple[float, bool]]] = {}
    for line, s_cm, entering in crossings[["line", "s_cm", "entering"]].itertuples(index=False):
        points.setdefault(line, []).append((s_cm, entering))
    columns = lines[["line", *_CUT_COLUMNS]].itertuples(index=False)
    return [_cut_line(points.get(line, []), *ends) for line, *ends in columns]


def tally_for(settings: Settings) -> Tally:
    """The sums that the session's robots call for."""
    return SoloTally(settings) if len(settings.robots) == 1 else SharedTally()


def invariants_of(points: Iterable[tuple[float, bool]]) -> tuple[int, float, float]:
    """Take a run's crossings, each (s_cm, entering), through an on-board estimator of its own: (k, L1, L3).

    Raises ValueError for crossings that do not alternate, or run backwards.
    """
    estimator = Estimator(covariance=False)
    estimator.start_line()
    for s_cm, entering in points:
        estimator.crossing(s_cm, entering)
    return estimator.end_line()


def _invariants(run: Run) -> tuple[int, float, float]:
    return invariants_of((crossing.s_cm, crossing.entering) for crossing in run.crossings)
