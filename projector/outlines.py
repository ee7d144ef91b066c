"""A font's file and outlines, as rings of points: the one place that meets fontTools and the font manager."""
# fontTools ships no py.typed marker and matplotlib's font manager is half annotated: unknown to the checker;
# everything is turned into plain floats and arrays before it leaves this module
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingTypeStubs=false, reportUntypedBaseClass=false, reportUnknownParameterType=false
# pyright: reportMissingParameterType=false
# ruff: noqa: N802, N815 - the pen protocol's own names

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
from fontTools.pens.basePen import BasePen
from fontTools.ttLib import TTFont, TTLibError
from matplotlib.font_manager import FontProperties, findfont, findSystemFonts, fontManager, get_font
from numpy.typing import NDArray

from projector.shape import ShapeError

Floats = NDArray[np.float64]
Point = tuple[float, float]

CURVE_POINTS = 32
_SHARE: Floats = np.arange(1, CURVE_POINTS + 1) / CURVE_POINTS
_UPRIGHT = ("Regular", "Book", "Roman", "Normal")
_FULL_NAME = 4  # the name table's id for "family and style"


def installed_font(family: str) -> Path | None:
    """The file of a font family that matplotlib's font manager finds on this system, or None.

    The manager keeps a list between runs and misses what was installed since; those files are looked at too.
    """
    try:
        return Path(str(findfont(FontProperties(family=[family]), fallback_to_default=False)))
    except ValueError:
        pass
    listed = {entry.fname for entry in fontManager.ttflist}
    for path in sorted(installed_files() - listed):
        try:
            face = get_font(path)
        except (OSError, RuntimeError):  # no font after all
            continue
        if face.family_name == family and face.style_name in _UPRIGHT:
            return Path(path)
    return None


def installed_files() -> set[str]:
    """The files of all fonts that matplotlib's font manager finds on this system."""
    return {entry.fname for entry in fontManager.ttflist} | set(findSystemFonts())


class _FlatPen(BasePen):
    """Collects every contour as points, each curve flattened to ``CURVE_POINTS`` of them."""

    def __init__(self, glyphs: Any) -> None:
        super().__init__(glyphs)
        self.rings: list[Floats] = []
        self._points: list[Point] = []

    def _moveTo(self, pt: Point) -> None:
        self._points = [pt]

    def _lineTo(self, pt: Point) -> None:
        self._points.append(pt)

    def _curveToOne(self, pt1: Point, pt2: Point, pt3: Point) -> None:
        p0, p1, p2, p3 = (np.array(point, dtype=float) for point in (self._points[-1], pt1, pt2, pt3))
        t = _SHARE[:, None]
        curve = (1 - t) ** 3 * p0 + 3 * (1 - t) ** 2 * t * p1 + 3 * (1 - t) * t**2 * p2 + t**3 * p3
        self._points.extend((float(x), float(y)) for x, y in curve)

    def _qCurveToOne(self, pt1: Point, pt2: Point) -> None:
        p0, p1, p2 = (np.array(point, dtype=float) for point in (self._points[-1], pt1, pt2))
        t = _SHARE[:, None]
        curve = (1 - t) ** 2 * p0 + 2 * (1 - t) * t * p1 + t**2 * p2
        self._points.extend((float(x), float(y)) for x, y in curve)

    def _closePath(self) -> None:
        self.rings.append(np.array(self._points, dtype=float))
        self._points = []

    _endPath = _closePath  # fonts fill open contours too


class Outlines:
    """One font's glyph outlines in font units, y up. Made by ``open_outlines``."""

    def __init__(self, font: TTFont, path: Path) -> None:
        self._glyphs: Any = font.getGlyphSet()
        self._names: dict[int, str] = dict(font.getBestCmap() or {})
        self.name: str = str(font["name"].getDebugName(_FULL_NAME) or path.stem)
        head: Any = font["head"]  # its fields come from the file
        self.units_per_em = float(head.unitsPerEm)
        capital = self.rings("H") if self.has("H") else []
        # symbol fonts have no H: 0.7 em is what text fonts come near to
        self.cap_height = (
            float(np.vstack(capital)[:, 1].max() - np.vstack(capital)[:, 1].min())
            if capital
            else 0.7 * self.units_per_em
        )

    def has(self, letter: str) -> bool:
        """Whether the font maps this character to a glyph."""
        return ord(letter) in self._names

    def rings(self, letter: str) -> list[Floats]:
        """The contours (n, 2) of a letter that the font has."""
        pen = _FlatPen(self._glyphs)
        self._glyphs[self._names[ord(letter)]].draw(pen)
        return pen.rings

    def advance(self, letter: str) -> float:
        """How far the pen moves on; a third of an em for a blank that the font lacks."""
        if not self.has(letter):
            return self.units_per_em / 3
        return float(self._glyphs[self._names[ord(letter)]].width)


def open_outlines(path: Path) -> Outlines:
    """Open a .ttf, .otf or .ttc (its first font). Raises ShapeError when it is none or has no outlines."""
    try:
        # from memory: fontTools reads lazily and would keep the file open
        return Outlines(TTFont(io.BytesIO(path.read_bytes()), fontNumber=0, lazy=True), path)
    except (TTLibError, OSError, KeyError, struct.error, AssertionError, ValueError) as error:
        raise ShapeError(str(path), "is not a font with outlines; give the path of a .ttf or .otf file") from error
