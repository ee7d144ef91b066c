"""True crossings, from the true lines and the shape, and how the robot's crossings compare with them.

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
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon

from lab.base.errors import RequestError
from tracking.chords import MARGIN_CM, Alignment, align, chord_table
from tracking.runs import column, place_along

Floats = NDArray[np.float64]

TRUE_CROSSINGS = ("line", "order", "t_s", "s_cm", "entering", "x_cm", "y_cm")
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
)
_TOUCHING_CM = 1e-6
_SLACK_CM = 2.0  # how far one line's offset may stray from the median offset
_FEWEST_FOR_SCALE = 8
_LARGEST_SCALE_ERROR = 0.25
_SCALE_ROUNDS = 3  # more chords match once the scale is nearly right


def true_crossings(
    true_lines: pd.DataFrame, geometry: Polygon | MultiPolygon, *, track: pd.DataFrame | None = None
) -> pd.DataFrame:
    """Where and when every true line crosses the boundary of the shape.

    Args:
        true_lines: from `fit_lines`; lines without a fit are skipped.
        geometry: the shape in arena cm as it lies in the plane of the light sensor, holes and pieces included.
        track: the frames the lines were fitted to. With them a place becomes a time through the robot's own
            progress; without, through a constant speed from the run's start to its end.

    Returns:
        One row a crossing, by line and order of travel: ``line order t_s s_cm entering x_cm y_cm``, s_cm from the
        run's start. Entering and leaving alternate, so a line has k = rows/2 chords. A point where the line only
        touches the shape is no crossing. A run that starts or ends inside the shape is closed there.

    Raises:
        RequestError: the geometry is not a valid polygon.
        TrackError: a column is missing.

    >>> from shapely import box
    >>> line = pd.DataFrame([dict(line=4, x_start_cm=-10.0, y_start_cm=0.0, x_end_cm=10.0, y_end_cm=0.0,
    ...     t_start_s=0.0, t_end_s=2.0, length_cm=20.0)])
    >>> true_crossings(line, box(-3, -3, 5, 3))[["line", "order", "s_cm", "entering"]].to_numpy().tolist()
    [[4, 0, 7.0, True], [4, 1, 15.0, False]]
    """
    if not shapely.is_valid(geometry) or geometry.is_empty:
        raise RequestError(f"the shape is no valid polygon ({shapely.is_valid_reason(geometry)}); mend it first")
    ends = np.stack(
        [
            np.column_stack([column(true_lines, f"x_{end}_cm"), column(true_lines, f"y_{end}_cm")])
            for end in ("start", "end")
        ],
        axis=1,
    )
    times = np.column_stack([column(true_lines, "t_start_s"), column(true_lines, "t_end_s")])
    numbers = column(true_lines, "line")
    fitted = np.flatnonzero(np.isfinite(ends).all(axis=(1, 2)))
    begins, finishes, owner = _lit_stretches(ends[fitted], geometry)
    frames = _frames_by_line(track)
    columns: dict[str, list[NDArray[Any]]] = {name: [np.empty(0, dtype=_kind(name))] for name in TRUE_CROSSINGS}
    for place in np.unique(owner):
        row = int(fitted[place])
        start, end = ends[row]
        length = float(np.hypot(*(end - start)))
        s_cm = _merged(begins[owner == place], finishes[owner == place])
        known_t, known_s = times[row], np.array([0.0, length])
        run = frames.get(int(numbers[row]))
        if run is not None:
            seen_t, seen_s = place_along(run, true_lines.iloc[row])
            if len(seen_t) >= 2:
                known_t, known_s = seen_t, seen_s
        order = np.arange(len(s_cm))
        columns["line"].append(np.full(len(s_cm), int(numbers[row])))
        columns["order"].append(order)
        columns["t_s"].append(np.interp(s_cm, known_s, known_t))
        columns["s_cm"].append(s_cm)
        columns["entering"].append(order % 2 == 0)
        columns["x_cm"].append(start[0] + s_cm / length * (end[0] - start[0]))
        columns["y_cm"].append(start[1] + s_cm / length * (end[1] - start[1]))
    return pd.DataFrame({name: np.concatenate(parts) for name, parts in columns.items()})


def _kind(name: str) -> type:
    return {"line": np.int64, "order": np.int64, "entering": np.bool_}.get(name, np.float64)


def _frames_by_line(track: pd.DataFrame | None) -> dict[int, pd.DataFrame]:
    """The track's rows of every line."""
    if track is None:
        return {}
    number = column(track, "line")
    return {int(n): track[number == n] for n in np.unique(number[number >= 0])}


def _lit_stretches(ends_cm: Floats, geometry: Polygon | MultiPolygon) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Begin and end (m,) along its run of every stretch of the runs (n, 2, 2) inside the shape, and whose it is."""
    start, along = ends_cm[:, 0], ends_cm[:, 1] - ends_cm[:, 0]
    along = along / np.hypot(along[:, 0], along[:, 1])[:, None]
    lit = np.asarray(shapely.intersection(shapely.linestrings(ends_cm), geometry), dtype=object)
    parts, owner = shapely.get_parts(lit, return_index=True)
    filled = ~np.asarray(shapely.is_empty(parts), dtype=bool)
    parts, owner = parts[filled], owner[filled]
    points, part = shapely.get_coordinates(parts, return_index=True)
    run = owner[part]
    place = ((points - start[run]) * along[run]).sum(axis=1)
    begins, finishes = np.full(len(owner), np.inf), np.full(len(owner), -np.inf)
    np.minimum.at(begins, part, place)
    np.maximum.at(finishes, part, place)
    middle = start[owner] + ((begins + finishes) / 2)[:, None] * along[owner]
    # a touched corner comes back as a point, an edge the run lies on as a stretch with its middle on the boundary
    inside = np.asarray(shapely.contains_properly(geometry, shapely.points(middle)), dtype=bool)
    kept = inside & (finishes - begins > _TOUCHING_CM)
    return begins[kept], finishes[kept], np.asarray(owner[kept], dtype=np.intp)


def _merged(begins: Floats, finishes: Floats) -> Floats:
    """Ends of the lit stretches in order, where stretches that meet in a point are one."""
    order = np.argsort(begins)
    begins, finishes = begins[order], finishes[order]
    apart = begins[1:] - finishes[:-1] > _TOUCHING_CM
    kept = np.column_stack([begins[np.concatenate([[True], apart])], finishes[np.concatenate([apart, [True]])]])
    return np.asarray(kept.ravel(), dtype=float)


@dataclass(frozen=True, slots=True, eq=False)
class ChordMatch:
    """The robot's chords against the true ones.

    ``bias_cm``, ``sd_cm`` and ``rms_cm`` are of robot minus true length over the matched chords, ``limits_cm`` the
    limits of agreement, bias +- 1.96 sd (Bland and Altman 1986). ``scale`` is the slope of robot on true
    length with its standard error, ``offset_cm`` the median over the chords of camera minus scaled robot
    distance along the run, ``offset_s`` the median of robot minus true crossing time and ``jitter_s``
    its spread (1.4826 MAD). What could not be measured is NaN.

    ``pairs``: one row a matched chord, ``line robot_length_cm true_length_cm difference_cm mean_length_cm
    robot_centre_cm true_centre_cm x_cm y_cm offset_cm overlap``; the robot's centre is moved to the camera's scale
    and origin, lengths are as measured, (x, y) is the true centre.
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
    pairs: pd.DataFrame

    def to_dict(self) -> dict[str, Any]:
        """The JSON form, without the pairs; NaN becomes None."""
        values: dict[str, Any] = {name: getattr(self, name) for name in self.__slots__ if name != "pairs"}
        values["limits_cm"] = [_known(limit) for limit in self.limits_cm]
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
    late = np.concatenate(
        [column(robot_chords, name)[a] - column(true_chords, name)[b] for name in ("t_in_s", "t_out_s")]
    )
    late = late[np.isfinite(late)]
    offset_s = float(np.median(late)) if len(late) else np.nan
    bias = float(difference.mean()) if len(a) else np.nan
    sd = float(difference.std(ddof=1)) if len(a) > 1 else np.nan
    slope, slope_sigma = _slope(true_length[b], length[a])
    return ChordMatch(
        lines=len(compared),
        matched=len(a),
        missed=len(true_chords) - len(a),
        extra=len(robot_chords) - len(a),
        bias_cm=bias,
        sd_cm=sd,
        rms_cm=float(np.sqrt(np.mean(difference**2))) if len(a) else np.nan,
        limits_cm=(bias - 1.96 * sd, bias + 1.96 * sd),
        scale=slope,
        scale_sigma=slope_sigma,
        offset_cm=float(np.median(best.offset_cm)) if len(a) else np.nan,
        offset_s=offset_s,
        jitter_s=1.4826 * float(np.median(np.abs(late - offset_s))) if len(late) else np.nan,
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
            },
            columns=list(PAIRS),
        ),
    )
