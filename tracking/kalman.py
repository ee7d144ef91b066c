"""Kalman smoothing of a track: constant velocity, uneven steps, gaps, outliers and bounces.

Forward filter and Rauch-Tung-Striebel backward pass. x and y do not mix in this model, so long tracks run through
the written-out recursions of ``tracking.recursion``; short ones run on filterpy, which is the reference: both give the
same numbers (a test holds them to 1e-9).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lab.base.errors import RequestError
from tracking.recursion import plan, process_noise, smooth_axis

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Median of chi-squared with two degrees of freedom: where the normalised innovations of a true model lie.
_MEDIAN_NIS = 2.0 * float(np.log(2.0))
# How often and from how many measurements the variances are put right.
_RESCALE_AT_MOST, _RESCALE_FROM = 6, 20


@dataclass(frozen=True, slots=True)
class KalmanSettings:
    """How the robot may move.

    Attributes:
        q_cm2_s3: spectral density of its acceleration (cm²/s³); the root is how far the speed wanders in a second.
        kick_cm_s: standard deviation of a velocity jump at a bounce or a sudden stop (cm/s).
        start_cm_s: standard deviation of the velocity at the start (cm/s).
        gate: a measurement with a larger normalised innovation squared (chi-squared, 2 degrees of freedom)
            is an outlier or a bounce; 16 passes 99.97 %.
        reference_until: tracks up to this length run on filterpy.
    """

    q_cm2_s3: float = 50.0
    kick_cm_s: float = 40.0
    start_cm_s: float = 40.0
    gate: float = 16.0
    reference_until: int = 60


DEFAULT_SETTINGS = KalmanSettings()


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """A smoothed track; every array is (n,), one entry a row that was given.

    Positions and sigmas in cm, velocities in cm/s. NaN before the first and after the last measurement that was
    taken; gaps between are bridged, with sigmas that say how far to trust it. ``used``: measurements that were
    taken; ``kicked``: samples before which the velocity jumped.
    """

    x_cm: Floats
    y_cm: Floats
    vx_cm_s: Floats
    vy_cm_s: Floats
    sigma_x_cm: Floats
    sigma_y_cm: Floats
    used: Flags
    kicked: Flags


def smooth_track(
    t_s: ArrayLike,
    x_cm: ArrayLike,
    y_cm: ArrayLike,
    var_x_cm2: ArrayLike,
    var_y_cm2: ArrayLike,
    settings: KalmanSettings = DEFAULT_SETTINGS,
) -> Smoothed:
    """Smooth a track.

    Args:
        t_s: (n,) times in s, rising; uneven steps are fine.
        x_cm: (n,) measured positions, NaN where not seen.
        y_cm: likewise.
        var_x_cm2: (n,) variances of the measurements. They are taken as right among themselves; where the
            innovations are larger than they allow, all are scaled up together.
        var_y_cm2: likewise.
        settings: how the robot may move.

    Raises:
        RequestError: the arrays differ in length or the times do not rise.
    """
    t, x, y, rx, ry = (
        np.ascontiguousarray(np.asarray(a, dtype=float)) for a in (t_s, x_cm, y_cm, var_x_cm2, var_y_cm2)
    )
    if not len(t) == len(x) == len(y) == len(rx) == len(ry):
        raise RequestError("a track's times, positions and variances must be equally many; give one of each a frame")
    if len(t) > 1 and not (np.diff(t) > 0).all():
        raise RequestError("a track's times must rise from frame to frame; sort the frames by t_s, one row each")
    n = len(t)
    columns = np.full((6, n), np.nan)
    used, kicked = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    seen = np.flatnonzero(np.isfinite(x) & np.isfinite(y) & (rx > 0) & (ry > 0))
    if len(seen):
        part = slice(int(seen[0]), int(seen[-1]) + 1)
        x, y = x.copy(), y.copy()
        unseen = np.ones(n, dtype=bool)
        unseen[seen] = False
        x[unseen], y[unseen], rx[unseen], ry[unseen] = np.nan, np.nan, 1.0, 1.0
        columns[:, part], used[part], kicked[part] = _smooth(t[part], x[part], y[part], rx[part], ry[part], settings)
        # Behind the last measurement that was taken lies nothing to lean on.
        last = int(np.flatnonzero(used)[-1])
        columns[:, last + 1 :] = np.nan
    return Smoothed(*columns, used=used, kicked=kicked)


def _smooth(
    t: Floats, x: Floats, y: Floats, rx: Floats, ry: Floats, settings: KalmanSettings
) -> tuple[Floats, Flags, Flags]:
    start_var = settings.start_cm_s**2
    arguments = (settings.q_cm2_s3, settings.kick_cm_s**2, start_var, settings.gate)
    for _ in range(_RESCALE_AT_MOST):
        # With the gate open: where the variances are far too small, it would shut out most of the track.
        _, _, nis = plan(t, x, y, rx, ry, *arguments[:3], np.inf)
        usual = nis[np.isfinite(nis)]
        scale = float(np.median(usual)) / _MEDIAN_NIS if len(usual) >= _RESCALE_FROM else 1.0
        if scale < 1.1:
            break
        rx, ry = rx * scale, ry * scale
    use, kick_var, _ = plan(t, x, y, rx, ry, *arguments)
    smoother = reference_axes if len(t) <= settings.reference_until else fast_axes
    return smoother(t, x, y, rx, ry, use, kick_var, settings.q_cm2_s3, start_var), use, kick_var > 0.0


def fast_axes(
    t: Floats, x: Floats, y: Floats, rx: Floats, ry: Floats, use: Flags, kick_var: Floats, q: float, start_var: float
) -> Floats:
    """Smooth both axes by the written-out recursions: (6, n) rows x, y, vx, vy, sigma x, sigma y."""
    ax, avx, acov = smooth_axis(t, x, rx, use, kick_var, q, start_var)
    ay, avy, bcov = smooth_axis(t, y, ry, use, kick_var, q, start_var)
    return np.vstack([ax, ay, avx, avy, np.sqrt(acov[:, 0]), np.sqrt(bcov[:, 0])])


def reference_axes(
    t: Floats, x: Floats, y: Floats, rx: Floats, ry: Floats, use: Flags, kick_var: Floats, q: float, start_var: float
) -> Floats:
    """Smooth both axes with filterpy, state (x, vx, y, vy): the same rows as ``fast_axes``."""
    steps = np.diff(t, prepend=t[0])
    transitions: list[Floats] = []
    noises: list[Floats] = []
    measured: list[Floats | None] = []
    spreads: list[Floats] = []
    for k, step in enumerate(steps):
        transitions.append(_both_axes(1.0, float(step), 0.0, 1.0))
        xx, xv, vv = process_noise(float(step), q, float(kick_var[k])) if k else (0.0, 0.0, 0.0)
        noises.append(_both_axes(xx, xv, xv, vv))
        # NaN would poison filterpy's state without a word; None means no measurement.
        measured.append(np.array([[x[k]], [y[k]]]) if use[k] and k else None)
        spreads.append(np.diag([rx[k], ry[k]]))
    start = np.array([[x[0]], [0.0], [y[0]], [0.0]])
    means, covariances = _filterpy(
        start, np.diag([rx[0], start_var, ry[0], start_var]), transitions, noises, measured, spreads
    )
    return np.vstack(
        [
            means[:, 0],
            means[:, 2],
            means[:, 1],
            means[:, 3],
            np.sqrt(covariances[:, 0, 0]),
            np.sqrt(covariances[:, 2, 2]),
        ]
    )


def _both_axes(xx: float, xv: float, vx: float, vv: float) -> Floats:
    """The (4, 4) matrix that does [[xx, xv], [vx, vv]] to either axis."""
    return np.array([[xx, xv, 0.0, 0.0], [vx, vv, 0.0, 0.0], [0.0, 0.0, xx, xv], [0.0, 0.0, vx, vv]])


def _filterpy(
    start: Floats,
    spread: Floats,
    transitions: list[Floats],
    noises: list[Floats],
    measured: list[Floats | None],
    spreads: list[Floats],
) -> tuple[Floats, Floats]:
    """Run filterpy forward and backward: means (n, 4), covariances (n, 4, 4)."""
    from filterpy.kalman import KalmanFilter  # noqa: PLC0415 # pyright: ignore[reportMissingTypeStubs]

    # filterpy carries no types, so it is met here and nowhere else.
    untyped: Any = KalmanFilter
    kalman: Any = untyped(dim_x=4, dim_z=2)
    kalman.x = start
    kalman.P = spread
    kalman.H = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    means, covariances, _, _ = kalman.batch_filter(measured, Fs=transitions, Qs=noises, Rs=spreads)
    smooth, smooth_covariances, _, _ = kalman.rts_smoother(means, covariances, Fs=transitions, Qs=noises)
    return np.asarray(smooth, dtype=float)[:, :, 0], np.asarray(smooth_covariances, dtype=float)
