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
from analysis.montecarlo import simulate_lines
from analysis.recognition import Weights, crossing_lines, log_prior, normalised, rank
from analysis.sensor import SensorModel
from lab.base.errors import RequestError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Kinds = tuple[Ints, Floats, Floats]

LENGTH_BINS = 128
SPREAD_BINS = 24
MAX_CHORDS = 8  # lines with more share the last table
_BANDWIDTHS = (0.5, 0.25, 0.125, 0.0625, 0.0)  # shares of Scott's
_BACKGROUND = 0.02  # share of lines that an entry leaves to what its table does not know


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
    model: SensorModel | None = None,
    threads: int | None = None,
) -> LineTables:
    """Learn the tables of a dictionary from ``lines`` Monte Carlo lines of each entry.

    With a ``model`` the lines are seen through the sensor first.

    Raises:
        RequestError: no entries.
        analysis.boundary.BoundaryError: an entry's geometry is empty or invalid.
    """
    seen: dict[str, Kinds] = {}
    for name, geometry in entries.items():
        if model is None:
            seen[name] = simulate_lines(geometry, lines, rng, threads=threads)
        else:
            seen[name] = model.sense(geometry, lines, rng, threads=threads).invariants()
    return tables_of(seen)


def tables_of(seen: Mapping[str, Kinds]) -> LineTables:
    """Make the tables of a dictionary from many lines of each entry: the arrays (k, 𝓛_1, 𝓛_3), k ≥ 1.

    Lines as the robot's own sensor measures them (`analysis.tablestore.learn_lines`) make the dictionary match it.
    Each table is smoothed, as far as its own lines bear out, and mixed with a little of what all entries share
    and of a uniform table, so that a line that no entry explains moves no posterior far.

    Raises:
        RequestError: no entries.
    """
    names = tuple(seen)
    log_prior(names, None)
    step_cm = 1.02 * max(float(l1_cm.max(initial=0.0)) for _, l1_cm, _ in seen.values()) / (LENGTH_BINS - 1)
    tables = np.stack([_table(*kinds, step_cm) for kinds in seen.values()])
    uniform = np.zeros_like(tables[0])
    uniform[0, :, 0] = 1.0
    uniform[1:] = 1 / SPREAD_BINS
    background = (tables.mean(axis=0) + uniform / uniform.sum()) / 2
    # A single chord has u = 0: the other bins of that table are never looked up.
    probability = np.maximum((1 - _BACKGROUND) * tables + _BACKGROUND * background, np.finfo(float).tiny)
    return LineTables(names, step_cm, np.log(probability))


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
        scott = [width * count ** (-1 / (dimensions + 4)) for width in widths]
        used[...] = max((_smoothed(used, scott, share) for share in _BANDWIDTHS), key=lambda found: found[0])[1]
    total = table.sum()
    return table / total if total > 0 else np.full_like(table, 1 / table.size)


def _smoothed(counts: Floats, scott: list[float], share: float) -> tuple[float, Floats]:
    """A histogram smoothed with a share of Scott's bandwidth, and how well that tells each line from the others.

    That is the leave-one-out log-likelihood: a line adds the kernel's peak to its own bin, and without it the bin
    must still expect it. A sensor's readings leave teeth in the lengths that Scott's rule alone would wipe out.
    """
    bandwidth = [share * width for width in scott]
    # "reflect" keeps the mass inside the table.
    smooth = np.asarray(ndimage.gaussian_filter(counts, bandwidth, mode="reflect"), dtype=float)
    middle = np.zeros_like(counts)
    centre = counts.shape[0] // 2, counts.shape[1] // 2
    middle[centre] = 1.0
    peak = ndimage.gaussian_filter(middle, bandwidth, mode="reflect")[centre]
    others = np.maximum(smooth - peak, 0.0) / (counts.sum() - 1)
    filled = counts > 0
    expected = (1 - _BACKGROUND) * others[filled] + _BACKGROUND / counts.size
    return float(counts[filled] @ np.log(expected)), smooth


def _spread_of(counts: Floats) -> float:
    """Standard deviation, in bins, of a histogram."""
    position = np.arange(counts.size)
    mean = np.average(position, weights=counts)
    return float(np.sqrt(np.average((position - mean) ** 2, weights=counts)))
