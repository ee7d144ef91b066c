"""Whether the robot's runs are straight: the bow that all share, and the bows of each run's own.

A bow is measured as its curvature, so that runs of every length speak of the same thing: a robot that turns by so much
for each cm rolled. The mean over runs is a steady turn (a gyro's bias, a lens not undone); the scatter beyond the
measurement's errors is a turn drawn anew for each run. Both by the random-effects model of DerSimonian and Laird
(1986).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import chi2
from scipy.stats import t as student

from tracking.runs import column

_FEWEST_RUNS = 5


@dataclass(frozen=True, slots=True)
class Straightness:
    """How far the runs of a session bow; left of the way they go is positive.

    Attributes:
        runs: runs whose bow could be measured.
        length_cm: their mean length, which the bows in cm are for.
        curvature_rad_cm: mean turn for each cm rolled, with its standard error ``curvature_sigma_rad_cm``.
        bend_cm: how far a run of mean length bows out at its middle by that, with its 95 % interval.
        p_value: of there being no steady turn.
        own_rad_cm: standard deviation of the runs' own turns, once the measurement's errors are taken off.
        own_bend_cm: the bow in cm that it means.
        own_p_value: of there being none but measurement errors (Cochran's Q).
        verdict: one plain line.
    """

    runs: int
    length_cm: float
    curvature_rad_cm: float
    curvature_sigma_rad_cm: float
    bend_cm: float
    bend_interval_cm: tuple[float, float]
    p_value: float
    own_rad_cm: float
    own_bend_cm: float
    own_p_value: float
    verdict: str

    @property
    def significant(self) -> bool:
        """Whether the runs share a turn (5 %)."""
        return self.p_value < 0.05

    def to_dict(self) -> dict[str, Any]:
        """The JSON form."""
        values: dict[str, Any] = {name: getattr(self, name) for name in self.__slots__}
        return values | {"bend_interval_cm": list(self.bend_interval_cm), "significant": self.significant}


def straightness(lines: pd.DataFrame) -> Straightness | None:
    """Judge the runs of a session.

    Args:
        lines: from `fit_lines`; rows without a measured bow are left out.

    Returns:
        The judgement, or None below five runs.

    Raises:
        TrackError: a column is missing.
    """
    bend, sigma, length = (column(lines, name) for name in ("bend_cm", "sigma_bend_cm", "length_cm"))
    known = np.isfinite(bend) & (sigma > 0.0) & (length > 0.0)
    many = int(known.sum())
    if many < _FEWEST_RUNS:
        return None
    # A bow h at the middle of a run of length L is an arc of curvature 8 h / L²; a turn to the left bows to the right.
    to_curvature = -8.0 / length[known] ** 2
    curvature, variance = bend[known] * to_curvature, (sigma[known] * to_curvature) ** 2
    weight = 1.0 / variance
    spread = float(weight @ (curvature - np.average(curvature, weights=weight)) ** 2)  # Cochran's Q
    between = max(0.0, (spread - (many - 1)) / float(weight.sum() - (weight**2).sum() / weight.sum()))
    weight = 1.0 / (variance + between)
    mean = float(np.average(curvature, weights=weight))
    # Hartung and Knapp (2001): the error from the runs' own scatter, with Student's t.
    error = float(np.sqrt(weight @ (curvature - mean) ** 2 / ((many - 1) * weight.sum())))
    reach = float(student.ppf(0.975, many - 1)) * error
    p_value = float(2.0 * student.sf(abs(mean) / error, many - 1)) if error > 0.0 else float(mean == 0.0)
    mean_length = float(length[known].mean())
    to_bend = -(mean_length**2) / 8.0
    own_p = float(chi2.sf(spread, many - 1))
    return Straightness(
        runs=many,
        length_cm=mean_length,
        curvature_rad_cm=mean,
        curvature_sigma_rad_cm=error,
        bend_cm=mean * to_bend,
        bend_interval_cm=((mean + reach) * to_bend, (mean - reach) * to_bend),
        p_value=p_value,
        own_rad_cm=float(np.sqrt(between)),
        own_bend_cm=float(np.sqrt(between)) * abs(to_bend),
        own_p_value=own_p,
        verdict=_verdict(mean * to_bend, reach * abs(to_bend), p_value, float(np.sqrt(between)) * abs(to_bend), own_p),
    )


def _verdict(bend_cm: float, reach_cm: float, p_value: float, own_cm: float, own_p: float) -> str:
    shared = (
        f"runs bow to the {'left' if bend_cm > 0 else 'right'} by {abs(bend_cm):.2f} ± {reach_cm:.2f} cm at the middle"
        if p_value < 0.05
        else f"runs share no bow (less than {abs(bend_cm) + reach_cm:.2f} cm at the middle)"
    )
    own = f"each run's own is {own_cm:.2f} cm" if own_p < 0.05 else "each run's own drowns in the camera's error"
    return f"{shared}; {own}"
