"""The collections of shapes that come with chordlab.

``paper`` is what a session chooses among by default: the six of the paper. ``monuments`` are drawn silhouettes,
``letters`` the capitals and digits of a font, ``words`` the words of the UN Charter's preamble, and ``all`` is
everything. Names are unique across collections: a text is ``text:WORD``, as a user would write it, and has the size
that it would have then.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lab.base.errors import ChordlabError, RequestError
from projector.catalogue import COLLECTIONS, DRAWN, LETTERS, PAPER, drawn_files, shapes_folder
from projector.geojson import read_shape
from projector.shape import Font, Shape
from projector.text import Typeface, find_font


def charter_words() -> list[str]:
    """The words of the UN Charter's preamble in capitals, each once, in the order of their appearance."""
    path = shapes_folder() / "words" / "un_charter_preamble.txt"
    try:
        rows = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise ChordlabError("the list of words is missing from this installation; install chordlab again") from error
    return [row.strip() for row in rows if row.strip() and not row.startswith("#")]


def load_dictionary(collection: str = PAPER, *, font: str | Path | Font | None = None) -> dict[str, Shape]:
    """Read a collection's shapes, by name.

    Drawn shapes go from the most compact to the most intricate: by P²/A, 4π for the circle. ``font`` is for
    letters and words: a path, or a record (default: ``find_font``).

    Raises RequestError for a name that is no collection, ShapeError for a font that lacks a letter.

    >>> list(load_dictionary())
    ['circle', 'square', 'triangle', 'chichen_itza', 'eiffel', 'liberty']
    """
    if collection not in COLLECTIONS:
        raise RequestError(f"{collection} is no collection of shapes; known are {', '.join(COLLECTIONS)}")
    shapes: list[Shape] = []
    for name in DRAWN:
        if collection in (name, "all"):
            shapes += _drawn(name)
    if collection in ("letters", "words", "all"):
        typeface = Typeface(font if isinstance(font, Font) else find_font(font))
        if collection in ("letters", "all"):
            shapes += _set(typeface, LETTERS)
        if collection in ("words", "all"):
            shapes += _set(typeface, charter_words())
    named = {shape.name: shape for shape in shapes}
    if len(named) < len(shapes):
        names = [shape.name for shape in shapes]
        double = sorted({name for name in named if names.count(name) > 1})
        raise ChordlabError(f"two shapes of the dictionary are called {', '.join(double)}; rename one")
    return named


def _drawn(collection: str) -> list[Shape]:
    files = drawn_files(collection)
    if not files:
        raise ChordlabError(f"the dictionary's folder holds no .geojson shape for {collection}; install chordlab again")
    shapes = [read_shape(path) for path in files.values()]
    return sorted(shapes, key=lambda shape: shape.perimeter_cm**2 / shape.area_cm2)


def _set(typeface: Typeface, texts: Iterable[str]) -> list[Shape]:
    return [typeface.shape(text) for text in texts]
