"""The derived tables of a session, rebuilt from its log at will."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from lab.base.files import write_aside
from lab.store.layout import SessionFolderError
from lab.store.lock import writing
from lab.store.reader import SessionReader
from lab.store.sound import check_sound

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

    @property
    def crossed(self) -> pd.DataFrame:
        """The lines of the statistics that crossed the shape."""
        return self.lines[self.lines["counts"] & (self.lines["k"] > 0)]


def tables_of(session: SessionReader) -> Tables:
    """Read a session's log into tables. Raises SessionFolderError naming the event that lacks a value."""
    return tables_from(session.events(), session.folder)


def tables_from(events: Iterable[Mapping[str, Any]], folder: Path) -> Tables:
    """Make tables of events, those of ``folder``'s session. Raises SessionFolderError as `tables_of`."""
    lines: list[dict[str, Any]] = []
    crossings: list[dict[str, Any]] = []
    estimates: list[dict[str, Any]] = []
    for event in events:
        if event["event"] != "line":
            continue
        try:
            lines.append({name: event[name] for name in LINE_COLUMNS})
            for order, (t_s, s_cm, entering) in enumerate(event["crossings"]):
                crossings.append(
                    {"line": event["line"], "order": order, "t_s": t_s, "s_cm": s_cm, "entering": entering}
                )
            if "estimate" in event:
                estimates.append({"line": event["line"], "t_s": event["t_end_s"], **event["estimate"]})
        except (KeyError, TypeError, ValueError) as error:
            raise SessionFolderError(folder, f"the event of line {event.get('line')} is not whole ({error})") from error
    tables = Tables(
        _table(folder, lines, LINE_COLUMNS),
        _table(folder, crossings, CROSSING_COLUMNS),
        _table(folder, estimates, ESTIMATE_COLUMNS),
    )
    check_sound(folder, tables.lines, tables.crossings, tables.estimates)
    return tables


def finalize(folder: Path) -> Tables:
    """Rebuild and write the tables of a session folder.

    Raises SessionFolderError: it is no session, its log is not whole, or another process writes in it.
    """
    session = SessionReader(folder)
    with writing(folder):
        tables = tables_of(session)
        for name in Tables.__slots__:
            write_table(folder, name, getattr(tables, name))
    return tables


def write_table(folder: Path, name: str, table: pd.DataFrame) -> None:
    """Write a derived table into a session's folder, whole or not at all. Raises OSError."""
    write_aside(folder / f"{name}.parquet", table.to_parquet(index=False))


def _table(folder: Path, rows: list[dict[str, Any]], columns: dict[str, str]) -> pd.DataFrame:
    try:
        return pd.DataFrame(rows, columns=list(columns)).astype(columns)
    except (TypeError, ValueError, OverflowError) as error:
        raise SessionFolderError(folder, f"the log holds a value of the wrong kind ({error})") from error
