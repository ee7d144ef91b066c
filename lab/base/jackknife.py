"""The jackknife's standard error, for the sums of lines and for statistics of their places alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def jackknife_sigma(replicates: Floats) -> Floats:
    """Standard error (…) of a value whose replicates (groups, …) each lack one of equally large groups of lines.

    Efron, The Jackknife, the Bootstrap and Other Resampling Plans, Eq. 3.4.
    """
    groups = len(replicates)
    return np.sqrt((groups - 1) / groups * ((replicates - replicates.mean(axis=0)) ** 2).sum(axis=0))
