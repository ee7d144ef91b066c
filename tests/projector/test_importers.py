"""Shapes from files: sizes, names, notes, and one line with the cure for everything that is wrong."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageDraw
from shapely.geometry import Polygon, box, mapping

from projector.dictionary import shape_from
from projector.importers import import_shape
from projector.outlines import installed_font
from projector.shape import ShapeError

BOW_TIE = [[0, 0], [40, 30], [40, 0], [0, 30], [0, 0]]
ARENA = box(-56, -41, 56, 41)


def geojson(tmp_path, rings, name="drawing.geojson", **properties):
    path = tmp_path / name
    geometry = {"type": "Polygon", "coordinates": rings}
    path.write_text(json.dumps({"type": "Feature", "properties": properties, "geometry": geometry}))
    return str(path)


def rectangle(width, height):
    return [[0, 0], [width, 0], [width, height], [0, height], [0, 0]]


def picture(tmp_path, name="picture.png", size=(300, 200), **kwargs):
    """A dark rectangle of 100 x 50 pixels."""
    image = Image.new("L", size, 255)
    ImageDraw.Draw(image).rectangle((100, 80, 199, 129), fill=0)
    image.save(tmp_path / name, **kwargs)
    return str(tmp_path / name)


def drawing(tmp_path, body, head='width="100mm" height="100mm" viewBox="0 0 100 100"'):
    path = tmp_path / "drawing.svg"
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {head}>{body}</svg>')
    return str(path)


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ({}, (40, 20)),
        ({"width_cm": 60}, (60, 30)),
        ({"height_cm": 30}, (60, 30)),
        ({"width_cm": 60, "height_cm": 10}, (20, 10)),
        ({"area_cm2": 200}, (20, 10)),
        ({"scale": 1.5}, (60, 30)),
    ],
)
def test_sizes(tmp_path, size, expected):
    made = import_shape(geojson(tmp_path, [rectangle(40, 20)]), "slab", **size)
    assert made.shape.size_cm == pytest.approx(expected)
    assert made.shape.geometry.centroid.coords[0] == pytest.approx((0, 0))


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ({"width_cm": 0}, "width must be above 0 cm"),
        ({"area_cm2": -3}, "area must be above 0 cm²"),
        ({"scale": float("nan")}, "scale must be above 0"),
        ({"area_cm2": 3, "width_cm": 4}, "width and area contradict each other"),
        ({"scale": 2, "height_cm": 4}, "height and scale contradict"),
        ({"width_cm": 400}, "does not fit in the 112 x 82 cm arena with 0 cm to spare; make it at most"),
        ({"width_cm": 0.01}, "too small for a robot to meet"),
        ({"scale": 1e6}, "larger than any arena"),
    ],
)
def test_sizes_that_cannot_be(tmp_path, size, words):
    with pytest.raises(ShapeError, match=words):
        import_shape(geojson(tmp_path, [rectangle(40, 20)]), "slab", arena=ARENA, **size)


@pytest.mark.parametrize("side", [1e-4, 4e6])
def test_a_drawing_in_another_unit_needs_its_size(tmp_path, side):
    path = geojson(tmp_path, [rectangle(side, side)])
    with pytest.raises(ShapeError, match="--width, --height, --area or --scale"):
        import_shape(path, "plot")
    with pytest.raises(ShapeError, match="--width"):
        shape_from(path)
    assert import_shape(path, "plot", width_cm=40).shape.area_cm2 == pytest.approx(1600)


def test_map_coordinates_far_from_the_origin_keep_their_digits(tmp_path):
    ring = [[x + 500_000.25, y + 5_400_000.5] for x, y in rectangle(40, 20)]
    made = import_shape(geojson(tmp_path, [ring]), "plot", width_cm=80)
    assert made.shape.area_cm2 == pytest.approx(3200, rel=1e-10)


@pytest.mark.parametrize(
    ("name", "kwargs", "width_cm", "note"),
    [
        ("p.png", {"dpi": (50, 50)}, 100 / 50 * 2.54, "size from the picture's 50 dpi"),
        ("p.jpg", {"dpi": (25, 25), "quality": 95}, 100 / 25 * 2.54, "size from the picture's 25 dpi"),
        ("p.png", {"dpi": (50, 25)}, 100 / 50 * 2.54, "size from"),
        ("p.png", {}, 100, "states no size: fitted"),
        ("p.jpg", {"dpi": (72, 72)}, 100, "states no size: fitted"),  # what cameras write for want of a size
    ],
)
def test_pictures_are_scaled_by_their_resolution(tmp_path, name, kwargs, width_cm, note):
    made = import_shape(picture(tmp_path, name, **kwargs), "block")
    assert made.shape.size_cm[0] == pytest.approx(width_cm, rel=0.01)
    assert any(note in line for line in made.notes)
    tall = 2 if kwargs.get("dpi") == (50, 25) else 1
    assert made.shape.size_cm[1] == pytest.approx(width_cm / 2 * tall, rel=0.02)
    given = import_shape(picture(tmp_path, name, **kwargs), "block", width_cm=30)
    assert given.shape.size_cm[0] == pytest.approx(30)
    assert given.notes == ()


def test_a_picture_on_its_side_turns_its_resolution_too(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    made = import_shape(picture(tmp_path, dpi=(50, 25), exif=exif), "block")
    assert made.shape.size_cm == pytest.approx((50 / 25 * 2.54, 100 / 50 * 2.54), rel=0.02)


def test_cm_a_pixel(tmp_path):
    assert import_shape(picture(tmp_path), "block", scale=0.25).shape.size_cm == pytest.approx((25, 12.5), rel=0.01)


def test_a_huge_picture_is_averaged_and_keeps_its_size(tmp_path):
    image = Image.new("L", (4000, 3000), 255)
    ImageDraw.Draw(image).ellipse((500, 500, 2500, 2500), fill=0)
    image.save(tmp_path / "huge.png", dpi=(100, 100))
    disc = import_shape(str(tmp_path / "huge.png"), "disc").shape
    assert disc.area_cm2 == pytest.approx(np.pi * (1000 / 100 * 2.54) ** 2, rel=2e-3)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.integers(20, 380), st.integers(20, 280)), min_size=3, max_size=3, unique=True))
def test_a_traced_triangle_has_as_many_pixels_as_the_raster(tmp_path_factory, corners):
    expected = Polygon(corners)
    if expected.area < 2000 or min(expected.minimum_rotated_rectangle.exterior.length, 200) < 200:
        return
    big = Image.new("L", (1600, 1200), 255)
    ImageDraw.Draw(big).polygon([(4 * x, 4 * y) for x, y in corners], fill=0)
    soft = big.resize((400, 300), Image.Resampling.BOX)
    path = tmp_path_factory.mktemp("tri") / "t.png"
    soft.save(path)
    ink = (255 - np.asarray(soft, dtype=float)).sum() / 255
    # a pixel is 1 cm: corners are rounded off by a pixel or so
    assert import_shape(str(path), "t", scale=1.0).shape.area_cm2 == pytest.approx(ink, rel=0.01)


def test_self_crossing_outlines_are_mended_on_request_alone(tmp_path):
    path = geojson(tmp_path, [BOW_TIE])
    with pytest.raises(ShapeError, match=r"crosses or touches itself \(.*\); untangle .* --mend"):
        import_shape(path, "tie")
    made = import_shape(path, "tie", mend=True)
    assert made.shape.area_cm2 == pytest.approx(600)  # both lobes of 20 x 30 / 2
    assert made.shape.pieces == 2
    assert any(note.startswith("mended: Self-intersection") for note in made.notes)


def test_open_rings_are_closed_on_request_alone(tmp_path):
    path = geojson(tmp_path, [rectangle(40, 20)[:-1]])
    with pytest.raises(ShapeError, match=r"ring is open: .* repeat the first, or close it by .* --mend"):
        import_shape(path, "slab")
    made = import_shape(path, "slab", mend=True)
    assert made.shape.area_cm2 == 800
    assert any(note.startswith("closed a ring") for note in made.notes)


def test_a_hole_that_reaches_out_is_mended(tmp_path):
    hole = [[-5, 5], [10, 5], [10, 15], [-5, 15], [-5, 5]]
    with pytest.raises(ShapeError, match="crosses"):
        import_shape(geojson(tmp_path, [rectangle(40, 20), hole]), "bay")
    assert import_shape(geojson(tmp_path, [rectangle(40, 20), hole]), "bay", mend=True).shape.area_cm2 == 700


def test_open_outlines_of_a_drawing_are_closed_as_its_fill_does(tmp_path):
    made = import_shape(drawing(tmp_path, '<path d="M0 0 H40 V30"/>'), "wedge")
    assert made.shape.area_cm2 == pytest.approx(6, rel=1e-5)
    assert "closed 1 open outline by a straight line, as a fill does" in made.notes
    whole = import_shape(drawing(tmp_path, '<path d="M0 0 H40 V30 z"/><circle cx="50" cy="50" r="9"/>'), "wedge")
    assert not any("open" in note for note in whole.notes)


def test_a_star_by_either_rule(tmp_path):
    turns = np.arange(5) * 4 * np.pi / 5
    points = " ".join(f"{50 + 40 * np.sin(t):.9f},{50 - 40 * np.cos(t):.9f}" for t in turns)
    # closed forms for the pentagram of radius R: its outline, and its five tips alone
    inner = 40 * np.sin(np.pi / 10) / np.sin(7 * np.pi / 10)
    outline = 5 * 40 * inner * np.sin(np.pi / 5)
    pentagon = 2.5 * inner**2 * np.sin(2 * np.pi / 5)
    whole = import_shape(drawing(tmp_path, f'<polygon points="{points}"/>'), "star").shape
    tips = import_shape(drawing(tmp_path, f'<polygon fill-rule="evenodd" points="{points}"/>'), "star").shape
    assert whole.area_cm2 == pytest.approx(outline / 100, rel=1e-5)
    assert tips.area_cm2 == pytest.approx((outline - pentagon) / 100, rel=1e-5)
    assert (whole.holes, tips.holes + tips.pieces) in {(0, 6), (0, 5)}


def test_texts_in_a_font(tmp_path):
    dejavu = installed_font("DejaVu Sans")
    made = import_shape("text:HO", "ho", font=dejavu, height_cm=20)
    assert made.shape.name == "ho"
    assert made.shape.size_cm[1] == pytest.approx(20, rel=0.05)
    assert made.notes == ("set in DejaVu Sans",)
    assert import_shape("text:HO", "ho", font=dejavu, area_cm2=500).shape.area_cm2 == pytest.approx(500)
    half = import_shape("text:HO", "ho", font=dejavu, scale=0.5).shape
    assert half.area_cm2 == pytest.approx(shape_from("text:HO", font=dejavu).area_cm2 / 4)
    with pytest.raises(ShapeError, match=r"is a font; write text:WORD --font"):
        import_shape(str(dejavu), "dejavu")
    with pytest.raises(ShapeError, match="takes no font"):
        import_shape(geojson(tmp_path, [rectangle(4, 2)]), "slab", font=dejavu)


def test_names_and_titles(tmp_path):
    path = geojson(tmp_path, [rectangle(40, 20)], name="plate.geojson", name_="", title="A  plate\nof mine")
    assert import_shape(path).shape.name == "plate"
    assert import_shape(path).shape.title == "A plate of mine"
    assert import_shape(path, "tafel", title="Tafel").shape.title == "Tafel"
    named = tmp_path / "x.geojson"
    named.write_text(
        json.dumps({"type": "Feature", "properties": {"name": "slab"}, "geometry": mapping(box(0, 0, 9, 9))})
    )
    assert import_shape(str(named)).shape.name == shape_from(str(named)).name == "slab"
    for bad in ("", "a b", "../up", "a" * 61, "text:A"):
        with pytest.raises(ShapeError, match="--name"):
            import_shape(path, bad)
    with pytest.raises(ShapeError, match="called eiffel already; give another --name"):
        import_shape(path, "eiffel", taken=("eiffel",))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.gif", b"GIF89a", "file ends in .geojson"),
        ("a.png", b"<svg/>", "is no PNG or JPEG"),
        ("a.svg", b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "is not SVG"),
        ("a.geojson", bytes(range(256)), "is not JSON"),
        ("a.geojson", b"9" * 5000, "is not JSON"),
        ("a.geojson", b'{"type":"Polygon","coordinates":[[[1' + b"0" * 400 + b",0]]]}", "no position"),
        ("a.geojson", b'{"type":"Polygon","coordinates":[[[1e10,0]]]}', "no position"),
        ("a.geojson", b'{"type":"Polygon","coordinates":[]}', "shape is empty"),
        ("a.svg", b'<!DOCTYPE svg SYSTEM "http://example.org/x.dtd"><svg/>', "DOCTYPE"),
        ("a.svg", b'<svg xmlns="http://www.w3.org/2000/svg"><style>' + b"a" * 30_000 + b"</style></svg>", "styles"),
        ("a.svg", b'<svg xmlns="http://www.w3.org/2000/svg"><path d="' + b"l1 1" * 300_000 + b'"/></svg>', "numbers"),
    ],
)
def test_files_that_are_something_else(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ShapeError, match=words) as caught:
        import_shape(str(tmp_path / name), "a")
    assert len(str(caught.value).splitlines()) == 1


def test_tangles_and_noise_end_soon(tmp_path):
    points = np.random.default_rng(1).uniform(0, 100, (3000, 2))
    body = '<path d="M' + " ".join(f"{x:.3f},{y:.3f}" for x, y in points) + 'z"/>'
    with pytest.raises(ShapeError, match="cross each other too many times"):
        import_shape(drawing(tmp_path, body), "tangle")
    with pytest.raises(ShapeError, match="cross each other too many times"):
        ring = [*points.tolist(), points[0].tolist()]
        import_shape(geojson(tmp_path, [ring]), "tangle", mend=True)
    stripes = "".join(
        f'<rect x="{n % 90}" width="{9 + n % 5}" height="90" fill="{("#000", "#fff")[n % 2]}"/>' for n in range(2000)
    )
    with pytest.raises(ShapeError, match="black and white 2000 times"):
        import_shape(drawing(tmp_path, stripes), "stripes")
    noise = np.random.default_rng(1).integers(0, 256, (900, 900)).astype(np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.png")
    with pytest.raises(ShapeError, match="smooth the picture"):
        import_shape(str(tmp_path / "noise.png"), "noise")


@pytest.mark.parametrize("thick", [1e-12, 1e-9, 1e-6])
def test_slivers_are_no_shapes(tmp_path, thick):
    with pytest.raises(ShapeError, match="next to nothing") as caught:
        import_shape(geojson(tmp_path, [rectangle(40, thick)]), "sliver", mend=True)
    assert str(caught.value).startswith(str(tmp_path))


def test_imported_shapes_are_not_torn_by_rounding(tmp_path):
    # two edges a hair apart, which scaling may lay on each other
    ring = [[0, 0], [30, 0], [30, 1], [1e-12, 1], [30, 1 + 1e-13], [30, 20], [0, 20], [0, 0]]
    for width_cm in np.linspace(20, 90, 15):
        assert import_shape(geojson(tmp_path, [ring]), "slit", width_cm=width_cm, mend=True).shape.geometry.is_valid
