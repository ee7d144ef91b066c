import itertools
import json

import numpy as np
import pytest
import shapely
from shapely.affinity import rotate
from shapely.geometry import LineString, MultiPolygon, Point, Polygon, box

from lab.base.errors import ChordlabError
from projector import catalogue
from projector.dictionary import ShapeError, check_fits, load_dictionary, shape_from
from projector.draw import draw_shape
from projector.geojson import write_shape
from projector.shape import Shape, polygons_of

ARENA = box(-60, -45, 60, 45)
NAMES = ["circle", "square", "triangle", "chichen_itza", "eiffel", "liberty"]


@pytest.fixture(scope="module")
def shapes():
    return load_dictionary()


def test_the_six_shapes_in_order_of_intricacy(shapes):
    assert list(shapes) == NAMES
    assert all(shape.name == name and shape.title and shape.source for name, shape in shapes.items())


def test_simple_shapes_are_what_they_say(shapes):
    circle = shapes["circle"]
    radius = circle.size_cm[0] / 2
    assert circle.area_cm2 == pytest.approx(np.pi * radius**2, rel=1e-4)
    assert circle.perimeter_cm == pytest.approx(2 * np.pi * radius, rel=1e-4)
    square = shapes["square"]
    assert square.perimeter_cm**2 == pytest.approx(16 * square.area_cm2, rel=1e-9)
    xy = shapely.get_coordinates(shapes["triangle"].geometry)[:3]
    sides = [np.linalg.norm(a - b) for a, b in itertools.combinations(xy, 2)]
    assert sides == pytest.approx([sides[0]] * 3, rel=1e-8)


def test_pyramid_and_triangle_have_the_same_area(shapes):
    assert shapes["chichen_itza"].area_cm2 == pytest.approx(shapes["triangle"].area_cm2, abs=1e-6)


def test_shapes_lie_apart_in_perimeter_and_area(shapes):
    for a, b in itertools.combinations(shapes.values(), 2):
        apart = np.hypot(np.log(a.area_cm2 / b.area_cm2), np.log(a.perimeter_cm / b.perimeter_cm))
        assert apart > 0.2, f"{a.name} and {b.name}"


def test_all_fit_the_default_arena_and_are_centred(shapes):
    for shape in shapes.values():
        check_fits(shape, ARENA, 6.0)
        x_low, y_low, x_high, y_high = shape.geometry.bounds
        assert x_low + x_high == pytest.approx(0, abs=1e-6)
        assert y_low + y_high == pytest.approx(0, abs=1e-6)


def test_monuments_are_whole_and_coarse_enough_for_the_sensor(shapes):
    expected_holes = {"chichen_itza": 3, "eiffel": 2, "liberty": 5}
    for name, holes in expected_holes.items():
        shape = shapes[name]
        assert (shape.pieces, shape.holes) == (1, holes)
        for piece in polygons_of(shape.geometry):
            for ring in piece.interiors:
                assert not Polygon(ring).buffer(-1.4).is_empty, f"{name}: an opening below 2.8 cm"
    # the tower holds together where 1.8 cm are taken off its thickness: no bridge is thinner
    assert isinstance(shapes["eiffel"].geometry.buffer(-0.9), Polygon)


def test_a_line_cuts_the_statue_in_six_chords(shapes):
    statue = shapes["liberty"].geometry
    pieces = [
        len(getattr(statue.intersection(LineString([(-60, y), (60, y)])), "geoms", [0]))
        for y in np.linspace(-37.5, 37.5, 301)
    ]
    assert max(pieces) in (6, 7)


def test_digest_names_the_shape_and_nothing_else(shapes):
    eiffel = shapes["eiffel"]
    shell = shapely.get_coordinates(eiffel.geometry.exterior)[:-1]
    turned = Polygon(np.roll(shell, 17, axis=0)[::-1], [ring.coords for ring in eiffel.geometry.interiors[::-1]])
    nudged = shapely.transform(turned, lambda xy: xy + 1e-9)
    assert Shape("other", "Other", nudged, "elsewhere").digest == eiffel.digest
    assert len({shape.digest for shape in shapes.values()}) == 6
    assert Shape("a", "A", rotate(eiffel.geometry, 0.1), "").digest != eiffel.digest
    zero = Shape("z", "Z", Polygon([(0, 0), (1, 0), (1, 1)]), "")
    minus = Shape("z", "Z", Polygon([(-0.0, -0.0), (1, -0.0), (1, 1)]), "")
    assert zero.digest == minus.digest


def test_shape_counts_pieces_and_holes():
    ring = Point(0, 0).buffer(5).difference(Point(0, 0).buffer(2))
    shape = Shape("two", "Two", MultiPolygon([ring, box(10, 0, 12, 1)]), "")
    assert (shape.pieces, shape.holes) == (2, 1)
    assert shape.size_cm == pytest.approx((17, 10))


@pytest.mark.parametrize(
    ("geometry", "words"),
    [
        (Polygon(), "empty"),
        (Polygon([(0, 0), (2, 2), (2, 0), (0, 2)]), "crosses"),
        (Polygon([(0, 0), (np.inf, 2), (2, 0)]), "finite"),
    ],
)
def test_no_invalid_shape_is_ever_made(geometry, words):
    with pytest.raises(ShapeError, match=words) as caught:
        Shape("bad", "Bad", geometry, "")
    assert caught.value.subject == "bad"
    assert "\n" not in str(caught.value)


def test_shape_from_a_name(shapes):
    assert shape_from("eiffel").digest == shapes["eiffel"].digest
    assert shape_from("Chichen-Itza").name == "chichen_itza"
    half = shape_from("eiffel", height_cm=shapes["eiffel"].size_cm[1] / 2)
    assert half.size_cm == pytest.approx([side / 2 for side in shapes["eiffel"].size_cm])
    assert half.area_cm2 == pytest.approx(shapes["eiffel"].area_cm2 / 4)
    bounded = shape_from("chichen_itza", width_cm=20, height_cm=70)
    assert bounded.size_cm[0] == pytest.approx(20)


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("eifel", "did you mean eiffel"),
        ("libertty", "did you mean liberty"),
        ("qqqq", "known are circle, square"),
        ("nowhere/shape.svg", "is not a file"),
        ("tests", "is not in the dictionary"),
        ("./tests", "file ends in"),
        ("text:", "empty"),
        ("text:   ", "empty"),
    ],
)
def test_what_cannot_be_had_is_told_in_one_line(spec, words):
    with pytest.raises(ShapeError, match=words) as caught:
        shape_from(spec)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


def test_bad_sizes_and_misplaced_font():
    with pytest.raises(ShapeError, match="height must be above 0"):
        shape_from("circle", height_cm=0)
    with pytest.raises(ShapeError, match="width must be above 0"):
        shape_from("circle", width_cm=float("nan"))
    with pytest.raises(ShapeError, match="takes no font"):
        shape_from("circle", font="some.ttf")


def test_shape_from_a_geojson_keeps_its_size_and_is_centred(tmp_path):
    path = tmp_path / "slab.geojson"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [[[5, 5], [25, 5], [25, 15], [5, 15], [5, 5]]]}))
    shape = shape_from(str(path))
    assert shape.geometry.bounds == pytest.approx((-10, -5, 10, 5))
    assert shape.name == "slab"
    assert shape_from(str(path), width_cm=40).area_cm2 == pytest.approx(800)


def test_check_fits_names_the_height_that_would_fit():
    wide = Shape("wide", "Wide", box(-70, -10, 70, 10), "")
    with pytest.raises(ShapeError, match=r"140\.0 x 20\.0 cm does not fit .* at most 15\.4 cm high") as caught:
        check_fits(wide, ARENA, 6.0)
    assert "\n" not in str(caught.value)
    check_fits(shape_at_height(wide, 15.4), ARENA, 6.0)
    with pytest.raises(ShapeError):
        check_fits(shape_at_height(wide, 15.5), ARENA, 6.0)
    # an arena drawn clockwise, and a disc
    check_fits(shape_at_height(wide, 15.4), Polygon(list(ARENA.exterior.coords)[::-1]), 6.0)
    disc = Point(0, 0).buffer(50, quad_segs=90)
    with pytest.raises(ShapeError, match="cm high"):
        check_fits(Shape("s", "S", box(-36, -36, 36, 36), ""), disc)
    check_fits(Shape("s", "S", box(-35, -35, 35, 35), ""), disc)
    with pytest.raises(ShapeError, match="make the arena larger"):
        check_fits(wide, ARENA, 46.0)


def shape_at_height(shape, height_cm):
    factor = height_cm / shape.size_cm[1]
    return Shape(shape.name, shape.title, shapely.transform(shape.geometry, lambda xy: xy * factor), "")


def test_installed_wheel_finds_its_shapes_beside_the_module(tmp_path, monkeypatch, shapes):
    package = tmp_path / "projector"
    (package / "shapes").mkdir(parents=True)
    write_shape(shapes["square"], package / "shapes" / "square.geojson")
    monkeypatch.setattr(catalogue, "__file__", str(package / "catalogue.py"))
    assert list(load_dictionary()) == ["square"]
    (package / "shapes" / "square.geojson").unlink()
    with pytest.raises(ChordlabError, match="holds no"):
        load_dictionary()
    (package / "shapes").rmdir()
    with pytest.raises(ChordlabError, match="install chordlab again"):
        load_dictionary()


def test_picture_has_the_silhouette_to_scale(tmp_path, shapes):
    cv2 = pytest.importorskip("cv2")
    path = tmp_path / "eiffel.png"
    figure = draw_shape(shapes["eiffel"], path)
    axes = figure.axes[0]
    figure.canvas.draw()
    image = cv2.imread(str(path))
    frame = axes.get_window_extent()
    pixels_per_cm = frame.width / np.diff(axes.get_xlim())[0]
    assert pixels_per_cm == pytest.approx(frame.height / np.diff(axes.get_ylim())[0], rel=1e-6)
    dark = 1 - np.clip((image[:, :, 2].astype(float) - 0x1F) / (255 - 0x1F), 0, 1)
    rows = slice(int(image.shape[0] - frame.y1) + 2, int(image.shape[0] - frame.y0) - 2)
    inked = dark[rows, int(frame.x0) + 2 : int(frame.x1) - 2].sum() / pixels_per_cm**2
    # the grid's pale lines add a little ink
    assert inked == pytest.approx(shapes["eiffel"].area_cm2, rel=0.08)
    words = " ".join(text.get_text() for text in figure.texts)
    assert "Eiffel Tower" in words
    assert "A = 1,478.5 cm²" in words
    assert "2 holes" in words


def test_picture_with_its_arena(shapes):
    figure = draw_shape(shapes["circle"], arena=ARENA)
    assert figure.axes[0].get_xlim() == (-64, 64)
    assert "1 piece, 0 holes" in figure.texts[1].get_text()
