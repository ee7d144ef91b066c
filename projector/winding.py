"""How often outlines wind about points: a compiled loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lab.base.compiled import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def _count_turns(rings: Floats, starts: Ints, points: Floats, out: Ints) -> None:
    for ring in range(starts.size - 1):
        first, last = starts[ring], starts[ring + 1]
        low_x, high_x = rings[first:last, 0].min(), rings[first:last, 0].max()
        low_y, high_y = rings[first:last, 1].min(), rings[first:last, 1].max()
        for i in range(out.size):
            x, y = points[i, 0], points[i, 1]
            if not (low_x <= x <= high_x and low_y <= y <= high_y):
                continue
            for j in range(first, last - 1):
                ax, ay, bx, by = rings[j, 0], rings[j, 1], rings[j + 1, 0], rings[j + 1, 1]
                if (ay <= y) == (by <= y):
                    continue
                # > 0: the point lies left of the edge
                side = (bx - ax) * (y - ay) - (x - ax) * (by - ay)
                if ay <= y and side > 0:
                    out[i] += 1
                elif ay > y and side < 0:
                    out[i] -= 1


count_turns = compiled(nogil=True, error_model="numpy")(_count_turns)
"""Add to ``out`` (n,) how often the closed ``rings`` turn counter-clockwise about each of ``points`` (n, 2).

``rings`` (m, 2) are the vertices end to end, each ring closed; ring i runs from ``starts[i]`` to ``starts[i + 1]``.
By the crossings of the ray to the right.
"""
