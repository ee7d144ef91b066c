"""Line and bow through the distances of a run's frames off a line, with errors that neighbouring frames may share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_MOST_CORRELATED = 0.95


@dataclass(frozen=True, slots=True, eq=False)
class Bow:
    """A straight line a + b u and a bow c (1 - u²) through distances off a line, u from -1 to 1 along it.

    ``straight`` (2,) holds a and b of the fit without the bow, ``bend`` is c; ``covariance`` (2, 2) is that of
    ``straight``, ``sigma_bend`` the error of c.
    """

    straight: Floats
    covariance: Floats
    bend: float
    sigma_bend: float


def fit_bow(u: Floats, off_cm: Floats, weight: Floats) -> Bow:
    """Fit by weighted least squares, with errors of neighbouring frames that may go together.

    The residuals are taken for an autoregression of first order, whose correlation r is put right for what the fit
    took out of it (Marriott and Pope 1954); r makes the variances of so slow functions (1 + r) / (1 - r) times as
    large as those of independent errors.
    """
    n = len(u)
    bow = np.column_stack([np.ones(n), u, 1.0 - u**2])
    weighted = bow * weight[:, None]
    # How each estimate answers to each frame's error; a bend is no error of the straight line.
    of_bow = np.linalg.solve(weighted.T @ bow, weighted.T)
    of_straight = np.linalg.solve(weighted[:, :2].T @ bow[:, :2], weighted[:, :2].T)
    fitted = of_bow @ off_cm
    residual = off_cm - bow @ fitted
    power = float(residual @ residual)
    apparent = float(residual[1:] @ residual[:-1]) / power if power > 0.0 else 0.0
    correlation = float(np.clip((apparent + 3.0 / n) / max(1.0 - 5.0 / n, 0.2), 0.0, _MOST_CORRELATED))
    variance = power / (n - 3) * (1.0 + correlation) / (1.0 - correlation)
    return Bow(
        straight=of_straight @ off_cm,
        covariance=variance * of_straight @ of_straight.T,
        bend=float(fitted[2]),
        sigma_bend=float(np.sqrt(variance * (of_bow[2] @ of_bow[2]))),
    )
