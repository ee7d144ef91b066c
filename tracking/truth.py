"""True crossings, from the true lines and the shape, with their errors.

The place of a crossing comes from the whole run's line, not from a frame: it errs by how far the line may lie beside
itself, over the tangent of the angle at which it meets the edge. So a grazing crossing errs much, and whether the
robot lit a sliver of an edge at all may be more than the camera can tell.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon

from lab.base.errors import RequestError
from tracking.paths import RunPath, run_paths
from tracking.runs import column, place_along

Floats = NDArray[np.float64]

TRUE_CROSSINGS = (
    "line",
    "order",
    "t_s",
    "s_cm",
    "entering",
    "x_cm",
    "y_cm",
    "sigma_s_cm",
    "sigma_t_s",
    "sigma_length_cm",
    "sure",
)
NEAR_CHORDS = ("line", "s_in_cm", "s_out_cm")
_SURE_SIGMAS = 2.0  # how far a line is moved aside to see which chords are sure
_LEAST_SINE = 1e-3  # of the angle at an edge: flatter, the linear law of errors means nothing
_SPEED_OVER_S = 0.15


def true_crossings(
    true_lines: pd.DataFrame, geometry: Polygon | MultiPolygon, *, track: pd.DataFrame | None = None
) -> pd.DataFrame:
    """Where and when every true line crosses the boundary of the shape.

    Args:
        true_lines: from `fit_lines`; lines without a fit are skipped. A bow that was measured is followed.
        geometry: the shape in arena cm as it lies in the plane of the light sensor, holes and pieces included.
        track: the frames the lines were fitted to. With them a place becomes a time through the robot's own
            progress; without, through a constant speed from the run's start to its end.

    Returns:
        One row a crossing, by line and order of travel: ``line order t_s s_cm entering x_cm y_cm sigma_s_cm sigma_t_s
        sigma_length_cm sure``, s_cm from the run's start. Entering and leaving alternate, so a line has k = rows/2
        chords. A point where the line only touches the shape, or an edge that it runs along, is no crossing. A run that
        starts or ends inside the shape is closed there. ``sigma_s_cm``: error of the place along the run;
        ``sigma_t_s``: of the time; ``sigma_length_cm``: of the length of the chord that begins or ends here, on both
        its rows. ``sure``: the chord is still there when the line is moved aside by two of its standard errors, either
        way. Without the errors' columns of `fit_lines` they are 0, and every chord is sure.

    Raises:
        RequestError: the geometry is not a valid polygon.
        TrackError: a column is missing.

    >>> from shapely import box
    >>> line = pd.DataFrame([dict(line=4, x_start_cm=-10.0, y_start_cm=0.0, x_end_cm=10.0, y_end_cm=0.0,
    ...     t_start_s=0.0, t_end_s=2.0, length_cm=20.0)])
    >>> true_crossings(line, box(-3, -3, 5, 3))[["line", "order", "s_cm", "entering"]].to_numpy().tolist()
    [[4, 0, 7.0, True], [4, 1, 15.0, False]]
    """
    _check(geometry)
    paths = run_paths(true_lines)
    times = np.column_stack([column(true_lines, "t_start_s"), column(true_lines, "t_end_s")])
    numbers = column(true_lines, "line")
    frames = _frames_by_line(track)
    edges = _Edges(geometry)
    columns: dict[str, list[NDArray[Any]]] = {name: [np.empty(0, dtype=_kind(name))] for name in TRUE_CROSSINGS}
    for row, path in paths.items():
        stretches = path.stretches(geometry)
        if not len(stretches):
            continue
        s_cm = stretches.ravel()
        known_t, known_s, sigma_along = times[row], np.array([0.0, path.length_cm]), 0.0
        run = frames.get(int(numbers[row]))
        if run is not None:
            seen_t, seen_s = place_along(run, true_lines.iloc[row])
            if len(seen_t) >= 2:
                known_t, known_s, sigma_along = seen_t, seen_s, _sigma_along(run)
        places = path.points(s_cm)
        # How far a crossing moves along for each cm that the line lies farther to the left.
        answer = edges.answer(places, path, s_cm)
        # Where the run ends inside the shape, moving it aside moves nothing.
        answer[(s_cm <= 0.0) | (s_cm >= path.length_cm)] = 0.0
        moved = answer[:, None] * path.covariance(s_cm) * answer
        variance = np.diagonal(moved)
        chord = np.diagonal(moved)[0::2] + np.diagonal(moved)[1::2] - 2.0 * np.diagonal(moved, 1)[0::2]
        when = np.interp(s_cm, known_s, known_t)
        speed = _speed(known_t, known_s, when)
        order = np.arange(len(s_cm))
        columns["line"].append(np.full(len(s_cm), int(numbers[row])))
        columns["order"].append(order)
        columns["t_s"].append(when)
        columns["s_cm"].append(s_cm)
        columns["entering"].append(order % 2 == 0)
        columns["x_cm"].append(places[:, 0])
        columns["y_cm"].append(places[:, 1])
        columns["sigma_s_cm"].append(np.sqrt(variance))
        columns["sigma_t_s"].append(np.sqrt(variance + sigma_along**2) / speed)
        columns["sigma_length_cm"].append(np.repeat(np.sqrt(np.maximum(chord, 0.0)), 2))
        columns["sure"].append(np.repeat(_sure(path, stretches, geometry), 2))
    return pd.DataFrame({name: np.concatenate(parts) for name, parts in columns.items()})


def near_chords(true_lines: pd.DataFrame, geometry: Polygon | MultiPolygon) -> pd.DataFrame:
    """Chords that are not there, but would be if a line lay two of its standard errors to one side.

    Args:
        true_lines: from `fit_lines`, with the errors' columns; without them there are none.
        geometry: as for `true_crossings`.

    Returns:
        One row a chord: ``line s_in_cm s_out_cm``.

    Raises:
        RequestError: the geometry is not a valid polygon.
        TrackError: a column is missing.
    """
    _check(geometry)
    numbers = column(true_lines, "line")
    rows: list[tuple[int, float, float]] = []
    for row, path in run_paths(true_lines).items():
        here = path.stretches(geometry)
        for sigmas in (-_SURE_SIGMAS, _SURE_SIGMAS):
            aside = path.stretches(geometry, sigmas)
            new = ~_overlapping(aside, here)
            rows += [(int(numbers[row]), float(begin), float(end)) for begin, end in aside[new]]
    return pd.DataFrame(rows, columns=list(NEAR_CHORDS)).astype({"line": "int64"})


def _check(geometry: Polygon | MultiPolygon) -> None:
    if not shapely.is_valid(geometry) or geometry.is_empty:
        raise RequestError(f"the shape is no valid polygon ({shapely.is_valid_reason(geometry)}); mend it first")


def _kind(name: str) -> type:
    return {"line": np.int64, "order": np.int64, "entering": np.bool_, "sure": np.bool_}.get(name, np.float64)


def _frames_by_line(track: pd.DataFrame | None) -> dict[int, pd.DataFrame]:
    """The track's rows of every line."""
    if track is None:
        return {}
    number = column(track, "line")
    return {int(n): track[number == n] for n in np.unique(number[number >= 0])}


def _sigma_along(run: pd.DataFrame) -> float:
    """Error of the place along the run in cm, that of a smoothed position; 0 where the track does not tell."""
    if "sigma_x_cm" not in run.columns or "sigma_y_cm" not in run.columns:
        return 0.0
    variance = (column(run, "sigma_x_cm") ** 2 + column(run, "sigma_y_cm") ** 2) / 2.0
    return float(np.sqrt(np.nanmedian(variance))) if np.isfinite(variance).any() else 0.0


def _speed(known_t: Floats, known_s: Floats, when: Floats) -> Floats:
    """Speed in cm/s around the instants ``when`` (m,)."""
    early = np.clip(when - _SPEED_OVER_S, known_t[0], known_t[-1])
    late = np.clip(when + _SPEED_OVER_S, known_t[0], known_t[-1])
    way = np.interp(late, known_t, known_s) - np.interp(early, known_t, known_s)
    return np.maximum(way, 1e-6) / np.maximum(late - early, 1e-9)


class _Edges:
    """The straight parts of a shape's boundary, found by place."""

    def __init__(self, geometry: Polygon | MultiPolygon) -> None:
        ends: list[Floats] = []
        for ring in shapely.get_rings(shapely.get_parts(geometry)):
            corners = shapely.get_coordinates(ring)
            ends.append(np.stack([corners[:-1], corners[1:]], axis=1))
        parts = np.concatenate(ends)
        parts = parts[np.hypot(*(parts[:, 1] - parts[:, 0]).T) > 0.0]
        self._tree = shapely.STRtree(list(np.atleast_1d(np.asarray(shapely.linestrings(parts), dtype=object))))
        way = parts[:, 1] - parts[:, 0]
        self._along = way / np.hypot(way[:, 0], way[:, 1])[:, None]

    def answer(self, places_cm: Floats, path: RunPath, s_cm: Floats) -> Floats:
        """Cm along the run that crossings (m, 2) move for each cm that the path moves left: cot of the angle there."""
        edge = self._along[np.asarray(self._tree.nearest(shapely.points(places_cm)))]
        slant = np.arctan(path.slant(s_cm))
        forward = np.cos(slant)[:, None] * path.along + np.sin(slant)[:, None] * path.left
        across = edge[:, 1] * forward[:, 0] - edge[:, 0] * forward[:, 1]
        with_it = (edge * forward).sum(axis=1)
        flat = np.abs(across) < _LEAST_SINE
        across = np.where(flat, np.where(across < 0.0, -_LEAST_SINE, _LEAST_SINE), across)
        return with_it / across


def _overlapping(some: Floats, others: Floats) -> NDArray[np.bool_]:
    """Whether each stretch (m, 2) shares a part with one of the others (n, 2)."""
    shared = (some[:, None, 0] < others[:, 1]) & (others[:, 0] < some[:, None, 1])
    return np.asarray(shared.any(axis=1), dtype=np.bool_)


def _sure(path: RunPath, stretches: Floats, geometry: Polygon | MultiPolygon) -> NDArray[np.bool_]:
    """Whether each chord is there wherever the line may lie."""
    if not path.sigma_beside(stretches.ravel()).any():
        return np.ones(len(stretches), dtype=bool)
    right, left = (path.stretches(geometry, sigmas) for sigmas in (-_SURE_SIGMAS, _SURE_SIGMAS))
    return _overlapping(stretches, right) & _overlapping(stretches, left)
