"""Read and write silhouettes as GeoJSON, with coordinates in centimetres of the arena frame."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, cast

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LinearRing, MultiPolygon, Polygon, mapping

from projector.shape import MAX_POINTS, Shape, ShapeError, Silhouette, check_silhouette, count_points

MAX_BYTES = 20_000_000


def read_shape(path: Path) -> Shape:
    """Read one Feature file as a Shape: its ``name``, ``title`` and ``source`` come from its properties.

    Absent properties fall back to the file's stem. Raises ShapeError as ``parse_silhouette`` does.
    """
    data = load_json(path)
    feature = cast("dict[str, Any]", data) if isinstance(data, dict) else {}
    properties: Any = feature.get("properties")
    texts = cast("dict[str, Any]", properties) if isinstance(properties, dict) else {}
    return Shape(
        name=str(texts.get("name", path.stem)),
        title=str(texts.get("title", path.stem)),
        geometry=parse_silhouette(data, str(path)),
        source=str(texts.get("source", path.name)),
    )


def write_shape(shape: Shape, path: Path) -> None:
    """Write ``shape`` as one Feature, coordinates in full, so that reading it back gives the same digest."""
    feature = {
        "type": "Feature",
        "properties": {"name": shape.name, "title": shape.title, "source": shape.source, "unit": "cm"},
        "geometry": mapping(shape.geometry),
    }
    path.write_text(json.dumps(feature, ensure_ascii=False) + "\n", encoding="utf-8")


def load_json(path: Path) -> Any:
    """Parse the file. Raises ShapeError where it is too large, empty or not JSON."""
    if path.stat().st_size > MAX_BYTES:
        raise ShapeError(str(path), f"is larger than {MAX_BYTES / 1e6:g} MB; simplify the drawing")
    try:
        text = path.read_text(encoding="utf-8-sig")
        if not text.strip():
            raise ShapeError(str(path), "the file is empty; save the drawing again")
        return json.loads(text)
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ShapeError(str(path), f"is not JSON ({error}); save it again as GeoJSON") from error
    except RecursionError as error:
        raise ShapeError(str(path), "is nested too deeply to be GeoJSON; save it again") from error


def parse_silhouette(data: Any, subject: str) -> Silhouette:
    """Turn parsed GeoJSON into a silhouette, coordinates kept as they are.

    Takes Polygon, MultiPolygon, GeometryCollection of those, Feature and FeatureCollection; several
    polygons are joined where they touch or overlap. Raises ShapeError for anything else, for a ring
    that is open or shorter than four positions, coordinates that are no finite numbers, and outlines
    that cross themselves.
    """
    pieces: list[Polygon] = []
    _collect(data, subject, pieces, depth=0)
    if not pieces:
        raise ShapeError(subject, "there is no polygon in it; draw at least one closed outline")
    if sum(count_points(piece) for piece in pieces) > MAX_POINTS:
        raise ShapeError(subject, f"has more than {MAX_POINTS} vertices; simplify the drawing")
    for piece in pieces:
        check_silhouette(piece, subject)
    joined = pieces[0] if len(pieces) == 1 else shapely.union_all(pieces)
    if not isinstance(joined, Polygon | MultiPolygon):
        raise ShapeError(subject, "its polygons do not join to an area; draw closed outlines")
    return joined


def _collect(data: Any, subject: str, pieces: list[Polygon], depth: int) -> None:
    if not isinstance(data, dict) or depth > 8:
        raise ShapeError(subject, "is not GeoJSON: every level needs an object with a `type`")
    node = cast("dict[str, Any]", data)
    kind = node.get("type")
    match kind:
        case "Polygon":
            pieces.append(_polygon(node.get("coordinates"), subject))
        case "MultiPolygon":
            pieces.extend(_polygon(rings, subject) for rings in _list(node.get("coordinates"), subject))
        case "Feature":
            _collect(node.get("geometry"), subject, pieces, depth + 1)
        case "FeatureCollection":
            for feature in _list(node.get("features"), subject):
                _collect(feature, subject, pieces, depth + 1)
        case "GeometryCollection":
            for geometry in _list(node.get("geometries"), subject):
                _collect(geometry, subject, pieces, depth + 1)
        case _:
            raise ShapeError(subject, f"holds a {kind}; only Polygon and MultiPolygon have an area to light")


def _list(value: Any, subject: str) -> list[Any]:
    if not isinstance(value, list):
        raise ShapeError(subject, "is not GeoJSON: a list of coordinates or features is missing")
    return cast("list[Any]", value)


def _polygon(rings: Any, subject: str) -> Polygon:
    parsed = [_ring(ring, subject) for ring in _list(rings, subject)]
    if not parsed:
        raise ShapeError(subject, "the shape is empty; draw at least one closed outline")
    return Polygon(LinearRing(parsed[0]), [LinearRing(hole) for hole in parsed[1:]])


def _ring(ring: Any, subject: str) -> NDArray[np.float64]:
    """Check one ring and give its positions (n, 2); a third coordinate is dropped."""
    positions: list[tuple[float, float]] = []
    for position in _list(ring, subject):
        numbers = cast("list[Any]", position)[:2] if isinstance(position, list) else []
        # bool is an int in Python, and json reads NaN and Infinity
        if len(numbers) < 2 or not all(type(value) in (int, float) and math.isfinite(value) for value in numbers):
            raise ShapeError(subject, f"{json.dumps(position)[:40]} is no position; give finite x and y in cm")
        positions.append((float(numbers[0]), float(numbers[1])))
    if len(positions) < 4:
        raise ShapeError(subject, f"a ring has {len(positions)} positions; a closed outline needs at least 4")
    if positions[0] != positions[-1]:
        raise ShapeError(
            subject, f"a ring is open: it starts at {positions[0]} and ends at {positions[-1]}; repeat the first"
        )
    return np.array(positions)
