"""Recognition line by line: the likelihood of each single (k, 𝓛_1, 𝓛_3) under each entry.

The means that Eq. 1 needs throw most of a line away. Here every entry has a table of how probable each kind of line
is, learnt from Monte Carlo lines seen through the robot's own sensor, and one running log-likelihood: still a few
scalars on board, and a hundred times fewer lines than with (A, P) for letters.

A line's kind is (k, 𝓛_1, u) with u = 1 − 𝓛_1/𝓛_3^{1/3} in [0, 1): 0 for a single chord, and the more the further its
chords lie apart. For each k, length and u are cut into bins that are narrow where the dictionary's lines crowd.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from analysis.boundary import Geometry
from analysis.montecarlo import simulate_lines
from analysis.outsider import OUTSIDER_PRIOR, Outsiders
from analysis.recognition import Weights, class_heads, crossing_lines, log_prior, normalised, rank_classes
from analysis.sensor import SensorModel
from analysis.smoothing import BACKGROUND, smooth_alike, smooth_table
from lab.base.errors import RequestError

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Kinds = tuple[Ints, Floats, Floats]

LENGTH_BINS = 96
SPREAD_BINS = 48
MAX_CHORDS = 8  # lines with more share the last table
_EVEN = 0.25  # share of the bins that are spread evenly; the others follow the lines
_COARSE = 4
_NEAR = 0.08  # Jeffreys' divergence per line, nats, below which two entries are near twins
_POOLED = 4000  # lines of each entry that decide where the bins lie


@dataclass(frozen=True, slots=True, eq=False)
class Bins:
    """How the kinds of lines are cut up.

    Attributes:
        length_edges_cm: (`MAX_CHORDS`, `LENGTH_BINS` − 1) inner edges in 𝓛_1; the last bin takes all that is longer.
        spread_edges: (`MAX_CHORDS`, `SPREAD_BINS` − 1) inner edges in u.
    """

    length_edges_cm: Floats
    spread_edges: Floats

    @classmethod
    def of(cls, seen: Mapping[str, Kinds]) -> Bins:
        """Bins that suit a dictionary's lines."""
        some = [tuple(column[:: max(1, len(column) // _POOLED)] for column in kinds) for kinds in seen.values()]
        k, l1_cm, l3_cm3 = (np.concatenate(columns) for columns in zip(*some, strict=True))
        layer, u = np.clip(k, 1, MAX_CHORDS), _spread(l1_cm, l3_cm3)
        longest_cm = 1.02 * max(float(l1_cm.max(initial=0.0)), 1e-6)
        every = range(1, MAX_CHORDS + 1)
        return cls(
            np.stack([_edges(l1_cm[layer == chords], longest_cm, LENGTH_BINS) for chords in every]),
            np.stack([_edges(u[layer == chords], 1.0, SPREAD_BINS) for chords in every]),
        )

    def address(self, k: ArrayLike, l1_cm: ArrayLike, l3_cm3: ArrayLike) -> Ints:
        """Number (lines,) of the bin that each crossing line, k ≥ 1, falls in."""
        layer = np.clip(np.asarray(k, dtype=np.int64).ravel(), 1, MAX_CHORDS) - 1
        length_cm = np.asarray(l1_cm, dtype=float).ravel()
        u = _spread(length_cm, np.asarray(l3_cm3, dtype=float).ravel())
        place = np.empty((2, layer.size), dtype=np.int64)
        for chords in np.unique(layer):
            own = layer == chords
            place[0, own] = np.searchsorted(self.length_edges_cm[chords], length_cm[own], side="right")
            place[1, own] = np.searchsorted(self.spread_edges[chords], u[own], side="right") if chords else 0
        return (layer * LENGTH_BINS + place[0]) * SPREAD_BINS + place[1]


@dataclass(frozen=True, slots=True, eq=False)
class LineTables:
    """How probable each kind of line is under each entry.

    Attributes:
        names: the entries.
        classes: entries that no lines tell apart, each in one class; twins have one table.
        bins: how the kinds are cut up.
        log_probability: (entries, `MAX_CHORDS`, `LENGTH_BINS`, `SPREAD_BINS`) log of the probability of a bin;
            single chords use the first bin in u only. Never −inf.
        background: (bins,) mean probability of a bin over the entries.
        learnt: of each entry the bins that its lines fell in, and how many lines of one half and of the other.
    """

    names: tuple[str, ...]
    classes: tuple[tuple[str, ...], ...]
    bins: Bins
    log_probability: Singles
    background: Floats
    learnt: tuple[tuple[Ints, Ints, Ints], ...]

    @property
    def by_bin(self) -> Singles:
        """(bins, entries) the same, by the bins' numbers; a view."""
        return self.log_probability.reshape(len(self.names), -1).T

    def look_up(self, k: ArrayLike, l1_cm: ArrayLike, l3_cm3: ArrayLike) -> Floats:
        """Log-likelihood (lines, entries) of crossing lines, k ≥ 1."""
        return self.by_bin[self.bins.address(k, l1_cm, l3_cm3)].astype(float)

    def halves(self, entry: int) -> Floats:
        """(2, `MAX_CHORDS`, `LENGTH_BINS`, `SPREAD_BINS`) the lines that an entry was learnt from, in two halves."""
        full = np.zeros((2, MAX_CHORDS * LENGTH_BINS * SPREAD_BINS))
        bins, *counts = self.learnt[entry]
        full[:, bins] = counts
        return full.reshape(2, MAX_CHORDS, LENGTH_BINS, SPREAD_BINS)


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


def tables_of(seen: Mapping[str, Kinds], classes: Sequence[Sequence[str]] = ()) -> LineTables:
    """Make the tables of a dictionary from many lines of each entry: the arrays (k, 𝓛_1, 𝓛_3), k ≥ 1.

    Lines as the robot's own sensor measures them (`analysis.tablestore.learn_lines`) make the dictionary match it.
    Each table is smoothed, as far as its own lines bear out, near twins together, and mixed with a little of what all
    entries share and of a uniform table, so that a line that no entry explains moves no posterior far. ``classes``
    (from `analysis.congruence.congruence_classes`) name the twins, which share their lines.

    Raises:
        RequestError: no entries, or a class names what is no entry.
    """
    names = tuple(seen)
    log_prior(names, None)
    whole = class_heads(names, classes)
    bins = Bins.of(seen)
    size = MAX_CHORDS * LENGTH_BINS * SPREAD_BINS
    uniform = np.zeros((MAX_CHORDS, LENGTH_BINS, SPREAD_BINS))
    uniform[0, :, 0] = 1.0
    uniform[1:] = 1 / SPREAD_BINS
    column = {name: number for number, name in enumerate(names)}
    probability = np.empty((size, len(names)), dtype=np.float32)
    learnt: dict[str, tuple[Ints, Ints, Ints]] = {}
    for members in whole:
        addresses = np.concatenate([bins.address(*seen[name]) for name in members])
        halves = [np.bincount(addresses[half::2], minlength=size) for half in (0, 1)]
        counts = halves[0] + halves[1]
        filled = np.flatnonzero(counts)
        table = smooth_table(counts.astype(float).reshape(uniform.shape)).ravel()
        for name in members:
            learnt[name] = filled, halves[0][filled], halves[1][filled]
            probability[:, column[name]] = table
    for group in _near_twins(probability[:, [column[members[0]] for members in whole]]):
        alike: list[Floats] = []
        for number in group:
            filled, *halves = learnt[whole[number][0]]
            counts = np.zeros(size)
            counts[filled] = np.sum(halves, axis=0)
            alike.append(counts.reshape(uniform.shape))
        for number, table in zip(group, smooth_alike(alike), strict=True):
            for name in whole[number]:
                probability[:, column[name]] = table.ravel()
    background = (probability.mean(axis=1, dtype=float) + uniform.ravel() / uniform.sum()) / 2
    probability *= 1 - BACKGROUND
    probability += (BACKGROUND * background[:, None]).astype(np.float32)
    # A single chord has u = 0: the other bins of that table are never looked up.
    np.maximum(probability, np.finfo(np.float32).tiny, out=probability)
    np.log(probability, out=probability)
    # a line looks all entries up at once: they lie side by side in memory
    tables = probability.T.reshape(len(names), *uniform.shape)
    return LineTables(names, whole, bins, tables, background, tuple(learnt[name] for name in names))


class LineRecogniser:
    """One running log-likelihood per entry.

    Args:
        tables: from `learn_tables` or `tables_of`.
        prior: relative prior weight of each entry, > 0; equal without it.
        weight: how many independent lines one line counts for. Lines after a bounce at the wall are not quite
            independent, and tables not quite exact; below 1 makes the posterior more cautious.
    """

    def __init__(self, tables: LineTables, *, prior: Mapping[str, float] | None = None, weight: float = 1.0) -> None:
        if not 0 < weight <= 1:
            raise RequestError(f"the weight of a line lies above 0 and up to 1, got {weight}")
        self.names = tables.names
        self.classes = tables.classes
        self._bins, self._tables = tables.bins, tables.by_bin
        self._log_prior = log_prior(self.names, prior)
        self._weight = weight
        self._outsiders = Outsiders(tables.halves, tables.background, self._tables, _class_numbers(tables), weight)
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
        self._seen = np.zeros(len(self._tables))

    def update(self, k: int, l1_cm: float, l3_cm3: float, weight: float = 1.0) -> None:
        """Take in one line; k = 0 changes nothing."""
        self.update_many([k], [l1_cm], [l3_cm3], weight)

    def update_many(self, k: ArrayLike, l1_cm: ArrayLike, l3_cm3: ArrayLike, weight: ArrayLike = 1.0) -> None:
        """Take in many lines, arrays of shape (lines,)."""
        lines = crossing_lines(k, l1_cm, l3_cm3, weight)
        if not len(lines):
            return
        bins, weights = self._bins.address(*lines[:, :3].T), lines[:, 3]
        self._n += len(lines)
        self._log_likelihood += weights @ self._tables[bins].astype(float)
        np.add.at(self._seen, bins, weights)
        self._weights.take(weights)

    @property
    def _scale(self) -> float:
        """As many lines of equal weight as these are worth, each of the weighted mean's likelihood."""
        weights = self._weights
        return weights.effective_lines / weights.total if weights.total else 0.0

    def posterior(self) -> dict[str, float]:
        """Probability of each entry, given that the shape is one of them; they sum to 1, and twins share evenly."""
        return normalised(self.names, self._log_prior + self._weight * self._scale * self._log_likelihood)

    def ranked(self) -> list[tuple[str, float]]:
        """(name, probability) of each class, the most probable first, under its first member's name."""
        return rank_classes(self.posterior(), self.classes)

    def unknown(self) -> float:
        """Probability that the shape is none of the dictionary's; `OUTSIDER_PRIOR` before the first line."""
        if not self._n:
            return OUTSIDER_PRIOR
        return self._outsiders.probability(list(self.posterior().values()), self._seen, self._scale)


def _class_numbers(tables: LineTables) -> Ints:
    """The class (entries,) that each entry is in."""
    number = {name: place for place, members in enumerate(tables.classes) for name in members}
    return np.array([number[name] for name in tables.names])


def _near_twins(probability: Singles) -> list[list[int]]:
    """Groups of classes, by their numbers, that hundreds of lines hardly tell apart; those alone are left out.

    Args:
        probability: (bins, classes).
    """
    # coarser bins: enough to see what is far apart, and with less of the learning's noise
    shape = MAX_CHORDS, LENGTH_BINS // _COARSE, _COARSE, SPREAD_BINS // _COARSE, _COARSE, -1
    coarse = probability.reshape(shape).sum(axis=(2, 4)).reshape(-1, probability.shape[1]).astype(float)
    logs = np.log((1 - BACKGROUND) * coarse + BACKGROUND / len(coarse))
    cross = coarse.T @ logs
    own = np.diag(cross)
    apart = own[:, None] + own - cross - cross.T
    count, group = connected_components(csr_array(apart < _NEAR), directed=False)
    groups = [np.flatnonzero(group == number).tolist() for number in range(count)]
    return [members for members in groups if len(members) > 1]


def _spread(l1_cm: Floats, l3_cm3: Floats) -> Floats:
    """How far the chords of each line lie apart: u = 1 − 𝓛_1/𝓛_3^{1/3}, in [0, 1)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.clip(np.where(l3_cm3 > 0, 1 - l1_cm / np.cbrt(l3_cm3), 0.0), 0.0, 1.0)


def _edges(values: Floats, most: float, bins: int) -> Floats:
    """Inner edges of ``bins`` bins on 0 … ``most``: some evenly spread, the others at the quantiles of ``values``."""
    even = np.linspace(0.0, most, 513)
    if not values.size:
        return even[np.round(np.linspace(0, 512, bins + 1)).astype(int)][1:-1]
    knots = np.unique(np.concatenate([even, np.quantile(values, np.linspace(0, 1, 513))]))
    below = np.searchsorted(np.sort(values), knots, side="right") / values.size
    filled = _EVEN * knots / most + (1 - _EVEN) * below
    return np.interp(np.linspace(0, 1, bins + 1)[1:-1], filled, knots)
