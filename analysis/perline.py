"""Recognition line by line: the likelihood of each single (k, 𝓛_1, 𝓛_3) under each entry.

The means that Eq. 1 needs throw most of a line away. Here every entry has a table of how probable each kind of line
is, learnt from Monte Carlo lines seen through the robot's own sensor, and one running log-likelihood: still a few
scalars on board, and some ten times fewer lines than with (A, P).

A line's kind is (k, 𝓛_1, u) with u = 1 − 𝓛_1/𝓛_3^{1/3} in [0, 1): 0 for a single chord, and the more the further its
chords lie apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from analysis.boundary import Geometry
from analysis.estimate import relative_covariance
from analysis.invariants import area_cm2, perimeter_cm
from analysis.kernels import ragged_sampled, ragged_sort
from analysis.montecarlo import Lines, simulate_crossings
from analysis.quadrature import Moments
from analysis.recognition import Weights, crossing_lines, log_prior, normalised, rank
from lab.base.errors import RequestError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LENGTH_BINS = 128
SPREAD_BINS = 24
MAX_CHORDS = 8  # lines with more share the last table
_BACKGROUND = 0.02  # share of lines that an entry leaves to what its table does not know


@dataclass(frozen=True, slots=True)
class LineModel:
    """What the robot's sensor makes of an ideal line.

    Attributes:
        jitter_cm: standard deviation of each crossing's position.
        min_chord_cm: distance rolled between two light readings. A lit or dark stretch shorter than this is
            seen with probability length/min_chord_cm; a dark one that is missed joins its chords.
        scale_sigma: relative standard deviation of a line's length (speed), common to all its crossings.
    """

    jitter_cm: float = 0.0
    min_chord_cm: float = 0.0
    scale_sigma: float = 0.0

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = float(getattr(self, name))
            if not (np.isfinite(value) and value >= 0):
                raise RequestError(f"line model: `{name}` must be 0 or more, got {value}")

    def observe(self, lines: Lines, rng: np.random.Generator) -> Lines:
        """Give the lines as the robot would report them; lines of which nothing is seen are gone."""
        s_cm, counts = lines.s_cm, lines.counts
        if self.min_chord_cm > 0:
            keep = np.zeros(s_cm.size, dtype=bool)
            ragged_sampled(s_cm, counts, rng.random(counts.size), self.min_chord_cm, keep)
            owner = np.repeat(np.arange(counts.size), counts)
            counts = np.bincount(owner[keep], minlength=counts.size)
            counts = counts[counts > 0].astype(np.int64)
            s_cm = s_cm[keep]
        if self.scale_sigma > 0:
            s_cm = s_cm * np.repeat(1 + self.scale_sigma * rng.standard_normal(counts.size), counts)
        if self.jitter_cm > 0:
            s_cm = s_cm + self.jitter_cm * rng.standard_normal(s_cm.size)
            ragged_sort(s_cm, counts)
        return Lines(s_cm, counts)


@dataclass(frozen=True, slots=True, eq=False)
class LineTables:
    """How probable each kind of line is under each entry.

    Attributes:
        names: the entries.
        length_step_cm: width of a bin in 𝓛_1; the last bin takes all that is longer.
        log_probability: (entries, `MAX_CHORDS`, `LENGTH_BINS`, `SPREAD_BINS`) log of the probability of a bin;
            single chords use the first bin in u only. Never −inf.
    """

    names: tuple[str, ...]
    length_step_cm: float
    log_probability: Floats

    def look_up(self, k: ArrayLike, l1_cm: ArrayLike, l3_cm3: ArrayLike) -> Floats:
        """Log-likelihood (lines, entries) of crossing lines, k ≥ 1."""
        chords = np.asarray(k, dtype=np.int64).ravel()
        length = np.asarray(l1_cm, dtype=float).ravel()
        cube = np.asarray(l3_cm3, dtype=float).ravel()
        return self.log_probability[:, *_bins(chords, length, cube, self.length_step_cm)].T


def learn_tables(
    entries: Mapping[str, Geometry],
    rng: np.random.Generator,
    *,
    lines: int = 100_000,
    model: LineModel | None = None,
    threads: int | None = None,
) -> LineTables:
    """Learn the tables of a dictionary from ``lines`` Monte Carlo lines of each entry.

    With a ``model`` the lines are seen through the sensor first, which makes the dictionary match the robot.
    Each table is smoothed with half of Scott's bandwidth and mixed with a little of what all entries share
    and of a uniform table, so that a line that no entry explains moves no posterior far.

    Raises:
        RequestError: no entries.
        analysis.boundary.BoundaryError: an entry's geometry is empty or invalid.
    """
    names = tuple(entries)
    log_prior(names, None)
    seen: list[tuple[Ints, Floats, Floats]] = []
    for geometry in entries.values():
        thrown = simulate_crossings(geometry, lines, rng, threads=threads)
        seen.append((model.observe(thrown, rng) if model else thrown).invariants())
    step_cm = 1.02 * max(float(l1_cm.max(initial=0.0)) for _, l1_cm, _ in seen) / (LENGTH_BINS - 1)
    tables = np.stack([_table(*kind, step_cm) for kind in seen])
    uniform = np.zeros_like(tables[0])
    uniform[0, :, 0] = 1.0
    uniform[1:] = 1 / SPREAD_BINS
    background = (tables.mean(axis=0) + uniform / uniform.sum()) / 2
    # A single chord has u = 0: the other bins of that table are never looked up.
    probability = np.maximum((1 - _BACKGROUND) * tables + _BACKGROUND * background, np.finfo(float).tiny)
    return LineTables(names, step_cm, np.log(probability))


def sensed_moments(
    geometry: Geometry, model: LineModel, rng: np.random.Generator, *, lines: int = 400_000, threads: int | None = None
) -> Moments:
    """Moments of a shape as the robot's sensor sees it, for a sensor-matched `GaussianRecogniser`.

    By Monte Carlo: area and perimeter are those that Eq. 1 gives for the sensed lines, and ``error`` is the
    larger of their relative standard errors. The hitting measure is that of the lines of which something is
    seen; the hull is the true shape's.
    """
    thrown = simulate_crossings(geometry, lines, rng, threads=threads)
    lines_seen = model.observe(thrown, rng)
    if lines_seen.counts.size < 2:
        raise RequestError(f"this sensor sees nothing of the shape: take readings closer than {model.min_chord_cm} cm")
    values = np.column_stack(lines_seen.invariants())
    mean = values.mean(axis=0)
    covariance = np.cov(values, rowvar=False)
    relative = relative_covariance(mean, covariance)
    # ⟨k⟩ of all the lines thrown measures how many lines hit: ∫[hit] dG = P/⟨k⟩.
    hitting_measure = geometry.length / (thrown.counts.mean() / 2)
    return Moments(
        area_cm2=float(area_cm2(mean[1], mean[2])),
        perimeter_cm=float(perimeter_cm(mean[0], mean[1], mean[2])),
        hull_perimeter_cm=float(geometry.convex_hull.length),
        hitting_measure_cm=float(hitting_measure * lines_seen.counts.size / lines),
        mean=mean,
        covariance=covariance,
        relative=relative,
        error=float(np.sqrt(np.diag(relative).max() / len(values))),
    )


class LineRecogniser:
    """One running log-likelihood per entry.

    Args:
        tables: from `learn_tables`.
        prior: relative prior weight of each entry, > 0; equal without it.
        weight: how many independent lines one line counts for. Lines after a bounce at the wall are not
            quite independent (lag-1 correlation up to 0.24); below 1 makes the posterior more cautious.
    """

    def __init__(self, tables: LineTables, *, prior: Mapping[str, float] | None = None, weight: float = 1.0) -> None:
        if not 0 < weight <= 1:
            raise RequestError(f"the weight of a line lies above 0 and up to 1, got {weight}")
        self.names = tables.names
        self._tables = tables
        self._log_prior = log_prior(self.names, prior)
        self._weight = weight
        self.reset()

    @property
    def n(self) -> int:
        """Crossing lines taken in so far."""
        return self._n

    def reset(self) -> None:
        """Forget every line."""
        self._n = 0
        self._log_likelihood = np.zeros(len(self.names))
        self._weights = Weights()

    def update(self, k: int, l1_cm: float, l3_cm3: float, weight: float = 1.0) -> None:
        """Take in one line; k = 0 changes nothing."""
        self.update_many([k], [l1_cm], [l3_cm3], weight)

    def update_many(self, k: ArrayLike, l1_cm: ArrayLike, l3_cm3: ArrayLike, weight: ArrayLike = 1.0) -> None:
        """Take in many lines, arrays of shape (lines,)."""
        lines = crossing_lines(k, l1_cm, l3_cm3, weight)
        self._n += len(lines)
        self._log_likelihood += (lines[:, 3:] * self._tables.look_up(*lines[:, :3].T)).sum(axis=0)
        self._weights.take(lines[:, 3])

    def posterior(self) -> dict[str, float]:
        """Probability of each entry; they sum to 1."""
        weights = self._weights
        # As many lines of equal weight as these are worth, each of the weighted mean's likelihood.
        scale = self._weight * weights.effective_lines / weights.total if weights.total else 0.0
        return normalised(self.names, self._log_prior + scale * self._log_likelihood)

    def ranked(self) -> list[tuple[str, float]]:
        """(name, probability), the most probable first."""
        return rank(self.posterior())


def _bins(k: Ints, l1_cm: Floats, l3_cm3: Floats, step_cm: float) -> tuple[Ints, Ints, Ints]:
    length = np.clip(l1_cm / step_cm, 0, LENGTH_BINS - 1).astype(np.int64)
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = np.where(l3_cm3 > 0, 1 - l1_cm / np.cbrt(l3_cm3), 0.0)
    spread = np.clip(spread * SPREAD_BINS, 0, SPREAD_BINS - 1).astype(np.int64)
    return np.clip(k, 1, MAX_CHORDS) - 1, length, np.where(k == 1, 0, spread)


def _table(k: Ints, l1_cm: Floats, l3_cm3: Floats, step_cm: float) -> Floats:
    """Smoothed histogram (`MAX_CHORDS`, `LENGTH_BINS`, `SPREAD_BINS`) that sums to 1."""
    table = np.zeros((MAX_CHORDS, LENGTH_BINS, SPREAD_BINS))
    np.add.at(table, _bins(k, l1_cm, l3_cm3, step_cm), 1.0)
    for chords in range(MAX_CHORDS):
        layer = table[chords]
        count = layer.sum()
        if count < 2:
            continue
        used = layer[:, :1] if chords == 0 else layer
        dimensions = 1 if chords == 0 else 2
        widths = [_spread_of(used.sum(axis=1)), 0.0 if chords == 0 else _spread_of(used.sum(axis=0))]
        bandwidth = [0.5 * width * count ** (-1 / (dimensions + 4)) for width in widths]
        # "reflect" keeps the mass inside the table.
        used[...] = np.asarray(ndimage.gaussian_filter(used, bandwidth, mode="reflect"), dtype=float)
    total = table.sum()
    return table / total if total > 0 else np.full_like(table, 1 / table.size)


def _spread_of(counts: Floats) -> float:
    """Standard deviation, in bins, of a histogram."""
    position = np.arange(counts.size)
    mean = np.average(position, weights=counts)
    return float(np.sqrt(np.average((position - mean) ** 2, weights=counts)))
