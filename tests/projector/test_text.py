import hashlib
import logging
import string
from types import SimpleNamespace

import numpy as np
import pytest
from fontTools.fontBuilder import FontBuilder
from fontTools.pens.areaPen import AreaPen
from fontTools.pens.t2CharStringPen import T2CharStringPen
from fontTools.ttLib import TTFont
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from projector import outlines
from projector.dictionary import ShapeError, shape_from
from projector.fill import fill
from projector.outlines import installed_font, open_outlines
from projector.text import Typeface, find_font, glyph

SQUARE = np.array([[0, 0], [4, 0], [4, 4], [0, 4]], dtype=float)


@pytest.fixture(scope="module")
def dejavu():
    return find_font(installed_font("DejaVu Sans"))


@pytest.fixture(scope="module")
def cubic_font(tmp_path_factory):
    """A font with cubic outlines: H a plain bar, o a circle of radius 200, x two bars that overlap."""

    def drawn(draw):
        pen = T2CharStringPen(600, None, roundTolerance=0)
        draw(pen)
        return pen.getCharString()

    def rectangle(pen, x0, y0, x1, y1):
        pen.moveTo((x0, y0))
        for point in ((x1, y0), (x1, y1), (x0, y1)):
            pen.lineTo(point)
        pen.closePath()

    def circle(pen):
        r, c = 200, 200 * 0.5522847498  # the cubic that comes nearest to a quarter circle
        pen.moveTo((300 + r, 300))
        pen.curveTo((300 + r, 300 + c), (300 + c, 300 + r), (300, 300 + r))
        pen.curveTo((300 - c, 300 + r), (300 - r, 300 + c), (300 - r, 300))
        pen.curveTo((300 - r, 300 - c), (300 - c, 300 - r), (300, 300 - r))
        pen.curveTo((300 + c, 300 - r), (300 + r, 300 - c), (300 + r, 300))
        pen.closePath()

    def cross(pen):
        rectangle(pen, 200, 0, 300, 500)
        rectangle(pen, 0, 200, 500, 300)

    builder = FontBuilder(1000, isTTF=False)
    builder.setupGlyphOrder([".notdef", "H", "o", "x", "space"])
    builder.setupCharacterMap({ord("H"): "H", ord("o"): "o", ord("x"): "x", 0x20: "space"})
    builder.setupCFF(
        "Test-Regular",
        {},
        {
            ".notdef": drawn(lambda pen: None),
            "H": drawn(lambda pen: rectangle(pen, 0, 0, 100, 700)),
            "o": drawn(circle),
            "x": drawn(cross),
            "space": drawn(lambda pen: None),
        },
        {},
    )
    builder.setupHorizontalMetrics(dict.fromkeys([".notdef", "H", "o", "x", "space"], (600, 0)))
    builder.setupHorizontalHeader(ascent=800, descent=-200)
    builder.setupNameTable({"familyName": "Test", "styleName": "Regular", "fullName": "Test Regular"})
    builder.setupOS2()
    builder.setupPost()
    path = tmp_path_factory.mktemp("fonts") / "test.otf"
    builder.save(path)
    return path


def test_letters_have_the_area_of_their_outlines(dejavu):
    font = TTFont(dejavu.path)
    glyphs, names = font.getGlyphSet(), font.getBestCmap()
    ours = open_outlines(dejavu.path)
    for letter in string.ascii_uppercase + string.digits + "aegß&@":
        pen = AreaPen(glyphs)
        glyphs[names[ord(letter)]].draw(pen)
        # the pen integrates the true curves; chords of 1/32 of a curve cut off 1e-3 of it at most
        assert glyph(ours, letter).area == pytest.approx(abs(pen.value), rel=5e-4), letter


def test_letters_have_their_holes(dejavu):
    holes = {letter: shape_from(f"text:{letter}", font=dejavu).holes for letter in string.ascii_uppercase}
    assert {letter for letter, count in holes.items() if count == 1} == set("ADOPQR")
    assert {letter for letter, count in holes.items() if count == 2} == set("B")
    assert shape_from("text:i", font=dejavu).pieces == 2
    assert shape_from("text:FREEDOM", font=dejavu).pieces == 7


def test_curves_are_flattened_finely(dejavu):
    outer = shape_from("text:O", font=dejavu).geometry.exterior
    assert len(outer.coords) > 4 * 32


def test_capitals_share_one_scale(dejavu):
    heights = {letter: shape_from(f"text:{letter}", font=dejavu).size_cm[1] for letter in "HEOQ"}
    assert heights["H"] == pytest.approx(40)
    assert heights["E"] == pytest.approx(40)
    assert 40 < heights["O"] < 42
    assert heights["Q"] > 43
    assert shape_from("text:H", font=dejavu, height_cm=20).size_cm[1] == pytest.approx(20)


def test_size_of_a_word(dejavu):
    def size(**kwargs):
        return shape_from("text:FREEDOM", font=dejavu, **kwargs).size_cm

    assert size()[0] == pytest.approx(100)
    assert size(width_cm=50)[0] == pytest.approx(50)
    assert size(height_cm=40)[0] > 200
    assert size(height_cm=40, width_cm=90)[0] == pytest.approx(90)
    assert size(height_cm=5, width_cm=90)[0] < 40


def test_anagrams_have_the_same_area_and_perimeter(dejavu):
    one, other = (shape_from(f"text:{word}", font=dejavu, height_cm=10) for word in ("LISTEN", "SILENT"))
    assert one.area_cm2 == pytest.approx(other.area_cm2, rel=1e-9)
    assert one.perimeter_cm == pytest.approx(other.perimeter_cm, rel=1e-9)
    assert one.digest != other.digest


def test_a_text_records_its_font(dejavu):
    shape = shape_from("text:A", font=dejavu.path)
    assert shape.font == dejavu
    assert dejavu.sha256 == hashlib.sha256(dejavu.path.read_bytes()).hexdigest()
    assert (dejavu.name, dejavu.fallback) == ("DejaVu Sans", False)
    assert shape.name == "text:A"


def test_a_font_that_stands_in_is_told(caplog):
    with caplog.at_level(logging.WARNING):
        font = find_font(families=["No Such Grotesque"])
    assert font.fallback
    assert "No Such Grotesque is installed; DejaVu Sans stands in" in caplog.text
    caplog.clear()
    assert not find_font(families=["No Such Grotesque", "DejaVu Serif"]).fallback
    assert caplog.text == ""


def test_no_font_at_all(monkeypatch):
    monkeypatch.setattr("projector.text.installed_font", lambda family: None)
    with pytest.raises(ShapeError, match="--font PATH"):
        find_font()


def test_a_font_installed_since_the_managers_list_was_made(dejavu, cubic_font, tmp_path, monkeypatch):
    def knows_none(*args, **kwargs):
        raise ValueError("none found")

    junk = tmp_path / "junk.ttf"
    junk.write_bytes(b"no font")
    monkeypatch.setattr(outlines, "findfont", knows_none)
    monkeypatch.setattr(outlines, "fontManager", SimpleNamespace(ttflist=[SimpleNamespace(fname=str(cubic_font))]))
    monkeypatch.setattr(outlines, "findSystemFonts", lambda: [str(junk), str(cubic_font), str(dejavu.path)])
    assert installed_font("DejaVu Sans") == dejavu.path
    assert installed_font("Test") is None  # listed: the manager had its say
    assert installed_font("Absent") is None


def test_cubic_outlines(cubic_font):
    outlines_ = open_outlines(cubic_font)
    assert outlines_.name == "Test Regular"
    assert outlines_.cap_height == 700
    assert glyph(outlines_, "o").area == pytest.approx(np.pi * 200**2, rel=5e-4)


def test_overlapping_contours_are_joined(cubic_font):
    # each bar 100 x 500, the overlap 100 x 100: neither counted twice nor cut out
    cross = glyph(open_outlines(cubic_font), "x")
    assert cross.area == pytest.approx(2 * 100 * 500 - 100 * 100)
    assert len(cross.interiors) == 0


def test_blanks_space_letters_out(cubic_font):
    shape = shape_from("text:H H", font=cubic_font, height_cm=7)
    assert (shape.pieces, shape.size_cm) == (2, pytest.approx((13, 7)))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("H漢語H", r"has no '漢' \(U\+6F22\), '語'"),
        (" \t", "empty"),
        ("H\nH", r"'\\n' \(U\+000A\)"),
        ("H" * 201, "longer"),
    ],
)
def test_texts_that_cannot_be_set(cubic_font, text, words):
    with pytest.raises(ShapeError, match=words) as caught:
        Typeface(find_font(cubic_font)).set(text)
    assert "\n" not in str(caught.value)


def test_sizes_of_texts_must_be_above_zero(cubic_font):
    font = find_font(cubic_font)
    with pytest.raises(ShapeError, match="height must be above 0"):
        Typeface(font).set("H", cap_height_cm=-1)
    with pytest.raises(ShapeError, match="width must be above 0"):
        Typeface(font).set("H", max_width_cm=0)


def test_a_letter_that_draws_nothing(dejavu):
    with pytest.raises(ShapeError, match="draws nothing"):
        Typeface(dejavu).set("\u00a0\u200b")


def test_files_that_are_no_font(tmp_path):
    with pytest.raises(ShapeError, match="is not a file"):
        find_font(tmp_path / "absent.ttf")
    for content in (b"", b"not a font", b"\x00\x01\x00\x00" + bytes(30)):
        path = tmp_path / "bad.ttf"
        path.write_bytes(content)
        with pytest.raises(ShapeError, match="not a font with outlines"):
            find_font(path)


def test_a_symbol_font_without_capitals(cubic_font, monkeypatch):
    monkeypatch.setattr(outlines.Outlines, "has", lambda self, letter: False)
    ours = open_outlines(cubic_font)
    assert ours.cap_height == 700
    assert ours.advance(" ") == pytest.approx(1000 / 3)


def test_island_in_a_hole_stays():
    hole = SQUARE[::-1] * 0.75 + 0.5
    island = SQUARE * 0.25 + 1.5
    target = fill([SQUARE, hole, island])
    assert target.area == pytest.approx(16 - 9 + 1)
    assert len(target.geoms) == 2


def test_nothing_to_fill():
    assert fill([]).is_empty
    assert fill([np.array([[0, 0], [1, 1], [0, 0.0]])]).is_empty


def winding_by_angle(ring, point):
    """The turns of ``ring`` about ``point`` by summing the angles its edges subtend."""
    away = np.vstack([ring, ring[:1]]) - point
    angles = np.arctan2(away[:, 1], away[:, 0])
    return round(np.sum((np.diff(angles) + np.pi) % (2 * np.pi) - np.pi) / (2 * np.pi))


@given(
    st.lists(arrays(float, (5, 2), elements=st.integers(0, 12).map(float)), min_size=1, max_size=3),
    st.integers(0, 2**32 - 1),
)
def test_fill_agrees_with_the_winding_number(rings, seed):
    # odd offsets keep the points off the integer lattice of the vertices
    points = np.random.default_rng(seed).uniform(0, 12, (20, 2))
    import shapely

    proper = [ring for ring in rings if len(np.unique(ring, axis=0)) >= 3]
    nonzero, evenodd = fill(rings), fill(rings, "evenodd")
    assert nonzero.is_valid
    assert evenodd.is_valid
    edges = [shapely.LinearRing(ring) for ring in proper]
    for point in points:
        spot = shapely.Point(point)
        if any(edge.distance(spot) < 1e-6 for edge in edges):
            continue
        turns = sum(winding_by_angle(ring, point) for ring in proper)
        assert nonzero.contains(spot) == (turns != 0)
        assert evenodd.contains(spot) == (turns % 2 == 1)
