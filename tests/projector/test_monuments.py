import itertools
import json

import numpy as np
import pytest
import shapely
from shapely.affinity import scale
from shapely.geometry import LineString, MultiPolygon, Polygon, box

from projector.dictionary import check_fits, load_dictionary, shapes_folder
from projector.geojson import read_shape
from projector.shape import ShapeError, count_points, polygons_of

FLOOR = box(-56, -41, 56, 41)
PATHS = sorted((shapes_folder() / "monuments").glob("*.geojson"))
SHAPES = {path.stem: read_shape(path) for path in PATHS}
SYMMETRIC = [
    "arc_de_triomphe",
    "atomium",
    "celtic_cross",
    "christ_the_redeemer",
    "golden_gate",
    "guitar",
    "heart",
    "lighthouse",
    "pagoda",
    "parthenon",
    "sagrada_familia",
    "star",
    "taj_mahal",
    "torii",
    "tower_bridge",
    "tree",
]
# what can be counted on the real thing or on the drawing: pieces, holes
COUNTS = {
    "footprints": (12, 0),  # two soles, ten toes
    "giza": (6, 0),  # three pyramids, one of them with its casing parted, sand and sun
    "stonehenge": (4, 0),  # two groups under lintels, a leaning and a fallen stone
    "sailing_boat": (4, 0),  # hull with mast and pennant, two sails, the water
    "lighthouse": (6, 1),  # four bands (the topmost with the lantern), two beams; the lantern's window
    "colosseum": (1, 24),  # eleven arches, seven, six windows; the lowest row opens downwards
    "pisa": (1, 22),  # six galleries of three, two windows below, two for the bells
    "parthenon": (1, 8),  # seven gaps between eight columns, the pediment
    "celtic_cross": (1, 4),
    "giraffe": (1, 6),
    "key": (1, 3),
    "teapot": (1, 1),
    "crescent": (1, 0),
    "hand": (1, 0),
}
TOUCH_CM = 1.2  # half of the finest leg or opening: 2.4 cm, three steps of the light sensor


def rings_of(geometry):
    return [ring for piece in polygons_of(geometry) for ring in (piece.exterior, *piece.interiors)]


def topology(geometry):
    pieces = polygons_of(geometry)
    return len(pieces), sum(len(piece.interiors) for piece in pieces)


def chords_at(shape, *, x=None, y=None):
    line = LineString([(-60, y), (60, y)] if x is None else [(x, -45), (x, 45)])
    return len(getattr(shape.geometry.intersection(line), "geoms", [0]))


def mirror_gap(geometry):
    """How far the vertices of a silhouette lie from those of its mirror image in x = 0."""
    own = shapely.get_coordinates(geometry)
    apart = np.abs((own * [-1.0, 1.0])[:, None, :] - own[None, :, :]).max(axis=2)
    return float(apart.min(axis=1).max())


def test_there_are_forty():
    assert len(SHAPES) == 40


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_every_file_is_a_silhouette_for_the_floor(path):
    shape = SHAPES[path.stem]
    assert shape.name == path.stem
    assert shape.title
    assert shape.source.endswith(".")
    assert path.stat().st_size <= 15_000
    properties = json.loads(path.read_text(encoding="utf-8"))["properties"]
    assert list(properties) == ["name", "title", "source", "unit"]
    assert properties["unit"] == "cm"
    assert shape.geometry.is_valid
    assert count_points(shape.geometry) <= 400
    check_fits(shape, FLOOR)
    assert 50 <= max(shape.size_cm) <= 78
    x_low, y_low, x_high, y_high = shape.geometry.bounds
    assert x_low + x_high == pytest.approx(0, abs=2e-4)
    assert y_low + y_high == pytest.approx(0, abs=2e-4)


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_no_leg_and_no_opening_is_finer_than_the_sensor_resolves(shape):
    geometry = shape.geometry
    # no leg breaks where the rim is taken off all round, no gap or opening closes where it is put on
    assert topology(geometry.buffer(-TOUCH_CM))[0] == shape.pieces
    assert topology(geometry.buffer(TOUCH_CM)) == (shape.pieces, shape.holes)
    opened = geometry.buffer(-0.4).buffer(0.4)
    assert opened.symmetric_difference(geometry).area < 0.02 * shape.area_cm2
    # nothing but corners and tips is lost to a disc of 2.4 cm, and nothing but corners is filled by it
    assert geometry.difference(geometry.buffer(-TOUCH_CM).buffer(TOUCH_CM)).area < 0.03 * shape.area_cm2
    assert geometry.buffer(TOUCH_CM).buffer(-TOUCH_CM).difference(geometry).area < 0.04 * shape.area_cm2


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_outlines_have_no_spikes_and_no_doubled_points(shape):
    for ring in rings_of(shape.geometry):
        xy = shapely.get_coordinates(ring)[:-1]
        back, on = np.roll(xy, 1, axis=0) - xy, np.roll(xy, -1, axis=0) - xy
        lengths = np.hypot(*back.T)
        assert lengths.min() > 0.01
        cos_corner = (back * on).sum(axis=1) / lengths / np.hypot(*on.T)
        assert np.degrees(np.arccos(cos_corner.clip(-1, 1))).min() > 12
        assert Polygon(ring).area > 2.0


def test_names_titles_and_silhouettes_are_all_different():
    everything = [*SHAPES.values(), *load_dictionary().values()]
    for values in (
        {shape.name for shape in everything},
        {shape.title.casefold() for shape in everything},
        {shape.source for shape in everything},
        {shape.digest for shape in everything},
    ):
        assert len(values) >= len(SHAPES) + 6
    assert len({shape.digest for shape in SHAPES.values()}) == len(SHAPES)


def test_every_two_lie_five_per_cent_apart_in_area_or_perimeter():
    everything = {shape.name: shape for shape in (*SHAPES.values(), *load_dictionary().values())}
    for a, b in itertools.combinations(everything.values(), 2):
        area_ratio = max(a.area_cm2 / b.area_cm2, b.area_cm2 / a.area_cm2)
        perimeter_ratio = max(a.perimeter_cm / b.perimeter_cm, b.perimeter_cm / a.perimeter_cm)
        assert max(area_ratio, perimeter_ratio) > 1.05, f"{a.name} and {b.name}"


def test_pieces_and_holes():
    assert {name: (SHAPES[name].pieces, SHAPES[name].holes) for name in COUNTS} == COUNTS
    assert isinstance(SHAPES["footprints"].geometry, MultiPolygon)


def test_the_symmetric_ones_are_symmetric():
    for name in SYMMETRIC:
        geometry = SHAPES[name].geometry
        assert mirror_gap(geometry) <= 1e-6, name
        assert scale(geometry, -1, 1, origin=(0, 0)).symmetric_difference(geometry).area < 1e-6, name
    for name in SHAPES.keys() - set(SYMMETRIC):
        assert mirror_gap(SHAPES[name].geometry) > 0.1, name


def test_closed_forms():
    # the pentagram's outline of circumradius R: ten triangles of R and R·sin 18°/sin 54° at 36°
    star = SHAPES["star"]
    circumradius = star.size_cm[0] / (2 * np.sin(np.radians(72)))
    inner = circumradius * np.sin(np.radians(18)) / np.sin(np.radians(54))
    assert star.area_cm2 == pytest.approx(5 * circumradius * inner * np.sin(np.radians(36)), rel=1e-4)
    side = np.sqrt(circumradius**2 + inner**2 - 2 * circumradius * inner * np.cos(np.radians(36)))
    assert star.perimeter_cm == pytest.approx(10 * side, rel=1e-4)
    # the heart's curve in units of its width 32: area 180π
    heart = SHAPES["heart"]
    assert heart.area_cm2 == pytest.approx(180 * np.pi * (heart.size_cm[0] / 32) ** 2, rel=5e-3)


def test_what_can_be_counted_on_the_real_thing():
    parthenon = SHAPES["parthenon"]
    assert chords_at(parthenon, y=-10) == 8
    assert chords_at(SHAPES["brandenburg_gate"], y=-20) == 6 + 4  # columns, posts of the halls
    assert chords_at(SHAPES["tree"], x=0) == 1
    assert chords_at(SHAPES["hand"], y=18) == 4  # the fingers, above the thumb
    # two wheels, each cut in two rims, below the pedal
    assert chords_at(SHAPES["bicycle"], y=-20) == 4
    # four bands and the lantern on the axis, which leaves through the window
    assert chords_at(SHAPES["lighthouse"], x=0) == 5


def test_the_tower_of_pisa_leans():
    tower = SHAPES["pisa"].geometry
    xs = []
    for y in (-20.0, 20.0):
        x_low, _, x_high, _ = tower.intersection(LineString([(-60, y), (60, y)])).bounds
        xs.append((x_low + x_high) / 2)
    assert np.degrees(np.arctan((xs[1] - xs[0]) / 40)) == pytest.approx(6, abs=0.7)


def test_too_large_for_a_small_floor_is_still_refused():
    with pytest.raises(ShapeError, match="does not fit"):
        check_fits(SHAPES["golden_gate"], box(-30, -30, 30, 30))
