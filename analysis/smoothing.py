"""Histograms of lines made smooth: as far as the lines themselves bear out, and no further."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Floats = NDArray[np.float64]

_BANDWIDTHS = (0.5, 0.25, 0.125, 0.0625, 0.0)  # shares of Scott's
_RATIO_BANDWIDTH = 0.4  # share of Scott's, for what tells near twins apart
BACKGROUND = 0.02  # share of lines that an entry leaves to what its table does not know


def smooth_table(counts: Floats) -> Floats:
    """Smooth a histogram of lines (chords, lengths, spreads), each number of chords by itself; it sums to 1.

    Single chords have one spread only, the first.
    """
    table = counts.copy()
    for chords in range(len(table)):
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


def smooth_alike(members: Sequence[Floats]) -> list[Floats]:
    """Smooth the histograms (chords, lengths, spreads) of near twins, such as a 6 and a 9; each sums to 1.

    Near twins share their ridges and teeth, which come from all their lines together; what tells them apart is
    smooth, and smoothed more. From tables made one by one the learning's noise would be most of their difference.
    """
    pooled = np.sum(members, axis=0)
    base = smooth_table(pooled)
    return [_bent(base, counts, pooled) for counts in members]


def _bent(base: Floats, counts: Floats, pooled: Floats) -> Floats:
    """A shared table times the smoothed ratio of a member's lines to all."""
    table = base.copy()
    for chords, (own, every) in enumerate(zip(counts, pooled, strict=True)):
        if every.sum() < 1:
            continue
        dimensions = 1 if chords == 0 else 2
        widths = [_spread_of(every.sum(axis=1)), 0.0 if chords == 0 else _spread_of(every.sum(axis=0))]
        bandwidth = [_RATIO_BANDWIDTH * width * max(own.sum(), 1.0) ** (-1 / (dimensions + 4)) for width in widths]
        smooth = np.asarray(ndimage.gaussian_filter(own, bandwidth, mode="reflect"), dtype=float)
        expected = np.asarray(ndimage.gaussian_filter(every, bandwidth, mode="reflect"), dtype=float)
        share = counts.sum() / pooled.sum()
        # where hardly a line fell, they differ in nothing
        table[chords] *= (smooth + 1e-3 * share) / (share * expected + 1e-3 * share)
    return table / table.sum()


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
    expected = (1 - BACKGROUND) * others[filled] + BACKGROUND / counts.size
    return float(counts[filled] @ np.log(expected)), smooth


def _spread_of(counts: Floats) -> float:
    """Standard deviation, in bins, of a histogram."""
    position = np.arange(counts.size)
    mean = np.average(position, weights=counts)
    return float(np.sqrt(np.average((position - mean) ** 2, weights=counts)))
