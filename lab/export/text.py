"""CSV: every table of a session, for spreadsheets and for everything else."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pandas as pd

from lab.export.aside import whole_file
from lab.export.source import Source

Progress = Callable[[int, int], None]

_LIGHT_COLUMNS = ("run", "robot", "t_host_s", "light_lux", "x_cm", "y_cm", "speed_cm_s")
# What a spreadsheet takes for the beginning of a formula (OWASP, CSV injection).
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def write_csv(source: Source, out: Path, progress: Progress | None = None) -> list[Path]:
    """Write lines.csv, crossings.csv, estimates.csv, light.csv and, where the film was tracked, track.csv.

    UTF-8 with a byte order mark, by which spreadsheets know it; numbers to their last digit; empty for what is not
    known. light.csv holds the raw samples of all runs in the order of the log, with ``run`` and ``robot`` before the
    columns of light.parquet. A text that a spreadsheet would take for a formula has an apostrophe before it: robots
    give themselves their names.

    Args:
        source: the session.
        out: a folder that exists.
        progress: called with (rows written, rows in all) after each piece.

    Returns:
        The files.

    Raises:
        RequestError: a file cannot be written, or a table of the session cannot be read.
    """
    tables = source.tables
    pieces: dict[str, Callable[[], Iterable[pd.DataFrame]]] = {
        "lines": lambda: [tables.lines],
        "crossings": lambda: [tables.crossings],
        "estimates": lambda: [tables.estimates],
        "light": lambda: _light(source),
    }
    if source.track is not None:
        pieces["track"] = source.track_rows
    total = len(tables.lines) + source.track_length()
    done, written = 0, list[Path]()
    for name, parts in pieces.items():
        path = out / f"{name}.csv"
        with whole_file(path) as aside, aside.open("w", encoding="utf-8-sig", newline="") as file:
            for number, part in enumerate(parts()):
                _append(file, part, header=number == 0)
                done += {"light": 1, "track": len(part)}.get(name, 0)
                if progress is not None:
                    progress(min(done, total), total)
        written.append(path)
    return written


def write_light(source: Source, file: io.TextIOBase) -> None:
    """Write light.csv to an open file; errors as ``write_csv``."""
    for number, part in enumerate(_light(source)):
        _append(file, part, header=number == 0)


def _light(source: Source) -> Iterator[pd.DataFrame]:
    yield pd.DataFrame(columns=list(_LIGHT_COLUMNS))
    for line, robot in zip(source.tables.lines["line"], source.tables.lines["robot"], strict=True):
        samples = source.light(int(line))
        yield samples.assign(run=line, robot=robot)[list(_LIGHT_COLUMNS)] if len(samples) else samples


def _append(file: io.TextIOBase, table: pd.DataFrame, *, header: bool) -> None:
    texts = table.select_dtypes(include=["object", "str"]).columns
    safe = table.assign(**{name: table[name].map(_guarded, na_action="ignore") for name in texts})
    if header or len(safe):
        safe.to_csv(file, index=False, header=header, lineterminator="\n")


def _guarded(value: object) -> object:
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value
