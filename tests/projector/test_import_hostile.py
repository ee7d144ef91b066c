"""Thousands of broken files: each becomes a shape or one line, never a traceback, never a warning, soon."""

import io
import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from shapely.geometry import box, mapping

from projector.importers import import_shape
from projector.shape import LARGEST_CM, ShapeError

EXAMPLES = 500  # of each of five tests
quickly = settings(
    max_examples=EXAMPLES,
    deadline=5000,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)


def encoded(kind, **kwargs):
    pixels = np.full((24, 32), 255, np.uint8)
    pixels[6:18, 8:20] = 0
    target = io.BytesIO()
    Image.fromarray(pixels).save(target, kind, **kwargs)
    return target.getvalue()


def exif(orientation):
    tags = Image.Exif()
    tags[0x0112], tags[0x011A] = orientation, 30.0
    return tags


PICTURES = [encoded("PNG"), encoded("PNG", dpi=(9, 9)), encoded("JPEG", dpi=(9, 9)), encoded("JPEG", exif=exif(6))]
SVG = (
    b'<svg xmlns="http://www.w3.org/2000/svg" width="30cm" viewBox="0 0 50 50"><style>.a{fill:red}</style>'
    b'<g transform="rotate(30) scale(2 3)"><path class="a" fill-rule="evenodd" d="M0 0 C 10 10 20 5 30 0 S 3 3 4 4'
    b' Q 1 2 3 4 T 9 9 A 5 6 20 1 0 30 30 H 3 V 2 z"/><rect x="1" width="20%" height="4" style="fill:#fff"/>'
    b'<use href="#x"/><polygon id="x" points="1,2 30,4 5,60"/></g></svg>'
)
JSON = json.dumps(
    {"type": "Feature", "properties": {"name": "a"}, "geometry": mapping(box(0, 0, 9, 8).difference(box(3, 3, 5, 5)))}
).encode()
TOKENS = [
    b"",
    b"0",
    b"-1",
    b"1e999",
    b"1e-300",
    b"NaN",
    b"null",
    b"[",
    b"]",
    b"{",
    b"}",
    b"<",
    b">",
    b"&lt;",
    b'"',
    b"%",
]
TOKENS += [b"matrix(", b"url(#a)", b"\x00", b"\xff\xd8", b"mm", b"A", b"z", b"M", b",", b"9" * 4400, b"Infinity"]


@st.composite
def broken(draw, seeds):
    """One of ``seeds`` with some bytes changed, cut or replaced."""
    data = draw(st.sampled_from(seeds))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        until = min(len(data), at + draw(st.integers(0, 9)))
        patch = draw(st.sampled_from(TOKENS) | st.binary(max_size=4))
        data = data[:at] + patch + data[until:]
    return data if draw(st.integers(0, 9)) else data[: draw(st.integers(0, len(data)))]


def survives(folder, suffix, data, *, mend):
    path = folder / f"file{suffix}"
    path.write_bytes(data)
    try:
        shape = import_shape(str(path), "thing", mend=mend).shape
    except ShapeError as error:
        message = str(error)
        assert message.startswith(str(path))
        assert len(message.splitlines()) == 1
        assert len(message) < len(str(path)) + 400
        assert "object at 0x" not in message
        return
    assert shape.geometry.is_valid
    assert 0 < max(shape.size_cm) <= LARGEST_CM


@quickly
@given(data=st.binary(max_size=300), suffix=st.sampled_from([".svg", ".png", ".jpg", ".geojson"]), mend=st.booleans())
def test_any_bytes(tmp_path, data, suffix, mend):
    survives(tmp_path, suffix, data, mend=mend)


@quickly
@given(data=broken(PICTURES), suffix=st.sampled_from([".png", ".jpg"]))
def test_broken_pictures(tmp_path, data, suffix):
    survives(tmp_path, suffix, data, mend=False)


@quickly
@given(data=broken([SVG]))
def test_broken_drawings(tmp_path, data):
    survives(tmp_path, ".svg", data, mend=False)


@quickly
@given(data=broken([JSON]), mend=st.booleans())
def test_broken_geojson(tmp_path, data, mend):
    survives(tmp_path, ".geojson", data, mend=mend)


corner = st.sampled_from([0, 1, 2, 5, -4, 30, 30.5, 1e-8, 1e9])
ring = st.lists(st.tuples(corner, corner), min_size=1, max_size=9).map(lambda points: [*points, points[0]])


@quickly
@given(rings=st.lists(ring, min_size=1, max_size=3), mend=st.booleans(), pieces=st.integers(1, 2))
def test_wild_outlines(tmp_path, rings, mend, pieces):
    data = {"type": "MultiPolygon", "coordinates": [rings] * pieces}
    survives(tmp_path, ".geojson", json.dumps(data).encode(), mend=mend)


NUMBERS = st.sampled_from(["0", "1", "5", "-3", "20", "7.5", "1e-9", "1e9", "2e9", "-40"])
LETTERS = {"M": 2, "L": 2, "H": 1, "V": 1, "C": 6, "S": 4, "Q": 4, "T": 2, "A": 7, "Z": 0}


@st.composite
def wild_path(draw):
    parts = ["M 1 1"]
    for _ in range(draw(st.integers(1, 7))):
        letter = draw(st.sampled_from("MLHVCSQTAZ"))
        numbers = [draw(NUMBERS) for _ in range(LETTERS[letter])]
        parts.append(" ".join([letter if draw(st.booleans()) else letter.lower(), *numbers]))
    return " ".join(parts)


@quickly
@given(paths=st.lists(wild_path(), min_size=1, max_size=3), matrix=st.lists(NUMBERS, min_size=6, max_size=6))
def test_wild_paths(tmp_path, paths, matrix):
    body = "".join(f'<path fill-rule="evenodd" d="{path}"/>' for path in paths)
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="300mm"><g transform="matrix({" ".join(matrix)})">'
    survives(tmp_path, ".svg", f"{head}{body}</g></svg>".encode(), mend=False)


@pytest.mark.parametrize("suffix", [".svg", ".png", ".geojson"])
def test_a_folder_and_a_missing_file(tmp_path, suffix):
    (tmp_path / f"folder{suffix}").mkdir()
    for name in ("folder", "missing"):
        with pytest.raises(ShapeError, match="is not a file; check the path"):
            import_shape(str(tmp_path / f"{name}{suffix}"), "thing")
