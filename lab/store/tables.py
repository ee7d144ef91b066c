"""The derived tables of a session, rebuilt from its log at will."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from lab.store import SessionFolderError, SessionReader

LINE_COLUMNS = {
    "line": "int64",
    "robot": "str",
    "t_start_s": "float64",
    "t_rolling_s": "float64",
    "t_end_s": "float64",
    "length_cm": "float64",
    "end_cm": "float64",
    "speed_cm_s": "float64",
    "k": "int64",
    "l1_cm": "float64",
    "l3_cm3": "float64",
    "ended": "str",
    "counts": "bool",
    "whole": "bool",
    "weight": "float64",
    "starts_lit": "bool",
    "ends_lit": "bool",
}
# What the lines of a log of schema 1 do not say: they were all of one robot, and whole.
_SCHEMA_1 = {"robot": "", "weight": 1.0, "starts_lit": False, "ends_lit": False}
CROSSING_COLUMNS = {"line": "int64", "order": "int64", "t_s": "float64", "s_cm": "float64", "entering": "bool"}
ESTIMATE_COLUMNS = {
    "n": "int64",
    "line": "int64",
    "t_s": "float64",
    "area_cm2": "float64",
    "perimeter_cm": "float64",
    "sigma_area_cm2": "float64",
    "sigma_perimeter_cm": "float64",
    "correlation": "float64",
    "leading": "str",
    "posterior": "float64",
}


@dataclass(frozen=True, slots=True)
class Tables:
    """What a session's log says, as tables.

    ``lines``: one row a run; ``counts`` is true for runs from wall to wall, the lines of the statistics.
    ``crossings``: one row a crossing of the shape's boundary. ``estimates``: one row a line that crosses.
    Lengths in cm, times in s of the host's clock. Sigmas and the correlation are NaN before the second line.
    """

    lines: pd.DataFrame
    crossings: pd.DataFrame
    estimates: pd.DataFrame


def tables_of(session: SessionReader) -> Tables:
    """Read a session's log into tables. Raises SessionFolderError naming the event that lacks a value."""
    lines: list[dict[str, Any]] = []
    crossings: list[dict[str, Any]] = []
    estimates: list[dict[str, Any]] = []
    absent = _SCHEMA_1 if session.schema_version == 1 else {}
    for event in session.events():
        if event["event"] != "line":
            continue
        try:
            known = {**absent, "whole": event["counts"], "end_cm": event["length_cm"], **event} if absent else event
            lines.append({name: known[name] for name in LINE_COLUMNS})
            for order, (t_s, s_cm, entering) in enumerate(event["crossings"]):
                crossings.append(
                    {"line": event["line"], "order": order, "t_s": t_s, "s_cm": s_cm, "entering": entering}
                )
            if "estimate" in event:
                estimates.append({"line": event["line"], "t_s": event["t_end_s"], **event["estimate"]})
        except (KeyError, TypeError, ValueError) as error:
            raise SessionFolderError(
                session.folder, f"the event of line {event.get('line')} is not whole ({error})"
            ) from error
    return Tables(
        _table(session, lines, LINE_COLUMNS),
        _table(session, crossings, CROSSING_COLUMNS),
        _table(session, estimates, ESTIMATE_COLUMNS),
    )


def finalize(folder: Path) -> Tables:
    """Rebuild and write the tables of a session folder."""
    tables = tables_of(SessionReader(folder))
    for name in Tables.__slots__:
        getattr(tables, name).to_parquet(folder / f"{name}.parquet", index=False)
    return tables


def _table(session: SessionReader, rows: list[dict[str, Any]], columns: dict[str, str]) -> pd.DataFrame:
    try:
        return pd.DataFrame(rows, columns=list(columns)).astype(columns)
    except (TypeError, ValueError) as error:
        raise SessionFolderError(session.folder, f"the log holds a value of the wrong kind ({error})") from error
