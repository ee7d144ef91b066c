"""How the commands take shapes and workers from the command line, and leave files."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from lab.base.errors import RequestError
from projector.collections import COLLECTIONS
from projector.dictionary import Shape, load_dictionary, shape_from
from projector.text import TEXT_PREFIX

PICTURES = (".png", ".svg", ".pdf")

ShapeArgument = Annotated[
    str, typer.Argument(metavar="SHAPE", help="A dictionary name, text:WORD, or a .geojson, .svg or .png file.")
]
ShapeArguments = Annotated[
    list[str] | None,
    typer.Argument(metavar="[SHAPE]...", help="Dictionary names, text:WORD, or .geojson, .svg or .png files."),
]
FontOption = Annotated[Path | None, typer.Option("--font", help="Font file for text:WORD.")]
CollectionOption = Annotated[str | None, typer.Option("--collection", help=f"One of {', '.join(COLLECTIONS)}.")]
WorkersOption = Annotated[
    int | None, typer.Option("--workers", min=0, help="Processes that share the work; 0: this one alone.")
]
SchedulerOption = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="tcp://HOST:PORT of a Dask cluster that does it.")
]


def chosen_shapes(specs: Sequence[str] | None, collection: str | None, font: Path | None) -> list[Shape]:
    """A collection and what is named beside it. Raises RequestError where two shapes share a name."""
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
