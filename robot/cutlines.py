"""Stored lines that contacts or stalls may have cut short, and the estimate that they make."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from robot.interrupted import InterruptedEstimator, path_per_cut


@dataclass(frozen=True, slots=True)
class CutLine:
    """One stored line.

    Attributes:
        s_cm: Where it crossed, distance from its start, rising.
        entering: For each crossing, whether it went from dark to light.
        starts_lit: Whether it began in the light.
        end_cm: Its length.
        cut: Whether, if it ended in the light, a contact or a stall ended it, rather than the arena's edge.
    """

    s_cm: Sequence[float]
    entering: Sequence[bool]
    starts_lit: bool
    end_cm: float
    cut: bool = True

    def into(self, estimator: InterruptedEstimator) -> None:
        """Take the line into the sums of ``estimator``. Raises ValueError when its points are out of order."""
        estimator.start_line(self.starts_lit)
        for s_cm, entering in zip(self.s_cm, self.entering, strict=True):
            estimator.crossing(s_cm, entering)
        estimator.end_line(self.end_cm, self.cut)


def estimate_interrupted(lines: Sequence[CutLine], path_per_cut_cm: float | None = None) -> InterruptedEstimator:
    """Weigh stored lines, of one robot or of all, under one L.

    Args:
        lines: The lines; they are gone through twice.
        path_per_cut_cm: L; found when not given, as the lit path per cut in the light.

    Raises:
        ValueError: A line's points are out of order, or L is not above 0.
    """
    found = path_per_cut_cm is None
    if path_per_cut_cm is None:
        first = InterruptedEstimator(math.inf)
        for line in lines:
            line.into(first)
        path_per_cut_cm = path_per_cut(first.lit_cm, first.cuts)
    estimator = InterruptedEstimator(path_per_cut_cm, found)
    for line in lines:
        line.into(estimator)
    return estimator
