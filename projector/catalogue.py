"""What collections of shapes there are, and where their files lie; nothing is read, so that a shell can ask it."""

from __future__ import annotations

import string
from pathlib import Path

from lab.base.errors import ChordlabError

PAPER = "paper"
DRAWN = (PAPER, "monuments")
COLLECTIONS = (*DRAWN, "letters", "words", "all")
LETTERS = string.ascii_uppercase + string.digits


def shapes_folder() -> Path:
    """The folder of the dictionary's files: beside this module when installed, else the checkout's."""
    here = Path(__file__).resolve().parent
    for folder in (here / "shapes", here.parent / "data" / "shapes"):
        if folder.is_dir():
            return folder
    raise ChordlabError("the dictionary's shapes are missing from this installation; install chordlab again")


def drawn_files(collection: str) -> dict[str, Path]:
    """The GeoJSON files of ``paper`` or ``monuments``, by the shapes' names."""
    folder = shapes_folder() if collection == PAPER else shapes_folder() / collection
    return {path.stem: path for path in sorted(folder.glob("*.geojson"))}
