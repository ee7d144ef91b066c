"""Silhouettes from SVG drawings.

What a drawing shows on white paper is the shape: fills are painted in order, a white fill erases what lies
below it, strokes are left out. Drawings come from anywhere, so what could open other files or blow up in
memory is refused before the drawing is read.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon

from projector.fill import fill
from projector.shape import MAX_POINTS, ShapeError, Silhouette
from projector.svgpaths import PIXELS_PER_INCH, painted

MAX_BYTES = 10_000_000
MAX_ELEMENTS = 20_000
_CM_PER_PIXEL = 2.54 / PIXELS_PER_INCH
_PHYSICAL = re.compile(r"^\s*[\d.eE+-]+\s*(mm|cm|in|pt|pc)\s*$")
# drawn in other ways than by filling outlines: left out silently they would give a wrong shape
_REFUSED = {
    "text": "convert it to paths",
    "image": "trace it, or import the picture itself",
    "mask": "flatten the drawing",
    "symbol": "flatten the drawing",
    "marker": "convert it to paths",
    "foreignObject": "remove it",
}


def read_svg(path: Path) -> tuple[Silhouette, bool]:
    """Read a drawing, y turned up, in cm at 96 pixels an inch; the flag tells whether that size was meant.

    It was when the drawing's width or height is given in mm, cm, in, pt or pc. Raises ShapeError for
    a file that is too large, no SVG, has a DOCTYPE or entities, repeats itself without end, holds text,
    pictures, masks or clips, or fills nothing.
    """
    subject = str(path)
    if path.stat().st_size > MAX_BYTES:
        raise ShapeError(subject, f"is larger than {MAX_BYTES / 1e6:g} MB; simplify the drawing")
    data = path.read_bytes()
    root = _parse(data, subject)
    _check_elements(root, subject)
    try:
        elements = painted(data)
    except (ValueError, TypeError, AttributeError, IndexError, ZeroDivisionError, RecursionError) as error:
        raise ShapeError(subject, f"holds an outline that cannot be read ({error}); save it as plain SVG") from error
    if sum(len(ring) for element in elements for ring in element.rings) > MAX_POINTS:
        raise ShapeError(subject, f"has more than {MAX_POINTS} vertices; simplify the drawing")
    if not all(np.isfinite(ring).all() for element in elements for ring in element.rings):
        raise ShapeError(subject, "a coordinate is not a finite number; save the drawing again")
    drawn: Polygon | MultiPolygon = MultiPolygon()
    for element in elements:
        area = fill(element.rings, element.rule)
        mixed = drawn.difference(area) if element.white else drawn.union(area)
        drawn = mixed if isinstance(mixed, Polygon | MultiPolygon) else MultiPolygon()
    if drawn.is_empty:
        raise ShapeError(subject, "fills nothing; give the outlines a fill other than white (strokes are left out)")
    in_cm = shapely.transform(drawn, lambda xy: xy * (_CM_PER_PIXEL, -_CM_PER_PIXEL))
    meant = any(_PHYSICAL.match(root.get(side, "")) for side in ("width", "height"))
    return in_cm, meant


def _parse(data: bytes, subject: str) -> ElementTree.Element:
    """Parse the XML once a DOCTYPE, the door of entities, is ruled out in whatever encoding it is."""
    if not data.strip():
        raise ShapeError(subject, "the file is empty; save the drawing again")

    def refuse(*_: object) -> None:
        raise ShapeError(subject, "has a DOCTYPE, which may open other files; remove that line or save as plain SVG")

    guard = expat.ParserCreate()
    guard.StartDoctypeDeclHandler = refuse
    guard.EntityDeclHandler = refuse
    try:
        guard.Parse(data, True)
        root = ElementTree.fromstring(data)
    except (expat.ExpatError, ElementTree.ParseError, ValueError, LookupError) as error:
        raise ShapeError(subject, f"is not SVG ({error}); save the drawing again") from error
    if _tag(root) != "svg":
        raise ShapeError(subject, f"is not SVG but {_tag(root)}; save the drawing as SVG")
    return root


def _tag(element: ElementTree.Element) -> str:
    return str(element.tag).rpartition("}")[2]


def _check_elements(root: ElementTree.Element, subject: str) -> None:
    """Refuse what cannot be drawn truly, and `use` elements that would multiply without end."""
    known: dict[str, ElementTree.Element] = {}
    for element in root.iter():
        tag = _tag(element)
        if tag in _REFUSED:
            raise ShapeError(subject, f"holds a <{tag}>, which has no filled outline of its own; {_REFUSED[tag]}")
        style = element.get("style", "")
        clip = element.get("clip-path") or element.get("mask") or ("clip-path:" in style or "mask:" in style)
        if clip and clip != "none":
            raise ShapeError(subject, "is clipped or masked; flatten the drawing (cut the outlines themselves)")
        if name := element.get("id"):
            known[name] = element
    sizes: dict[ElementTree.Element, int] = {}
    open_: set[ElementTree.Element] = set()

    def size(element: ElementTree.Element) -> int:
        if element in sizes:
            return sizes[element]
        if element in open_:
            raise ShapeError(subject, "holds a <use> that contains itself; save it as plain SVG")
        open_.add(element)
        total = 1 + sum(size(child) for child in element)
        if _tag(element) == "use":
            link = element.get("href") or element.get("{http://www.w3.org/1999/xlink}href") or ""
            if not link.startswith("#"):
                raise ShapeError(subject, "uses a part of another file; save it as plain SVG")
            total += size(known[link[1:]]) if link[1:] in known else 0
        open_.discard(element)
        sizes[element] = total
        return total

    try:
        count = size(root)
    except RecursionError as error:
        raise ShapeError(subject, "is nested too deeply; flatten the drawing") from error
    if count > MAX_ELEMENTS:
        raise ShapeError(subject, f"draws {count} elements, more than {MAX_ELEMENTS}; simplify the drawing")
