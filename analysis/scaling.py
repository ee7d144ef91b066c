"""How the scatter falls as lines are added: a power law through simulated runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lab.base.errors import RequestError

Floats = NDArray[np.float64]

_RESAMPLES = 200


@dataclass(frozen=True, slots=True)
class PowerLaw:
    """σ(N) = prefactor · N^slope, fitted.

    Attributes:
        slope: −1/2 for a mean of independent lines.
        slope_sigma: its standard error, from resampled runs.
        prefactor: σ_0, the scatter of one line, with the slope held at −1/2.
        prefactor_sigma: its standard error.
    """

    slope: float
    slope_sigma: float
    prefactor: float
    prefactor_sigma: float


def fit_scatter(n: ArrayLike, runs: ArrayLike, rng: np.random.Generator, *, first: float = 30) -> PowerLaw:
    """Fit the standard deviation over ``runs`` (runs, checkpoints) of an estimate at the ``n`` (checkpoints,) lines.

    Least squares in (log N, log σ) over the checkpoints from ``first`` lines on; below, ratios of means are not
    normal yet. Each run grows from its own lines, so that the checkpoints are not independent: the errors come from
    fitting resampled runs (bootstrap).

    Raises:
        RequestError: fewer than three runs, or than two checkpoints from ``first`` lines on.
    """
    lines, values = np.asarray(n, dtype=float), np.asarray(runs, dtype=float)
    late = lines >= first
    if len(values) < 3 or np.count_nonzero(late) < 2:
        raise RequestError(f"a power law needs 3 runs and 2 checkpoints from {first:g} lines on; simulate more")
    lines, values = lines[late], values[:, late]
    slope, prefactor = _fit(lines, values)
    picks = rng.integers(0, len(values), (_RESAMPLES, len(values)))
    slopes, prefactors = np.transpose([_fit(lines, values[pick]) for pick in picks])
    return PowerLaw(slope, float(np.std(slopes, ddof=1)), prefactor, float(np.std(prefactors, ddof=1)))


def _fit(lines: Floats, values: Floats) -> tuple[float, float]:
    log_n, log_sigma = np.log(lines), np.log(values.std(axis=0, ddof=1))
    centred = log_n - log_n.mean()
    slope = float(centred @ log_sigma / (centred @ centred))
    return slope, float(np.exp((log_sigma + 0.5 * log_n).mean()))
