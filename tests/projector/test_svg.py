import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projector import svg
from projector.dictionary import ShapeError, shape_from
from projector.svg import read_svg

CM = 96 / 2.54  # CSS pixels


def written(tmp_path, body, head='width="200" height="200"', name="drawing.svg"):
    path = tmp_path / name
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" {head}>{body}</svg>'
    )
    return path


def area(tmp_path, body, **kwargs):
    """The filled area in the drawing's CSS pixels."""
    return read_svg(written(tmp_path, body, **kwargs)).geometry.area * CM**2


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ('<rect x="10" y="20" width="30" height="40"/>', 1200),
        ('<circle cx="50" cy="50" r="20"/>', np.pi * 400),
        ('<ellipse cx="50" cy="50" rx="20" ry="10"/>', np.pi * 200),
        ('<polygon points="0,0 40,0 0,30"/>', 600),
        ('<polyline points="0,0 40,0 0,30"/>', 600),
        ('<path d="M0 0h40v30z"/>', 600),
        ('<path d="M0 0 q 20 40 40 0 z"/>', 2 / 3 * 40 * 20),  # Archimedes: 2/3 of base times height
        ('<path d="M0 0 h10 v10 h-10 z m20 0 h10 v10 h-10 z"/>', 200),
        ('<g transform="translate(5 5) scale(2)"><rect width="10" height="10" transform="rotate(30)"/></g>', 400),
        ('<g transform="matrix(1 0 0.5 1 0 0)"><rect width="10" height="10"/></g>', 100),
        ('<rect width="10" height="10"/><rect x="5" width="10" height="10"/>', 150),
        ('<g fill="none"><rect width="10" height="10"/><rect width="5" height="5" fill="red"/></g>', 25),
        ('<g style="display:none"><rect width="10" height="10"/></g><rect width="5" height="5"/>', 25),
        ('<rect width="10" height="10" visibility="hidden"/><rect width="5" height="5"/>', 25),
        ('<rect width="10" height="10" opacity="0"/><rect width="5" height="5" opacity="half"/>', 25),
        ('<rect width="10" height="10" fill-opacity="0%"/><rect width="5" height="5"/>', 25),
        ('<style>.off{fill:none}</style><rect class="off" width="9" height="9"/><rect width="5" height="5"/>', 25),
        ('<rect width="10" height="10" fill="url(#gradient)"/>', 100),
        ('<rect width="20" height="20"/><rect width="10" height="10" fill="#FFF"/>', 300),
        ('<rect width="20" height="20"/><rect width="10" height="10" style="fill: rgb(255, 255, 255)"/>', 300),
        ('<rect width="9" height="9" fill="white"/><rect width="20" height="20"/>', 400),
        ('<defs><rect id="a" width="10" height="10"/></defs><use href="#a"/><use xlink:href="#a" x="20"/>', 200),
        ('<use href="#absent"/><rect width="10" height="10"/>', 100),
        ('<line x1="0" y1="0" x2="50" y2="50"/><rect width="10" height="10"/>', 100),
        ('<path d="M0 0 h20 v20 h-20 z M5 5 h10 v10 h-10 z"/>', 400),
        ('<path d="M0 0 h20 v20 h-20 z M5 5 v10 h10 v-10 z"/>', 300),
        ('<path fill-rule="evenodd" d="M0 0 h20 v20 h-20 z M5 5 h10 v10 h-10 z"/>', 300),
        ('<g style="fill-rule:evenodd"><path d="M0 0 h20 v20 h-20 z M5 5 h10 v10 h-10 z"/></g>', 300),
    ],
)
def test_filled_area(tmp_path, body, expected):
    assert area(tmp_path, body) == pytest.approx(expected, rel=3e-4)


def test_up_is_up(tmp_path):
    # a wide foot at the bottom of the page must lie low in the arena
    body = '<rect x="40" y="0" width="20" height="80"/><rect x="0" y="80" width="100" height="20"/>'
    shape = shape_from(str(written(tmp_path, body)))
    assert shape.geometry.centroid.y < -1
    assert shape.size_cm == pytest.approx((70, 70))


@pytest.mark.parametrize(
    ("head", "width_cm"),
    [
        ('width="100mm" viewBox="0 0 10 10" height="100mm"', 5),
        ('width="4in" height="4in" viewBox="0 0 10 10"', 5.08),
        ('width="100" height="100" viewBox="0 0 10 10"', 70),
        ('viewBox="0 0 10 10"', 70),
    ],
)
def test_a_size_in_millimetres_is_kept(tmp_path, head, width_cm):
    shape = shape_from(str(written(tmp_path, '<rect x="1" y="1" width="5" height="5"/>', head=head)))
    assert shape.size_cm[0] == pytest.approx(width_cm)
    assert shape.geometry.bounds[0] == pytest.approx(-width_cm / 2)


@given(
    turn=st.floats(0, 2 * np.pi),
    a=st.floats(0.2, 3),
    d=st.floats(0.2, 3),
    skew=st.floats(-0.5, 0.5),
    width=st.floats(1, 40),
    height=st.floats(1, 40),
)
def test_transforms_multiply_the_area_by_their_determinant(tmp_path_factory, turn, a, d, skew, width, height):
    path = tmp_path_factory.mktemp("svg")
    body = (
        f'<g transform="rotate({np.degrees(turn):.6f}) matrix({a:.6f} 0 {skew:.6f} {d:.6f} 3 4)">'
        f'<rect width="{width:.6f}" height="{height:.6f}"/></g>'
    )
    assert area(path, body) == pytest.approx(a * d * width * height, rel=1e-4)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("", "fills nothing"),
        ('<rect width="10" height="10" fill="none" stroke="black"/>', "fills nothing"),
        ('<rect width="10" height="10" fill="white"/>', "other than white"),
        ("<text>A</text>", "convert it to paths"),
        ('<image href="a.png"/>', "import the picture itself"),
        ('<mask id="m"><rect width="1" height="1"/></mask>', "flatten"),
        ('<rect width="10" height="10" clip-path="url(#c)"/>', "clipped or masked"),
        ('<rect width="10" height="10" style="fill:red;mask:url(#c)"/>', "clipped or masked"),
        ('<use href="other.svg#a"/>', "part of another file"),
        ('<g id="a"><use href="#a"/></g>', "contains itself"),
        ('<path d="M 0 0 L 10 x"/>', "cannot be read"),
        ('<path d="M 0 0 L 1e999 0 L 3 3 z"/>', "finite"),
    ],
)
def test_what_is_refused(tmp_path, body, words):
    with pytest.raises(ShapeError, match=words) as caught:
        shape_from(str(written(tmp_path, body)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty"),
        (b"not xml", "not SVG"),
        (b"<html/>", "not SVG but html"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'><rect></svg>", "not SVG"),
        (b'<!DOCTYPE svg PUBLIC "-//W3C//DTD SVG 1.1//EN" "http://example.org/svg11.dtd"><svg/>', "DOCTYPE"),
        (b'<!DOCTYPE svg [<!ENTITY a SYSTEM "file:///etc/passwd">]><svg>&a;</svg>', "DOCTYPE"),
        ('<?xml version="1.0" encoding="utf-16"?><!DOCTYPE svg [<!ENTITY a "b">]><svg/>'.encode("utf-16"), "DOCTYPE"),
    ],
)
def test_files_that_are_not_plain_svg(tmp_path, content, words):
    path = tmp_path / "drawing.svg"
    path.write_bytes(content)
    with pytest.raises(ShapeError, match=words) as caught:
        read_svg(path)
    assert "\n" not in str(caught.value)


def test_uses_that_multiply_are_refused_before_they_are_drawn(tmp_path):
    levels = '<rect id="l0" width="1" height="1"/>' + "".join(
        f'<g id="l{n}">' + f'<use href="#l{n - 1}"/>' * 10 + "</g>" for n in range(1, 12)
    )
    with pytest.raises(ShapeError, match=r"draws \d{11,} elements, more than"):
        read_svg(written(tmp_path, f"<defs>{levels}</defs><use href='#l11'/>"))


def test_too_deep_too_large_and_too_many(tmp_path, monkeypatch):
    with pytest.raises(ShapeError, match="nested too deeply"):
        read_svg(written(tmp_path, "<g>" * 5000 + "</g>" * 5000))
    path = written(tmp_path, '<circle r="5"/>')
    monkeypatch.setattr(svg, "MAX_POINTS", 100)
    with pytest.raises(ShapeError, match="vertices"):
        read_svg(path)
    monkeypatch.setattr(svg, "MAX_BYTES", 10)
    with pytest.raises(ShapeError, match="larger than"):
        read_svg(path)
