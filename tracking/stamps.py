"""What a video's time stamps tell of the camera: its rate, frames that were lost, frames that came twice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

_ABOUT = 4
# Below this a step cannot be told from the error of two positions.
_LEAST_STEP_PX = 0.6


@dataclass(frozen=True, slots=True)
class Timing:
    """The rate and the faults of a video's stamps.

    Attributes:
        rate_hz: one over the mean of the single intervals; NaN with fewer than two frames.
        dropped: frames missing: an interval of n usual ones hides n - 1.
        duplicated: frames stamped no later than the one before, or not a third of an interval later.
        uneven: standard deviation of the intervals without those, as a share of the usual one: variable frame rate.
    """

    rate_hz: float
    dropped: int
    duplicated: int
    uneven: float


def timing_of(t_s: ArrayLike) -> Timing:
    """Judge the stamps (n,) of one video, in the order of its frames, in s."""
    stamps = np.asarray(t_s, dtype=float)
    intervals = np.diff(stamps)
    forward = intervals[intervals > 0.0]
    if len(forward) == 0:
        return Timing(float("nan"), 0, len(intervals), float("nan"))
    usual_s = float(np.median(forward))
    twice = intervals < usual_s / 3.0
    periods = intervals[~twice] / usual_s
    missed = np.maximum(np.rint(periods) - 1.0, 0.0)
    single = intervals[~twice][missed == 0.0]
    # The mean of the single intervals: a file's stamps are rounded, and so is their median.
    mean_s = float(np.mean(single)) if len(single) else usual_s
    uneven = float(np.std(single)) / mean_s if len(single) else 0.0
    return Timing(1.0 / mean_s, int(missed.sum()), int(twice.sum()), uneven)


def frozen(t_s: ArrayLike, x_px: ArrayLike, y_px: ArrayLike) -> NDArray[np.bool_]:
    """Find frames (n,) that show the picture before them again under a stamp of their own.

    A camera or an encoder fills gaps so. The robot seems to stand still for a frame and then to catch up: a step below
    a fifth of the usual one about it, followed by one that is longer than usual by more than half of what was missing.
    At rest nothing can be told, nor needs to be.
    """
    t, x, y = (np.asarray(values, dtype=float) for values in (t_s, x_px, y_px))
    same = np.zeros(len(t), dtype=bool)
    if len(t) < 2 * _ABOUT + 1:
        return same
    dt = np.diff(t)
    dx, dy = np.diff(x), np.diff(y)
    with np.errstate(divide="ignore", invalid="ignore"):
        speeds = np.where(dt > 0.0, np.hypot(dx, dy) / dt, np.nan)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(speeds, _ABOUT, constant_values=np.nan), 2 * _ABOUT + 1)
    known = np.isfinite(around).any(axis=1)
    usual = np.full(len(speeds), np.nan)
    usual[known] = np.nanmedian(around[known], axis=1)
    expected = usual * dt
    step = np.hypot(dx, dy)
    stands = (step < 0.2 * expected) & (expected > _LEAST_STEP_PX)
    # What stood still is made up for with the next step, or by the one after a row of standing frames.
    owed = 0.0
    first: int | None = None
    for number in range(len(step)):
        if stands[number]:
            first = number if first is None else first
            owed += expected[number] - step[number]
        elif first is not None:
            if step[number] > expected[number] + 0.5 * owed:
                same[first + 1 : number + 1] = True
            owed, first = 0.0, None
    return same
