"""How every command speaks: results on stdout, progress and errors on stderr, JSON alone when asked."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Annotated, Any, cast

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

JsonFlag = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout, and nothing else.")]


def say(text: str) -> None:
    """One line of result on stdout."""
    Console(soft_wrap=True, highlight=False, markup=False).print(text)


def complain(text: str) -> None:
    """One line on stderr."""
    Console(stderr=True, soft_wrap=True, highlight=False, markup=False).print(text)


def show_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A small table on stdout; first column left, the rest right."""
    table = Table(title=title, title_justify="left", header_style="bold", show_header=any(columns))
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    Console(highlight=False).print(table)


def lines_needed(lines: int | None) -> str:
    """The lines that something takes, as a table says it."""
    return "never" if lines is None else str(lines)


def emit(data: Mapping[str, Any]) -> None:
    """Print one JSON object. Numbers that are not finite become null."""
    typer.echo(json.dumps(plain(data), ensure_ascii=False))


def plain(value: Any) -> Any:
    """Make a value JSON: arrays to lists, NaN to null, paths to text."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in cast("Mapping[Any, Any]", value).items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(cast("Any", value).tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in cast("Sequence[Any]", value)]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)


@contextmanager
def progress_bar(label: str, *, quiet: bool) -> Generator[Callable[[int, int], None]]:
    """A bar on stderr; yields ``update(done, total)``. Silent when ``quiet`` or when stderr is no terminal."""
    console = Console(stderr=True, quiet=quiet)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task(label, total=None)

        def update(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        yield update
