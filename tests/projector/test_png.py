import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image
from shapely.affinity import translate
from shapely.geometry import Point, box

from projector import png
from projector.dictionary import ShapeError, load_dictionary, shape_from
from projector.png import read_image, trace
from projector.render import coverage


def picture(geometry, size=(400, 300)):
    """Anti-aliased coverage of a geometry in pixels, y down, as gray 0..255."""
    return np.rint(255 * coverage(geometry, size)).astype(np.uint8)


def saved(tmp_path, image, name="picture.png"):
    path = tmp_path / name
    Image.fromarray(image).save(path)
    return path


RING = Point(200, 150).buffer(100, quad_segs=90).difference(Point(200, 150).buffer(40, quad_segs=90))


def test_anti_aliased_outlines_are_found_between_the_pixels(tmp_path):
    traced = read_image(saved(tmp_path, 255 - picture(RING))).geometry
    assert traced.area == pytest.approx(RING.area, rel=1e-3)
    assert traced.length == pytest.approx(RING.length, rel=2e-3)
    assert len(traced.interiors) == 1
    assert traced.centroid.coords[0][0] - traced.bounds[0] == pytest.approx(100, abs=0.1)


def test_outlines_without_anti_aliasing_keep_their_length(tmp_path):
    stairs = np.where(picture(RING) > 127, 0, 255).astype(np.uint8)
    traced = read_image(saved(tmp_path, stairs)).geometry
    assert traced.area == pytest.approx(RING.area, rel=3e-3)
    # the stairs themselves would be 4/pi = 27 % longer, their marching squares 5 %
    assert traced.length == pytest.approx(RING.length, rel=0.01)


def test_light_on_dark_and_dark_on_light_are_the_same(tmp_path):
    light = read_image(saved(tmp_path, picture(RING))).geometry
    dark = read_image(saved(tmp_path, 255 - picture(RING), "dark.png")).geometry
    assert light.symmetric_difference(dark).area < 1.0


def test_a_statue_survives_the_way_through_a_picture(tmp_path):
    statue = load_dictionary()["liberty"]
    scaled = translate(statue.geometry, 30, 42)
    grown = type(scaled)(
        [(x * 12, 1008 - y * 12) for x, y in scaled.exterior.coords],
        [[(x * 12, 1008 - y * 12) for x, y in ring.coords] for ring in scaled.interiors],
    )
    shape = shape_from(str(saved(tmp_path, 255 - picture(grown, (720, 1008)))), height_cm=statue.size_cm[1])
    assert (shape.pieces, shape.holes) == (1, 5)
    assert shape.area_cm2 == pytest.approx(statue.area_cm2, rel=2e-3)
    assert shape.perimeter_cm == pytest.approx(statue.perimeter_cm, rel=0.01)
    overlap = shape.geometry.intersection(statue.geometry).area
    assert overlap > 0.985 * statue.area_cm2  # the same way up and the same way round


def test_shapes_that_the_edge_cuts_are_closed(tmp_path):
    image = np.full((60, 80), 255, np.uint8)
    image[40:, 20:60] = 0
    assert read_image(saved(tmp_path, image)).geometry.area == pytest.approx(20 * 40, rel=0.01)


def test_transparency_cuts_the_shape_out(tmp_path):
    rgba = np.zeros((300, 400, 4), np.uint8)
    rgba[:, :, 0] = np.arange(400) % 256
    rgba[:, :, 3] = picture(RING)
    assert read_image(saved(tmp_path, rgba)).geometry.area == pytest.approx(RING.area, rel=1e-3)


def test_jpeg_rings_and_dirt_leave_no_specks(tmp_path):
    image = 255 - picture(RING)
    image[10:12, 10:12] = 0
    image[50:52, 200:202] = 255
    Image.fromarray(image).save(tmp_path / "photo.jpg", quality=60)
    shape = shape_from(str(tmp_path / "photo.jpg"))
    assert (shape.pieces, shape.holes) == (1, 1)
    assert shape.size_cm == pytest.approx((70, 70), abs=0.05)


def test_a_turned_photo_is_turned_back(tmp_path):
    image = 255 - picture(box(50, 100, 350, 200))
    exif = Image.Exif()
    exif[0x0112] = 6  # shown a quarter turn clockwise
    Image.fromarray(image).save(tmp_path / "photo.jpg", exif=exif)
    x0, y0, x1, y1 = read_image(tmp_path / "photo.jpg").geometry.bounds
    assert (x1 - x0, y1 - y0) == pytest.approx((100, 300), abs=1)


def test_two_squares_that_touch_at_a_corner():
    ink = np.zeros((40, 40), np.uint8)
    ink[10:20, 10:20] = ink[20:30, 20:30] = 255
    traced = trace(ink, "checker")
    assert traced.is_valid
    assert traced.area == pytest.approx(200, rel=0.05)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.full((20, 20), 200, np.uint8), "one colour"),
        (np.tile(np.array([100, 110], np.uint8), (20, 10)), "contrast"),
        (np.pad(np.full((2, 2), 255, np.uint8), 20), "specks"),
    ],
)
def test_pictures_without_a_shape(tmp_path, image, words):
    with pytest.raises(ShapeError, match=words):
        read_image(saved(tmp_path, image))


def png_of_size(width, height):
    """A PNG whose header claims a size that its data does not hold."""

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty"),
        (b"GIF89a not a png", "is no PNG or JPEG"),
        (png_of_size(8000, 8000), "8000 x 8000 pixels, more than 40 million"),
        (png_of_size(12_000, 12_000), "more than 40 million"),
        (png_of_size(100_000, 100_000), "cannot be read|more than"),
        (png_of_size(20, 20), "cannot be read"),
    ],
)
def test_files_that_are_no_picture_or_too_large(tmp_path, content, words):
    path = tmp_path / "picture.png"
    path.write_bytes(content)
    with pytest.raises(ShapeError, match=words) as caught:
        shape_from(str(path))
    assert "\n" not in str(caught.value)


def test_limits(tmp_path, monkeypatch):
    path = saved(tmp_path, 255 - picture(RING))
    monkeypatch.setattr(png, "MAX_POINTS", 50)  # of pixels along the outline too
    with pytest.raises(ShapeError, match="smooth the picture"):
        read_image(path)
    monkeypatch.setattr(png, "MAX_BYTES", 10)
    with pytest.raises(ShapeError, match="larger than"):
        read_image(path)


def test_palettes_and_sixteen_bits_are_read(tmp_path):
    palette = Image.fromarray(255 - picture(RING)).convert("P")
    palette.save(tmp_path / "palette.png")
    assert read_image(tmp_path / "palette.png").geometry.area == pytest.approx(RING.area, rel=2e-3)
    deep = (65535 - 257 * picture(RING).astype(np.uint16)).astype(np.uint16)
    (tmp_path / "deep.png").write_bytes(cv2.imencode(".png", deep)[1].tobytes())
    assert read_image(tmp_path / "deep.png").geometry.area == pytest.approx(RING.area, rel=2e-3)
    assert Image.open(io.BytesIO((tmp_path / "deep.png").read_bytes())).mode.startswith("I")
