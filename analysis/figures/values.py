"""The plain values that figures and report share beside the tables: names, numbers and arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.estimate import Estimate

if TYPE_CHECKING:
    from analysis.montecarlo import Bands
    from analysis.quadrature import Moments

Floats = NDArray[np.float64]

Measured = Estimate  # A and P with their covariance, whoever measured them: the robot or the camera


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """A shape as statistical geometry sees it.

    ``covariance_per_line`` (2, 2) is that of (A cm², P cm) estimated from ONE crossing line (delta method); after N
    lines the estimates scatter with ``covariance_per_line / N``.
    """

    title: str
    area_cm2: float
    perimeter_cm: float
    covariance_per_line: Floats

    @classmethod
    def of(cls, title: str, moments: Moments) -> Entry:
        """Take what the figures need out of a shape's exact moments."""
        return cls(title, moments.area_cm2, moments.perimeter_cm, moments.covariance_at(1))

    def covariance_at(self, n: float) -> Floats:
        """Covariance (2, 2) of (A cm², P cm) after ``n`` crossing lines."""
        return self.covariance_per_line / n


def _no_runs() -> Floats:
    return np.empty((0, 0))


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Spread of A(N) and P(N) over simulated sessions.

    ``n`` (m,) crossing lines, ``levels`` (q,) quantile levels in rising order, ``area_cm2`` and ``perimeter_cm`` (q, m)
    the quantiles, ``runs`` the number of sessions behind them. ``area_runs_cm2`` and ``perimeter_runs_cm`` (r, m) are
    a few single sessions to draw, if any.
    """

    n: NDArray[np.int64]
    levels: Floats
    area_cm2: Floats
    perimeter_cm: Floats
    runs: int
    area_runs_cm2: Floats = field(default_factory=_no_runs)
    perimeter_runs_cm: Floats = field(default_factory=_no_runs)

    @classmethod
    def of(cls, bands: Bands, *, single_runs: int = 8) -> Band:
        """Take what the figures need out of a simulation."""
        return cls(
            bands.n,
            bands.quantile_levels,
            bands.area_quantiles_cm2,
            bands.perimeter_quantiles_cm,
            len(bands.area_runs_cm2),
            bands.area_runs_cm2[:single_runs],
            bands.perimeter_runs_cm[:single_runs],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Isotropy:
    """The test of the runs' randomness.

    ``u`` and ``v`` (n,) are each run's direction and place turned into numbers that are uniform on [0, 1) when the
    lines are isotropic and homogeneous. ``p_values`` maps a test's name to its p-value, corrected for the number of
    tests; ``passed`` is the tester's own conclusion and ``verdict`` its sentence.
    """

    u: Floats
    v: Floats
    p_values: Mapping[str, float] = field(default_factory=dict[str, float])
    passed: bool = True
    verdict: str = ""
