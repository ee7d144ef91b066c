"""Which law does a robot turn by? The exponent m of a density ∝ cos^m φ, fitted to the lengths of its runs.

Lengths are counted in bins, and the likeliest m is the one under which simulated robots in the same arena share
them out so. The likelihood takes runs for independent, which successive ones are not: that costs the fit little,
but its scatter and its bias are then those of simulated sessions, never those of the likelihood's curvature.

Runs straight across a rectangle pile up at its height and at its width, so that half a per cent of scale moves many
of them together into a bin where hardly any belong. Simulated sessions are therefore measured by a robot whose scale
is off as a real one's may be: only what no such error explains speaks against the turning.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from shapely.geometry import Polygon

from analysis.billiard import roll

Floats = NDArray[np.float64]

# Exponents from −0.75 to 8, even in log(1 + m): what is simulated, and what is told apart.
_GRID: Floats = np.asarray(np.linspace(np.log(0.25), np.log(9.0), 25), dtype=float)
_FINE: Floats = np.asarray(np.linspace(_GRID[0], _GRID[-1], 801), dtype=float)
_SESSIONS, _RUNS = 1000, 200  # simulated for each exponent
_BINS = 30
_SMOOTH = 3  # degree in log(1 + m) of the fit's bias and scatter
_SCALE_SIGMA = 0.01  # relative; a session's lengths all share it, as a robot's speed is known no better


@dataclass(frozen=True, slots=True)
class Exponent:
    """A fitted exponent (free of the median's bias) and its 95 % interval; both stay within −0.75 … 8."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class LawTable:
    """What robots of every exponent do in one arena.

    Attributes:
        bins_cm: (bins − 1,) edges between the bins of the run lengths.
        log_share: (bins, fine grid of log(1 + m)) logarithm of each bin's share.
        low, median, high: (fine grid,) the fits of sessions with that exponent: 2.5, 50 and 97.5 % quantiles.
    """

    bins_cm: Floats
    log_share: Floats
    low: Floats
    median: Floats
    high: Floats

    def likeliest(self, lengths_cm: Floats) -> Floats:
        """log(1 + m) of each row (sessions, runs) of lengths, with the bias of the fit taken off."""
        best = _FINE[np.argmax(_counts(lengths_cm, self.bins_cm) @ self.log_share, axis=1)]
        return np.asarray(np.interp(best, self.median, _FINE), dtype=float)

    def fit(self, lengths_cm: Floats) -> Exponent:
        """The exponent of one session's lengths (runs,): the interval holds those under which its fit is usual."""
        value = float(self.likeliest(lengths_cm[None, :])[0])
        seen = float(np.interp(value, _FINE, self.median))
        low, high = float(np.interp(seen, self.high, _FINE)), float(np.interp(seen, self.low, _FINE))
        return Exponent(math.expm1(value), math.expm1(low), math.expm1(high))


def tabulate_law(reachable: Polygon, runs: int, bins_from_cm: Floats, rng: np.random.Generator) -> LawTable:
    """Simulate robots of many exponents in the arena (convex polygon, cm), for sessions of ``runs`` runs.

    ``bins_from_cm`` are lengths whose quantiles become the bins' edges. Of long sessions the first 200 runs are
    simulated, and the scatter of the fit is scaled by 1/√runs.
    """
    rolled = min(runs, _RUNS)
    sessions = _SESSIONS * _RUNS // rolled
    bins = np.asarray(np.quantile(bins_from_cm, np.arange(1, _BINS) / _BINS), dtype=float)
    counts = [
        _counts(as_measured(roll(reachable, sessions, rolled, rng, exponent=float(np.expm1(x))).length_cm, rng), bins)
        for x in _GRID.tolist()
    ]
    shares = np.array([count.sum(axis=0) + 0.5 for count in counts]) / (sessions * rolled + 0.5 * _BINS)
    log_share = np.asarray(CubicSpline(_GRID, np.log(shares))(_FINE), dtype=float).T
    fitted = [_FINE[np.argmax(count @ log_share, axis=1)] for count in counts]
    quantiles = np.array([np.quantile(fits, [0.025, 0.5, 0.975]) for fits in fitted])
    median = quantiles[:, 1]
    narrower = np.sqrt(rolled / runs)
    low, middle, high = (
        _rising(median + narrower * (values - median)) for values in (quantiles[:, 0], median, quantiles[:, 2])
    )
    return LawTable(bins, log_share, low, middle, high)


def as_measured(lengths_cm: Floats, rng: np.random.Generator) -> Floats:
    """Lengths (sessions, runs) as robots report them whose scale is known to 1 %: a factor for each session."""
    return lengths_cm * (1 + _SCALE_SIGMA * rng.standard_normal((len(lengths_cm), 1)))


def _counts(lengths_cm: Floats, bins_cm: Floats) -> Floats:
    """How many of each row's lengths fall into each bin: (sessions, bins)."""
    row = np.arange(len(lengths_cm))[:, None] * _BINS
    flat = (np.searchsorted(bins_cm, lengths_cm) + row).ravel()
    return np.bincount(flat, minlength=len(lengths_cm) * _BINS).reshape(-1, _BINS).astype(float)


def _rising(fitted: Floats) -> Floats:
    """Fits (grid,) on the fine grid, smoothed, and rising strictly so that they can be inverted."""
    off = np.polynomial.Polynomial.fit(_GRID, fitted - _GRID, _SMOOTH)(_FINE)
    return np.asarray(np.maximum.accumulate(_FINE + off) + 1e-9 * np.arange(_FINE.size), dtype=float)
