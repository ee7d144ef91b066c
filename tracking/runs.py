"""From the track to true lines: which frames belong to which run, and the straight line through each.

A run is the robot's straight roll from wall to wall. Its line is fitted by total least squares, for
both coordinates carry the same noise, with Tukey's weights against reflections and lost LEDs, from a start
that half of the frames may not spoil.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.optimize import isotonic_regression

from lab.base.errors import RequestError
from tracking.bow import fit_bow
from tracking.straight import FINEST_CM, TUKEY, Straight, straight_through

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

TRUE_LINES = (
    "line",
    "theta_rad",
    "p_cm",
    "x_start_cm",
    "y_start_cm",
    "x_end_cm",
    "y_end_cm",
    "t_start_s",
    "t_end_s",
    "length_cm",
    "rms_cm",
    "pivot_cm",
    "sigma_pivot_cm",
    "sigma_theta_rad",
    "bend_cm",
    "sigma_bend_cm",
    "n_frames",
    "reason",
)
_MOVING = 0.2  # share of the cruising speed above which the robot counts as rolling
_LONGEST_PAUSE_S = 0.25  # a hidden LED or one bad frame does not end a run
_FEWEST_FOR_BEND = 8


class TrackError(RequestError):
    """A track that cannot be read as runs; carries ``column`` where one is missing."""

    def __init__(self, message: str, column: str = "") -> None:
        super().__init__(message)
        self.column = column


@dataclass(frozen=True, slots=True, eq=False)
class _Frames:
    """The frames of one run in which the LED was seen, in order of time."""

    t_s: Floats
    xy_cm: Floats
    weight: Floats
    raw_cm: Floats  # as measured, whose errors are each frame's own; NaN where bridged
    raw_weight: Floats

    def between(self, first: int, last: int) -> _Frames:
        return self.only(np.arange(first, last + 1))

    def only(self, kept: NDArray[np.bool_] | NDArray[np.intp]) -> _Frames:
        return _Frames(self.t_s[kept], self.xy_cm[kept], self.weight[kept], self.raw_cm[kept], self.raw_weight[kept])


def column(table: pd.DataFrame, name: str) -> Floats:
    """One column as floats; raises TrackError where the table lacks it."""
    if name not in table.columns:
        raise TrackError(f"the table has no column `{name}`; hand in one as its docstring describes", name)
    return np.asarray(table[name], dtype=float)


def _frames(track: pd.DataFrame) -> tuple[Floats, Floats, Floats]:
    """Times (n,), positions (n, 2) and weights (n,), NaN where the LED was not seen."""
    if "robot" in track.columns and track["robot"].nunique() > 1:
        raise TrackError("the track holds several robots; hand in the rows of one robot at a time")
    smooth = "x_smooth_cm" in track.columns
    names = ("x_smooth_cm", "y_smooth_cm") if smooth else ("x_cm", "y_cm")
    xy = np.column_stack([column(track, name) for name in names])
    weight = np.ones(len(xy))
    if "sigma_x_cm" in track.columns and "sigma_y_cm" in track.columns:
        variance = (column(track, "sigma_x_cm") ** 2 + column(track, "sigma_y_cm") ** 2) / 2
        weight = np.where(np.isfinite(variance), 1.0 / (np.nan_to_num(variance) + FINEST_CM**2), 0.0)
        xy[weight == 0] = np.nan
    return column(track, "t_s"), xy, weight


def _raw(track: pd.DataFrame, xy_cm: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Measured positions (n, 2) in cm and their weights (n,); the smoothed ones where the track holds no others."""
    if "x_cm" not in track.columns or "y_cm" not in track.columns:
        return xy_cm, weight
    # The sigmas of a track are those of its smoothed positions: they do not tell the measured ones apart.
    return np.column_stack([column(track, "x_cm"), column(track, "y_cm")]), np.ones(len(track))


def _rate(t_s: Floats, value: Floats) -> Floats:
    """Change per second of a coordinate, from the neighbours on either side."""
    after = np.minimum(np.arange(len(t_s)) + 1, len(t_s) - 1)
    before = np.maximum(np.arange(len(t_s)) - 1, 0)
    return (value[after] - value[before]) / np.maximum(t_s[after] - t_s[before], 1e-9)


def _longest_stretch(moving: NDArray[np.bool_], t_s: Floats, speed_cm_s: Floats) -> tuple[int, int] | None:
    """First and last index of the stretch of moving frames in which the robot got farthest; short pauses bridged."""
    index = np.flatnonzero(moving)
    if not len(index):
        return None
    breaks = np.flatnonzero((np.diff(index) > 1) & (np.diff(t_s[index]) > _LONGEST_PAUSE_S))
    firsts = index[np.concatenate([[0], breaks + 1])]
    lasts = index[np.concatenate([breaks, [len(index) - 1]])]
    path = np.concatenate([[0.0], np.cumsum(np.diff(t_s) * (speed_cm_s[1:] + speed_cm_s[:-1]) / 2)])
    best = int(np.argmax(path[lasts] - path[firsts]))
    return int(firsts[best]), int(lasts[best])


def _rolling(frames: _Frames, fewest: int, shortest_cm: float) -> tuple[_Frames | None, str]:
    """The frames of the longest roll along one line, or the reason why there are none."""
    # a single bad frame looks like two leaps
    steady = np.asarray(median_filter(frames.xy_cm, size=(5, 1), mode="nearest"), dtype=float)
    extent = np.quantile(steady, 0.95, axis=0) - np.quantile(steady, 0.05, axis=0)
    if float(np.hypot(*extent)) < shortest_cm:
        return None, "the robot stood still"
    speed = np.hypot(_rate(frames.t_s, steady[:, 0]), _rate(frames.t_s, steady[:, 1]))
    cruising = float(np.quantile(speed, 0.9))
    stretch = _longest_stretch(speed > _MOVING * cruising, frames.t_s, speed)
    if stretch is None or stretch[1] - stretch[0] + 1 < fewest:
        return None, f"the robot rolled in less than {fewest} frames"
    moving = frames.between(*stretch)
    line = straight_through(moving.xy_cm, moving.weight)
    # what is rolled before or after in another direction belongs to the neighbouring runs
    on_line = moving.only(np.abs(line.residual_cm) < max(6.0 * line.scale_cm, 0.3))
    forward = _rate(on_line.t_s, on_line.xy_cm @ line.along)
    stretch = _longest_stretch(forward > _MOVING * cruising, on_line.t_s, np.abs(forward))
    if stretch is None or stretch[1] - stretch[0] + 1 < max(fewest, 0.5 * len(moving.t_s)):
        return None, "not straight: less than half of the rolling frames lie on one line"
    return on_line.between(*stretch), ""


def _fit(
    frames: _Frames, fewest: int, crookedest_cm: float, shortest_cm: float, systematic_cm: float
) -> tuple[dict[str, float], str]:
    """The numbers of one run, or the reason why there are none."""
    if len(frames.t_s) < fewest:
        return {}, f"LED seen in {len(frames.t_s)} frames, {fewest} needed"
    rolled, reason = _rolling(frames, fewest, shortest_cm)
    if rolled is None:
        return {}, reason
    line = straight_through(rolled.xy_cm, rolled.weight)
    kept = np.abs(line.residual_cm) < TUKEY * line.scale_cm
    rms = float(np.sqrt(np.mean(line.residual_cm[kept] ** 2)))
    progress = (rolled.xy_cm[kept] - line.point_cm) @ line.along
    begin, end = float(progress[0]), float(progress[-1])
    if rms > crookedest_cm:
        return {"rms_cm": rms}, f"not straight: {rms:.1f} cm rms, {crookedest_cm:g} allowed"
    if end - begin < max(shortest_cm, 10 * rms):
        return {"rms_cm": rms}, f"rolled only {end - begin:.1f} cm, too short to tell its direction"
    line, errors = _scatter(rolled, line, begin, end, systematic_cm)
    progress = (rolled.xy_cm[kept] - line.point_cm) @ line.along
    begin, end = float(progress[0]), float(progress[-1])
    normal = np.array([-line.along[1], line.along[0]])
    theta = float(np.arctan2(normal[1], normal[0]))
    p = float(normal @ line.point_cm)
    if theta < 0:
        theta, p = theta + np.pi, -p
    if theta >= np.pi:
        theta, p = 0.0, -p
    start, stop = line.point_cm + begin * line.along, line.point_cm + end * line.along
    return errors | {
        "theta_rad": theta,
        "p_cm": p,
        "x_start_cm": float(start[0]),
        "y_start_cm": float(start[1]),
        "x_end_cm": float(stop[0]),
        "y_end_cm": float(stop[1]),
        "t_start_s": float(rolled.t_s[kept][0]),
        "t_end_s": float(rolled.t_s[kept][-1]),
        "length_cm": end - begin,
        "rms_cm": rms,
        "n_frames": float(kept.sum()),
    }, ""


def _scatter(
    frames: _Frames, line: Straight, begin_cm: float, end_cm: float, systematic_cm: float
) -> tuple[Straight, dict[str, float]]:
    """The line put right by the measured positions, with its errors and the run's bend.

    Smoothed positions lean on each other; the measured ones say how well the line is known.
    """
    away = frames.raw_cm - line.point_cm
    off = away[:, 1] * line.along[0] - away[:, 0] * line.along[1]
    half = (end_cm - begin_cm) / 2.0
    u = (away @ line.along - begin_cm) / half - 1.0
    known = np.isfinite(off) & (np.abs(u) <= 1.0)
    if known.any():
        known &= np.abs(off) < TUKEY * max(1.4826 * float(np.median(np.abs(off[known]))), FINEST_CM)
    if int(known.sum()) < _FEWEST_FOR_BEND:
        return line, {}
    bow = fit_bow(u[known], off[known], frames.raw_weight[known])
    lateral, mixed, turning = bow.covariance[0, 0], bow.covariance[0, 1], bow.covariance[1, 1]
    pivot = -mixed / turning if turning > 0.0 else 0.0
    normal = np.array([-line.along[1], line.along[0]])
    turned = line.along + bow.straight[1] / half * normal
    straight = Straight(
        line.point_cm + (begin_cm + half) * line.along + bow.straight[0] * normal,
        turned / np.hypot(*turned),
        line.residual_cm,
        line.scale_cm,
    )
    return straight, {
        "pivot_cm": half * (1.0 + pivot),
        "sigma_pivot_cm": float(np.sqrt(max(lateral + pivot * mixed, 0.0) + systematic_cm**2)),
        "sigma_theta_rad": float(np.sqrt(turning)) / half,
        "bend_cm": bow.bend,
        "sigma_bend_cm": bow.sigma_bend,
    }


def fit_lines(
    track: pd.DataFrame,
    *,
    fewest_frames: int = 5,
    crookedest_cm: float = 2.0,
    shortest_cm: float = 1.0,
    systematic_cm: float = 0.0,
) -> pd.DataFrame:
    """Fit the straight line of every run.

    Args:
        track: one row a frame of one robot, columns ``line t_s`` and ``x_smooth_cm y_smooth_cm`` (or ``x_cm
            y_cm``), optionally ``sigma_x_cm sigma_y_cm``. NaN where the LED was not seen; rows with a
            negative line are skipped. Frames of turning and standing around the roll may be there.
        fewest_frames: rolling frames that a line needs.
        crookedest_cm: a run whose frames stray farther, rms, is no straight line.
        shortest_cm: a robot that rolled less has no direction.
        systematic_cm: how far all positions of a run may be off together (see `track.systematic_cm`); it becomes part
            of ``sigma_pivot_cm``.

    Returns:
        One row a line, in order: ``line theta_rad p_cm x_start_cm y_start_cm x_end_cm y_end_cm t_start_s
        t_end_s length_cm rms_cm pivot_cm sigma_pivot_cm sigma_theta_rad bend_cm sigma_bend_cm n_frames reason``.
        theta in [0, pi) is the direction of the normal, p the signed distance, end points in order of travel, rms of
        the distances from the line. ``pivot_cm``: the place from the run's start where the errors of the line's
        position (``sigma_pivot_cm``, across it) and direction do not depend on each other, so that s cm from the start
        the line lies uncertain by the root of sigma_pivot² + (s - pivot)² sigma_theta². ``bend_cm``: how far the run
        bows out at its middle, left of the way it went positive. ``reason`` is empty for a fitted line; else it says
        why there is none and the numbers are NaN, n_frames 0.

    Raises:
        TrackError: a column is missing, or the rows are of several robots.
    """
    t_all, xy_all, weight_all = _frames(track)
    raw_all, raw_weight_all = _raw(track, xy_all, weight_all)
    number = column(track, "line")
    seen = np.isfinite(xy_all).all(axis=1) & np.isfinite(t_all)
    rows: list[dict[str, float | str]] = []
    order = np.lexsort((t_all, number))
    order = order[np.isfinite(number[order]) & (number[order] >= 0)]
    bounds = np.flatnonzero(np.diff(number[order])) + 1
    for index in np.split(order, bounds) if len(order) else []:
        used = index[seen[index]]
        fitted, reason = _fit(
            _Frames(t_all[used], xy_all[used], weight_all[used], raw_all[used], raw_weight_all[used]),
            max(fewest_frames, 3),
            crookedest_cm,
            shortest_cm,
            systematic_cm,
        )
        row: dict[str, float | str] = dict.fromkeys(TRUE_LINES, np.nan)
        row |= fitted
        row |= {"line": float(number[index[0]]), "reason": reason, "n_frames": fitted.get("n_frames", 0.0)}
        rows.append(row)
    lines = pd.DataFrame(rows, columns=list(TRUE_LINES))
    floats = [name for name in TRUE_LINES if name not in ("line", "n_frames", "reason")]
    return lines.astype({"line": "int64", "n_frames": "int64", "reason": "str"} | dict.fromkeys(floats, "float64"))


def place_along(track: pd.DataFrame, line: pd.Series) -> tuple[Floats, Floats]:
    """Where along its line the robot was, and when: (t_s, s_cm), both rising, s from the run's start.

    Args:
        track: the frames of this run, as for `fit_lines`.
        line: the run's row of `fit_lines`, fitted.

    Frames off the line are left out; the robot only rolls forward, so the rest is made monotone by
    isotonic regression, and frames without progress are merged so that s can be inverted.
    """
    t_s, xy, _ = _frames(track)
    start = np.array([line["x_start_cm"], line["y_start_cm"]], dtype=float)
    along = (np.array([line["x_end_cm"], line["y_end_cm"]], dtype=float) - start) / float(line["length_cm"])
    away = xy - start
    off = np.abs(away[:, 1] * along[0] - away[:, 0] * along[1])
    used = (t_s >= float(line["t_start_s"])) & (t_s <= float(line["t_end_s"]))
    used &= off < max(6.0 * float(line["rms_cm"]), 0.3)
    order = np.argsort(t_s[used], kind="stable")
    when = t_s[used][order]
    place = np.asarray(isotonic_regression((away[used] @ along)[order]).x, dtype=float)
    levels, members = np.unique(place, return_inverse=True)
    count = np.bincount(members)
    return np.bincount(members, weights=when) / count, levels


def segment_runs(track: pd.DataFrame, *, tolerance_cm: float = 1.0, shortest_cm: float = 3.0) -> pd.DataFrame:
    """Split a continuous track at the bounces and number the runs.

    The path is simplified to the fewest corners that keep it within ``tolerance_cm`` (Douglas and Peucker), which
    finds grazing bounces where a turning angle between frames drowns in noise; corners of less
    than 8 degrees are drift, not bounces.

    Args:
        track: one row a frame of one robot in order of time, as for `fit_lines` but without ``line``.
        tolerance_cm: how far a run may stray from straight; well above the noise of a position.
        shortest_cm: shorter pieces are turning or jitter and belong to no run.

    Returns:
        A copy with ``line`` (int64), from 0 in order of travel; -1 for frames of no run.

    Raises:
        TrackError: a column is missing, or the rows are of several robots.
    """
    _, xy, _ = _frames(track)
    number = np.full(len(track), -1, dtype=np.int64)
    seen = np.flatnonzero(np.isfinite(xy).all(axis=1))
    if len(seen) >= 2:
        corner = _corners(np.asarray(median_filter(xy[seen], size=(5, 1), mode="nearest"), dtype=float), tolerance_cm)
        points = xy[seen[corner]]
        size = np.hypot(*np.diff(points, axis=0).T)
        count = 0
        for piece, length in enumerate(size):
            if length >= shortest_cm:
                first = seen[corner[piece]] + (1 if piece else 0)
                number[first : seen[corner[piece + 1]] + 1] = count
                count += 1
    return track.assign(line=number)


def _corners(path: Floats, tolerance_cm: float) -> Indices:
    """Indices of the corners of a path (n, 2), both ends included."""
    # the frame's index rides along as z, which the simplification carries but does not look at
    indexed = shapely.linestrings(np.column_stack([path, np.arange(len(path))]))
    kept = shapely.simplify(indexed, tolerance_cm, preserve_topology=False)
    corner: Indices = np.asarray(shapely.get_coordinates(kept, include_z=True)[:, 2]).astype(np.int64)
    while len(corner) > 2:
        leg = np.diff(path[corner], axis=0)
        turn = np.abs(np.arctan2(leg[:-1, 0] * leg[1:, 1] - leg[:-1, 1] * leg[1:, 0], (leg[:-1] * leg[1:]).sum(axis=1)))
        if float(turn.min()) >= np.radians(8.0):
            break
        flattest = int(turn.argmin()) + 1
        corner = np.concatenate([corner[:flattest], corner[flattest + 1 :]])
    return corner
