"""Drawings, pictures and texts by a stranger's hand: a whole shape, or one line that says what is wrong."""

import io
import json
import struct
import zlib

import numpy as np
import pytest
from PIL import Image
from shapely.geometry import box, mapping

from projector.dictionary import shape_from
from projector.importers import import_shape
from projector.shape import LARGEST_CM, ShapeError
from projector.text import Typeface, find_font
from tests.fuzz.harness import fuzz, is_refused
from tests.fuzz.mutate import TEXTS, hostile, mangled, mutated, pick
from tests.fuzz.mutate import to_json as broken_json

SQUARE = mapping(box(0, 0, 9, 8).difference(box(3, 3, 5, 5)))
PLAIN = json.loads(json.dumps({"type": "Feature", "properties": {"name": "a", "title": "A"}, "geometry": SQUARE}))
NESTED = json.loads(
    json.dumps(
        {
            "type": "FeatureCollection",
            "features": [
                PLAIN,
                {"type": "Feature", "geometry": {"type": "GeometryCollection", "geometries": [SQUARE]}},
            ],
        }
    )
)


def checked(path, **kwargs):
    """What a session does with a shape: it has an area and a size, a digest, and can be written."""
    shape = import_shape(str(path), "thing", **kwargs).shape
    assert shape.geometry.is_valid
    assert 0 < max(shape.size_cm) <= LARGEST_CM
    assert shape.digest
    json.dumps(mapping(shape.geometry), allow_nan=False)
    f"{shape.title}{shape.source}".encode()


def tangle(rng):
    """Rings of a few points on a coarse grid: they cross, touch, retrace and degenerate as often as they can."""
    rings = []
    for _ in range(int(rng.integers(1, 6))):
        grid = rng.integers(-3, 12, size=(int(rng.integers(1, 14)), 2)) * float(pick(rng, (1.0, 3.0, 1e-7, 1e7, 0.1)))
        rings.append([*grid.tolist(), grid[0].tolist()])
    kind = pick(rng, ("Polygon", "MultiPolygon"))
    return {"type": kind, "coordinates": rings if kind == "Polygon" else [[ring] for ring in rings]}


def star(rng):
    """One ring of many crossing strokes."""
    points = rng.uniform(-20, 20, size=(int(rng.integers(20, 300)), 2)).tolist()
    return {"type": "Polygon", "coordinates": [[*points, points[0]]]}


def geojson(rng):
    way = rng.random()
    if way < 0.25:
        return mangled(json.dumps(pick(rng, (PLAIN, NESTED))).encode(), rng)
    if way < 0.5:
        return json.dumps(tangle(rng)).encode()
    if way < 0.53:
        return json.dumps(star(rng)).encode()
    return broken_json(mutated(pick(rng, (PLAIN, NESTED)), rng), rng)


def test_geojson(share, tmp_path):
    path = tmp_path / "given.geojson"

    def read(data):
        path.write_bytes(data)
        checked(path, mend=bool(len(data) % 2))

    fuzz("geojson", share(8_000, 300), geojson, read)


SVG = (
    b'<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" width="30cm" height="20cm"'
    b' viewBox="0 0 50 50"><style>.a{fill:red}</style><defs><path id="p" d="M0 0h9v9z"/></defs>'
    b'<g transform="rotate(30) scale(2 3)"><path class="a" fill-rule="evenodd" d="M0 0 C 10 10 20 5 30 0 S 3 3 4 4'
    b' Q 1 2 3 4 T 9 9 A 5 6 20 1 0 30 30 H 3 V 2 z"/><rect x="1" width="20%" height="4" style="fill:#fff"/>'
    b'<use xlink:href="#p" x="3"/><circle r="4" cx="9" cy="1e1"/><ellipse rx="3" ry="4"/>'
    b'<polygon id="x" points="1,2 30,4 5,60"/></g></svg>'
)
SIMPLE = (
    b'<svg xmlns="http://www.w3.org/2000/svg" width="90mm"><path d="M1 1h20v20h-20z M5 5l9 9-9 9-3-7 9 0-4-10z"/></svg>'
)
SVG_WORDS = (
    *(
        b"M",
        b"m",
        b"z",
        b"A 1 1 0 0 0 ",
        b"C",
        b"T",
        b"1e308",
        b"-1e308",
        b"1e999",
        b"nan",
        b"inf",
        b"0",
        b"-0",
        b"%",
        b"mm",
        b"em",
    ),
    *(
        b"matrix(0 0 0 0 0 0)",
        b"scale(1e200)",
        b"skewX(90)",
        b"rotate(nan)",
        b"url(#p)",
        b"#p",
        b"&amp;",
        b"&lol;",
        b"<g>",
        b"</g>",
    ),
    *(
        b'<use href="#x"/>',
        b'<image href="file:///etc/passwd"/>',
        b'<use href="file:///etc/passwd#a"/>',
        b"<!DOCTYPE svg>",
    ),
    *(
        b"<![CDATA[",
        b"]]>",
        b"<?xml version='1.0' encoding='utf-16'?>",
        b"<?php",
        b"@import url(/etc/passwd);",
        b"<svg>",
        b"</svg>",
    ),
    *(
        b' display="none"',
        b' viewBox="0 0 0 0"',
        b' viewBox="nan nan 1 1"',
        b' width="1e400"',
        b' transform="x"',
        b"\xff\xfe",
    ),
)


NUMBERS_IN_SVG = ((b"20", b"20"), (b"30", b"30"), (b"9", b"-9"))


LETTERS = {"M": 2, "L": 2, "H": 1, "V": 1, "C": 6, "S": 4, "Q": 4, "T": 2, "A": 7, "Z": 0}
MOVES = ("rotate(%s)", "scale(%s)", "skewX(%s)", "translate(%s 1)", "matrix(1 0 %s 1 0 0)")


def drawn(rng):
    """A drawing that is well-formed, of wild paths in wild groups."""

    def number():
        return repr(float(pick(rng, (0, 1, 5, -3, 20, 7.5, 40))) * float(pick(rng, (*[1] * 60, 1e-9, 1e7, 1e300))))

    paths = []
    for _ in range(int(rng.integers(1, 5))):
        steps = ["M 1 1"]
        for letter in (pick(rng, list(LETTERS)) for _ in range(int(rng.integers(1, 9)))):
            numbers = [number() for _ in range(LETTERS[letter])]
            if letter == "A":  # its fourth and fifth are flags
                numbers[3:5] = pick(rng, "01"), pick(rng, "01")
            steps.append(" ".join([pick(rng, (letter, letter.lower())), *numbers]))
        move = f' transform="{pick(rng, MOVES) % number()}"' if rng.random() < 0.4 else ""
        rule, fill = pick(rng, ("evenodd", "nonzero")), pick(rng, ("#fff", "red", "none", "black", "inherit"))
        paths.append(f'<g{move}><path fill-rule="{rule}" fill="{fill}" d="{" ".join(steps)}"/></g>')
    side = number() + pick(rng, ("", "mm", "cm", "%", "em"))
    return f'<svg xmlns="http://www.w3.org/2000/svg" width="{side}">{"".join(paths)}</svg>'.encode()


def svg(rng):
    if rng.random() < 0.5:
        return drawn(rng)
    data = pick(rng, (SVG, SIMPLE))
    if rng.random() < 0.3:
        return mangled(data, rng, (SVG, SIMPLE), most=2)
    for old, new in NUMBERS_IN_SVG[: int(rng.integers(4))]:
        data = data.replace(old, b"%g" % (float(new) * 10.0 ** float(rng.uniform(-3, 3))))
    for _ in range(int(rng.integers(1 if data in (SVG, SIMPLE) else 0, 3))):
        # within values more often than within tags
        place = int(pick(rng, [i for i, byte in enumerate(data) if byte in b' "'] or [0])) + int(rng.integers(2))
        data = data[:place] + pick(rng, SVG_WORDS) + data[place + int(rng.integers(3)) :]
    return data


def test_svg(share, tmp_path):
    path = tmp_path / "given.svg"

    def read(data):
        path.write_bytes(data)
        checked(path)

    fuzz("svg", share(6_000, 300), svg, read)


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_of(width, height, rows, *, depth=8, colour=0, extra=b""):
    """A PNG whose header may say what its data do not hold."""
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + extra + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def pictures():
    pixels = np.full((24, 32), 255, np.uint8)
    pixels[6:18, 8:20] = 0
    made = []
    for kind, kwargs in (("PNG", {}), ("PNG", {"dpi": (9, 9)}), ("JPEG", {"dpi": (9, 9)})):
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, kind, **kwargs)
        made.append(file.getvalue())
    rgba = np.dstack([pixels] * 3 + [255 - pixels])
    file = io.BytesIO()
    Image.fromarray(rgba).save(file, "PNG")
    return [*made, file.getvalue()]


PICTURES = pictures()
BOMB = zlib.compress(bytes(1 << 24), 9)
SIZES = (0, 1, 2, 24, 1000, 6000, 40_000, 65_535, 2**31 - 1, 2**32 - 1)


def picture(rng):
    if rng.random() < 0.6:
        return mangled(pick(rng, PICTURES), rng, PICTURES)
    width, height = (int(pick(rng, SIZES)) for _ in range(2))
    rows = zlib.compress(
        rng.bytes(int(rng.integers(2000))) if rng.random() < 0.5 else bytes(int(rng.integers(1 << 16)))
    )
    extra = pick(rng, (b"", chunk(b"pHYs", struct.pack(">IIB", 2**32 - 1, 0, 1)), chunk(b"zTXt", b"a\0\0" + BOMB)))
    depth, colour = pick(rng, ((8, 0), (16, 0), (1, 0), (8, 2), (8, 3), (8, 6), (7, 1)))
    return png_of(width, height, rows, depth=depth, colour=colour, extra=extra)


def test_pictures(share, tmp_path):
    path = tmp_path / "given.png"

    def read(data):
        path.write_bytes(data)
        checked(path)

    fuzz("png and jpeg", share(2_500, 150), picture, read)


def text(rng):
    letters = [
        pick(rng, TEXTS),
        "".join(chr(int(rng.integers(0x110000))) for _ in range(3)),
        "FREEDOM",
        "a b",
        "8",
        "\u0301e",
    ]
    return "text:" + "".join(pick(rng, letters) for _ in range(int(rng.integers(1, 4))))


def test_texts(share):
    typeface = Typeface(find_font())

    def read(spec):
        assert typeface.shape(spec.removeprefix("text:")).geometry.is_valid

    fuzz("text:WORD", share(1_500, 150), text, read)
    assert is_refused(shape_from, "text:\ud800\x00")


def name(rng):
    value = hostile(rng)
    return value if isinstance(value, str) else str(value)[:5000]


def test_names(share):
    fuzz("SHAPE names and paths", share(2_000, 100), name, shape_from)


LOL = (
    b'<!DOCTYPE svg [<!ENTITY a "ha">'
    + b"".join(b'<!ENTITY %c "%s">' % (98 + i, b"&%c;" % (97 + i) * 10) for i in range(10))
    + b"]><svg xmlns='http://www.w3.org/2000/svg'><path d='M0 0h9v9z'/>&k;</svg>"
)
ROOT = b'<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" width="9cm">%s</svg>'
USES = b'<g id="a0"><path d="M0 0h9v9z"/></g>' + b"".join(
    b'<g id="a%d"><use href="#a%d"/><use href="#a%d"/></g>' % (i, i - 1, i - 1) for i in range(1, 40)
)


@pytest.mark.parametrize(
    ("suffix", "data"),
    [
        (".svg", LOL),
        (".svg", b'<!DOCTYPE s [<!ENTITY x SYSTEM "file:///etc/passwd">]><svg>&x;</svg>'),
        (".svg", '<?xml version="1.0" encoding="utf-16"?><!DOCTYPE s><svg/>'.encode("utf-16")),
        (".svg", ROOT % USES),
        (".svg", ROOT % b'<use href="file:///etc/passwd#a"/>'),
        (".svg", ROOT % b'<image xlink:href="http://127.0.0.1:9/x.png" width="9" height="9"/>'),
        (".svg", ROOT % (b'<path d="M0 0h9v9z"/>' * 200_000)),
        (".svg", ROOT % (b'<path d="M0 0' + b"l1 1" * 400_000 + b'z"/>')),
        (".svg", ROOT % (b"<g>" * 50_000 + b"</g>" * 50_000)),
        (".svg", b'<svg width="1cm" viewBox="0 0 0 0"><path d="M0 0h9v9z"/></svg>'),
        (".png", png_of(60_000, 60_000, zlib.compress(bytes(1 << 22)))),
        (".png", png_of(6_000, 6_000, zlib.compress(b"\0"))),
        (".geojson", b"[" * 200_000),
        (".geojson", b'{"type": "Polygon", "coordinates": ' + b"[" * 200_000),
        (".geojson", b'{"type": "Polygon", "coordinates": [[[NaN, 0], [1, Infinity], [1e999, 1], [NaN, 0]]]}'),
        (
            ".geojson",
            json.dumps({"type": "Polygon", "coordinates": [[[i % 997, i * i % 991] for i in range(40_000)]]}).encode(),
        ),
    ],
)
def test_bombs(suffix, data, tmp_path):
    path = tmp_path / f"given{suffix}"
    path.write_bytes(data)
    assert is_refused(lambda path: import_shape(str(path), "thing", mend=True), path)


def test_halves_of_characters_in_a_title(tmp_path):
    path = tmp_path / "given.geojson"
    path.write_bytes(json.dumps(PLAIN | {"properties": {"title": "\ud800"}}).encode())
    with pytest.raises(ShapeError):
        import_shape(str(path), "thing")
