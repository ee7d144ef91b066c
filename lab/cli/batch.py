"""`chordlab batch`: every stored session below some folders."""

from __future__ import annotations

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lab.base.errors import ChordlabError, RequestError
from lab.cli.choosing import SchedulerOption, WorkersOption
from lab.cli.output import JsonFlag, QuietFlag, complain, emit, progress_bar, say, show_table

if TYPE_CHECKING:
    import pandas as pd

    from lab.batch.analyse import Analysed


def batch(
    roots: Annotated[list[Path], typer.Argument(metavar="ROOT...", help="Folders that hold sessions.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the tables and the report.")] = Path("batch"),
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    again: Annotated[bool, typer.Option("--again", help="Analyse anew what is known, too.")] = False,
    no_cache: Annotated[bool, typer.Option("--no-cache", help="Neither use nor keep what is known.")] = False,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Analyse every session below ROOT. One table, one row a session; a broken one is a row with its reason.

    Nothing is written in the sessions. What is known from the last time is not worked out again.

    Example: chordlab batch sessions --out batch
    """
    from lab.batch.analyse import analyse
    from lab.batch.cache import RowCache
    from lab.batch.places import places_below
    from lab.batch.shapes import per_shape

    places = places_below(roots)
    _make(out)
    with progress_bar("sessions", quiet=quiet) as update, _terminated_as_interrupted():
        found = analyse(
            places,
            cache=None if no_cache else RowCache(out / "cache"),
            again=again,
            workers=workers,
            scheduler=scheduler,
            progress=update,
        )
    shapes = per_shape(found.table)
    files = _write(found.table, shapes, out)
    broken = found.table[found.table["error"] != ""]
    if as_json:
        emit(
            {
                "sessions": len(found.table),
                "asked": len(places),
                "computed": found.computed,
                "broken": broken[["session", "error"]].to_dict(orient="records"),
                "shapes": shapes.to_dict(orient="records"),
                **files,
            }
        )
    else:
        _tell(found, shapes, broken, files, quiet=quiet)
    if isinstance(found.stopped, ChordlabError):
        raise found.stopped
    if found.stopped is not None:
        complain(f"stopped after {len(found.table)} of {len(places)} sessions; the same command goes on from there")
    if found.stopped is not None or len(broken) == len(found.table):
        raise typer.Exit(1)


def _make(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"{out}: {error.strerror}; choose another --out") from error


def _write(table: pd.DataFrame, shapes: pd.DataFrame, out: Path) -> dict[str, Path]:
    from analysis.report.sheet import write_sheet
    from lab.base.files import write_aside

    files = {"table": out / "batch.parquet", "csv": out / "batch.csv", "shapes_csv": out / "shapes.csv"}
    try:
        write_aside(files["table"], table.to_parquet(index=False))
        write_aside(files["csv"], table.to_csv(index=False).encode())
        write_aside(files["shapes_csv"], shapes.to_csv(index=False).encode())
    except OSError as error:
        raise RequestError(f"{out}: cannot be written ({error.strerror or error}); choose another --out") from error
    return files | {"report": write_sheet(table, shapes, out / "report.html")}


def _tell(found: Analysed, shapes: pd.DataFrame, broken: pd.DataFrame, files: dict[str, Path], *, quiet: bool) -> None:
    import pandas as pd

    from analysis.report.words import count, percent, signed, signed_with

    if quiet:
        say(str(files["report"]))
        return

    def side(row: pd.Series[Any], name: str) -> str:
        error, sigma = row[f"{name}_error_rel"], row[f"{name}_error_sigma_rel"]
        return signed(100 * error) if pd.isna(sigma) else signed_with(100 * error, 100 * sigma)

    def spread(row: pd.Series[Any], name: str) -> str:
        sd = row[f"{name}_z_sd"]
        return "–" if pd.isna(sd) else f"{sd:.2f}"

    rows = [
        (
            str(row["shape"]),
            str(row["sessions"]),
            percent(row["right_share"], 0),
            side(row, "area"),
            spread(row, "area"),
            side(row, "perimeter"),
            spread(row, "perimeter"),
        )
        for _, row in shapes.iterrows()
    ]
    show_table("Sessions by shape", ("shape", "sessions", "right", "A error, %", "sd z", "P error, %", "sd z"), rows)
    for _, row in broken.iterrows():
        say(f"{row['session']}: {row['error']}")
    say(f"{count(len(found.table), 'session')}, {found.computed} of them analysed now")
    say(str(files["report"]))


@contextmanager
def _terminated_as_interrupted() -> Generator[None]:
    """Take a request to end (SIGTERM) as Ctrl-C: what is done is kept."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
