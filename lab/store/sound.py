"""Whether a log's tables can be true: a stranger's folder, or a bad disk, may hold any number."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd

from lab.store.layout import SessionFolderError

_LONGEST_CM = 1e6  # ten kilometres: far beyond any floor, and its cube still far from a float's end
_LONGEST_S = 1e11
# The least and the most of each column; the second part may be missing (NaN) too.
_LINES = {
    "line": (0, 10**9),
    "t_start_s": (-_LONGEST_S, _LONGEST_S),
    "t_end_s": (-_LONGEST_S, _LONGEST_S),
    "length_cm": (0, _LONGEST_CM),
    "end_cm": (-_LONGEST_CM, _LONGEST_CM),
    "k": (0, 10**6),
    "l1_cm": (0, _LONGEST_CM),
    "l3_cm3": (0, _LONGEST_CM**3),
    "weight": (1e-9, 1e9),
}
_LINES_OR_MISSING = {"t_rolling_s": (-_LONGEST_S, _LONGEST_S), "speed_cm_s": (0, _LONGEST_CM)}
_CROSSINGS = {"line": (0, 10**9), "t_s": (-_LONGEST_S, _LONGEST_S), "s_cm": (-_LONGEST_CM, _LONGEST_CM)}
_ESTIMATES = {"n": (0, 10**9), "line": (0, 10**9), "t_s": (-_LONGEST_S, _LONGEST_S)}


def check_sound(folder: Path, lines: pd.DataFrame, crossings: pd.DataFrame, estimates: pd.DataFrame) -> None:
    """Make sure that every figure of a session's tables is one that a session can have, and each run is there once.

    Raises:
        SessionFolderError: one is not; it names the run.
    """
    _check(folder, lines, _LINES)
    _check(folder, lines, _LINES_OR_MISSING, may_miss=True)
    _check(folder, crossings, _CROSSINGS)
    _check(folder, estimates, _ESTIMATES)
    figures = [name for name, kind in estimates.dtypes.items() if kind == np.float64 and name not in _ESTIMATES]
    _check(folder, estimates, {str(name): (-1e300, 1e300) for name in figures}, may_miss=True)
    twice = lines["line"].duplicated()
    _refuse(folder, lines.loc[twice, "line"], "stands in the log twice")
    stray = ~crossings["line"].isin(lines["line"])
    _refuse(folder, crossings.loc[stray, "line"], "has crossings and no run")


def _check(
    folder: Path, table: pd.DataFrame, bounds: dict[str, tuple[float, float]], *, may_miss: bool = False
) -> None:
    for name, (least, most) in bounds.items():
        values = table[name]
        good = values.between(least, most) | (values.isna() if may_miss else False)
        _refuse(folder, table.loc[~good, "line"], f"has a {name} that cannot be")


def _refuse(folder: Path, lines: Iterable[int], what: str) -> None:
    for line in lines:
        raise SessionFolderError(folder, f"the event of line {line} {what}; the log was changed, take another copy")
