"""The likelihood landscape: what an estimate anywhere in the (P, A) plane would say, and after how many lines.

For the paper's recogniser alone, whose answer depends on (P, A) and N and on nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.confusion import fewest_lines
from analysis.recognition import FIRST_POSTERIOR_N, GaussianRecogniser

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_VALUES_AT_ONCE = 2_000_000  # bounds the memory
_SPOKES, _RINGS = 24, 24
_STEPS_PER_DECADE = 12


@dataclass(frozen=True, slots=True, eq=False)
class Domains:
    """Who leads where.

    Attributes:
        perimeter_cm: (columns,).
        area_cm2: (rows,).
        n: crossing lines behind each estimate.
        leader: (rows, columns) index of the likeliest entry.
        posterior: (rows, columns) its probability.
    """

    perimeter_cm: Floats
    area_cm2: Floats
    n: float
    leader: Ints
    posterior: Floats


def domains(recogniser: GaussianRecogniser, perimeter_cm: Floats, area_cm2: Floats, n: float) -> Domains:
    """Ask the recogniser at every point of a grid (columns,) x (rows,), as if ``n`` lines had led there."""
    leader = np.empty((area_cm2.size, perimeter_cm.size), dtype=np.int64)
    posterior = np.empty(leader.shape)
    rows = max(1, _VALUES_AT_ONCE // (perimeter_cm.size * len(recogniser.names)))
    for first in range(0, area_cm2.size, rows):
        part = slice(first, first + rows)
        area, perimeter = np.meshgrid(area_cm2[part], perimeter_cm, indexing="ij")
        found = recogniser.landscape(area, perimeter, n)
        leader[part] = found.argmax(axis=-1)
        posterior[part] = found.max(axis=-1)
    return Domains(perimeter_cm, area_cm2, n, leader, posterior)


def lines_to_confidence(
    recogniser: GaussianRecogniser,
    perimeter_cm: Floats,
    area_cm2: Floats,
    *,
    confidence: float = 0.95,
    most: float = 1e5,
) -> Floats:
    """Lines (rows, columns) from which on an estimate that stays at this point names an entry with ``confidence``.

    At least `FIRST_POSTERIOR_N`; NaN where even ``most`` lines do not do, as half way between two entries. Between
    the N that are tried, the log odds of the leader against all others are interpolated.
    """
    decades = np.log10(most / FIRST_POSTERIOR_N)
    tried = np.geomspace(FIRST_POSTERIOR_N, most, int(np.ceil(decades * _STEPS_PER_DECADE)) + 1)
    asked = np.log(confidence / (1 - confidence))
    reached = np.full((area_cm2.size, perimeter_cm.size), np.nan)
    above = np.zeros(reached.shape)
    holds = np.ones(reached.shape, dtype=bool)
    # from the largest N down, as long as the confidence holds
    for n, later in zip(tried[::-1], [np.nan, *tried[:0:-1]], strict=True):
        posterior = domains(recogniser, perimeter_cm, area_cm2, float(n)).posterior
        odds = np.log(np.maximum(posterior, 1e-300)) - np.log(np.maximum(1 - posterior, 1e-300))
        falls = holds & (odds < asked)
        if np.isfinite(later):
            share = (asked - odds[falls]) / np.maximum(above[falls] - odds[falls], 1e-12)
            reached[falls] = n * (later / n) ** share
        holds &= ~falls
        above = odds
    reached[holds] = FIRST_POSTERIOR_N
    return reached


def lines_to_be_sure(
    recogniser: GaussianRecogniser, entry: int, covariance: Floats, centre: tuple[float, float], *, share: float = 0.95
) -> int | None:
    """Lines after which the ``entry``, when true, is given 95 % or more in a ``share`` of all runs; None for never.

    Stricter than being the likeliest: it is when a robot that waits for 95 % may stop. ``covariance`` (2, 2) is that
    of (A cm², P cm) for one line and ``centre`` (A, P); the estimates are taken as normal.
    """
    radius = np.sqrt(-2 * np.log1p(-(np.arange(_RINGS) + 0.5) / _RINGS))
    phase = (np.arange(_SPOKES) + 0.5) * 2 * np.pi / _SPOKES
    points = np.stack([np.outer(radius, np.cos(phase)).ravel(), np.outer(radius, np.sin(phase)).ravel()])
    spread = np.linalg.cholesky(covariance) @ points

    def missed(n: float) -> float:
        area, perimeter = np.array(centre)[:, None] + spread / np.sqrt(n)
        return float((recogniser.landscape(area, perimeter, n)[:, entry] < 0.95).mean())

    return fewest_lines(missed, 1 - share)
