"""Whether a line's record fits the entry that leads, or none of the dictionary's: the evidence for an outsider.

An entry is known by the lines it was learnt from. Against it stands the hypothesis that the lines come from some
other shape, of which nothing is known: its distribution over the kinds of lines is drawn at random about the entry's
own, from an optional Pólya tree (Wong and Ma, Annals of Statistics 38, 2010). The kinds are halved again and again
into cells that the entry fills equally; at each halving the outsider either stops deviating or turns its share into
a Beta variate. Its marginal likelihood over the entry's is a Bayes factor in closed form. Taken line by line it is a
martingale while the entry is true: however often one looks, a factor of x comes up in at most 1/x of its sessions
(Ville's inequality).

The entry itself is only known from finitely many learnt lines; they enter as the Beta posterior of each halving, so
that a long session does not take the learning's own noise for an outsider.

Trees know nothing of what shapes are like. What the other entries' log-likelihoods do (`analysis.deviation`) is the
second opinion: near copies show there in a tenth of the lines.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from analysis.deviation import FEWEST_LINES, Deviation
from analysis.kernels import kernel
from analysis.smoothing import BACKGROUND, smooth_table

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Singles = NDArray[np.float32]

DEPTH = 8  # halvings, down to cells of 1/256 of an entry's lines
_LEVELS = 6  # halvings by likelihood
_FEWEST = 20  # learnt lines in a cell that is worth halving
_STOP = 0.2  # chance that the outsider deviates no further from a halving on
_CONCENTRATIONS = np.array([4.0, 16.0, 64.0, 256.0])  # of the Beta variate about the entry's own share
_CANDIDATE = 0.01  # least posterior of an entry that an outsider may be like
OUTSIDER_PRIOR = 0.05  # probability, before any line, that the shape is in no entry


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """Halvings of the kinds of lines, heap-ordered: node i has the halves 2i and 2i + 1.

    Attributes:
        leaf: (bins,) the node in which a bin of the table ends.
        learnt: (2^(DEPTH+1),) learnt lines in each node; 0 where there is none.
    """

    leaf: Ints
    learnt: Floats


def grow(counts: Floats, first: int = 0) -> Tree:
    """Halve the bins (chords, lengths, spreads) of a table that holds ``counts`` learnt lines.

    The number of chords is halved first, then length and spread in turn, ``first`` 0 for length. Each halving is the
    most even one.
    """
    leaf = np.ones(counts.shape, dtype=np.int64)
    learnt = np.zeros(2 << DEPTH)
    boxes = [(1, tuple(slice(0, size) for size in counts.shape), first)]
    while boxes:
        node, box, turn = boxes.pop()
        inside = counts[box]
        learnt[node] = inside.sum()
        leaf[box] = node
        if node >= 1 << DEPTH or learnt[node] < _FEWEST:
            continue
        wanted = (0,) if inside.shape[0] > 1 else (1 + turn % 2, 2 - turn % 2)
        for axis in wanted:
            parts = np.cumsum(inside.sum(axis=tuple(other for other in range(3) if other != axis)))[:-1]
            if not parts.size:
                continue
            cut = int(np.abs(parts - learnt[node] / 2).argmin())
            if min(parts[cut], learnt[node] - parts[cut]) <= 0.02 * learnt[node] and axis == wanted[0] != 0:
                continue  # hopelessly uneven: try the other way
            middle = box[axis].start + cut + 1
            halves = slice(box[axis].start, middle), slice(middle, box[axis].stop)
            following = turn if axis == 0 else turn + 1
            boxes += [
                (2 * node + half, (*box[:axis], part, *box[axis + 1 :]), following) for half, part in enumerate(halves)
            ]
            break
    return Tree(leaf.ravel(), learnt)


def grow_by_level(halves: Floats, background: Floats) -> Tree:
    """Halve the bins by how much likelier they are for the entry than for shapes at large.

    Where an entry's lines crowd on narrow ridges, those of a like shape fall beside them: all over the table, and
    only this ordering brings them together. The order comes from one half of the learnt lines, the shares of the
    cells from the other; from the same lines both would flatter the entry.
    """
    table = smooth_table(halves[0]).ravel()
    order = np.argsort(table / np.maximum(background, np.finfo(float).tiny), kind="stable")
    leaf = np.empty(order.size, dtype=np.int64)
    cells = 1 << _LEVELS
    leaf[order] = cells + np.minimum((np.cumsum(table[order]) * cells).astype(np.int64), cells - 1)
    learnt = np.zeros(2 * cells)
    np.add.at(learnt, leaf, halves[1].ravel())
    for node in range(cells - 1, 0, -1):
        learnt[node] = learnt[2 * node] + learnt[2 * node + 1]
    return Tree(leaf, learnt)


class Outsiders:
    """The outsider hypothesis beside a dictionary: half of it the trees', half of it `analysis.deviation`'s.

    Args:
        halves: gives an entry's learnt lines (2, chords, lengths, spreads) in two halves, by its number; asked only
            for entries that come to lead.
        background: (bins,) how probable each bin is for shapes at large.
        by_bin: (bins, entries) log-probability of each bin.
        classes: (entries,) number of the class of twins that an entry is in.
        weight: how many independent lines one line counts for in the trees. The mean gains need none: over simulated
            sessions with bounces their variance was 1.04 of that of independent lines.
    """

    def __init__(
        self,
        halves: Callable[[int], Floats],
        background: Floats,
        by_bin: Singles,
        classes: Ints,
        weight: float = 1.0,
    ) -> None:
        self._halves = halves
        self._background = background
        self._by_bin = by_bin
        self._classes = classes
        self._weight = weight
        self._trees: dict[int, list[Tree]] = {}
        self._deviations: dict[int, Deviation | None] = {}

    def probability(self, posterior: Sequence[float], seen: Floats, scale: float = 1.0) -> float:
        """Probability that the shape is none of the entries.

        Args:
            posterior: of each entry, given that the shape is one of them.
            seen: (bins,) weights of the lines in each bin.
            scale: how many lines a weight of 1 stands for.
        """
        bins = np.flatnonzero(seen)
        weights = scale * seen[bins]
        odds = -np.inf
        for entry, share in enumerate(posterior):
            if share >= _CANDIDATE:
                odds = np.logaddexp(odds, math.log(share) + self._evidence(entry, bins, weights))
        odds += math.log(OUTSIDER_PRIOR / (1 - OUTSIDER_PRIOR))
        return float(expit(odds))

    def _evidence(self, entry: int, bins: Ints, weights: Floats) -> float:
        """Log Bayes factor of an outsider like ``entry`` against it: the mean over the ways to look."""
        if entry not in self._trees:
            halves = self._halves(entry)
            whole = halves.sum(axis=0)
            self._trees[entry] = [grow(whole, 0), grow(whole, 1), *2 * [grow_by_level(halves, self._background)]]
        found = [evidence(tree, bins, self._weight * weights) for tree in self._trees[entry]]
        trees = float(np.logaddexp.reduce(found)) - math.log(len(found))
        if weights.sum() < FEWEST_LINES:
            return trees
        deviation = self._deviation(entry)
        other = 0.0 if deviation is None else deviation.evidence(bins, weights)
        return float(np.logaddexp(trees, other)) - math.log(2)

    def _deviation(self, entry: int) -> Deviation | None:
        """What the entry's lines do to the others; None where there are no others."""
        if entry not in self._deviations:
            others = self._classes != self._classes[entry]
            found = None
            if others.any():
                first, second = self._halves(entry)
                table = (1 - BACKGROUND) * smooth_table(first).ravel() + BACKGROUND * self._background
                own = np.log(np.maximum(table, np.finfo(np.float32).tiny))
                filled = np.flatnonzero(second)
                found = Deviation.of(own, self._by_bin[:, others], filled, second.ravel()[filled])
            self._deviations[entry] = found
        return self._deviations[entry]


def evidence(tree: Tree, bins: Ints, weights: Floats) -> float:
    """Log Bayes factor of an outsider against the entry, from lines in ``bins``, counted as ``weights``."""
    seen = np.bincount(tree.leaf[bins], weights=weights, minlength=tree.learnt.size).astype(float)
    return float(_evidence(seen, tree.learnt, _CONCENTRATIONS, _STOP))


@kernel
def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


@kernel
def _evidence(seen: Floats, learnt: Floats, concentrations: Floats, stop: float) -> float:
    """Sum the tree up from its leaves; ``seen`` is filled with the weights of the inner nodes."""
    log_factor = np.zeros(seen.size)
    for node in range(seen.size // 2 - 1, 0, -1):
        left, right = 2 * node, 2 * node + 1
        learnt_left, learnt_right = learnt[left] + 0.5, learnt[right] + 0.5
        if learnt[left] + learnt[right] == 0.0:
            continue
        seen[node] += seen[left] + seen[right]
        if seen[node] == 0.0:
            continue
        # The entry: the next share given the learnt ones.
        entry = _log_beta(learnt_left + seen[left], learnt_right + seen[right]) - _log_beta(learnt_left, learnt_right)
        share = learnt_left / (learnt_left + learnt_right)
        total = 0.0
        for concentration in concentrations:
            a, b = concentration * share, concentration * (1.0 - share)
            other = _log_beta(a + seen[left], b + seen[right]) - _log_beta(a, b)
            total += np.exp(min(other - entry, 600.0))
        deviates = np.log(total / concentrations.size) + log_factor[left] + log_factor[right]
        high = max(np.log(stop), np.log(1.0 - stop) + deviates)
        log_factor[node] = high + np.log(np.exp(np.log(stop) - high) + np.exp(np.log(1.0 - stop) + deviates - high))
    return log_factor[1]
