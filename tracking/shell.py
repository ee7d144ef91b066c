"""What the ball's shell adds under the spot, learnt over the picture while the robot moves.

How the projected light is shifted on the ball against the floor follows from heights and from where camera and
projector hang: both are projections of planes, so it is an affine function of the place in the picture. So is, to
first order, everything else of the shell that a view from the side changes.
"""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import NDArray

from tracking.spot import Evidence, Shell
from tracking.spotkernels import SHELL_SIZE

Floats = NDArray[np.float64]

# Share, shift x and y (px), slope x and y, bulge: mean and spread before anything was seen, how much they may change
# over half a picture's width, and by how much a place departs from the affine law.
_MEAN = np.array([0.5, 0.0, 0.0, 0.0, 0.0, -0.01])
_SPREAD = np.array([0.4, 5.0, 5.0, 0.02, 0.02, 0.03])
_TILT = np.array([0.1, 8.0, 8.0, 0.04, 0.04, 0.01])
_DEPARTURE = np.array([0.02, 0.3, 0.3, 0.002, 0.002, 0.002])
# Successive frames show the same stretch of edge with the same faults: they are not independent witnesses.
_INDEPENDENT_SHARE = 0.25
_DEPARTURE_VARIANCE = np.diag(_DEPARTURE**2)
_CERTAIN = np.zeros((SHELL_SIZE, SHELL_SIZE))


class ShellField:
    """The shell's six parameters as affine functions of the place: ask ``at``, and teach with ``learn``.

    ``lessons`` counts what it was taught.

    Args:
        size: the picture's (width, height) in pixels.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        width, height = size
        self._middle = np.array([(width - 1) / 2.0, (height - 1) / 2.0])
        self._half = width / 2.0
        spread = np.column_stack([_SPREAD, _TILT, _TILT]).ravel()
        self._precision: Floats = np.diag(1.0 / spread**2)
        mean = np.zeros((SHELL_SIZE, 3))
        mean[:, 0] = _MEAN
        self._weighted: Floats = self._precision @ mean.ravel()
        self._mean: Floats = mean.ravel()
        self._covariance: Floats = np.diag(spread**2)
        self._stale = False
        self.lessons = 0

    def copy(self) -> ShellField:
        """Give a field that knows the same and goes on to learn by itself."""
        other = copy(self)
        other._precision, other._weighted = self._precision.copy(), self._weighted.copy()
        return other

    def at(self, x_px: float, y_px: float) -> Shell:
        """What to expect at a place."""
        if self._stale:
            self._covariance = np.asarray(np.linalg.inv(self._precision), dtype=float)
            self._mean = self._covariance @ self._weighted
            self._stale = False
        place = self._place(x_px, y_px)
        half = (self._covariance.reshape(-1, 3) @ place).reshape(SHELL_SIZE, 3, SHELL_SIZE)
        covariance = np.tensordot(place, half, (0, 1)) + _DEPARTURE_VARIANCE
        return Shell(self._mean.reshape(SHELL_SIZE, 3) @ place, np.asarray(np.linalg.inv(covariance), dtype=float))

    def mean_at(self, x_px: float, y_px: float) -> Shell:
        """As ``at``, but taken as known for sure: in a few microseconds."""
        if self._stale:
            return self.at(x_px, y_px)
        return Shell(self._mean.reshape(SHELL_SIZE, 3) @ self._place(x_px, y_px), _CERTAIN)

    def learn(self, x_px: float, y_px: float, evidence: Evidence) -> None:
        """Take in what a patch at a place said."""
        place = self._place(x_px, y_px)
        precision = _INDEPENDENT_SHARE * evidence.precision
        weighted = _INDEPENDENT_SHARE * evidence.weighted
        # The place's own departure dilutes it: (precision⁻¹ + departure²)⁻¹, in a form that a singular one can take.
        dilution = np.linalg.inv(np.eye(SHELL_SIZE) + precision * _DEPARTURE**2)
        # Each parameter is its three coefficients times (1, x, y): so is what is learnt of them.
        self._precision += _tensor(dilution @ precision, np.outer(place, place))
        self._weighted += np.outer(dilution @ weighted, place).ravel()
        self._stale = True
        self.lessons += 1

    def _place(self, x_px: float, y_px: float) -> Floats:
        return np.array([1.0, (x_px - self._middle[0]) / self._half, (y_px - self._middle[1]) / self._half])


def _tensor(one: Floats, other: Floats) -> Floats:
    """Kronecker's product, in a tenth of the time that NumPy's takes on matrices this small."""
    rows, columns = one.shape[0] * other.shape[0], one.shape[1] * other.shape[1]
    return (one[:, None, :, None] * other[None, :, None, :]).reshape(rows, columns)
