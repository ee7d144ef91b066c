"""How the commands take shapes and workers from the command line, and leave files."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lab.base.errors import RequestError
from lab.cli.completing import collections, shapes
from projector.catalogue import COLLECTIONS

if TYPE_CHECKING:
    from projector.dictionary import Shape


PICTURES = (".png", ".svg", ".pdf")

ShapeArgument = Annotated[
    str,
    typer.Argument(
        metavar="SHAPE", help="A dictionary name, text:WORD, or a .geojson, .svg or .png file.", autocompletion=shapes
    ),
]
ShapeArguments = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[SHAPE]...",
        help="Dictionary names, text:WORD, or .geojson, .svg or .png files.",
        autocompletion=shapes,
    ),
]
FontOption = Annotated[Path | None, typer.Option("--font", help="Font file for text:WORD.")]
CollectionOption = Annotated[
    str | None, typer.Option("--collection", help=f"One of {', '.join(COLLECTIONS)}.", autocompletion=collections)
]
ConfidenceOption = Annotated[
    float, typer.Option("--confidence", min=0.5, max=1, help="Chance of being right that is asked for.")
]
WorkersOption = Annotated[
    int | None, typer.Option("--workers", min=0, help="Processes that share the work; 0: this one alone.")
]
SchedulerOption = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="tcp://HOST:PORT of a Dask cluster that does it.")
]


def chosen_shapes(specs: Sequence[str] | None, collection: str | None, font: Path | None) -> list[Shape]:
    """A collection and what is named beside it. Raises RequestError where two shapes share a name."""
    from projector.dictionary import load_dictionary, shape_from
    from projector.text import TEXT_PREFIX

    known = {} if collection is None else load_dictionary(collection, font=font)
    for spec in specs or ():
        shape = shape_from(spec, font=font if spec.startswith(TEXT_PREFIX) else None)
        if shape.name in known and known[shape.name].digest != shape.digest:
            raise RequestError(f"two different shapes are called {shape.name}; rename one of the files")
        known[shape.name] = shape
    return list(known.values())


def picture_path(path: Path) -> Path:
    """Refuse what is no picture by its name."""
    if path.suffix.lower() not in PICTURES:
        raise RequestError(f"{path}: a picture ends in {', '.join(PICTURES)}")
    return path


@contextmanager
def leaving(path: Path) -> Generator[None]:
    """Make the folder of a file that is about to be written; say in one line when it cannot be."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise RequestError(f"{path}: cannot be written ({error.strerror or error}); choose another --out") from error
