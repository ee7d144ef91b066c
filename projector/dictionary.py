"""The dictionary of shapes that the robot may meet, and the way from what a user writes to a shape.

A SHAPE is a dictionary name (``eiffel``, or a monument's), a text (``text:WORD``), or a .geojson, .svg, .png or
.jpg file.
"""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

from projector.collections import DRAWN, drawn_files, load_dictionary, shapes_folder
from projector.geojson import read_shape
from projector.importers import SUFFIXES, read_drawing
from projector.shape import Font, Shape, ShapeError, Silhouette, check_fits, check_sane, fit
from projector.text import TEXT_PREFIX, Typeface, find_font

__all__ = ["Font", "Shape", "ShapeError", "Silhouette", "check_fits", "load_dictionary", "shape_from", "shapes_folder"]


def shape_from(
    spec: str,
    *,
    font: str | Path | Font | None = None,
    width_cm: float | None = None,
    height_cm: float | None = None,
) -> Shape:
    """Make a shape from what a user wrote, centred on the arena's origin.

    ``spec`` is the name of a drawn shape, ``text:WORD``, or the path of a .geojson, .svg, .png or .jpg file;
    ``font`` is the font for a text: a path, or a record to set many texts in one font (default: ``find_font``).

    Size, proportions kept: ``width_cm`` and ``height_cm`` bound the box (given both, the tighter decides);
    for a text ``height_cm`` is that of its capitals, so that letters of one setting stay comparable.
    Without either: a dictionary shape, a GeoJSON (in cm), an SVG whose width or height is in mm, cm, in, pt
    or pc and a picture that states its resolution keep their size; a text gets capitals of 40 cm, or less to
    be at most 100 cm wide; anything else is fitted into 100 x 70 cm.

    Raises ShapeError, one line that says what is wrong and how to mend it.
    """
    if spec.startswith(TEXT_PREFIX):
        return _from_text(spec, font, width_cm, height_cm)
    if font is not None:
        raise ShapeError(spec, "takes no font; a font is for text:WORD")
    if Path(spec).suffix.lower() in SUFFIXES or "/" in spec or "\\" in spec:
        return _from_file(spec, width_cm, height_cm)
    shape = _from_name(spec)
    if width_cm is None and height_cm is None:
        return shape
    geometry = fit(shape.geometry, shape.name, width_cm=width_cm, height_cm=height_cm)
    return Shape(shape.name, shape.title, geometry, shape.source)


def _from_name(spec: str) -> Shape:
    name = spec.strip().lower().replace("-", "_").replace(" ", "_")
    known = {name: path for collection in DRAWN for name, path in drawn_files(collection).items()}
    if name in known:
        return read_shape(known[name])
    near = get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(load_dictionary())} and the monuments"
    raise ShapeError(spec, f"is not in the dictionary; {hint} (or give text:WORD or a file)")


def _from_text(spec: str, font: str | Path | Font | None, width_cm: float | None, height_cm: float | None) -> Shape:
    text = spec.removeprefix(TEXT_PREFIX)
    if not text.strip():
        raise ShapeError(spec, "the text is empty; write for example text:FREEDOM")
    typeface = Typeface(font if isinstance(font, Font) else find_font(font))
    return typeface.shape(text, width_cm=width_cm, height_cm=height_cm)


def _from_file(spec: str, width_cm: float | None, height_cm: float | None) -> Shape:
    drawing = read_drawing(Path(spec))
    sized = fit(drawing.geometry, spec, width_cm=width_cm, height_cm=height_cm, keep_size=drawing.in_cm)
    if width_cm is None and height_cm is None:
        check_sane(sized, spec)
    return Shape(drawing.name, drawing.title, sized, drawing.source)
