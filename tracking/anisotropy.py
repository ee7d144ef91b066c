"""How far lines are from isotropic, and what that does to area and perimeter of the shape at hand.

Sizes of faults: the density of the lines on the square (U, V) is 1 + sum c_j f_j, with Neyman's orthonormal
functions f_j (`tracking.uniformity`), and c_j is the mean of f_j over the lines.

Bias: only lines that meet the shape count, and they meet its convex hull. Seen from the hull they have a (U, V) of
their own, again uniform if they are right, and smooth, for the walls are far. With the density
1 + sum d_j f_j on the hull's square the mean of a quantity q of a line is

    <q>_d = <q> + sum d_j <q f_j>,

<.> over isotropic lines that meet the hull. With q = k, L1, L3 (chords, lit length, third invariant of a line;
Vlasov, arXiv:0711.4734) this gives what A = (pi/3) <L3>/<L1> and P = pi A <k>/<L1> tend to.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import ncx2
from shapely import MultiPolygon, Polygon

from lab.base.errors import RequestError
from lab.base.jackknife import jackknife_sigma
from tracking.linespace import LineSpace, support
from tracking.nulltable import CENTRE_PULL, SMOOTH, NullTable
from tracking.uniformity import smooth_functions, smooth_terms

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# on the hull's square; the prediction of the bias no longer changes beyond
_HULL_ORDER = 6
_DIRECTIONS = 192
_LINES_A_DIRECTION = 192
_GOLDEN = 0.6180339887498949
_FEWEST_HITS = 10
_CONFIDENCE = 0.95
_MOST_BLOCKS = 40


class TooFewHitsError(RequestError):
    """Too few lines meet the shape to say what their density does to it; carries ``hits`` and ``needed``."""

    def __init__(self, hits: int, needed: int) -> None:
        super().__init__(f"{hits} lines that meet the shape are too few to predict a bias; roll on until {needed} do")
        self.hits = hits
        self.needed = needed


@dataclass(frozen=True, slots=True)
class Effect:
    """The size of one kind of fault, with its 95 % interval, and the least size seen in 8 sessions of 10."""

    name: str
    value: float
    low: float
    high: float
    least_seen: float


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What `bias_from` needs of a session: its lines, and what its tests could see.

    The lines are in order, chain by chain; ``information`` (14, 14) is Fisher's on the coefficients c,
    ``noncentrality`` the c I c at which a fault of no special kind shows in 8 sessions of 10.
    """

    theta_rad: Floats
    p_cm: Floats
    information: Floats
    noncentrality: float


def _amplitude(found: Floats, sigma: float) -> tuple[float, float]:
    """The 95 % interval of the length of a vector in the plane, from one measurement with this error per axis.

    (length / sigma)^2 is chi-square with two degrees and a noncentrality, whose interval is exact
    (Rice's distribution); unlike percentiles of bootstrapped lengths it reaches down to 0.
    """
    squared = float(found @ found) / sigma**2

    def limit(chance: float) -> float:
        if float(ncx2.cdf(squared, 2, 0.0)) <= chance:
            return 0.0
        root = brentq(lambda x: float(ncx2.cdf(squared, 2, x)) - chance, 0.0, (np.sqrt(squared) + 8.0) ** 2)
        return float(np.sqrt(root)) * sigma

    tail = (1.0 - _CONFIDENCE) / 2.0
    return limit(1.0 - tail), limit(tail)


def _second_degree(mean: float, null: NullTable, column: int) -> tuple[float, float]:
    """The 95 % interval of the coefficient c of f = sqrt(5) P_2(2V - 1), after Wilson's for a share.

    The scatter belongs to c, not to what was measured: f has the variance 1 + <f^3> c - c^2 under the density
    1 + c f, with <f^3> = 5^(3/2) 2/35. With the measured variance too few intervals cover.
    """
    k = 1.96**2 * float(null.plain_covariance[column, column])
    middle = (mean + 5.0**1.5 / 35.0 * k) / (1.0 + k)
    half = float(np.sqrt(max(middle**2 - (mean**2 - k) / (1.0 + k), 0.0)))
    return middle - half, middle + half


def effects_of(u: Floats, v: Floats, null: NullTable) -> tuple[tuple[Effect, ...], float]:
    """The sizes of the three faults a teacher may look for in lines (n,), and the favoured angle 2 pi U.

    ``one_axis`` and ``four_arms`` are amplitudes a of densities 1 + a cos(2 pi U - .) and 1 + a cos(4 pi U - .);
    ``centre_pull`` is 1 - 3 <(2V - 1)^2>: 0 for right lines, 1 if all pass through the middle, negative if they
    keep to the walls. Errors are those of dependent runs, from the simulated sessions.
    """
    functions = smooth_functions(u, v)
    means = functions.mean(axis=0) - null.plain_mean[:SMOOTH]
    terms = smooth_terms()
    effects: list[Effect] = []
    for name, half_waves in (("one_axis", 2), ("four_arms", 4)):
        pair = [i for i, term in enumerate(terms) if term == (half_waves, 0)]
        found = means[pair]
        axis = found / np.hypot(*found) if found.any() else np.array([1.0, 0.0])
        # a strong fault narrows the scatter along its own axis
        narrowing = float(np.var(functions[:, pair] @ axis))
        sigma = float(np.sqrt(axis @ null.plain_covariance[np.ix_(pair, pair)] @ axis * narrowing))
        low, high = _amplitude(found, sigma)
        value, low, high = (float(np.sqrt(2.0) * length) for length in (np.hypot(*found), low, high))
        effects.append(Effect(name, value, low, min(2.0, high), null.least_seen[name]))
    second = terms.index((0, 2))
    low, high = sorted(CENTRE_PULL * limit for limit in _second_degree(means[second], null, second))
    pull = CENTRE_PULL * float(means[second])
    effects.append(Effect("centre_pull", pull, low, high, null.least_seen["centre_pull"]))
    waves = means[[i for i, term in enumerate(terms) if term == (2, 0)]]
    return tuple(effects), float(np.arctan2(waves[1], waves[0]))


@dataclass(frozen=True, slots=True)
class ShapeBias:
    """Relative bias of area and perimeter that the lines' density causes, with standard errors.

    ``area_rel`` = -0.1 means that the area comes out 10 % too small. ``least_area_rel`` and ``least_perimeter_rel``
    (positive) are the worst that a density could do which the tests would overlook in 2 sessions of 10: what may
    be wrong although nothing was found.
    """

    area_rel: float
    area_rel_sigma: float
    perimeter_rel: float
    perimeter_rel_sigma: float
    least_area_rel: float
    least_perimeter_rel: float

    def sentence(self) -> str:
        """In plain words: what the lines do to this shape, and what could still hide."""
        area, perimeter = (f"{100 * off:+.1f}".replace("-", "−") for off in (self.area_rel, self.perimeter_rel))
        return (
            f"By these lines alone the shape's area comes out {area} ± {100 * self.area_rel_sigma:.1f} % and its "
            f"perimeter {perimeter} ± {100 * self.perimeter_rel_sigma:.1f} % off; an uneven spread too weak to be "
            f"found could cause at worst {100 * self.least_area_rel:.0f} % and {100 * self.least_perimeter_rel:.0f} %."
        )

    def to_dict(self) -> dict[str, Any]:
        """The JSON form."""
        return {name: getattr(self, name) for name in self.__slots__}


def line_invariants(theta_rad: float, p_cm: Floats, sides_cm: Floats) -> Floats:
    """(k, L1, L3), (3, n), of parallel lines with the sides (m, 2, 2) of a shape, in cm and cm^3.

    Along a line in and out alternate; L3 sums cubes of distances between in and out, less those between
    like crossings, gathered chord by chord without cancellation.
    """
    normal = np.array([np.cos(theta_rad), np.sin(theta_rad)])
    height, along = sides_cm @ normal, sides_cm @ np.array([-normal[1], normal[0]])
    below = height[None] <= p_cm[:, None, None]
    crossed = below[..., 0] != below[..., 1]
    deepest = int(crossed.sum(axis=1).max(initial=0))
    out = np.zeros((3, len(p_cm)))
    rise = np.where(height[:, 0] == height[:, 1], 1.0, height[:, 1] - height[:, 0])
    place = along[:, 0] + (p_cm[:, None] - height[:, 0]) / rise * (along[:, 1] - along[:, 0])
    place = np.sort(np.where(crossed, place, np.inf), axis=1)[:, :deepest]
    # crossings that are not there get the place of the last one that is: chords and gaps of length 0
    count = crossed.sum(axis=1)
    last = np.take_along_axis(place, np.maximum(count - 1, 0)[:, None], axis=1) if deepest else place
    place = np.where(np.arange(deepest) < count[:, None], place, np.where(count[:, None] > 0, last, 0.0))
    lit, twice = np.zeros(len(p_cm)), np.zeros(len(p_cm))
    for j in range(0, deepest, 2):
        if j:
            twice += 2.0 * (place[:, j] - place[:, j - 1]) * lit
        chord = place[:, j + 1] - place[:, j]
        out[2] += 3.0 * twice * chord + 3.0 * lit * chord**2 + chord**3
        twice += 2.0 * chord * lit + chord**2
        lit += chord
    out[0], out[1] = count / 2.0, lit
    return out


@dataclass(frozen=True, slots=True, eq=False)
class _Probe:
    """Lines (m,) spread over a shape's hull: (k, L1, L3) of each times its measure, (3, m), and where it lies."""

    theta_rad: Floats
    p_cm: Floats
    weighted: Floats

    @classmethod
    def of(cls, shape: Polygon | MultiPolygon, hull: Polygon) -> _Probe:
        sides = [
            np.stack([ring[:-1], ring[1:]], axis=1)
            for polygon in shapely.get_parts(shape)
            for ring in (shapely.get_coordinates(r) for r in (polygon.exterior, *polygon.interiors))
        ]
        theta = (np.arange(_DIRECTIONS) + 0.5) * np.pi / _DIRECTIONS
        low, high = -support(theta + np.pi, hull), support(theta, hull)
        # each direction's lines are shifted by the golden section, which spreads them best
        shift = np.mod(_GOLDEN * np.arange(_DIRECTIONS), 1.0)
        steps = (np.arange(_LINES_A_DIRECTION)[None] + shift[:, None]) / _LINES_A_DIRECTION
        p = low[:, None] + steps * (high - low)[:, None]
        all_sides = np.concatenate(sides)
        found = np.stack([line_invariants(t, row, all_sides) for t, row in zip(theta.tolist(), p, strict=True)], axis=1)
        weighted = found * (high - low)[:, None]
        return cls(np.repeat(theta, _LINES_A_DIRECTION), p.ravel(), weighted.reshape(3, -1))

    def responses(self, region: Polygon, order: int) -> Floats:
        """<q f_j>/<q>, (3, functions), for the functions on the square of this region, q = k, L1, L3."""
        u, v = LineSpace.of(region).uniforms(self.theta_rad, self.p_cm)
        isotropic = self.weighted.sum(axis=1)
        return self.weighted @ smooth_functions(u, np.clip(v, 0.0, 1.0), order) / isotropic[:, None]


# relative change of area and perimeter per relative change of <k>, <L1>, <L3>
_AREA, _PERIMETER = np.array([0.0, -1.0, 1.0]), np.array([1.0, -2.0, 1.0])


def _left_out(functions: Floats, hit: Bools) -> Floats:
    """Coefficients (blocks, f) from all hits but those of one block of successive lines at a time."""
    n = len(hit)
    block = np.arange(n) * min(_MOST_BLOCKS, max(8, n // 8)) // n
    sums, hits = np.zeros((int(block[-1]) + 1, functions.shape[1])), np.zeros(int(block[-1]) + 1)
    np.add.at(sums, block[hit], functions[hit])
    np.add.at(hits, block, hit)
    return (sums.sum(axis=0) - sums) / np.maximum(hits.sum() - hits, 1.0)[:, None]


def bias_from(evidence: Evidence, region: Polygon, shape: Polygon | MultiPolygon) -> ShapeBias:
    """Predict from a session's lines alone what their density does to area and perimeter of a shape.

    The lines are a sample, and so is the prediction: with few lines its error is about that of the estimates
    themselves, which the same lines make wrong by chance. It tells a lasting fault from chance only as the
    error shrinks.

    Args:
        evidence: of the report by `tracking.isotropy.examine_lines`.
        region: convex polygon in which the ball's centre moves, cm, as it was given there.
        shape: the projected shape, cm; what lies outside the region no line meets.

    Raises:
        RegionError: the region is not convex.
        RequestError: the shape has no area within the region.
        TooFewHitsError: fewer than 10 lines meet the shape's convex hull.
    """
    inside = shapely.intersection(shape, region)
    parts = [part for part in shapely.get_parts(inside) if isinstance(part, Polygon) and part.area > 0]
    lit = MultiPolygon(parts)
    hull = shapely.convex_hull(lit)
    if not isinstance(hull, Polygon):  # the hull of nothing is none
        raise RequestError("the shape has no area within the region that the robot can reach; move or enlarge it")
    u, v = LineSpace.of(hull).uniforms(evidence.theta_rad, evidence.p_cm)
    hit = (v > 0.0) & (v < 1.0)
    if int(hit.sum()) < _FEWEST_HITS:
        raise TooFewHitsError(int(hit.sum()), _FEWEST_HITS)
    functions = smooth_functions(u, np.where(hit, v, 0.5), _HULL_ORDER)
    coefficients = functions[hit].mean(axis=0)
    probe = _Probe.of(lit, hull)
    response = probe.responses(hull, _HULL_ORDER)
    left_out = _left_out(functions, hit)
    worst = probe.responses(region, 4)
    found: list[float] = []
    for weights in (_AREA, _PERIMETER):

        def biased(c: Floats, weights: Floats = weights) -> Floats:
            return np.asarray(np.exp(np.log(np.maximum(1.0 + c @ response.T, 0.01)) @ weights), dtype=float)

        # the jackknife by blocks longer than the dependence; it knows the ratio's curvature, too
        found += [float(biased(coefficients)) - 1.0, float(jackknife_sigma(biased(left_out)))]
    least = [
        float(np.sqrt(evidence.noncentrality * (s @ np.linalg.solve(evidence.information, s))))
        for s in (_AREA @ worst, _PERIMETER @ worst)
    ]
    return ShapeBias(*found, *least)
