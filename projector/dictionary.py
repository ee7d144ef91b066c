"""The dictionary of shapes that the robot may meet, and the way from what a user writes to a shape.

A SHAPE is a dictionary name (``eiffel``), a text (``text:WORD``), or a .geojson, .svg, .png or .jpg file.
"""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

from lab.base.errors import ChordlabError
from projector.geojson import load_json, parse_silhouette, read_shape
from projector.png import read_image
from projector.shape import FIT_WIDTH_CM, Font, Shape, ShapeError, Silhouette, check_fits, fit
from projector.svg import read_svg
from projector.text import TEXT_HEIGHT_CM, find_font, set_text

__all__ = ["Font", "Shape", "ShapeError", "Silhouette", "check_fits", "load_dictionary", "shape_from", "shapes_folder"]

TEXT_PREFIX = "text:"
_SUFFIXES = (".geojson", ".json", ".svg", ".png", ".jpg", ".jpeg")


def shapes_folder() -> Path:
    """The folder of the dictionary's GeoJSON files: beside this module when installed, else the checkout's."""
    here = Path(__file__).resolve().parent
    for folder in (here / "shapes", here.parent / "data" / "shapes"):
        if folder.is_dir():
            return folder
    raise ChordlabError("the dictionary's shapes are missing from this installation; install chordlab again")


def load_dictionary(folder: Path | None = None) -> dict[str, Shape]:
    """Read every shape of ``folder`` (default: the one that comes with chordlab), by name.

    The order goes from the most compact to the most intricate: by P²/A, 4π for the circle.

    >>> list(load_dictionary())
    ['circle', 'square', 'triangle', 'chichen_itza', 'eiffel', 'liberty']
    """
    shapes = [read_shape(path) for path in sorted((folder or shapes_folder()).glob("*.geojson"))]
    if not shapes:
        raise ChordlabError("the dictionary's folder holds no .geojson shape; install chordlab again")
    shapes.sort(key=lambda shape: shape.perimeter_cm**2 / shape.area_cm2)
    return {shape.name: shape for shape in shapes}


def shape_from(
    spec: str,
    *,
    font: str | Path | Font | None = None,
    width_cm: float | None = None,
    height_cm: float | None = None,
) -> Shape:
    """Make a shape from what a user wrote, centred on the arena's origin.

    ``spec`` is a dictionary name, ``text:WORD``, or the path of a .geojson, .svg, .png or .jpg file;
    ``font`` is the font for a text: a path, or a record to set many texts in one font (default: ``find_font``).

    Size, proportions kept: ``width_cm`` and ``height_cm`` bound the box (given both, the tighter decides);
    for a text ``height_cm`` is that of its capitals, so that letters of one setting stay comparable.
    Without either: a dictionary shape, a GeoJSON (in cm) and an SVG whose width or height is in mm, cm,
    in, pt or pc keep their size; a text gets capitals of 40 cm, or less to be at most 100 cm wide;
    anything else is fitted into 100 x 70 cm.

    Raises ShapeError, one line that says what is wrong and how to mend it.
    """
    if spec.startswith(TEXT_PREFIX):
        return _from_text(spec, font, width_cm, height_cm)
    if font is not None:
        raise ShapeError(spec, "takes no font; a font is for text:WORD")
    if Path(spec).suffix.lower() in _SUFFIXES or "/" in spec or "\\" in spec:
        return _from_file(spec, width_cm, height_cm)
    known = load_dictionary()
    name = spec.strip().lower().replace("-", "_").replace(" ", "_")
    if name not in known:
        near = get_close_matches(name, known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
        raise ShapeError(spec, f"is not in the dictionary; {hint} (or give text:WORD or a file)")
    shape = known[name]
    if width_cm is None and height_cm is None:
        return shape
    geometry = fit(shape.geometry, name, width_cm=width_cm, height_cm=height_cm)
    return Shape(shape.name, shape.title, geometry, shape.source)


def _from_text(spec: str, font: str | Path | Font | None, width_cm: float | None, height_cm: float | None) -> Shape:
    text = spec.removeprefix(TEXT_PREFIX)
    if not text.strip():
        raise ShapeError(spec, "the text is empty; write for example text:FREEDOM")
    chosen = font if isinstance(font, Font) else find_font(font)
    by_size = width_cm is not None or height_cm is not None
    geometry = set_text(
        text,
        chosen,
        cap_height_cm=height_cm if by_size else TEXT_HEIGHT_CM,
        max_width_cm=width_cm if by_size else FIT_WIDTH_CM,
    )
    return Shape(spec, f"“{text}” in {chosen.name}", geometry, f"set in {chosen.name}", chosen)


def _from_file(spec: str, width_cm: float | None, height_cm: float | None) -> Shape:
    path = Path(spec)
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise ShapeError(spec, f"a shape's file ends in {', '.join(_SUFFIXES)}")
    if not path.is_file():
        raise ShapeError(spec, "is not a file; check the path")
    try:
        match suffix:
            case ".svg":
                geometry, in_cm = read_svg(path)
            case ".png" | ".jpg" | ".jpeg":
                geometry, in_cm = read_image(path), False
            case _:
                geometry, in_cm = parse_silhouette(load_json(path), spec), True
    except OSError as error:
        raise ShapeError(spec, f"cannot be read ({error.strerror or error}); check the file") from error
    sized = fit(geometry, spec, width_cm=width_cm, height_cm=height_cm, keep_size=in_cm)
    return Shape(path.stem, path.stem, sized, path.name)
