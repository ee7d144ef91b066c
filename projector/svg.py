"""Silhouettes from SVG drawings.

What a drawing shows on white paper is the shape: fills are painted in order, a white fill erases what lies
below it, strokes are left out. Drawings come from anywhere, so what could open other files or blow up in
memory is refused before the drawing is read.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon

from projector.fill import fill
from projector.shape import MAX_COORDINATE, MAX_POINTS, Drawing, ShapeError, Silhouette, unrounded
from projector.svgpaths import PIXELS_PER_INCH, Painted, painted

MAX_BYTES = 10_000_000
MAX_ELEMENTS = 10_000
MAX_TOKENS = 3 * MAX_POINTS  # x, y and a letter for each vertex
MAX_LAYERED_POINTS = 10_000_000  # layers times vertices: some seconds
MAX_STYLE = 20_000  # letters of a style sheet or an attribute, other than outlines: reading them takes their square
MAX_RULE = 2_000
_OUTLINES = ("d", "points")
_TOKEN = re.compile(r"[A-Za-z]|\d[\d.]*")
_CM_PER_PIXEL = 2.54 / PIXELS_PER_INCH
_UNREADABLE = (ValueError, TypeError, AttributeError, LookupError, ArithmeticError, AssertionError, RecursionError)
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


def read_svg(path: Path) -> Drawing:
    """Read a drawing, y turned up, in cm at 96 pixels an inch.

    That size was meant (``size_from``) when the drawing's width or height is given in mm, cm, in, pt or pc. Raises
    ShapeError for a file that is too large, no SVG, has a DOCTYPE or entities, repeats itself without end, holds
    text, pictures, masks or clips, or fills nothing.
    """
    subject = str(path)
    if path.stat().st_size > MAX_BYTES:
        raise ShapeError(subject, f"is larger than {MAX_BYTES / 1e6:g} MB; simplify the drawing")
    data = path.read_bytes()
    root = _parse(data, subject)
    _check_elements(root, subject)
    try:
        with np.errstate(all="ignore"):  # what overflows is refused below
            elements = painted(data)
    except _UNREADABLE as error:
        reason = str(error) or type(error).__name__
        raise ShapeError(subject, f"holds an outline that cannot be read ({reason}); save it as plain SVG") from error
    if sum(len(ring) for element in elements for ring in element.rings) > MAX_POINTS:
        raise ShapeError(subject, f"has more than {MAX_POINTS} vertices; simplify the drawing")
    for ring in (ring for element in elements for ring in element.rings):
        if not (np.abs(ring) <= MAX_COORDINATE).all():  # false for NaN too
            raise ShapeError(subject, "a coordinate is not a finite number below 1e9; save the drawing again")
    drawn = _paint(elements, subject)
    if drawn.is_empty:
        raise ShapeError(subject, "fills nothing; give the outlines a fill other than white (strokes are left out)")
    in_cm = shapely.transform(drawn, lambda xy: xy * (_CM_PER_PIXEL, -_CM_PER_PIXEL))
    stated = [root.get(side, "") for side in ("width", "height") if _PHYSICAL.match(root.get(side, ""))]
    open_ = sum(element.open_rings for element in elements)
    notes = (f"closed {open_} open outline{'s' * (open_ > 1)} by a straight line, as a fill does",) if open_ else ()
    return Drawing(unrounded(in_cm, subject), f"the page's {stated[0].strip()}" if stated else "", notes)


def _paint(elements: Sequence[Painted], subject: str) -> Silhouette:
    """What stays dark when ``elements`` are painted one over the other."""
    turns = sum(1 for _ in groupby(elements, key=lambda element: element.white))
    if turns * sum(len(ring) for element in elements for ring in element.rings) > MAX_LAYERED_POINTS:
        raise ShapeError(subject, f"paints black and white {turns} times in turn; flatten the drawing")
    layers = [
        (white, shapely.union_all([fill(element.rings, element.rule, subject=subject) for element in group]))
        for white, group in groupby(elements, key=lambda element: element.white)
    ]
    drawn: shapely.Geometry = MultiPolygon()
    for white, layer in layers:
        drawn = drawn.difference(layer) if white else drawn.union(layer)
    return drawn if isinstance(drawn, Polygon | MultiPolygon) else MultiPolygon()


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
    for count, element in enumerate(root.iter(), start=1):
        if count > MAX_ELEMENTS:
            raise ShapeError(subject, f"draws more than {MAX_ELEMENTS} elements; simplify the drawing")
        tag = _tag(element)
        if tag in _REFUSED:
            raise ShapeError(subject, f"holds a <{tag}>, which has no filled outline of its own; {_REFUSED[tag]}")
        style = element.get("style", "")
        clip = element.get("clip-path") or element.get("mask") or ("clip-path:" in style or "mask:" in style)
        if clip and clip != "none":
            raise ShapeError(subject, "is clipped or masked; flatten the drawing (cut the outlines themselves)")
        texts = [value for name, value in element.attrib.items() if name not in _OUTLINES]
        sheet = element.text or "" if tag == "style" else ""
        rules = re.split("[{}]", sheet)
        if any(len(text) > MAX_STYLE for text in (*texts, sheet)) or any(len(rule) > MAX_RULE for rule in rules):
            raise ShapeError(subject, f"has styles of more than {MAX_STYLE} letters; save it as plain SVG")
        if name := element.get("id"):
            known[name] = element
    sizes: dict[ElementTree.Element, tuple[int, int]] = {}
    open_: set[ElementTree.Element] = set()

    def size(element: ElementTree.Element) -> tuple[int, int]:
        """How many elements are drawn, and of how many numbers and letters their outlines consist."""
        if element in sizes:
            return sizes[element]
        if element in open_:
            raise ShapeError(subject, "holds a <use> that contains itself; save it as plain SVG")
        open_.add(element)
        parts = [size(child) for child in element]
        if _tag(element) == "use":
            link = element.get("href") or element.get("{http://www.w3.org/1999/xlink}href") or ""
            if not link.startswith("#"):
                raise ShapeError(subject, "uses a part of another file; save it as plain SVG")
            if link[1:] in known:
                parts.append(size(known[link[1:]]))
        open_.discard(element)
        outline = "".join(element.get(name, "") for name in _OUTLINES)
        own = sum(1 for _ in _TOKEN.finditer(outline))
        sizes[element] = (1 + sum(count for count, _ in parts), own + sum(tokens for _, tokens in parts))
        return sizes[element]

    try:
        count, tokens = size(root)
    except RecursionError as error:
        raise ShapeError(subject, "is nested too deeply; flatten the drawing") from error
    if count > MAX_ELEMENTS:
        raise ShapeError(subject, f"draws {count} elements, more than {MAX_ELEMENTS}; simplify the drawing")
    if tokens > MAX_TOKENS:
        raise ShapeError(subject, f"has outlines of {tokens} numbers, more than {MAX_TOKENS}; simplify the drawing")
