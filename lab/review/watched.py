"""What a robot read and found on its runs, put where the camera saw it at that moment."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.edgeshift import FEWEST_EDGES, EdgeShift, Outline, Ramps, fit_edge_shift, ramp_of_line
from analysis.replay import Passes
from lab.reopen.parts import LearntLevels
from lab.session.run import EDGES
from lab.settings.settings import Settings
from lab.store.layout import LIGHT
from lab.store.reader import SessionReader, numbers_of
from projector.shape import Silhouette
from tracking.runs import place_along

if TYPE_CHECKING:
    from lab.review.filmed import Filmed

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_LARGEST_JITTER = 0.3  # of the interval; beyond, which reading is which cannot be told
_FARTHEST_CM = 4.0  # from the other crossings' median; farther, it is a match of two different edges
_REACHES_CM = (3.0, 2.0, 1.2)  # how far a ramp may extend; less where edges lie close
_CORNER_CM, _ENOUGH_EDGES = 1.5, 3 * FEWEST_EDGES
_AROUND_CM = 8.0  # beyond the crossings: what is read farther off, such as a ring of light, is not the shape's
_SETTLED = 0.2  # share of a run in which it gathers speed


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Light samples of one run: host times in s, and light from 0 in the dark to 1 in the shape."""

    t_s: Floats
    light: Floats

    def stamp_variance_s2(self) -> float:
        """Variance of the time stamps about a regular clock; NaN where they cannot be counted."""
        if len(self.t_s) < 5:
            return math.nan
        apart_s = np.diff(self.t_s)
        interval_s = float(np.median(apart_s))
        if interval_s <= 0:
            return math.nan
        number = np.concatenate([[0.0], np.cumsum(np.round(apart_s / interval_s))])  # some may be lost
        rest = self.t_s - np.polyval(np.polyfit(number, self.t_s, 1), number)
        variance = float((rest**2).sum() / (len(self.t_s) - 2))
        return variance if variance < (_LARGEST_JITTER * interval_s) ** 2 else math.nan


def readings_of(session: SessionReader, line: int, levels: Mapping[str, float] | None) -> Readings:
    """The samples of a run; without levels their light is NaN, and a robot that keeps its samples has none."""
    path = session.line_path(line, LIGHT)
    if not path.exists():
        return Readings(np.empty(0), np.empty(0))
    table = numbers_of(path, ("t_host_s", "light_lux"))
    t_s, lux = (np.asarray(table[name], dtype=float) for name in ("t_host_s", "light_lux"))
    if levels is None:
        return Readings(t_s, np.full(len(t_s), np.nan))
    return Readings(t_s, (lux - levels["dark_lux"]) / (levels["bright_lux"] - levels["dark_lux"]))


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """The counted lines of a session as the camera saw them, row by row.

    Attributes:
        seen: (n,) whether it saw the line.
        passes: where the lines lie; of no meaning for lines not seen.
        step_cm: (n,) way between two readings.
        jitter_cm2: (n,) variance of the places at which readings are taken to be; NaN where unknown.
        lines: the session's, with ``end_cm`` by the camera.
        crossings: the robot's on the lines seen, with ``s_cm`` where the camera saw it at ``t_s``.
        light: by line, places of its readings along the run in cm, and their light.
    """

    seen: NDArray[np.bool_]
    passes: Passes
    step_cm: Floats
    jitter_cm2: Floats
    lines: pd.DataFrame
    crossings: pd.DataFrame
    light: Mapping[int, tuple[Floats, Floats]]


def watch(
    session: SessionReader,
    settings: Settings,
    geometry: Silhouette,
    lines: pd.DataFrame,
    crossings: pd.DataFrame,
    filmed: Filmed,
    path_per_cut_cm: float,
) -> Watched:
    """Look up where the robot was.

    Args:
        session: the stored session.
        settings: its settings.
        geometry: the projected shape, arena cm.
        lines: counted rows of the ``lines`` table.
        crossings: of these lines, in order.
        filmed: what the camera saw.
        path_per_cut_cm: of lines that robots cut short; infinite where none is cut.
    """
    count, levels = len(lines), LearntLevels.of(session)
    several = lines["robot"].nunique() > 1
    # whole lines that pass through the shape may as well be endless; their ends in the film are less sure than that
    endless = not several and settings.arena.lines_within.contains(geometry)
    true: dict[int, Any] = {int(row["line"]): row for _, row in filmed.lines.iterrows()}
    frames: dict[Any, pd.DataFrame] = dict(iter(filmed.track.groupby("line")))
    own: dict[Any, pd.DataFrame] = dict(iter(crossings.groupby("line")))
    theta, p, low, high = np.zeros((4, count))
    cut, seen = np.zeros((count, 2), dtype=np.bool_), np.zeros(count, dtype=np.bool_)
    step, jitter = np.full(count, np.nan), np.full(count, np.nan)
    lengths = np.array(lines["end_cm"], dtype=float)
    light: dict[int, tuple[Floats, Floats]] = {}
    moved: list[pd.DataFrame] = []
    for row, (line, robot, ended) in enumerate(lines[["line", "robot", "ended"]].itertuples(index=False)):
        if line not in true or line not in frames:
            continue
        t_s, s_cm = place_along(frames[line], true[line])
        if len(t_s) < 3:
            continue
        seen[row], lengths[row] = True, float(true[line]["length_cm"])
        theta[row], p[row], begin, end = _pass(true[line])
        low[row], high[row] = (-math.inf, math.inf) if endless else sorted((begin, end))
        if several:
            cuts = (True, ended not in EDGES)
            cut[row] = cuts if begin < end else cuts[::-1]
        read = readings_of(session, line, levels.get(line, robot))
        while_seen = (read.t_s > t_s[0]) & (read.t_s < t_s[-1])
        read = Readings(read.t_s[while_seen], read.light[while_seen])
        places = np.interp(read.t_s, t_s, s_cm)
        light[line] = places, read.light
        if len(places) > 5:
            settled = int(_SETTLED * len(places))
            way_cm, time_s = places[-1] - places[settled], read.t_s[-1] - read.t_s[settled]
            step[row] = way_cm / (len(places) - 1 - settled)
            jitter[row] = read.stamp_variance_s2() * (way_cm / time_s) ** 2
        if line in own:
            crossed_s = np.asarray(own[line]["t_s"], dtype=float)
            moved.append(own[line].assign(s_cm=places_at(crossed_s, t_s, s_cm, lengths[row])))
    fallback_cm = settings.motion.speed_cm_s * settings.sensor.interval_s
    step[~(step > 0)] = float(np.median(step[step > 0])) if (step > 0).any() else fallback_cm
    return Watched(
        seen,
        Passes(theta, p, low, high, cut, path_per_cut_cm),
        step,
        jitter,
        lines.assign(end_cm=lengths),
        pd.concat(moved) if moved else crossings.iloc[:0],
        light,
    )


def _pass(line: pd.Series) -> tuple[float, float, float, float]:
    """θ, p, and where along (−sin θ, cos θ) a fitted line begins and ends."""
    cos, sin = math.cos(line["theta_rad"]), math.sin(line["theta_rad"])
    begin, end = (line[f"y_{which}_cm"] * cos - line[f"x_{which}_cm"] * sin for which in ("start", "end"))
    return float(line["theta_rad"]), float(line["p_cm"]), float(begin), float(end)


def places_at(t_s: Floats, known_t_s: Floats, known_cm: Floats, length_cm: float) -> Floats:
    """Places along a run in cm at times in s; before the first and after the last known one by the mean speed.

    None lies off the run: what was felt a moment before the film saw it begin is at its begin.
    """
    speed = (known_cm[-1] - known_cm[0]) / (known_t_s[-1] - known_t_s[0])
    beyond = np.maximum(t_s - known_t_s[-1], 0.0) - np.maximum(known_t_s[0] - t_s, 0.0)
    return np.clip(np.interp(t_s, known_t_s, known_cm) + speed * beyond, 0.0, length_cm)


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Crossings of robot and camera that belong together, one row each.

    Attributes:
        line: (n,) whose they are; ``row`` (n,) its row among the counted lines.
        place_cm: (n,) where along the run the robot found it; ``late_cm`` (n,) how far behind its true place.
        point_cm: (n, 2) the true place on the floor.
        travel: (n, 2) unit vector of the way.
        normal: (n, 2) outward unit normal of the edge.
        corner_cm: (n,) distance to the nearest corner.
    """

    line: Ints
    row: Ints
    place_cm: Floats
    late_cm: Floats
    point_cm: Floats
    travel: Floats
    normal: Floats
    corner_cm: Floats

    @classmethod
    def between(cls, watched: Watched, filmed: Filmed, geometry: Silhouette) -> Edges:
        """Pair the crossings of those lines on which both found as many, neither end of the run among them."""
        lines = watched.lines
        open_ends = lines.loc[lines["starts_lit"] | lines["ends_lit"], "line"]
        found, true = watched.crossings, filmed.crossings
        many, truly = found.groupby("line").size(), true.groupby("line").size()
        alike = many.index[many == truly.reindex(many.index)].difference(pd.Index(open_ends))
        pairs = found[found["line"].isin(alike)].merge(true, on=["line", "order"], suffixes=("", "_true"))
        late = np.asarray(pairs["s_cm"] - pairs["s_cm_true"], dtype=float)
        kept = np.abs(late - np.median(late)) < _FARTHEST_CM if len(late) else np.zeros(0, dtype=np.bool_)
        pairs, late = pairs[kept], late[kept]
        ways = filmed.lines.set_index("line").loc[pairs["line"]]
        along = np.column_stack([ways["x_end_cm"] - ways["x_start_cm"], ways["y_end_cm"] - ways["y_start_cm"]])
        point = pairs[["x_cm", "y_cm"]].to_numpy(dtype=float)
        outline = Outline.of(geometry)
        return cls(
            line=pairs["line"].to_numpy(dtype=np.int64),
            row=pd.Index(lines["line"]).get_indexer(pd.Index(pairs["line"])).astype(np.int64),
            place_cm=pairs["s_cm"].to_numpy(dtype=float),
            late_cm=late,
            point_cm=point,
            travel=along / np.hypot(along[:, 0], along[:, 1])[:, None],
            normal=outline.normals_at(point),
            corner_cm=outline.corner_distance_cm(point),
        )

    def shift(self, nadir_cm: Floats, group: Ints, groups: int) -> EdgeShift | None:
        """Why they lie where they lie; ``group`` is by row of the counted lines."""
        # a footprint moves the edge near a corner, which is no shift of the image
        used = self.corner_cm > _CORNER_CM
        if int(used.sum()) < _ENOUGH_EDGES:
            used = np.ones(len(used), dtype=np.bool_)
        away_cm = self.point_cm[used] - nadir_cm
        return fit_edge_shift(
            self.late_cm[used], self.travel[used], self.normal[used], away_cm, group[self.row[used]], groups
        )

    def ramps(self, watched: Watched) -> Ramps | None:
        """The light's ramps at clean edges, by row of the counted lines; None with too few."""
        met = (self.travel * self.normal).sum(axis=1)
        for reach_cm in _REACHES_CM:
            width, edges = np.zeros((2, len(watched.seen)))
            clean = self.corner_cm > reach_cm
            for line in np.unique(self.line).tolist():
                mine = np.flatnonzero(self.line == line)
                s_cm, light = watched.light[line]
                places = self.place_cm[mine]
                near = (s_cm > places[0] - _AROUND_CM) & (s_cm < places[-1] + _AROUND_CM) & np.isfinite(light)
                row = self.row[mine[0]]
                width[row], edges[row] = ramp_of_line(s_cm[near], light[near], places, met[mine], clean[mine], reach_cm)
            if edges.sum() >= FEWEST_EDGES:
                return Ramps(width, edges)
        return None
