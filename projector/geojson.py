"""Read and write silhouettes as GeoJSON, with coordinates in centimetres of the arena frame."""

from __future__ import annotations

import json
import reprlib
from pathlib import Path
from typing import Any, cast

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LinearRing, MultiPolygon, Polygon, mapping
from shapely.validation import explain_validity

from lab.base.files import write_aside
from lab.base.given import json_of
from projector.fill import check_tangle
from projector.fill import mend as untangle
from projector.shape import (
    MAX_COORDINATE,
    MAX_POINTS,
    Drawing,
    Shape,
    ShapeError,
    Silhouette,
    check_silhouette,
    count_points,
    rings_of,
)

MAX_BYTES = 20_000_000


def read_shape(path: Path) -> Shape:
    """Read one Feature file as a Shape: its ``name``, ``title`` and ``source`` come from its properties.

    Absent properties fall back to the file's stem. Raises ShapeError as ``parse_drawing`` does.
    """
    data = load_json(path)
    texts = texts_of(data)
    return Shape(
        name=texts.get("name", path.stem),
        title=texts.get("title", path.stem),
        geometry=parse_drawing(data, str(path)).geometry,
        source=texts.get("source", path.name),
    )


def texts_of(data: Any) -> dict[str, str]:
    """The ``name``, ``title`` and ``source`` among a Feature's properties that are texts, each on one line."""
    feature = cast("dict[str, Any]", data) if isinstance(data, dict) else {}
    properties: Any = feature.get("properties")
    known = cast("dict[str, Any]", properties) if isinstance(properties, dict) else {}
    texts = {key: " ".join(str(known[key]).split()) for key in ("name", "title", "source") if key in known}
    return {key: text for key, text in texts.items() if text}


def write_shape(shape: Shape, path: Path) -> None:
    """Write ``shape`` as one Feature, coordinates in full, so that reading it back gives the same digest.

    Raises OSError.
    """
    feature = {
        "type": "Feature",
        "properties": {"name": shape.name, "title": shape.title, "source": shape.source, "unit": "cm"},
        "geometry": mapping(shape.geometry),
    }
    write_aside(path, (json.dumps(feature, ensure_ascii=False) + "\n").encode())


def load_json(path: Path) -> Any:
    """Parse the file. Raises ShapeError where it is too large, empty or not JSON."""
    if path.stat().st_size > MAX_BYTES:
        raise ShapeError(str(path), f"is larger than {MAX_BYTES / 1e6:g} MB; simplify the drawing")
    try:
        text = path.read_text(encoding="utf-8-sig")
        if not text.strip():
            raise ShapeError(str(path), "the file is empty; save the drawing again")
        return json_of(text)
    except ValueError as error:  # no UTF-8, no JSON, or a number of thousands of digits
        raise ShapeError(str(path), f"is not JSON ({error}); save it again as GeoJSON") from error


def parse_drawing(data: Any, subject: str, *, mend: bool = False) -> Drawing:
    """Turn parsed GeoJSON into a silhouette, coordinates kept as they are.

    Takes Polygon, MultiPolygon, GeometryCollection of those, Feature and FeatureCollection; several
    polygons are joined where they touch or overlap. With ``mend`` open rings are closed and crossings
    untangled, and the notes say so. Raises ShapeError for anything else, for a ring that is open or
    shorter than four positions, coordinates that are no finite numbers, and outlines that cross themselves.
    """
    reader = _Reader(subject, mend)
    reader.collect(data)
    pieces = reader.pieces
    if not pieces:
        raise ShapeError(subject, "there is no polygon in it; draw at least one closed outline")
    if sum(count_points(piece) for piece in pieces) > MAX_POINTS:
        raise ShapeError(subject, f"has more than {MAX_POINTS} vertices; simplify the drawing")
    whole: list[Silhouette] = []
    for piece in pieces:
        if mend and not piece.is_valid:
            reader.notes.append(f"mended: {' '.join(explain_validity(piece).split())}")
            mended = untangle(piece, subject)
            if not mended.is_empty:
                whole.append(mended)
        else:
            check_silhouette(piece, subject)
            whole.append(piece)
    if len(whole) > 1:
        check_tangle([shapely.get_coordinates(ring) for ring in rings_of(whole)], subject)
    joined = whole[0] if len(whole) == 1 else shapely.union_all(whole)
    if not isinstance(joined, Polygon | MultiPolygon) or joined.is_empty:
        raise ShapeError(subject, "its polygons do not join to an area; draw closed outlines")
    return Drawing(joined, "coordinates in cm", tuple(reader.notes))


class _Reader:
    """Walks through parsed GeoJSON and gathers its polygons."""

    def __init__(self, subject: str, mend: bool) -> None:
        self.subject = subject
        self.mend = mend
        self.pieces: list[Polygon] = []
        self.notes: list[str] = []

    def collect(self, data: Any, depth: int = 0) -> None:
        """Take the polygons of ``data`` and of what it contains."""
        if not isinstance(data, dict) or depth > 8:
            raise ShapeError(self.subject, "is not GeoJSON: every level needs an object with a `type`")
        node = cast("dict[str, Any]", data)
        match node.get("type"):
            case "Polygon":
                self.pieces.append(self._polygon(node.get("coordinates")))
            case "MultiPolygon":
                self.pieces.extend(self._polygon(rings) for rings in self._list(node.get("coordinates")))
            case "Feature":
                self.collect(node.get("geometry"), depth + 1)
            case "FeatureCollection":
                for feature in self._list(node.get("features")):
                    self.collect(feature, depth + 1)
            case "GeometryCollection":
                for geometry in self._list(node.get("geometries")):
                    self.collect(geometry, depth + 1)
            case kind:
                what = kind[:40] if isinstance(kind, str) else reprlib.repr(kind)
                raise ShapeError(self.subject, f"holds a {what}; only Polygon and MultiPolygon have an area to light")

    def _list(self, value: Any) -> list[Any]:
        if not isinstance(value, list):
            raise ShapeError(self.subject, "is not GeoJSON: a list of coordinates or features is missing")
        return cast("list[Any]", value)

    def _polygon(self, rings: Any) -> Polygon:
        parsed = [self._ring(ring) for ring in self._list(rings)]
        if not parsed:
            raise ShapeError(self.subject, "the shape is empty; draw at least one closed outline")
        return Polygon(LinearRing(parsed[0]), [LinearRing(hole) for hole in parsed[1:]])

    def _ring(self, ring: Any) -> NDArray[np.float64]:
        """Check one ring and give its positions (n, 2); a third coordinate is dropped."""
        positions: list[tuple[float, float]] = []
        for position in self._list(ring):
            entry: object = position
            numbers = cast("list[Any]", position)[:2] if isinstance(position, list) else []
            # bool is an int in Python, json reads NaN and Infinity, and NaN fails every comparison
            if len(numbers) < 2 or not all(type(x) in (int, float) and abs(x) <= MAX_COORDINATE for x in numbers):
                raise ShapeError(
                    self.subject, f"{reprlib.repr(entry)} is no position; give finite x and y in cm, below 1e9"
                )
            positions.append((float(numbers[0]), float(numbers[1])))
        if self.mend and len(positions) >= 3 and positions[0] != positions[-1]:
            self.notes.append(f"closed a ring that was open between {positions[-1]} and {positions[0]}")
            positions.append(positions[0])
        if len(positions) < 4:
            raise ShapeError(self.subject, f"a ring has {len(positions)} positions; a closed outline needs at least 4")
        if positions[0] != positions[-1]:
            raise ShapeError(
                self.subject,
                f"a ring is open: it starts at {positions[0]} and ends at {positions[-1]}; repeat the first, or close"
                " it by chordlab shapes import --mend",
            )
        return np.array(positions)
