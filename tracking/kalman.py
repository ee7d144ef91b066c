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

# From how many measurements on the noise is learnt; what is believed before: medians and factors of one sigma.
_LEARN_FROM = 20
_Q_BEFORE_CM2_S3, _Q_FACTOR = 5.0, 10.0
_SCALE_FACTOR = 2.0
_LEARN_TO = 0.05  # in natural logarithms
_Q_RANGE, _SCALE_RANGE = (0.05, 1e3), (0.25, 1e5)


@dataclass(frozen=True, slots=True)
class KalmanSettings:
    """How the robot may move.

    Attributes:
        q_cm2_s3: spectral density of its acceleration (cm²/s³); the root is how far the speed wanders in a second.
            None: learnt from the track, with the scale of the measurements' variances.
        kick_cm_s: standard deviation of a velocity jump at a bounce or a sudden stop (cm/s).
        start_cm_s: standard deviation of the velocity at the start (cm/s).
        gate: a measurement with a larger normalised innovation squared (chi-squared, 2 degrees of freedom)
            is an outlier or a bounce; 16 passes 99.97 %.
        reference_until: tracks up to this length run on filterpy.
    """

    q_cm2_s3: float | None = None
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
    taken; ``kicked``: samples before which the velocity jumped. ``innovation_x`` and ``innovation_y``: what the
    forward filter had not foreseen of each measurement but the first, over the standard deviation that it stated,
    with the measurements' variances as they were given; NaN where there was none, and large for an outlier. Those of
    a true model are white, of variance 1. ``q_cm2_s3`` and ``scale``: the process noise that was used, and the factor
    that all measurements' variances were multiplied by before smoothing.
    """

    x_cm: Floats
    y_cm: Floats
    vx_cm_s: Floats
    vy_cm_s: Floats
    sigma_x_cm: Floats
    sigma_y_cm: Floats
    used: Flags
    kicked: Flags
    innovation_x: Floats
    innovation_y: Floats
    q_cm2_s3: float
    scale: float

    @property
    def nis(self) -> Floats:
        """Normalised innovations squared (n,), chi-squared with two degrees of freedom under a true model."""
        return self.innovation_x**2 + self.innovation_y**2


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
        var_x_cm2: (n,) variances of the measurements. They are taken as right among themselves; a common factor
            is learnt from the innovations, with q where the settings leave it open.
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
    columns, innovations = np.full((6, n), np.nan), np.full((2, n), np.nan)
    used, kicked = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    q, scale = settings.q_cm2_s3 or _Q_BEFORE_CM2_S3, 1.0
    seen = np.flatnonzero(np.isfinite(x) & np.isfinite(y) & (rx > 0) & (ry > 0))
    if len(seen):
        part = slice(int(seen[0]), int(seen[-1]) + 1)
        unseen = np.ones(n, dtype=bool)
        unseen[seen] = False
        x, y, rx, ry = (np.where(unseen, blank, a) for a, blank in ((x, np.nan), (y, np.nan), (rx, 1.0), (ry, 1.0)))
        track = (t[part], x[part], y[part], rx[part], ry[part])
        if len(seen) >= _LEARN_FROM:
            q, scale = learn_noise(*track, settings)
        rest = (settings.kick_cm_s**2, settings.start_cm_s**2, settings.gate)
        # With the gate open: where the variances are far too small, it would shut out what tells of it.
        opened = settings.gate * max(scale, 1.0)
        innovations[:, part] = plan(*track, q, *rest[:2], opened)[2].T
        scaled = (*track[:3], scale * track[3], scale * track[4])
        use, kick_var, _, _ = plan(*scaled, q, *rest)
        smoother = reference_axes if len(use) <= settings.reference_until else fast_axes
        columns[:, part] = smoother(*scaled, use, kick_var, q, rest[1])
        used[part], kicked[part] = use, kick_var > 0.0
        # Behind the last measurement that was taken lies nothing to lean on.
        last = int(np.flatnonzero(used)[-1])
        columns[:, last + 1 :] = np.nan
    x_innovation, y_innovation = innovations
    return Smoothed(
        *columns,
        used=used,
        kicked=kicked,
        innovation_x=x_innovation,
        innovation_y=y_innovation,
        q_cm2_s3=q,
        scale=scale,
    )


def learn_noise(
    t_s: Floats,
    x_cm: Floats,
    y_cm: Floats,
    var_x_cm2: Floats,
    var_y_cm2: Floats,
    settings: KalmanSettings = DEFAULT_SETTINGS,
) -> tuple[float, float]:
    """Give the process noise in cm²/s³, and the factor on the variances, that make a track's innovations likeliest.

    Maximum likelihood of the innovations (Bar-Shalom, Li & Kirubarajan 2001, ch. 11), with a wide log-normal prior on
    either, so that a short track does not run away; turns and outliers count for no more than the gate. Where the
    settings say q, only the factor is learnt.

    Args:
        t_s: (n,) times, rising, the first of a measurement.
        x_cm: (n,) measured positions, NaN where not seen.
        y_cm: likewise.
        var_x_cm2: (n,) variances as stated.
        var_y_cm2: likewise.
        settings: how the robot may move.
    """
    known = settings.q_cm2_s3
    arguments = (settings.kick_cm_s**2, settings.start_cm_s**2, settings.gate)

    def deviance(log_q: float, log_scale: float) -> float:
        if (known is None and log_q < np.log(_Q_RANGE[0]) - _LEARN_TO) or log_scale < np.log(_SCALE_RANGE[0]):
            return np.inf
        factor = np.exp(log_scale)
        cost = plan(t_s, x_cm, y_cm, factor * var_x_cm2, factor * var_y_cm2, np.exp(log_q), *arguments)[3]
        return (
            float(cost)
            + 0.5 * ((log_q - np.log(_Q_BEFORE_CM2_S3)) / np.log(_Q_FACTOR)) ** 2
            + 0.5 * (log_scale / np.log(_SCALE_FACTOR)) ** 2
        )

    qs = np.geomspace(_Q_RANGE[0], _Q_RANGE[1], 7) if known is None else np.array([known])
    scales = np.geomspace(_SCALE_RANGE[0], _SCALE_RANGE[1], 9)
    trials = [np.log([q, scale]) for q in qs for scale in scales]
    costs = [deviance(q, scale) for q, scale in trials]
    least, best = min(costs), trials[int(np.argmin(costs))]
    # Pattern search: the gate makes the deviance jump a little, which no gradient survives.
    step = np.array([0.0 if known is not None else 1.0, 1.0])
    while step[1] > _LEARN_TO:
        trials = [best + sign * move for move in np.diag(step) if move.any() for sign in (1.0, -1.0)]
        costs = [deviance(*trial) for trial in trials]
        if min(costs) < least:
            least, best = min(costs), trials[int(np.argmin(costs))]
        else:
            step = step / 2.0
    return float(np.exp(best[0])), float(np.exp(best[1]))


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
