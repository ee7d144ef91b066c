import json

import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import Point, box, mapping
from shapely.geometry import shape as from_mapping

from projector import geojson
from projector.geojson import load_json, parse_drawing, read_shape, write_shape
from projector.shape import Shape, ShapeError

RING = [[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]]
HOLE = [[1, 1], [2, 1], [2, 2], [1, 2], [1, 1]]


def polygon(*rings):
    return {"type": "Polygon", "coordinates": list(rings)}


def feature(geometry):
    return {"type": "Feature", "properties": {}, "geometry": geometry}


def test_every_kind_that_has_an_area():
    far = [[x + 10, y] for x, y in RING]
    touching = [[x + 4, y] for x, y in RING]
    assert parse_drawing(polygon(RING, HOLE), "s").geometry.area == 11
    assert parse_drawing(feature(polygon(RING)), "s").geometry.area == 12
    both = {"type": "MultiPolygon", "coordinates": [[RING], [far]]}
    assert len(parse_drawing(both, "s").geometry.geoms) == 2
    collection = {"type": "FeatureCollection", "features": [feature(polygon(RING)), feature(polygon(touching))]}
    joined = parse_drawing(collection, "s").geometry
    assert (joined.geom_type, joined.area) == ("Polygon", 24)
    nested = {"type": "GeometryCollection", "geometries": [polygon(RING)]}
    assert parse_drawing(nested, "s").geometry.area == 12
    assert parse_drawing(polygon([[*xy, 7] for xy in RING]), "s").geometry.area == 12


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (polygon(RING[:-1]), "open: it starts at"),
        (polygon(RING[:3]), "at least 4"),
        (polygon(), "empty"),
        (polygon([[0, 0], [4, 3], [4, 0], [0, 3], [0, 0]]), "crosses or touches itself"),
        (polygon([[0, 0], [4, float("nan")], [4, 3], [0, 0]]), "no position"),
        (polygon([[0, 0], [4, "3"], [4, 3], [0, 0]]), "no position"),
        (polygon([[0, 0], [4, True], [4, 3], [0, 0]]), "no position"),
        (polygon([[0, 0], 4, [4, 3], [0, 0]]), "no position"),
        (polygon([[0, 0], [1, 1], [2, 2], [0, 0]]), "invalid|crosses|area"),
        ({"type": "Polygon"}, "is missing"),
        ({"type": "LineString", "coordinates": RING}, "holds a LineString"),
        ({"type": "FeatureCollection", "features": []}, "no polygon"),
        (feature(None), "not GeoJSON"),
        ([], "not GeoJSON"),
        ({}, "holds a None"),
    ],
)
def test_what_is_refused(data, words):
    with pytest.raises(ShapeError, match=words) as caught:
        parse_drawing(data, "drawing.geojson")
    assert str(caught.value).startswith("drawing.geojson: ")
    assert "\n" not in str(caught.value)


def test_too_deep_and_too_many(monkeypatch):
    deep = polygon(RING)
    for _ in range(10):
        deep = {"type": "GeometryCollection", "geometries": [deep]}
    with pytest.raises(ShapeError, match="not GeoJSON"):
        parse_drawing(deep, "s")
    monkeypatch.setattr(geojson, "MAX_POINTS", 20)
    with pytest.raises(ShapeError, match="vertices"):
        parse_drawing(json.loads(json.dumps(mapping(Point(0, 0).buffer(1)))), "s")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty"),
        (b"  \n", "empty"),
        (b"{", "not JSON"),
        (b"\xff\xfe", "not JSON"),
        (b"[" * 200_000, "nested|not JSON"),
    ],
)
def test_files_that_are_no_json(tmp_path, content, words):
    path = tmp_path / "s.geojson"
    path.write_bytes(content)
    with pytest.raises(ShapeError, match=words):
        load_json(path)


def test_a_file_too_large(tmp_path, monkeypatch):
    path = tmp_path / "s.geojson"
    path.write_text(json.dumps(polygon(RING)))
    monkeypatch.setattr(geojson, "MAX_BYTES", 10)
    with pytest.raises(ShapeError, match="larger than"):
        load_json(path)


@given(st.floats(0.5, 40), st.floats(-20, 20), st.floats(0.1, 0.8))
def test_write_and_read_give_the_same_shape(tmp_path_factory, radius, x, hole):
    path = tmp_path_factory.mktemp("shapes") / "ring.geojson"
    geometry = Point(x, -x).buffer(radius).difference(Point(x, -x).buffer(radius * hole))
    shape = Shape("ring", "Ring “é”", geometry, "a test")
    write_shape(shape, path)
    back = read_shape(path)
    assert (back.name, back.title, back.source, back.digest) == (shape.name, shape.title, shape.source, shape.digest)
    # the file is plain GeoJSON to others
    other = from_mapping(json.loads(path.read_text(encoding="utf-8"))["geometry"])
    assert shapely.equals_exact(other.normalize(), geometry.normalize(), tolerance=0)


def test_a_bare_geometry_is_named_after_its_file(tmp_path):
    path = tmp_path / "plate.geojson"
    path.write_text(json.dumps(mapping(box(0, 0, 1, 1))))
    shape = read_shape(path)
    assert (shape.name, shape.title, shape.source) == ("plate", "plate", "plate.geojson")
