"""What the test statistics of perfect sessions look like, and how large a fault must be to stand out.

Successive runs share an end point x on the wall, and so are alike: where both run near a corner both are short.
In the plain mean of a function f over the lines that likeness hides faults (the variance of the mean square of
V is 2.4 times that of independent lines in a rectangle). But what the lines through x have in common is
known: under Lambert's law E[f | x] is an integral over the angle. If the density of lines is w, and each
turn is drawn accordingly, the likelihood of a chain is prod w(line) / prod E[w | x] over the points x shared;
so for w = 1 + c f the score of c is

    sum over lines f(line) - sum over shared points E[f | x],

in which the common part is gone. Every statistic here is made of such means. Lines that share no end (drawn
afresh, of different robots, after a lost run) give the plain mean, and the tests their textbook form.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from shapely import Polygon

from tracking.linespace import LineSpace, Wall, line_of, roll
from tracking.uniformity import (
    cramer_von_mises,
    cramer_von_mises_weights,
    hermans_rasson,
    hermans_rasson_weights,
    neyman,
    smooth_means,
    smooth_terms,
)

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

FAMILY = ("rayleigh", "hermans_rasson", "cramer_von_mises", "neyman")
LEVEL = 0.05
SMOOTH = len(smooth_terms())
# waves of U and of V from which what shared ends have in common is taken out; beyond, there is next to nothing
_WAVES = 8
_RE, _IM, _COS = (slice(SMOOTH + i * _WAVES, SMOOTH + (i + 1) * _WAVES) for i in range(3))
# a fault in directions alone or in places alone is likelier than one in their interplay
_INTERPLAY = 0.5
_PURE = np.array([not (half_waves and degree) for half_waves, degree in smooth_terms()])
_PLACES, _ANGLES = 1024, 128
# runs simulated at once: bounds the memory of a table for long sessions
_RUNS_AT_ONCE = 500_000
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
_PHASES = 97
# 1 - 3 <(2V - 1)^2> is this times the mean of the function of second degree in V
CENTRE_PULL = -2.0 / np.sqrt(5.0)


def line_means(u: Floats, v: Floats) -> Floats:
    """Means (..., f) over the lines (..., n) of everything that the statistics need.

    They are Neyman's functions, cos and sin of 2 pi m U, and cos of pi j V.
    """
    step = np.exp(2j * np.pi * u)
    turning, waves = step, list[Floats]()
    for _ in range(_WAVES):
        waves.append(turning.mean(axis=-1))
        turning = turning * step
    cosine = np.cos(np.pi * v)
    before, now, heights = np.ones_like(cosine), cosine, list[Floats]()
    for _ in range(_WAVES):
        heights.append(now.mean(axis=-1))
        before, now = now, 2.0 * cosine * now - before
    wave = np.stack(waves, axis=-1)
    return np.concatenate([smooth_means(u, v), wave.real, wave.imag, np.stack(heights, axis=-1)], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class SharedEnds:
    """E[f | x], (places, f), at places along the wall of a region, for lines that leave x by Lambert's law."""

    means: Floats
    perimeter_cm: float

    @classmethod
    def of(cls, region: Polygon) -> SharedEnds:
        """Average over angles, with sin(phi) at midpoints."""
        wall = Wall.of(region)
        place = (np.arange(_PLACES) + 0.5) / _PLACES * wall.perimeter_cm
        sine = (2.0 * np.arange(_ANGLES) + 1.0) / _ANGLES - 1.0
        position, edge = wall.at(np.repeat(place, _ANGLES))
        theta, p = line_of(position, wall.heading(edge, np.tile(sine, _PLACES)))
        u, v = (a.reshape(_PLACES, _ANGLES) for a in LineSpace.of(region).uniforms(theta, p))
        return cls(line_means(u, np.clip(v, 0.0, 1.0)), wall.perimeter_cm)

    def total(self, place_cm: Floats, shared: Bools) -> Floats:
        """The sums (sessions, f) of E[f | x] over the shared points among places (sessions, m)."""
        bins = np.minimum(np.mod(place_cm / self.perimeter_cm, 1.0) * _PLACES, _PLACES - 1).astype(np.intp)
        bins += _PLACES * np.arange(len(bins))[:, None]
        counts = np.bincount(bins[shared], minlength=_PLACES * len(bins)).reshape(len(bins), _PLACES)
        return counts @ self.means


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """Sessions reduced to what the statistics need, one row each.

    ``plain`` (sessions, f) are means over the lines, ``freed`` the same without what shared ends have in common,
    ``tails`` (sessions, 2) what the waves left out add to Hermans-Rasson and Cramer-von Mises.
    """

    plain: Floats
    freed: Floats
    tails: Floats
    mean_run_cm: Floats

    @classmethod
    def of(cls, u: Floats, v: Floats, length_cm: Floats, common: Floats) -> Sums:
        """Reduce lines (sessions, n); ``common`` (sessions, f) from `SharedEnds.total`."""
        n = u.shape[-1]
        plain = line_means(u, v)
        waves = plain[:, _RE] ** 2 + plain[:, _IM] ** 2
        tails = [
            hermans_rasson(u) - n * waves @ hermans_rasson_weights(_WAVES),
            cramer_von_mises(v) - n * plain[:, _COS] ** 2 @ cramer_von_mises_weights(_WAVES),
        ]
        return cls(plain, plain - common / n, np.stack(tails, axis=-1), length_cm.mean(axis=-1))


@dataclass(frozen=True, slots=True, eq=False)
class NullTable:
    """What perfect sessions of ``lines`` runs in one region give.

    ``sums`` are the simulated sessions, ``plain_mean`` and ``freed_mean`` their expectations (0 unless short runs
    are left out), ``plain_covariance`` and ``freed_covariance`` the covariances of one session's means,
    ``statistics`` their sorted statistics, ``least_p`` the sorted smallest p-values of a session's family of tests,
    ``least_seen`` the sizes of faults that show in 8 sessions of 10 (of ``any``: the square root of c I c).
    """

    reachable: Polygon
    lines: int
    shortest_cm: float
    sums: Sums
    ends: SharedEnds
    plain_mean: Floats
    plain_covariance: Floats
    freed_mean: Floats
    freed_covariance: Floats
    mean_run_cm: float
    statistics: dict[str, Floats]
    least_p: Floats
    least_seen: dict[str, float]

    def statistics_of(self, sums: Sums) -> dict[str, Floats]:
        """Every statistic of sessions, (sessions,) each; large speaks against the lines."""
        freed, covariance, n = sums.freed - self.freed_mean, self.freed_covariance, self.lines
        variance = np.diagonal(covariance)
        first = [_RE.start, _IM.start]
        inverse = np.asarray(np.linalg.inv(covariance[np.ix_(first, first)]), dtype=float)
        waves = freed[:, _RE] ** 2 / variance[_RE] + freed[:, _IM] ** 2 / variance[_IM]
        values, axes = np.linalg.eigh(covariance[:SMOOTH, :SMOOTH])
        white = (axes / np.sqrt(values)) @ axes.T
        weights = np.where(_PURE, 1.0, _INTERPLAY)
        return {
            "rayleigh": neyman(freed[:, first], inverse),
            "hermans_rasson": sums.tails[:, 0] + waves @ hermans_rasson_weights(_WAVES) / 2.0,
            "cramer_von_mises": sums.tails[:, 1] + n * freed[:, _COS] ** 2 @ cramer_von_mises_weights(_WAVES),
            "neyman": neyman(freed[:, :SMOOTH], white @ np.diag(weights) @ white),
            "run_length": np.abs(sums.mean_run_cm - self.mean_run_cm),
        }

    def p_values(self, name: str, statistic: Floats) -> Floats:
        """The shares of perfect sessions at least as extreme, (1 + #)/(1 + sessions)."""
        null = self.statistics[name]
        beyond = len(null) - np.searchsorted(null, statistic, side="left")
        return np.asarray((1 + beyond) / (1 + len(null)), dtype=float)

    def family_p(self, least_p: Floats) -> Floats:
        """The shares of perfect sessions in which some test of the family gives as small a p-value.

        Holm's correction alone takes no account of what the tests share, and condemns 4 perfect sessions in 100.
        """
        beyond = np.searchsorted(self.least_p, least_p * (1.0 + 1e-12), side="right")
        return np.asarray((1 + beyond) / (1 + len(self.least_p)), dtype=float)

    def smallest_p(self, sums: Sums) -> Floats:
        """The smallest p-value of the family of tests in each session, (sessions,)."""
        found = self.statistics_of(sums)
        return np.stack([self.p_values(name, found[name]) for name in FAMILY]).min(axis=0)

    def information(self) -> Floats:
        """Fisher's information (14, 14) on the coefficients c of a density 1 + sum c_j f_j, at c = 0.

        The covariance of the score, which is ``lines`` times the freed means.
        """
        return self.lines**2 * self.freed_covariance[:SMOOTH, :SMOOTH]

    def power(self, coefficients: Floats) -> float:
        """How often the tests together reject at 5 % where the density of lines is 1 + sum c_j f_j.

        ``coefficients`` (m, 14) are spread over the simulated sessions, whose means are shifted as such a density
        shifts them to first order.
        """
        rows = coefficients[np.arange(len(self.sums.freed)) % len(coefficients)]
        shift = self.lines * rows @ self.freed_covariance[:SMOOTH]
        moved = Sums(self.sums.plain, self.sums.freed + shift, self.sums.tails, self.sums.mean_run_cm)
        return float((self.family_p(self.smallest_p(moved)) < LEVEL).mean())

    def seen(self, directions: Floats, *, power: float = 0.8) -> float:
        """The factor on coefficients (m, 14) at which their fault is found with this power."""
        low, high = 0.0, 1.0
        while self.power(high * directions) < power and high < 1e3:
            low, high = high, 2.0 * high
        for _ in range(12):
            middle = (low + high) / 2.0
            low, high = (low, middle) if self.power(middle * directions) >= power else (middle, high)
        return (low + high) / 2.0


def _fault_directions(information: Floats) -> dict[str, Floats]:
    """Coefficients (m, 14) of faults of size 1: waves of U at any phase, a pull to the centre, and any whatever.

    ``one_axis`` and ``four_arms`` are densities 1 + cos(2 pi U - .) and 1 + cos(4 pi U - .), ``centre_pull`` one with
    1 - 3 <(2V - 1)^2> = 1, ``any`` fill the sphere c I c = 1 of the information I evenly.
    """
    terms = smooth_terms()
    phases = 2.0 * np.pi * np.mod(_GOLDEN * np.arange(_PHASES), 1.0)
    found: dict[str, Floats] = {}
    for name, half_waves in (("one_axis", 2), ("four_arms", 4)):
        found[name] = np.zeros((_PHASES, SMOOTH))
        pair = [i for i, term in enumerate(terms) if term == (half_waves, 0)]
        found[name][:, pair] = np.column_stack([np.cos(phases), np.sin(phases)]) / np.sqrt(2.0)
    found["centre_pull"] = np.zeros((1, SMOOTH))
    found["centre_pull"][0, terms.index((0, 2))] = 1.0 / CENTRE_PULL
    values, axes = np.linalg.eigh(information)
    sphere = np.random.default_rng(0).standard_normal((10 * _PHASES, SMOOTH))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    found["any"] = sphere @ (axes / np.sqrt(values)).T
    return found


def tabulate(
    reachable: Polygon,
    lines: int,
    rng: np.random.Generator,
    *,
    sessions: int = 1999,
    shortest_cm: float = 0.0,
    successive: bool = True,
    begins: Bools | None = None,
) -> NullTable:
    """Tabulate the statistics of perfect sessions: Lambert's turn at every wall of the region.

    Args:
        reachable: convex polygon in which the ball's centre moves, cm.
        lines: runs in each session.
        rng: source of the simulated sessions.
        sessions: how many; p-values come in steps of 1/(sessions + 1).
        shortest_cm: runs shorter than this are left out, as the camera leaves them out.
        successive: the runs follow each other; False for lines drawn afresh each.
        begins: (lines,), true for runs that do not follow the one before: another robot's, or after a lost run.

    Raises:
        RegionError: the region is not convex.
        RequestError: runs of ``shortest_cm`` hardly occur.
    """
    space, ends = LineSpace.of(reachable), SharedEnds.of(reachable)
    at_once = max(1, _RUNS_AT_ONCE // lines)
    parts: list[Sums] = []
    for begun in range(0, sessions, at_once):
        rolls = roll(
            reachable,
            min(at_once, sessions - begun),
            lines,
            rng,
            successive=successive,
            begins=begins,
            shortest_cm=shortest_cm,
        )
        u, v = space.uniforms(rolls.theta_rad, rolls.p_cm)
        common = ends.total(rolls.start_cm[:, 1:], rolls.start_cm[:, 1:] == rolls.end_cm[:, :-1])
        parts.append(Sums.of(u, np.clip(v, 0.0, 1.0), rolls.length_cm, common))
    sums = Sums(*(np.concatenate([getattr(part, name) for part in parts]) for name in Sums.__slots__))
    known = shortest_cm <= 0  # then the functions' expectations are 0, and the mean run is Cauchy's
    plain_mean, freed_mean = (np.zeros(a.shape[1]) if known else a.mean(axis=0) for a in (sums.plain, sums.freed))
    plain, freed = sums.plain - plain_mean, sums.freed - freed_mean
    table = NullTable(
        reachable,
        lines,
        shortest_cm,
        sums,
        ends,
        plain_mean,
        plain.T @ plain / sessions,
        freed_mean,
        freed.T @ freed / sessions,
        float(np.pi * reachable.area / reachable.length) if known else float(sums.mean_run_cm.mean()),
        {},
        np.empty(sessions),
        {},
    )
    table.statistics.update({name: np.sort(values) for name, values in table.statistics_of(sums).items()})
    table.least_p[:] = np.sort(table.smallest_p(sums))
    directions = _fault_directions(table.information())
    table.least_seen.update({name: table.seen(rows) for name, rows in directions.items()})
    return table
