"""Is a measured A(N), P(N) one of the simulated ones? A test of the whole curve, not a look at each point.

A robot's curve that leaves a pointwise 95 % band somewhere proves nothing: most of the simulated ones do. The global
envelope test by the largest directional deviation (M. Myllymäki, P. Grabarnik, H. Seijo, D. Stoyan, Spatial Statistics
11 (2015) 19) asks how far a curve goes, at the point where it goes farthest, in units of the simulated curves' own
quantiles there: upwards and downwards apart, since early estimates are skewed. It is a Monte Carlo test: its level is
exact for any shape and any number of lines, however the points of a curve depend on each other. Its envelope is what
the test decides by: a curve lies outside somewhere if, and only if, it is rejected. A bias shows once it exceeds some
three standard errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from shapely.geometry import Polygon

from analysis.boundary import Geometry
from analysis.exploration import Turning, follow_sessions
from analysis.invariants import sizes
from analysis.montecarlo import running_bands
from analysis.sensor import SensorModel
from lab.base.errors import RequestError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SESSIONS = 999  # simulated; with the measured one a round thousand
FEWEST_SESSIONS = 199
FIRST_LINES = 10  # below, a curve says little and nothing of the robot
POINTS = 40
_TAIL = 0.025  # of the quantiles that a deviation is measured by


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """A(N) and P(N) of one session, or of many.

    Attributes:
        n: (points,) crossing lines.
        area_cm2: (points,), or (sessions, points).
        perimeter_cm: the same.
    """

    n: Ints
    area_cm2: Floats
    perimeter_cm: Floats

    @property
    def joined(self) -> Floats:
        """The logarithms of area and perimeter, which are less skewed, end to end: (…, 2 points)."""
        return np.log(np.concatenate([self.area_cm2, self.perimeter_cm], axis=-1))


@dataclass(frozen=True, slots=True, eq=False)
class BandTest:
    """A curve against the envelope of simulated ones.

    Attributes:
        p_value: share of sessions, the measured one among them, whose curves go at least as far.
        inside: whether the curve stays in the envelope, which it does if and only if ``p_value`` > 1 − ``level``.
        level: share of whole simulated curves that the envelope holds.
        sessions: simulated.
        n: (points,) crossing lines.
        area_cm2: (2, points) lower and upper edge of the envelope.
        perimeter_cm: (2, points).
        leaves_at: number of lines at which A or P first lies outside; None where neither does.
    """

    p_value: float
    inside: bool
    level: float
    sessions: int
    n: Ints
    area_cm2: Floats
    perimeter_cm: Floats
    leaves_at: int | None


def checkpoints_to(lines: int) -> Ints:
    """Numbers of lines, evenly on a logarithmic scale, at which curves of ``lines`` crossing lines are compared.

    Raises:
        RequestError: there are too few lines for a curve.
    """
    if lines < 2 * FIRST_LINES:
        raise RequestError(f"a curve of {lines} crossing lines is too short to test: roll at least {2 * FIRST_LINES}")
    return np.unique(np.geomspace(FIRST_LINES, lines, POINTS).round().astype(np.int64))


def curve_of(
    k: ArrayLike, l1_cm: ArrayLike, l3_cm3: ArrayLike, checkpoints: Ints, *, weights: ArrayLike = 1.0
) -> Curves:
    """A(N) and P(N) of one session from its crossing lines (lines,), in the order rolled."""
    values = np.column_stack([np.asarray(column, dtype=float).ravel() for column in (k, l1_cm, l3_cm3)])
    weighed = values * np.broadcast_to(np.asarray(weights, dtype=float), len(values))[:, None]
    return _curves(checkpoints, np.cumsum(weighed, axis=0)[checkpoints - 1])


def independent_curves(geometry: Geometry, checkpoints: Ints, sessions: int, rng: np.random.Generator) -> Curves:
    """Simulate sessions of independent, ideal lines: the paper's Monte Carlo. Arrays (sessions, points)."""
    bands = running_bands(geometry, checkpoints, sessions, rng)
    return Curves(bands.n, bands.area_runs_cm2, bands.perimeter_runs_cm)


def rolled_curves(
    geometry: Geometry,
    reachable: Polygon,
    checkpoints: Ints,
    sessions: int,
    rng: np.random.Generator,
    *,
    turning: Turning | float = Turning.LAMBERT,
    sensor: SensorModel | None = None,
) -> Curves:
    """Simulate sessions whose lines follow upon one another from wall to wall, seen through a ``sensor`` if given.

    Successive lines are not quite independent: each begins where the one before ended. Arguments as for
    `analysis.exploration.explore`. Arrays (sessions, points).
    """
    sums = follow_sessions(geometry, reachable, checkpoints, sessions, rng, turning=turning, sensor=sensor)
    return _curves(checkpoints, sums)


def band_test(measured: Curves, simulated: Curves, *, level: float = 0.95) -> BandTest:
    """Test one curve against simulated ones at the same numbers of lines.

    Raises:
        RequestError: the numbers of lines differ, or there are fewer simulated curves than the level needs.
    """
    if not np.array_equal(measured.n, simulated.n):
        raise RequestError("both curves must be taken at the same numbers of lines: use one set of checkpoints")
    sessions = len(simulated.area_cm2)
    if not 0 < level < 1 or sessions + 1 < 1 / (1 - level):
        raise RequestError(f"{sessions} simulated sessions cannot decide at level {level:g}: simulate more")
    together: Floats = np.vstack([measured.joined, simulated.joined])
    middle: Floats = np.mean(together, axis=0)
    reach: Floats = np.quantile(together, [_TAIL, 1 - _TAIL], axis=0) - middle
    # how far each curve goes at each point, in units of the quantile on that side
    gap: Floats = together - middle
    far: Floats = np.maximum(gap / reach[1], gap / reach[0])
    farthest: Floats = np.max(far, axis=1)
    p_values: Floats = np.mean(farthest[:, None] <= farthest, axis=1)
    limit = float(np.max(farthest[p_values > 1 - level]))
    points = measured.n.size
    edges: Floats = np.exp(middle + limit * reach)
    beyond = np.flatnonzero(np.any(np.reshape(far[0] > limit, (2, points)), axis=0))
    return BandTest(
        p_value=float(p_values[0]),
        inside=bool(p_values[0] > 1 - level),
        level=level,
        sessions=sessions,
        n=measured.n,
        area_cm2=edges[:, :points],
        perimeter_cm=edges[:, points:],
        leaves_at=int(measured.n[beyond[0]]) if beyond.size else None,
    )


def _curves(checkpoints: Ints, sums: Floats) -> Curves:
    """Eq. 1 from sums (…, 3) of (k, 𝓛_1, 𝓛_3)."""
    area, perimeter = np.ascontiguousarray(np.moveaxis(sizes(sums), -1, 0))
    return Curves(checkpoints, area, perimeter)
