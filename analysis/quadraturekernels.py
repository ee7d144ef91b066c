"""Compiled inner loop of the quadrature: all lines of one direction, exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.kernels import chord_moments, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

N_INTEGRALS = 21

# Gauss–Legendre on [0, 1], six points: exact to degree 11, and 𝓛_5² is of degree 10 in p.
_NODES_P = np.array([(1.0 + x) / 2 for x in np.polynomial.legendre.leggauss(6)[0]])
_WEIGHTS_P = np.array([w / 2 for w in np.polynomial.legendre.leggauss(6)[1]])


@kernel
def direction_integrals(theta_rad: Floats, x_cm: Floats, y_cm: Floats, previous: Ints, following: Ints) -> Floats:
    """Integrate over p, exactly, for every direction: returns (n, 21).

    With q = ([hit], k, 𝓛_1, 𝓛_3, 𝓛_4, 𝓛_5) the columns are ∫ q_a q_b dp, a ≤ b, row by row of the upper triangle: the
    first six are ∫q. The vertices' projections cut the p axis into strips in which the same edges are crossed and
    every crossing is linear in p.
    ``previous`` and ``following`` are each vertex' neighbours in its ring; edge i runs from vertex i to
    ``following[i]``.
    """
    n = x_cm.size
    out = np.zeros((theta_rad.size, 21))
    sums = np.empty(14)
    order = np.arange(n)
    p = np.empty(n)
    t = np.empty(n)
    active = np.empty(n, np.int64)
    middle = np.empty(n)
    low = np.empty(n)
    rise = np.empty(n)
    crossings = np.empty(n)
    is_active = np.zeros(n, np.bool_)
    for row in range(theta_rad.size):
        cos = np.cos(theta_rad[row])
        sin = np.sin(theta_rad[row])
        for i in range(n):
            p[i] = x_cm[i] * cos + y_cm[i] * sin
            t[i] = y_cm[i] * cos - x_cm[i] * sin
        if row == 0:
            order[:] = np.argsort(p)
        else:  # neighbouring directions keep almost the same order
            for i in range(1, n):
                vertex = order[i]
                j = i - 1
                while j >= 0 and p[order[j]] > p[vertex]:
                    order[j + 1] = order[j]
                    j -= 1
                order[j + 1] = vertex
        is_active[:] = False
        m = 0
        for rank in range(n - 1):
            vertex = order[rank]
            for side in range(2):
                edge = vertex if side == 0 else previous[vertex]
                if is_active[edge]:
                    is_active[edge] = False
                    j = 0
                    while active[j] != edge:
                        j += 1
                    m -= 1
                    for i in range(j, m):
                        active[i] = active[i + 1]
                else:
                    is_active[edge] = True
                    active[m] = edge
                    m += 1
            p_low = p[vertex]
            width = p[order[rank + 1]] - p_low
            if width <= 0.0 or m < 2:
                continue
            for i in range(m):
                edge = active[i]
                end = following[edge]
                slope = (t[end] - t[edge]) / (p[end] - p[edge])
                at_low = t[edge] + (p_low - p[edge]) * slope
                at_middle = at_low + 0.5 * width * slope
                j = i - 1
                while j >= 0 and middle[j] > at_middle:
                    active[j + 1] = active[j]
                    middle[j + 1] = middle[j]
                    low[j + 1] = low[j]
                    rise[j + 1] = rise[j]
                    j -= 1
                active[j + 1] = edge
                middle[j + 1] = at_middle
                low[j + 1] = at_low
                rise[j + 1] = width * slope
            sums[:] = 0.0
            for node in range(6):
                for i in range(m):
                    crossings[i] = low[i] + _NODES_P[node] * rise[i]
                _, l1, l3, l4, l5 = chord_moments(crossings, 0, m)
                weight = width * _WEIGHTS_P[node]
                w1, w3, w4, w5 = weight * l1, weight * l3, weight * l4, weight * l5
                sums[0] += w1
                sums[1] += w3
                sums[2] += w4
                sums[3] += w5
                sums[4] += w1 * l1
                sums[5] += w1 * l3
                sums[6] += w1 * l4
                sums[7] += w1 * l5
                sums[8] += w3 * l3
                sums[9] += w3 * l4
                sums[10] += w3 * l5
                sums[11] += w4 * l4
                sums[12] += w4 * l5
                sums[13] += w5 * l5
            chords = m // 2  # the same all over the strip
            out[row, 0] += width
            out[row, 1] += width * chords
            out[row, 6] += width * chords * chords
            for i in range(4):
                out[row, 2 + i] += sums[i]
                out[row, 7 + i] += chords * sums[i]
            for i in range(10):
                out[row, 11 + i] += sums[4 + i]
    return out
