"""How every command speaks: results on stdout, progress and errors on stderr, JSON alone when asked."""

from __future__ import annotations

import errno
import json
import math
import os
import textwrap
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Annotated, Any, cast

import typer

JsonFlag = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout, and nothing else.")]
QuietFlag = Annotated[bool, typer.Option("--quiet", help="Only the result, and errors: no progress, no remarks.")]

_FULL = (errno.ENOSPC, errno.EDQUOT)


def say(text: str) -> None:
    """One line of result on stdout."""
    _print(text, to_stderr=False)


def complain(text: str) -> None:
    """One line on stderr."""
    _print(text, to_stderr=True)


def _print(text: str, *, to_stderr: bool) -> None:
    """On a terminal words stay whole; a path, and all that goes into a pipe, stays one line."""
    from rich.console import Console

    console = Console(stderr=to_stderr, highlight=False, markup=False)
    console.print(text, soft_wrap=not console.is_terminal or " " not in text)


def fail(text: str) -> None:
    """Say on stderr, in one line, what is wrong and how to mend it; in colour on a terminal alone."""
    from rich.console import Console
    from rich.text import Text

    line = Text.assemble(("error:", "bold red"), " ", " ".join(text.split()))
    Console(stderr=True, soft_wrap=True, highlight=False).print(line)


def refused(error: OSError) -> str:
    """What the operating system will not do, and the cure."""
    what = f"{error.filename}: {error.strerror}" if error.filename else str(error.strerror or error)
    if error.errno in _FULL:
        return f"{what}; make room, or name another disk"
    if error.filename:
        return f"{what}; name another file or folder, or mend its rights"
    return f"{what}; mend that, and try again"


def show_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A small table on stdout; figures to the right, texts to the left.

    On a narrow terminal texts fold between words, figures never; where even that is too wide, a row becomes a line.
    Into a pipe or a file, where nobody says how wide it is (COLUMNS), nothing folds.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False, markup=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _ENDLESS
    cells = list(zip(*rows, strict=True)) if rows else [()] * len(columns)
    figures = [number > 0 and _is_of_figures(column) for number, column in enumerate(cells)]
    table = Table(title=title, title_justify="left", header_style="bold", show_header=any(columns))
    widths = _widths(columns, cells, figures, console.width - 3 * len(columns) - 1)
    if widths is None:
        console.print(Text(title, "bold"))
        for row in rows:
            console.print(_as_line(columns, row, console.width), soft_wrap=True)
        return
    for column, is_figures, width in zip(columns, figures, widths, strict=True):
        table.add_column(column, justify="right" if is_figures else "left", overflow="fold", width=width)
    for row in rows:
        table.add_row(*map(Text, row))
    console.print(table)


_ENDLESS = 10_000
_LONGEST_WORD = 24  # a path folds
_JOINED = "\N{NO-BREAK SPACE}"


def _is_of_figures(cells: Sequence[str]) -> bool:
    """Whether most cells are numbers, maybe with error and unit, and not texts."""
    return bool(cells) and 2 * sum(len(cell) <= 24 and cell[:1] in set("0123456789+-−–±<") for cell in cells) >= len(
        cells
    )


def _widths(
    columns: Sequence[str], cells: Sequence[Sequence[str]], figures: Sequence[bool], room: int
) -> list[int] | None:
    """How wide each column is where all have so much room; None where words or figures would be cut."""
    least: list[int] = []
    widths: list[int] = []
    for column, own, is_figures in zip(columns, cells, figures, strict=True):
        rows = [row for cell in own for row in cell.split("\n")]
        whole = [*column.split(), *rows] if is_figures else [word for text in (column, *rows) for word in text.split()]
        widths.append(max(map(len, (column, *rows))))
        least.append(min(widths[-1], max(map(len, whole), default=0), _LONGEST_WORD))
    while sum(widths) > room:
        spare = [width - low for width, low in zip(widths, least, strict=True)]
        if max(spare) <= 0:
            return None
        widths[spare.index(max(spare))] -= 1
    return widths


def _as_line(columns: Sequence[str], row: Sequence[str], width: int) -> str:
    """A row as `first: column figure; column figure`, broken between them."""
    pairs = [f"{name} {cell}".strip() for name, cell in zip(columns[1:], row[1:], strict=True) if cell]
    text = " ".join(
        (pair.replace(" ", _JOINED) if len(pair) <= _LONGEST_WORD else pair) + ";" for pair in pairs
    ).rstrip(";")
    whole = textwrap.fill(
        f"{row[0].replace(' ', _JOINED)}: {text}",
        width,
        subsequent_indent="  ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    return whole.replace(_JOINED, " ")


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
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in cast("Sequence[Any]", value)]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    as_list = getattr(value, "tolist", None)  # NumPy's arrays and scalars
    return str(value) if as_list is None else plain(as_list())


@contextmanager
def progress_bar(label: str, *, quiet: bool) -> Generator[Callable[[int, int], None]]:
    """A bar with the time left on stderr; yields ``update(done, total)``.

    Silent when ``quiet`` or when stderr is no terminal.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True, quiet=quiet)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task(label, total=None)

        def update(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        yield update
