"""What the measurements of a robot are worked out with: pure functions of times, paths and bumps.

Everything here takes arrays and gives figures with errors; nothing knows a robot, a camera or a clock.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from robot.collision import wall_normal_heading

Floats = NDArray[np.float64]

TURN = 2.0 * math.pi
_MAD_TO_SIGMA = 1.4826  # of a normal distribution
_OUTLIER_SIGMAS = 4.0
_ROUNDS = 4
_FEWEST_PLACES = 8
_STARTS = 6
_STEADY_SHARE = 0.9  # of the cruising speed: above it a run is steady
_AXES_AGREE = 0.7  # mean cosine of the best order of axes; random directions give 0
_AXES_AHEAD = 6.0  # logarithm of the odds against the second best: 1 in 400
_FARTHEST_RAD = 0.5
_STRAIGHT_CM = 0.5  # places that stray more from a line lie on an arc
_LEAST_SPREAD_RAD = 0.1  # a wall is never known better than this


@dataclass(frozen=True, slots=True)
class Figure:
    """A measured number: its value, standard error, how many measurements, and their scatter (one sigma)."""

    value: float
    error: float
    n: int
    scatter: float = math.nan


def mean_of(values: ArrayLike) -> Figure:
    """The mean of measurements alike, those farther than four sigma from the median left out. NaN of none."""
    x = np.asarray(values, dtype=float).ravel()
    x = x[np.isfinite(x)]
    if not len(x):
        return Figure(math.nan, math.nan, 0)
    off = np.abs(x - np.median(x))
    # Measurements that all but agree have no outliers.
    least = 1e-3 * float(np.abs(np.median(x)))
    kept = x[off <= _OUTLIER_SIGMAS * max(_MAD_TO_SIGMA * float(np.median(off)), least)]
    scatter = float(kept.std(ddof=1)) if len(kept) > 1 else math.nan
    return Figure(float(kept.mean()), scatter / math.sqrt(len(kept)), len(kept), scatter)


def combine(values: ArrayLike, errors: ArrayLike) -> Figure:
    """The mean of measurements with errors of their own that besides scatter from one to the next.

    Weights 1/(error² + scatter²), the scatter estimated from the measurements themselves (DerSimonian & Laird 1986).
    """
    x, sigma = np.asarray(values, dtype=float).ravel(), np.asarray(errors, dtype=float).ravel()
    usable = np.isfinite(x) & (sigma > 0)
    x, sigma = x[usable], sigma[usable]
    if len(x) < 2:
        return Figure(float(x[0]), float(sigma[0]), 1) if len(x) else Figure(math.nan, math.nan, 0)
    weight = sigma**-2.0
    total = float(weight.sum())
    spread = float(weight @ (x - float(weight @ x) / total) ** 2)
    between = max(0.0, (spread - (len(x) - 1)) / (total - float(weight @ weight) / total))
    weight = 1.0 / (sigma**2 + between)
    total = float(weight.sum())
    return Figure(float(weight @ x) / total, math.sqrt(1.0 / total), len(x), math.sqrt(between))


def onset_s(t_s: ArrayLike, path_cm: ArrayLike) -> float:
    """When a robot that was at rest set off: its path is extrapolated back through the ramp of its speed.

    The path is fitted by rest until t0, even acceleration from then on, and an even speed in the end. So the
    onset is found far more finely than the samples are spaced.

    Args:
        t_s: (n,) times, from before the onset to well into the run.
        path_cm: (n,) path rolled at each.

    Returns:
        t0, or NaN where fewer than four samples show it rolling.
    """
    t, path = np.asarray(t_s, dtype=float), np.asarray(path_cm, dtype=float)
    if len(t) < 5:
        return math.nan
    path = path - path[0]
    end_cm = float(path[-1])
    rolling = path > 0.02 * end_cm
    if end_cm <= 0 or int(rolling.sum()) < 4:
        return math.nan
    speed = float((np.diff(path) / np.diff(t)).max())
    first_s, last_s = float(t[rolling][0]), float(t[-1])

    def residual(guess: Floats) -> Floats:
        t0, ramp, cruising = guess
        since = np.maximum(t - t0, 0.0)
        up = np.minimum(since, ramp)
        return cruising * (up * up / (2.0 * ramp) + since - up) - path

    # The corners of the model hold a search fast, so it is begun from several onsets before the first motion; with
    # each goes the ramp that explains the path at the end.
    starts = first_s - float(np.median(np.diff(t))) * np.arange(_STARTS) / 2.0
    fits = [
        least_squares(
            residual,
            (t0, min(max(0.02, 2.0 * (last_s - t0 - end_cm / speed)), 0.99 * (last_s - t0)), speed),
            bounds=((t0 - 1.0, 1e-4, 1e-6), (last_s, last_s - float(t[0]) + 1.0, 10.0 * speed)),
            x_scale=(0.01, 0.05, speed),
        )
        for t0 in starts
    ]
    return float(min(fits, key=lambda fit: float(fit.cost)).x[0])


def latency_of(delays_s: ArrayLike, interval_s: float) -> Figure:
    """Latency of a stream from the delays between events at random phases and the samples that first show them.

    A sample comes on average half an interval after the event, beyond the latency itself.
    """
    mean = mean_of(delays_s)
    return Figure(mean.value - interval_s / 2.0, mean.error, mean.n, mean.scatter)


def path_of(x_cm: ArrayLike, y_cm: ArrayLike) -> Floats:
    """Path rolled (n,) from the first of the points on."""
    x, y = np.asarray(x_cm, dtype=float), np.asarray(y_cm, dtype=float)
    return np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))]) if len(x) else np.zeros(0)


def steady_window(t_s: ArrayLike, speed_cm_s: ArrayLike, margin_s: float) -> tuple[float, float] | None:
    """The longest stretch of a run at its cruising speed, ``margin_s`` less at both ends; None if nothing is left.

    The margin covers what the clocks of two instruments may differ by.
    """
    t, speed = np.asarray(t_s, dtype=float), np.asarray(speed_cm_s, dtype=float)
    if len(t) < 3 or not float(speed.max()) > 0:
        return None
    steady = speed >= _STEADY_SHARE * float(np.quantile(speed[speed > 0], 0.75))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], steady, [False]]).astype(np.int8)))
    firsts, lasts = edges[::2], edges[1::2] - 1
    best = int(np.argmax(t[lasts] - t[firsts]))
    begin_s, end_s = float(t[firsts[best]]) + margin_s, float(t[lasts[best]]) - margin_s
    return (begin_s, end_s) if end_s > begin_s else None


def slope(t_s: ArrayLike, path_cm: ArrayLike) -> Figure:
    """Speed, by a straight line through path against time; strays are left out. NaN below 3 points."""
    return Figure(*_polynomial(np.asarray(t_s, dtype=float), np.asarray(path_cm, dtype=float), 1))


@dataclass(frozen=True, slots=True)
class PathFit:
    """A steady stretch of a run as seen from above: speed (cm/s), curvature (rad/cm, clockwise +), length (cm)."""

    speed_cm_s: Figure
    curvature_rad_per_cm: Figure
    length_cm: float


def fit_path(t_s: ArrayLike, x_cm: ArrayLike, y_cm: ArrayLike) -> PathFit | None:
    """Speed and curvature of a steady run from its places in the arena (x right, y up); None from fewer than 8 places.

    Along the main axis of the places path is linear in time; across it is a parabola whose second derivative is
    the curvature. For the bends in question (a few degrees a run) arc and chord differ by less than 0.1 %.
    """
    t = np.asarray(t_s, dtype=float)
    place = np.column_stack([np.asarray(x_cm, dtype=float), np.asarray(y_cm, dtype=float)])
    seen = np.isfinite(place).all(axis=1) & np.isfinite(t)
    t, place = t[seen], place[seen]
    if len(t) < _FEWEST_PLACES:
        return None
    middle = np.median(place, axis=0)
    third = len(t) // 3
    ahead = np.median(place[-third:], axis=0) - np.median(place[:third], axis=0)
    length = float(np.hypot(*ahead))
    if length == 0.0:
        return None
    along = ahead / length
    # Right of the way: clockwise curvature bends the path to it.
    right = np.array([along[1], -along[0]])
    path, off = (place - middle) @ along, (place - middle) @ right
    bend, error, n = _polynomial(path, off, 2)
    speed = slope(t, path)
    if min(n, speed.n) < _FEWEST_PLACES:
        return None
    return PathFit(speed, Figure(2.0 * bend, 2.0 * error, n), float(np.ptp(path)))


def _polynomial(x: Floats, y: Floats, degree: int) -> tuple[float, float, int]:
    """The leading coefficient of a least-squares polynomial, its standard error, and from how many points.

    Points beyond four sigma are left out. NaN and 0 where too few are left.
    """
    usable = np.isfinite(x) & np.isfinite(y)
    x, y = x[usable], y[usable]
    kept = np.ones(len(x), dtype=bool)
    leading, error, n = math.nan, math.nan, 0
    for _ in range(_ROUNDS):
        n = int(kept.sum())
        if n < degree + 2:
            return math.nan, math.nan, 0
        # Centred and scaled, or the powers could not be told apart; the leading coefficient knows no centre.
        centre, reach = float(x[kept].mean()), max(float(np.ptp(x[kept])) / 2.0, 1e-12)
        powers = np.vander((x - centre) / reach, degree + 1, increasing=True)
        inverse = np.linalg.pinv(powers[kept])
        residual = y - powers @ (inverse @ y[kept])
        sigma = math.sqrt(float(residual[kept] @ residual[kept]) / (n - degree - 1))
        scale = reach**-degree
        leading = float(inverse[degree] @ y[kept]) * scale
        error = max(sigma * float(np.linalg.norm(inverse[degree])) * scale, 1e-12)
        within = np.abs(residual) <= _OUTLIER_SIGMAS * max(_MAD_TO_SIGMA * float(np.median(np.abs(residual))), 1e-9)
        if bool((within == kept).all()):
            break
        kept = within
    return leading, error, n


@dataclass(frozen=True, slots=True)
class Hit:
    """A bump whose wall is known: headings in the robot's frame.

    Attributes:
        heading_rad: What it rolled along.
        reported_rad: Where the report pointed, taken with x to the right and y forward.
        normal_rad: The wall's normal, into the arena, known otherwise.
    """

    heading_rad: float
    reported_rad: float
    normal_rad: float


@dataclass(frozen=True, slots=True)
class AxesFound:
    """The order and signs of a collision report's axes.

    Attributes:
        axes: What x and y point along.
        agreement: Mean cosine between the walls' normals and what these axes make of the reports; 1 is perfect.
        lead: Logarithm of the odds against the next best order, were the errors normal.
        n: Bumps.
        spread_rad: Angle between the two, one sigma by the median.
    """

    axes: tuple[str, str]
    agreement: float
    lead: float
    n: int
    spread_rad: float

    @property
    def certain(self) -> bool:
        """Whether the bumps tell this order from every other."""
        return self.agreement >= _AXES_AGREE and self.lead >= _AXES_AHEAD


ALL_AXES: tuple[tuple[str, str], ...] = tuple(
    axes for side, along in product(("right", "left"), ("forward", "back")) for axes in ((side, along), (along, side))
)
"""The eight ways in which x and y can point sideways and lengthwise."""


def axes_of(hits: Sequence[Hit]) -> AxesFound | None:
    """Which axes make the reports point along the walls' normals; None without hits.

    Head-on bumps tell which value opposes the motion and its sign, oblique ones the sign of the other.
    """
    if not hits:
        return None
    tried: list[tuple[float, tuple[str, str], Floats]] = []
    for axes in ALL_AXES:
        off: list[float] = []
        for hit in hits:
            felt_rad = hit.reported_rad - hit.heading_rad
            made_rad = wall_normal_heading(math.sin(felt_rad), math.cos(felt_rad), hit.heading_rad, axes)
            off.append(abs(math.remainder(made_rad - hit.normal_rad, TURN)))
        # Bounded: a bump round a corner, against another wall than was thought, must not outweigh the rest.
        angles = np.asarray(off, dtype=float)
        tried.append((float(np.sum(np.minimum(angles, _FARTHEST_RAD) ** 2)), axes, angles))
    tried.sort(key=lambda one: one[0])
    (best, axes, angles), (second, _, _) = tried[:2]
    spread_rad = _MAD_TO_SIGMA * float(np.median(angles))
    lead = (second - best) / (2.0 * max(spread_rad, _LEAST_SPREAD_RAD) ** 2)
    return AxesFound(axes, float(np.mean(np.cos(angles))), lead, len(hits), spread_rad)


@dataclass(frozen=True, slots=True, eq=False)
class WallSeen:
    """A wall as the places where it was hit show it, in the robot's frame.

    Attributes:
        stray_cm: How far the places stray from it.
        reach_cm: How long a piece of it they span.
        radius_cm: Of its bend; infinite where it is straight.
        along: Unit vector along it (x right, y forward).
        inward: Unit vector across it, into the arena.
        middle_cm: A place on it.
        slopes: Coefficients (b, c) of its inward way b u + c u² at u cm along it.
    """

    stray_cm: float
    reach_cm: float
    radius_cm: float
    along: Floats
    inward: Floats
    middle_cm: Floats
    slopes: tuple[float, float]

    def normal_rad(self, place_cm: tuple[float, float]) -> float:
        """Heading of its normal, into the arena, beside ``place_cm``."""
        linear, bent = self.slopes
        slope_here = linear + 2.0 * bent * float((np.asarray(place_cm) - self.middle_cm) @ self.along)
        right, forward = self.inward - slope_here * self.along
        return math.atan2(float(right), float(forward)) % TURN


def wall_through(places_cm: Sequence[tuple[float, float]], inside_cm: tuple[float, float]) -> WallSeen | None:
    """The wall through places where the robot ran into it: straight, or where that does not fit, a shallow arc.

    Args:
        places_cm: Two or more places (x right, y forward) in the robot's frame.
        inside_cm: A place inside the arena, which says which way the normal points.

    Returns:
        None where the places are fewer than two or lie on one spot.
    """
    points = np.asarray(places_cm, dtype=float).reshape(-1, 2)
    if len(points) < 2:
        return None
    middle = points.mean(axis=0)
    centred = points - middle
    along = np.linalg.svd(centred, full_matrices=False)[2][0]
    u = centred @ along
    if float(np.ptp(u)) < 1e-6:
        return None
    inward = np.array([along[1], -along[0]])
    if float((np.asarray(inside_cm) - middle) @ inward) < 0:
        inward = -inward
    w = centred @ inward
    stray, slopes, radius = float(np.abs(w).max()), (0.0, 0.0), math.inf
    if stray > _STRAIGHT_CM and len(points) > 2:
        powers = np.column_stack([np.ones_like(u), u, u * u])
        bend = np.linalg.pinv(powers) @ w
        stray, slopes = float(np.abs(w - powers @ bend).max()), (float(bend[1]), float(bend[2]))
        radius = 0.5 / max(abs(slopes[1]), 1e-12)
    return WallSeen(stray, float(np.ptp(u)), radius, along, inward, middle, slopes)
