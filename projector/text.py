"""Texts as silhouettes: choose a font, flatten its outlines, fill them, set the word.

The paper reads Helvetica. The font decides which letters are confusable, so which one was used is part
of a session's record (``Font``).
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.affinity import translate
from shapely.geometry import MultiPolygon, Polygon

from projector.fill import fill
from projector.outlines import Outlines, installed_files, installed_font, open_outlines
from projector.shape import FIT_WIDTH_CM, Font, Shape, ShapeError, Silhouette, fit, size_of

Floats = NDArray[np.float64]

HELVETICA_LIKE = (
    "Helvetica",
    "Nimbus Sans",
    "Nimbus Sans L",
    "TeX Gyre Heros",
    "FreeSans",
    "Arial",
    "Liberation Sans",
)
FALLBACK = "DejaVu Sans"  # ships with matplotlib
TEXT_PREFIX = "text:"
TEXT_HEIGHT_CM = 40.0
MAX_LETTERS = 200

_log = logging.getLogger(__name__)


def find_font(path: str | Path | None = None, families: Sequence[str] = HELVETICA_LIKE) -> Font:
    """Give the font at ``path``, or the first of ``families`` that the system's font manager knows.

    Where it knows none, DejaVu Sans stands in: a warning is logged and the record's ``fallback`` is set,
    since figures from another font do not compare with the paper's. Raises ShapeError when ``path`` is
    no font.
    """
    if path is not None:
        return _record(Path(path), fallback=False)
    for family in families:
        found = installed_font(family)
        if found is not None:
            return _record(found, fallback=False)
    standing_in = installed_font(FALLBACK)
    if standing_in is None:
        raise ShapeError("font", f"neither Helvetica nor {FALLBACK} is installed; give a font with --font PATH")
    font = _record(standing_in, fallback=True)
    _log.warning("none of %s is installed; %s stands in (choose with --font PATH)", ", ".join(families), font.name)
    return font


def is_installed(path: Path) -> bool:
    """Whether a font's file is one of this system's."""
    return path.is_absolute() and str(path) in installed_files()


def _record(path: Path, *, fallback: bool) -> Font:
    if not path.is_file():
        raise ShapeError(str(path), "is not a file; give the path of a .ttf or .otf font")
    outlines = open_outlines(path)
    return Font(outlines.name, path, hashlib.sha256(path.read_bytes()).hexdigest(), fallback)


class Typeface:
    """A font opened once, to set many texts in it. Raises ShapeError where its file is no font with outlines."""

    def __init__(self, font: Font) -> None:
        self.font = font
        self._outlines = open_outlines(font.path)
        self._glyphs: dict[str, Silhouette] = {}

    def shape(self, text: str, *, width_cm: float | None = None, height_cm: float | None = None) -> Shape:
        """``text:TEXT`` as a shape; without a size its capitals are 40 cm high, or less to be 100 cm wide."""
        by_size = width_cm is not None or height_cm is not None
        geometry = self.set(
            text,
            cap_height_cm=height_cm if by_size else TEXT_HEIGHT_CM,
            max_width_cm=width_cm if by_size else FIT_WIDTH_CM,
        )
        name = self.font.name
        return Shape(f"{TEXT_PREFIX}{text}", f"“{text}” in {name}", geometry, f"set in {name}", self.font)

    def set(
        self, text: str, *, cap_height_cm: float | None = TEXT_HEIGHT_CM, max_width_cm: float | None = None
    ) -> Silhouette:
        """Set ``text`` on one line and centre its bounding box on the origin.

        ``cap_height_cm`` is the height of the font's flat capitals (its H), not of this text: so letters of
        one setting share one scale, round ones overshoot and a Q reaches below, as in print. ``max_width_cm``
        makes it smaller where it would be wider. With ``cap_height_cm`` None the text gets that width (100 cm
        if that is None too). Letters stand at their advance widths, unkerned.

        Raises ShapeError for an empty text, a letter that the font lacks (all of them are named), or a size
        that is not above 0.
        """
        subject = f"{TEXT_PREFIX}{text}"
        if not text.strip():
            raise ShapeError(subject, "the text is empty; write for example text:FREEDOM")
        if len(text) > MAX_LETTERS:
            raise ShapeError(f"{TEXT_PREFIX}{text[:20]}…", f"is longer than {MAX_LETTERS} letters; take fewer")
        for name, value in (("height", cap_height_cm), ("width", max_width_cm)):
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ShapeError(subject, f"the {name} must be above 0 cm, got {value:g}")
        outlines = self._outlines
        missing = sorted({letter for letter in text if not outlines.has(letter) and letter != " "})
        if missing:
            names = ", ".join(f"{letter!r} (U+{ord(letter):04X})" for letter in missing)
            raise ShapeError(subject, f"{self.font.name} has no {names}; choose another font or text")
        placed: list[Silhouette] = []
        pen_x = 0.0
        for letter in text:
            placed.append(translate(self._glyph(letter), pen_x, 0.0))
            pen_x += outlines.advance(letter)
        joined = shapely.union_all(placed)
        if not isinstance(joined, Polygon | MultiPolygon) or joined.is_empty:
            raise ShapeError(subject, f"{self.font.name} draws nothing for it; choose another font or text")
        width, height = size_of(joined)
        if cap_height_cm is None:
            return fit(joined, subject, width_cm=max_width_cm or FIT_WIDTH_CM)
        factor = min(cap_height_cm / outlines.cap_height, (max_width_cm or np.inf) / width)
        return fit(joined, subject, height_cm=height * factor)

    def _glyph(self, letter: str) -> Silhouette:
        if letter not in self._glyphs:
            self._glyphs[letter] = glyph(self._outlines, letter)
        return self._glyphs[letter]


def glyph(outlines: Outlines, letter: str) -> Silhouette:
    """The filled letter in font units, its origin at the pen; empty for a blank."""
    return fill(outlines.rings(letter)) if outlines.has(letter) else MultiPolygon()
