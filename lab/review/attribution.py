"""Several robots in one film: whose each track is, which run each frame belongs to, and what cut runs still say.

The film of several robots is cut by time, not by run: their runs overlap. The tracks were told apart by the colours
of the LEDs; here they get the robots' names, and every frame the run that its robot was rolling then.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely import Polygon

from analysis.estimate import Estimate
from lab.session.run import EDGES
from lab.session.tally import stored_estimate

Floats = NDArray[np.float64]

_AT_END_CM = 1e-6  # a crossing so near to a run's end is the end itself


def attribute(track: pd.DataFrame, lines: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Give each row of a film's track its robot's name and its run.

    Args:
        track: several robots' track on the host's clock; ``line`` is the number of the film's slice, ``robot`` the
            place in ``names``.
        lines: the session's runs: ``line robot t_start_s t_end_s``.
        names: the robots, in the order of their tracks.

    Returns:
        The track with ``segment`` for the slice, ``line`` for the run (-1 between runs) and ``robot`` for the name.
    """
    own = track.rename(columns={"line": "segment"}).assign(robot=np.asarray(names, dtype=object)[track["robot"]])
    line = np.full(len(own), -1, dtype=np.int64)
    t_s = own["t_s"].to_numpy(dtype=float)
    for name, runs in lines.sort_values("t_start_s").groupby("robot"):
        rows = np.flatnonzero(own["robot"] == name)
        starts, ends = runs["t_start_s"].to_numpy(dtype=float), runs["t_end_s"].to_numpy(dtype=float)
        run = np.asarray(np.searchsorted(starts, t_s[rows], side="right"), dtype=np.int64) - 1
        rolling = (run >= 0) & (t_s[rows] <= ends[run])
        line[rows[rolling]] = runs["line"].to_numpy(dtype=np.int64)[run[rolling]]
    own.insert(0, "line", line)
    return own.astype({"robot": "str"})


def camera_estimate(true_lines: pd.DataFrame, crossings: pd.DataFrame, lines: pd.DataFrame) -> Estimate | None:
    """Area and perimeter from the camera's own lines, those that other robots cut short included.

    Args:
        true_lines: as ``fit_lines`` gives them.
        crossings: as ``true_crossings`` gives them, closed at a run's ends where these are lit.
        lines: the session's runs.
    """
    seen = true_lines[["line", "length_cm"]].merge(lines[["line", "robot", "ended"]], on="line")
    ends = dict(zip(seen["line"], seen["length_cm"], strict=True))
    known = crossings[crossings["line"].isin(seen["line"])]
    of_line = known.groupby("line")["s_cm"]
    starts_lit = {line for line, s_cm in of_line.min().items() if s_cm < _AT_END_CM}
    ends_lit = {line for line, s_cm in of_line.max().items() if s_cm > ends[line] - _AT_END_CM}
    made = seen.assign(
        counts=True,
        k=seen["line"].map(of_line.size()).fillna(0).astype(int) // 2,
        end_cm=seen["length_cm"],
        starts_lit=seen["line"].isin(starts_lit),
        ends_lit=seen["line"].isin(ends_lit),
    )
    return stored_estimate(made, known)


def lines_from_the_edge(
    true_lines: pd.DataFrame, lines: pd.DataFrame, region: Polygon, part_of: Mapping[int, int] | None = None
) -> pd.DataFrame:
    """The true lines of runs that began at the edge, robot by robot, each as long as it would have been.

    Where a run ends says nothing of how its robot turned, so one cut short by another robot counts as the line that
    it lay on; what begins at another robot, or where a robot was set down, does not follow the law of the edge. It is
    set down anew in each part of a session that was resumed: ``part_of`` is the part of each run (no entry: 0).
    """
    runs = lines.sort_values(["robot", "t_start_s"])
    part = [(part_of or {}).get(line, 0) for line in runs["line"].tolist()]
    before = runs.assign(part=part).groupby(["robot", "part"])["ended"].shift()
    began = runs.assign(cut=~runs["ended"].isin(EDGES))[before.isin(EDGES).to_numpy()]
    found = began[["line", "cut"]].merge(true_lines, on="line")
    whole_cm = _chord_cm(found["theta_rad"].to_numpy(dtype=float), found["p_cm"].to_numpy(dtype=float), region)
    return found.assign(length_cm=np.where(found["cut"], whole_cm, found["length_cm"])).drop(columns="cut")


def _chord_cm(theta_rad: Floats, p_cm: Floats, region: Polygon) -> Floats:
    """Length inside the region of lines with normal direction theta at distance p."""
    normal = np.column_stack([np.cos(theta_rad), np.sin(theta_rad)])
    along = np.column_stack([-normal[:, 1], normal[:, 0]])
    left, bottom, right, top = region.bounds
    reach = np.hypot(right - left, top - bottom)
    middle = p_cm[:, None] * normal
    ends = np.stack([middle - reach * along, middle + reach * along], axis=1)
    return np.array([shapely.LineString(line).intersection(region).length for line in ends], dtype=float)
