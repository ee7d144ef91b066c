"""How often one entry of a dictionary is taken for another after n lines, and how many lines it takes not to be.

Two ways to recognise, two ways to err. In the (P, A) plane the estimates scatter normally about each entry's own
size, and the chance that a rival explains one better is an integral over a region bounded by a conic: exact along
every ray from the entry's centre. Line by line the log-likelihood ratio of an entry and its rival is a random walk
whose drift is a Kullback–Leibler rate: after n lines it is normal with mean n·rate and variance n·variance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from analysis.boundary import Geometry
from analysis.estimate import ratio_bias
from analysis.montecarlo import simulate_lines
from analysis.perline import LineTables
from analysis.quadrature import Moments
from analysis.recognition import FIRST_POSTERIOR_N
from analysis.sensor import SensorModel

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

MOST_LINES = 10**8  # what takes more takes a robot years
_RAYS = 240
_NEGLIGIBLE = 1e-9  # chance of a confusion that is not worth adding up


class PlaneConfusion:
    """Confusions of the Gaussian recogniser of (P, A).

    Args:
        moments: of each entry, `analysis.quadrature.exact_moments`.
        rivals: (entries, entries) whether a mistake of the first for the second counts; twins do not.
    """

    def __init__(self, moments: Sequence[Moments], rivals: Bools) -> None:
        self.rivals = rivals
        self._size = np.array([[m.area_cm2, m.perimeter_cm] for m in moments])
        self._bias = self._size * np.array([ratio_bias(m.mean, m.covariance) for m in moments])
        covariance = np.array([m.covariance_at(1) for m in moments])
        self._inverse = np.linalg.inv(covariance)
        self._root = np.linalg.cholesky(covariance)
        self._log_volume = 0.5 * np.linalg.slogdet(covariance)[1]
        phase = (np.arange(_RAYS) + 0.5) * 2 * np.pi / _RAYS
        self._rays = np.stack([np.cos(phase), np.sin(phase)])

    def errors(self, entry: int, n: float) -> Floats:
        """Chance (entries,), when ``entry`` is true, that each rival alone is likelier after ``n`` lines."""
        errors = np.zeros(len(self._size))
        errors[self.rivals[entry]] = self._shares(entry, n, np.flatnonzero(self.rivals[entry]))
        return errors

    def pair_lines(self, entry: int, rival: int, confidence: float, most: int = MOST_LINES) -> int | None:
        """Lines after which ``entry`` is likelier than ``rival``, when true, with ``confidence``; None for never."""
        only = np.array([rival])
        return fewest_lines(lambda n: float(self._shares(entry, n, only)[0]), 1 - confidence, most)

    def _shares(self, entry: int, n: float, rivals: NDArray[np.intp]) -> Floats:
        low, high = self._lost(entry, n, rivals)
        return (high - low).sum(axis=0).mean(axis=-1)

    def error(self, entry: int, n: float) -> float:
        """Chance that some rival is likelier than ``entry``, when that is true, after ``n`` lines."""
        errors = self.errors(entry, n)
        near = np.flatnonzero(errors > _NEGLIGIBLE)
        if not near.size:
            return 0.0
        low, high = self._lost(entry, n, near)
        # Along each ray the union of what is lost to any rival: stretches in the order of their beginnings.
        low, high = (part.transpose(2, 0, 1).reshape(_RAYS, -1) for part in (low, high))
        order = np.argsort(low, axis=1)
        low, high = np.take_along_axis(low, order, axis=1), np.take_along_axis(high, order, axis=1)
        reached = np.maximum.accumulate(high, axis=1)
        before = np.concatenate([np.zeros((_RAYS, 1)), reached[:, :-1]], axis=1)
        return float(np.maximum(high - np.maximum(low, before), 0).sum(axis=1).mean())

    def _lost(self, entry: int, n: float, rivals: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Stretches (2, rivals, rays) of each ray in which the rival is likelier, in terms of exp(−r²/2)."""
        step = self._root[entry] @ self._rays / np.sqrt(n)
        apart = self._size[entry] - self._size[rivals] + (self._bias[entry] - self._bias[rivals]) / n
        inverse = n * self._inverse[rivals]
        # log(p_entry/p_rival) = square·r² + linear·r + constant
        square = 0.5 * np.einsum("ar,jab,br->jr", step, inverse, step) - 0.5
        linear = np.einsum("ja,jab,br->jr", apart, inverse, step)
        constant = 0.5 * np.einsum("ja,jab,jb->j", apart, inverse, apart)
        constant = (constant + self._log_volume[rivals] - self._log_volume[entry])[:, None]
        return _negative(square, linear, constant)


def fewest_lines(error_after: Callable[[float], float], allowed: float, most: int = MOST_LINES) -> int | None:
    """The n from which on ``error_after(n)`` is at most ``allowed``, to half a per cent, from `FIRST_POSTERIOR_N` up.

    None where even ``most`` lines do not do. The error is taken to fall as lines are added.
    """
    if error_after(most) > allowed:
        return None
    low, high = FIRST_POSTERIOR_N, most
    if error_after(low) <= allowed:
        return low
    while high - low > max(1.0, 0.005 * low):
        middle = min(max(round(np.sqrt(low * high)), low + 1), high - 1)
        low, high = (low, middle) if error_after(middle) <= allowed else (middle, high)
    return high


@dataclass(frozen=True, slots=True, eq=False)
class LineConfusion:
    """Confusions of the recogniser that goes line by line.

    Attributes:
        rate: (entries, entries) expected log-likelihood ratio per line, when the first is true, against the second,
            in nats: the Kullback–Leibler rate at which the second is given up.
        variance: (entries, entries) its variance per line.
        lines: how many lines of each entry they were measured on.
        rivals: (entries, entries) whether a mistake of the first for the second counts.
    """

    rate: Floats
    variance: Floats
    lines: int
    rivals: Bools

    @property
    def is_resolved(self) -> Bools:
        """Where both rates are above zero beyond their own uncertainty; elsewhere nothing tells the two apart."""
        resolved = self.rate > 3 * np.sqrt(self.variance / self.lines)
        return resolved & resolved.T

    def errors(self, entry: int, n: float) -> Floats:
        """Chance (entries,), when ``entry`` is true, that each rival alone is likelier after ``n`` lines."""
        with np.errstate(divide="ignore", invalid="ignore"):
            away = np.sqrt(n) * self.rate[entry] / np.sqrt(self.variance[entry])
        away = np.where(self.is_resolved[entry], away, 0.0)
        return np.where(self.rivals[entry], ndtr(-away), 0.0)

    def error(self, entry: int, n: float) -> float:
        """Chance that some rival is likelier: the sum over the rivals, which is a little too high."""
        return min(1.0, float(self.errors(entry, n).sum()))

    def pair_lines(self, entry: int, rival: int, confidence: float, most: int = MOST_LINES) -> int | None:
        """Lines after which ``entry`` is likelier than ``rival``, when true, with ``confidence``; None for never."""
        if not self.is_resolved[entry, rival]:
            return None
        lines = int(np.ceil(ndtri(confidence) ** 2 * self.variance[entry, rival] / self.rate[entry, rival] ** 2))
        return max(1, lines) if lines <= most else None


def measure_rates(
    entries: Mapping[str, Geometry],
    tables: LineTables,
    rivals: Bools,
    rng: np.random.Generator,
    *,
    lines: int = 100_000,
    model: SensorModel | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> LineConfusion:
    """Measure rates and variances on ``lines`` fresh lines of each entry, other than those the tables learnt from.

    On the tables' own lines the noise that they learnt would pass for a difference between entries.
    """
    share = np.empty((len(entries), len(tables.by_bin)))
    for row, (name, geometry) in enumerate(entries.items()):
        seen = simulate_lines(geometry, lines, rng) if model is None else model.sense(geometry, lines, rng).invariants()
        bins = tables.bins.address(*seen)
        share[row] = np.bincount(bins, minlength=share.shape[1]) / max(1, bins.size)
        progress(name)
    used = share.any(axis=0)
    share, logs = share[:, used], tables.by_bin[used].T.astype(float)
    own = np.einsum("eb,eb->e", share, logs)
    rate = own[:, None] - share @ logs.T
    # ⟨(log p_i − log p_j)²⟩ under i, multiplied out.
    squares = np.einsum("eb,eb->e", share, logs**2)[:, None] - 2 * (share * logs) @ logs.T + share @ (logs**2).T
    return LineConfusion(rate, np.maximum(squares - rate**2, 0.0), lines, rivals)


def _negative(square: Floats, linear: Floats, constant: Floats) -> tuple[Floats, Floats]:
    """Where square·r² + linear·r + constant < 0 for r ≥ 0: two stretches, ends (2, …) in terms of exp(−r²/2)."""
    discriminant = linear**2 - 4 * square * constant
    real = discriminant > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        # the root that does not cancel, then the other by the product of the roots
        q = -0.5 * (linear + np.copysign(np.sqrt(np.maximum(discriminant, 0)), linear))
        first, second = q / square, np.broadcast_to(constant, q.shape) / q
    near, far = np.clip(np.fmin(first, second), 0, np.inf), np.clip(np.fmax(first, second), 0, np.inf)
    opens = square < 0  # negative outside of the roots
    zero, infinite = np.zeros_like(near), np.full_like(near, np.inf)
    start_1 = np.where(opens, zero, np.where(real, near, infinite))
    end_1 = np.where(opens, np.where(real, near, infinite), np.where(real, far, infinite))
    start_2 = np.where(opens & real, far, infinite)
    low = np.exp(-0.5 * np.stack([end_1, infinite]) ** 2)
    high = np.exp(-0.5 * np.stack([start_1, start_2]) ** 2)
    return low, high
