"""Random lines across simple shapes, an estimator rolled over them, and the sums by their definition."""

import math
from fractions import Fraction
from itertools import combinations

import numpy as np

from robot.onboard import Estimator


def signed_pair_sum(s_cm, n):
    """Eq. 1's L_n over all pairs of crossings, O(k^2), exact in rational numbers."""
    total = Fraction(0)
    for (i, a), (j, b) in combinations(enumerate(s_cm), 2):
        total += (1 if (i + j) % 2 else -1) * abs(Fraction(b) - Fraction(a)) ** n
    return total


def roll(estimator, s_cm, weight=1.0):
    estimator.start_line()
    for order, s in enumerate(s_cm):
        estimator.crossing(s, order % 2 == 0)
    return estimator.end_line(None, weight)


def rolled(lines, **kept):
    estimator = Estimator(**kept)
    for s_cm in lines:
        roll(estimator, s_cm)
    return estimator


def disc_lines(n, radius, rng):
    half = np.sqrt(radius**2 - rng.uniform(-radius, radius, n) ** 2)
    return np.column_stack([-half, half]).tolist()


def annulus_lines(n, outer, inner, rng):
    p = rng.uniform(-outer, outer, n)
    half = np.sqrt(outer**2 - p**2)
    hole = np.sqrt(np.maximum(inner**2 - p**2, 0.0))
    return [[-h, -g, g, h] if g > 0 else [-h, h] for h, g in zip(half.tolist(), hole.tolist(), strict=True)]


def square_lines(n, side, rng):
    """Uniform lines that meet a square, by clipping those that meet its circumscribed circle."""
    half, lines = side / 2, []
    while len(lines) < n:
        theta, p = rng.uniform(0, math.pi), rng.uniform(-half * math.sqrt(2), half * math.sqrt(2))
        x, y, dx, dy = p * math.cos(theta), p * math.sin(theta), -math.sin(theta), math.cos(theta)
        slab_x = sorted(((-half - x) / dx, (half - x) / dx))
        slab_y = sorted(((-half - y) / dy, (half - y) / dy))
        entry, leave = max(slab_x[0], slab_y[0]), min(slab_x[1], slab_y[1])
        if entry < leave:
            lines.append([entry, leave])
    return lines
