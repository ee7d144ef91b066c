"""From a user's file to a named shape in cm: drawings (SVG, GeoJSON), pictures (PNG, JPEG) and texts in a font.

Whatever the file holds, the result is a valid silhouette, or one line that says what is wrong and how to mend it.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import shapely
from shapely.geometry import Polygon

from projector.geojson import load_json, parse_drawing, texts_of
from projector.png import read_image
from projector.shape import Drawing, Font, Shape, ShapeError, check_fits, check_sane, fit
from projector.svg import read_svg
from projector.text import TEXT_PREFIX, Typeface, find_font

SUFFIXES = (".geojson", ".json", ".svg", ".png", ".jpg", ".jpeg")
FONT_SUFFIXES = (".ttf", ".otf", ".ttc", ".woff", ".woff2")
_NAME = re.compile(r"\w[\w-]{0,59}")


@dataclass(frozen=True, slots=True)
class NamedDrawing(Drawing):
    """A drawing with what its file says about itself."""

    name: str = ""
    title: str = ""
    source: str = ""


@dataclass(frozen=True, slots=True)
class Imported:
    """A shape made from a file; ``notes`` say in a line each what was done to it on the way."""

    shape: Shape
    notes: tuple[str, ...]


def read_drawing(path: Path, *, mend: bool = False) -> NamedDrawing:
    """Read a .geojson, .svg, .png or .jpg file by its suffix.

    With ``mend`` open rings are closed and crossings untangled. Raises ShapeError, one line that says what is wrong
    and how to mend it.
    """
    subject, suffix = str(path), path.suffix.lower()
    if suffix in FONT_SUFFIXES:
        raise ShapeError(subject, f"is a font; write text:WORD --font {path}")
    if suffix not in SUFFIXES:
        raise ShapeError(subject, f"a shape's file ends in {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise ShapeError(subject, "is not a file; check the path")
    name, title, source = path.stem, path.stem, path.name
    try:
        match suffix:
            case ".svg":
                drawing = read_svg(path)
            case ".png" | ".jpg" | ".jpeg":
                drawing = read_image(path)
            case _:
                data = load_json(path)
                drawing = parse_drawing(data, subject, mend=mend)
                texts = texts_of(data)
                name = texts["name"] if _NAME.fullmatch(texts.get("name", "")) else name
                title, source = texts.get("title", title), texts.get("source", source)
    except OSError as error:
        raise ShapeError(subject, f"cannot be read ({error.strerror or error}); check the file") from error
    except shapely.GEOSException as error:
        raise ShapeError(subject, f"holds an outline that cannot be sorted out ({error}); simplify it") from error
    return NamedDrawing(drawing.geometry, drawing.size_from, drawing.notes, name, title, source)


def import_shape(
    spec: str,
    name: str | None = None,
    *,
    title: str | None = None,
    font: str | Path | Font | None = None,
    width_cm: float | None = None,
    height_cm: float | None = None,
    area_cm2: float | None = None,
    scale: float | None = None,
    mend: bool = False,
    arena: Polygon | None = None,
    margin_cm: float = 0.0,
    taken: Collection[str] = (),
) -> Imported:
    """Make a shape from a file, or from ``text:WORD`` in a font, centred on the arena's origin.

    Sizes as for `projector.shape.fit`; without any a file that says its size keeps it, anything else is fitted.
    ``scale`` multiplies the file's own size, which is in cm for GeoJSON, at 96 units an inch for an SVG and at
    1 cm a pixel for a picture that states no resolution. A text's height is that of its capitals.

    ``name`` (default: what the file calls itself) is of letters, digits, - and _ and none of ``taken``. With an
    ``arena`` the shape must lie in it with ``margin_cm`` to spare.

    Raises ShapeError: the file is unreadable, the outline not closed or self-crossing (unless mended), the shape
    empty, too large for the arena, or too small to be met.
    """
    sized = any(value is not None for value in (width_cm, height_cm, area_cm2, scale))
    if spec.startswith(TEXT_PREFIX):
        typeface = Typeface(font if isinstance(font, Font) else find_font(font))
        made = typeface.shape(spec.removeprefix(TEXT_PREFIX), width_cm=width_cm, height_cm=height_cm)
        geometry = fit(made.geometry, spec, area_cm2=area_cm2, scale=scale, keep_size=True)
        notes, own_title, source, own_name = (f"set in {typeface.font.name}",), made.title, made.source, ""
        chosen_font = typeface.font
    else:
        if font is not None:
            raise ShapeError(spec, "takes no font; a font is for text:WORD")
        drawing = read_drawing(Path(spec), mend=mend)
        geometry = fit(
            drawing.geometry,
            spec,
            width_cm=width_cm,
            height_cm=height_cm,
            area_cm2=area_cm2,
            scale=scale,
            keep_size=drawing.in_cm,
        )
        notes, own_title, source, own_name = drawing.notes, drawing.title, drawing.source, drawing.name
        chosen_font = None
        if not sized:
            origin = f"size from {drawing.size_from}" if drawing.in_cm else "the file states no size: fitted"
            notes = (*notes, f"{origin}; choose with --width, --height, --area or --scale")
    called = _checked_name(name if name is not None else own_name, spec, taken)
    check_sane(geometry, spec)
    shape = Shape(called, title or (own_title if own_title != own_name else called), geometry, source, chosen_font)
    if arena is not None:
        check_fits(shape, arena, margin_cm)
    return Imported(shape, notes)


def _checked_name(name: str, spec: str, taken: Collection[str]) -> str:
    if not _NAME.fullmatch(name):
        problem = f"“{name}” is no name for a shape" if name else "needs a name"
        raise ShapeError(spec, f"{problem}; give --name with letters, digits, - and _, for example --name tower")
    if name in taken:
        raise ShapeError(spec, f"the dictionary has a shape called {name} already; give another --name")
    return name
