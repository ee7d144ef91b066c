"""The pixelwise median of pictures, by a sorting network: no pixel decides what is done next, so rows go at once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.uint8]

# Pixels of one picture at a time: those of fifteen pictures stay in the processor's cache.
_BAND_PIXELS = 32_768


@cache
def median_network(count: int) -> tuple[tuple[int, int, bool, bool], ...]:
    """Exchanges that bring the median of ``count`` values to place ``count // 2`` (the upper one of an even number).

    Batcher's odd-even merge sort (Knuth, The Art of Computer Programming 3, algorithm 5.2.2 M), without what the
    median does not need.

    Returns:
        (i, j, low, high) in order: with ``low`` place i takes the lesser of the two, with ``high`` place j the greater.
    """
    pairs: list[tuple[int, int]] = []
    top = (1 << (count - 1).bit_length()) >> 1
    p = top
    while p:
        q, r, d = top, 0, p
        while True:
            pairs += [(i, i + d) for i in range(count - d) if i & p == r]
            if q == p:
                break
            d, q, r = q - p, q // 2, p
        p //= 2
    asked = {count // 2}
    needed: list[tuple[int, int, bool, bool]] = []
    for i, j in reversed(pairs):
        if i in asked or j in asked:
            needed.append((i, j, i in asked, j in asked))
            asked |= {i, j}
    return tuple(reversed(needed))


def median_of(planes: Sequence[Plane]) -> Plane:
    """Take the pixelwise median of one or more planes (h, w) of the same size; of an even number the upper one."""
    rows, columns = planes[0].shape
    out: Plane = np.empty((rows, columns), dtype=np.uint8)
    network, height = median_network(len(planes)), max(1, _BAND_PIXELS // max(columns, 1))
    for top in range(0, rows, height):
        values = [plane[top : top + height].copy() for plane in planes]
        spare = np.empty_like(values[0])
        for i, j, low, high in network:
            one, other = values[i], values[j]
            if low and high:
                cv2.min(one, other, spare)
                cv2.max(one, other, other)
                values[i], spare = spare, one
            elif low:
                cv2.min(one, other, one)
            else:
                cv2.max(one, other, other)
        out[top : top + height] = values[len(planes) // 2]
    return out
