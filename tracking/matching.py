"""How the robot's crossings compare with the true ones.

Chords are compared, not areas: a chord is what one line lights between an entering and the next leaving
crossing, and the robot's chords differ from the true ones by reasons that show in their statistics:
threshold and footprint (bias), odometry (scale), sampling and noise (spread), missed chords.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lab.base.blandaltman import WITHIN_LIMITS, BlandAltman, bland_altman
from tracking.chords import MARGIN_CM, Alignment, align, chord_table
from tracking.clusters import clustered_mean
from tracking.runs import column

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

PAIRS = (
    "line",
    "robot_length_cm",
    "true_length_cm",
    "difference_cm",
    "mean_length_cm",
    "robot_centre_cm",
    "true_centre_cm",
    "x_cm",
    "y_cm",
    "offset_cm",
    "overlap",
    "sigma_true_cm",
    "sure",
    "late_in_s",
    "late_out_s",
)
_SLACK_CM = 2.0  # how far one line's offset may stray from the median offset
_FEWEST_FOR_SCALE = 8
_LARGEST_SCALE_ERROR = 0.25
_SCALE_ROUNDS = 3  # more chords match once the scale is nearly right
_STRAYS = 5.0  # robust standard deviations beyond which a delay belongs to a mismatched edge


@dataclass(frozen=True, slots=True)
class Latency:
    """How late the robot's crossings of one kind are: mean in s, its error, spread of one (1.4826 MAD), how many.

    Chords of one line share the error of its clocks, so the mean's error is taken from line to line.
    """

    mean_s: float
    sigma_s: float
    jitter_s: float
    crossings: int

    def to_dict(self) -> dict[str, Any]:
        """The JSON form; NaN becomes None."""
        values = {name: getattr(self, name) for name in self.__slots__}
        return {name: _known(value) if isinstance(value, float) else value for name, value in values.items()}


def latency(late_s: Floats, line: Floats) -> Latency:
    """Sum up delays (n,) of crossings on lines (n,); mismatched edges, far beyond the rest, are left out."""
    known = np.isfinite(late_s)
    if not known.any():
        return Latency(np.nan, np.nan, np.nan, 0)
    middle = float(np.median(late_s[known]))
    jitter = 1.4826 * float(np.median(np.abs(late_s[known] - middle)))
    known &= np.abs(late_s - middle) <= _STRAYS * jitter + 1e-9
    mean = clustered_mean(late_s[known], line[known])
    return Latency(mean.value, mean.sigma, jitter, int(known.sum()))


@dataclass(frozen=True, slots=True, eq=False)
class ChordMatch:
    """The robot's chords against the true ones.

    ``missed`` and ``extra`` count chords that only the camera or only the robot saw; of them ``missed_unsure`` and
    ``extra_unsure`` are no fault of the robot's that the camera could prove: slivers along an edge that are there or
    not within the error of the camera's line. Lengths are compared over the matched chords that are ``sure``:
    ``bias_cm``, ``sd_cm`` and ``rms_cm`` are of robot minus true length, ``limits_cm`` the limits of agreement, bias
    +- 1.96 sd, and ``agreement`` has their intervals and the trend (Bland and Altman 1999; None below two chords).
    ``camera_sd_cm`` is the part of sd that is the camera's own error (rms). ``scale`` is the slope of robot on true
    length with its standard error, ``offset_cm`` the median over the chords of camera minus scaled robot
    distance along the run, ``offset_s`` the median of robot minus true crossing time and ``jitter_s``
    its spread (1.4826 MAD); ``entering`` and ``leaving`` are the same for either kind, with errors. What could not be
    measured is NaN.

    ``pairs``: one row a matched chord, ``line robot_length_cm true_length_cm difference_cm mean_length_cm
    robot_centre_cm true_centre_cm x_cm y_cm offset_cm overlap sigma_true_cm sure late_in_s late_out_s``; the robot's
    centre is moved to the camera's scale and origin, lengths are as measured, (x, y) is the true centre,
    ``sigma_true_cm`` the error of the true length.
    """

    lines: int
    matched: int
    missed: int
    extra: int
    bias_cm: float
    sd_cm: float
    rms_cm: float
    limits_cm: tuple[float, float]
    scale: float
    scale_sigma: float
    offset_cm: float
    offset_s: float
    jitter_s: float
    missed_unsure: int
    extra_unsure: int
    camera_sd_cm: float
    entering: Latency
    leaving: Latency
    agreement: BlandAltman | None
    pairs: pd.DataFrame

    def to_dict(self) -> dict[str, Any]:
        """The JSON form, without the pairs; NaN becomes None."""
        values: dict[str, Any] = {name: getattr(self, name) for name in self.__slots__ if name != "pairs"}
        values["limits_cm"] = [_known(limit) for limit in self.limits_cm]
        values |= {"entering": self.entering.to_dict(), "leaving": self.leaving.to_dict()}
        values["agreement"] = None if self.agreement is None else self.agreement.to_dict()
        return {name: _known(value) if isinstance(value, float) else value for name, value in values.items()}


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _centres(chords: pd.DataFrame) -> Floats:
    return (column(chords, "s_in_cm") + column(chords, "s_out_cm")) / 2


def _slope(true_cm: Floats, robot_cm: Floats) -> tuple[float, float]:
    """Slope of robot on true length with its standard error, gross mismatches left out; NaN where undetermined.

    The intercept stays free: threshold and footprint add the same to every chord and are no scale.
    """
    half = len(true_cm) // 2
    if len(true_cm) < _FEWEST_FOR_SCALE or float(np.std(true_cm)) < MARGIN_CM:
        return np.nan, np.nan
    # Theil's incomplete method: slopes across half the range of lengths, safe from a few merged chords
    order = np.argsort(true_cm, kind="stable")
    x, y = true_cm[order], robot_cm[order]
    run, rise = x[half:] - x[: len(x) - half], y[half:] - y[: len(y) - half]
    slope = float(np.median(rise[run > 0] / run[run > 0]))
    residual = y - slope * x
    residual -= np.median(residual)
    used = np.abs(residual) <= max(4 * 1.4826 * float(np.median(np.abs(residual))), 0.1)
    x, y = x[used] - x[used].mean(), y[used] - y[used].mean()
    spread = float((x**2).sum())
    if spread == 0:
        return np.nan, np.nan
    slope = float((x * y).sum()) / spread
    return slope, float(np.sqrt(((y - slope * x) ** 2).sum() / max(len(x) - 2, 1) / spread))


def match_crossings(
    robot: pd.DataFrame,
    true: pd.DataFrame,
    *,
    lines: Iterable[int] | None = None,
    near: pd.DataFrame | None = None,
    largest_offset_cm: float = 6.0,
    fit_scale: bool = True,
    least_overlap: float = 0.5,
) -> ChordMatch:
    """Match the robot's crossings with the true ones, chord by chord.

    The robot counts its way from where it thinks it started. So the chords of each line are first matched with
    an offset of their own, then once more within 2 cm of the median offset of all chords and, with
    ``fit_scale``, with the robot's unit of length corrected.

    Args:
        robot: crossings ``line order s_cm entering`` and, where known, ``t_s``.
        true: the same from `true_crossings`, with ``x_cm y_cm``.
        lines: the lines to compare; give those the camera could fit, or chords it had no chance to see
            count as extra. Default: every line that occurs in either table.
        near: chords that the true lines just miss, from `near_chords`: a robot's chord there is an unsure extra.
        largest_offset_cm: how far the two origins of a run may lie apart.
        fit_scale: let the robot's unit of length differ from the camera's.
        least_overlap: below this shared part two chords are different chords.

    Raises:
        TrackError: a column is missing.
    """
    tables = [chord_table(robot), chord_table(true)]
    numbers = np.concatenate([column(table, "line") for table in (robot, true)] if lines is None else [[*lines]])
    compared = np.unique(numbers).astype(np.int64)
    robot_chords, true_chords = (table[table["line"].isin(compared)].reset_index(drop=True) for table in tables)
    length, true_length = column(robot_chords, "length_cm"), column(true_chords, "length_cm")

    def matched(unit: float) -> Alignment:
        free = align(
            robot_chords, true_chords, scale=unit, near_cm=0.0, reach_cm=largest_offset_cm, least=least_overlap
        )
        near = float(np.median(free.offset_cm)) if len(free.robot) else 0.0
        reach = min(_SLACK_CM, largest_offset_cm)
        return align(robot_chords, true_chords, scale=unit, near_cm=near, reach_cm=reach, least=least_overlap)

    unit, best = 1.0, matched(1.0)
    for _ in range(_SCALE_ROUNDS if fit_scale else 0):
        slope, _ = _slope(true_length[best.true], length[best.robot])
        if not abs(slope - 1.0) < _LARGEST_SCALE_ERROR:
            break
        # chords that merged can feign a scale: it must explain where the chords lie, too
        rescaled = matched(slope)
        if float(rescaled.overlap.sum()) <= float(best.overlap.sum()):
            break
        unit, best = slope, rescaled
    a, b = best.robot, best.true
    difference = length[a] - true_length[b]
    line = column(robot_chords, "line")[a]
    certain = column(true_chords, "sure") > 0.5
    sure = certain[b]
    late = [column(robot_chords, name)[a] - column(true_chords, name)[b] for name in ("t_in_s", "t_out_s")]
    both = np.concatenate(late)
    both = both[np.isfinite(both)]
    offset_s = float(np.median(both)) if len(both) else np.nan
    offset_cm = float(np.median(best.offset_cm)) if len(a) else np.nan
    compared_cm = difference[sure]
    bias = float(compared_cm.mean()) if len(compared_cm) else np.nan
    sd = float(compared_cm.std(ddof=1)) if len(compared_cm) > 1 else np.nan
    slope, slope_sigma = _slope(true_length[b][sure], length[a][sure])
    lone = np.setdiff1d(np.arange(len(robot_chords)), a)
    sigma_true = column(true_chords, "sigma_length_cm")[b]
    return ChordMatch(
        lines=len(compared),
        matched=len(a),
        missed=len(true_chords) - len(a),
        extra=len(robot_chords) - len(a),
        bias_cm=bias,
        sd_cm=sd,
        rms_cm=float(np.sqrt(np.mean(compared_cm**2))) if len(compared_cm) else np.nan,
        limits_cm=(bias - WITHIN_LIMITS * sd, bias + WITHIN_LIMITS * sd),
        scale=slope,
        scale_sigma=slope_sigma,
        offset_cm=offset_cm,
        offset_s=offset_s,
        jitter_s=1.4826 * float(np.median(np.abs(both - offset_s))) if len(both) else np.nan,
        missed_unsure=int((~np.delete(certain, b)).sum()),
        extra_unsure=_beside(robot_chords.iloc[lone], near, unit, 0.0 if np.isnan(offset_cm) else offset_cm),
        camera_sd_cm=float(np.sqrt(np.mean(sigma_true[sure] ** 2))) if sure.any() else np.nan,
        entering=latency(np.where(sure, late[0], np.nan), line),
        leaving=latency(np.where(sure, late[1], np.nan), line),
        agreement=bland_altman(length[a][sure], true_length[b][sure]),
        pairs=pd.DataFrame(
            {
                "line": column(robot_chords, "line")[a].astype(np.int64),
                "robot_length_cm": length[a],
                "true_length_cm": true_length[b],
                "difference_cm": difference,
                "mean_length_cm": (length[a] + true_length[b]) / 2,
                "robot_centre_cm": _centres(robot_chords)[a] / unit + best.offset_cm,
                "true_centre_cm": _centres(true_chords)[b],
                "x_cm": column(true_chords, "x_cm")[b],
                "y_cm": column(true_chords, "y_cm")[b],
                "offset_cm": best.offset_cm,
                "overlap": best.overlap,
                "sigma_true_cm": sigma_true,
                "sure": sure,
                "late_in_s": late[0],
                "late_out_s": late[1],
            },
            columns=list(PAIRS),
        ),
    )


def _beside(robot_chords: pd.DataFrame, near: pd.DataFrame | None, unit: float, offset_cm: float) -> int:
    """How many of the robot's chords lie, within what its places are good for, where the true line just misses one."""
    if near is None or near.empty or robot_chords.empty:
        return 0
    begin, end = (column(robot_chords, name) / unit + offset_cm for name in ("s_in_cm", "s_out_cm"))
    same = column(robot_chords, "line")[:, None] == column(near, "line")
    before = begin[:, None] - _SLACK_CM < column(near, "s_out_cm")
    behind = end[:, None] + _SLACK_CM > column(near, "s_in_cm")
    return int((same & before & behind).any(axis=1).sum())
