"""What is projected: three levels of light, and a ring exactly between the edge of the runs and the wall."""

import numpy as np
import pytest
import shapely
from shapely import Point, box

from lab.base.errors import RequestError
from lab.bench.pictures import check_on_floor, draw_pictures
from lab.settings.sections import ArenaSettings, OpticsSettings
from projector.render import RenderError, render
from projector.shape import Shape, ShapeError

SENSOR_CM = 6.0
SQUARE = box(-22, -22, 22, 22)
GAMMA = 2.2
RINGS = {"dark_ring": (0.4, 1.0, 0.0), "bright_ring": (0.0, 0.4, 1.0)}  # floor, shape, ring
ARENAS = {"rectangle": {}, "disc": {"kind": "disc", "radius_cm": 50.0}}


@pytest.fixture(scope="module")
def optics():
    return OpticsSettings(image_size=(960, 540), height_cm=250.0, field_width_cm=220.0, tilt_deg=(2.0, -3.0)).pinhole()


def drawn(arena, optics, geometry=SQUARE):
    return draw_pictures(geometry, arena, optics, SENSOR_CM, optics.image_size)


def light_of(picture):
    """Relative light of each pixel: a projector's own gamma."""
    return (picture / 255) ** GAMMA


def pixel_corners_cm(optics):
    """Where the corners of the pixels meet the sensor's plane, arena cm, (height + 1, width + 1, 2)."""
    width, height = optics.image_size
    u, v = np.meshgrid(np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5)
    return optics.to_plane(np.column_stack([u.ravel(), v.ravel()]), SENSOR_CM).reshape(height + 1, width + 1, 2)


def pixel_middles_cm(optics):
    """x and y of the middles of the pixels there, each (height, width)."""
    corners = pixel_corners_cm(optics)
    return np.moveaxis((corners[1:, 1:] + corners[:-1, :-1]) / 2, -1, 0)


def pixel_areas_cm2(optics):
    """The area of each pixel in the sensor's plane, by half the product of its diagonals."""
    corners = pixel_corners_cm(optics)
    one = corners[1:, 1:] - corners[:-1, :-1]
    two = corners[1:, :-1] - corners[:-1, 1:]
    return np.abs(one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0]) / 2


@pytest.mark.parametrize("edge", RINGS)
@pytest.mark.parametrize("kind", ARENAS)
def test_floor_shape_and_ring_have_three_levels_of_light(edge, kind, optics):
    arena = ArenaSettings(edge=edge, **ARENAS[kind])
    pictures = drawn(arena, optics)
    floor, lit, ring = RINGS[edge]
    for picture, level in ((pictures.floor, floor), (pictures.lit, lit), (pictures.ring, ring)):
        assert picture.shape == optics.image_size[::-1]
        assert picture.dtype == np.uint8
        assert len(np.unique(picture)) == 1
        assert light_of(picture)[0, 0] == pytest.approx(level, abs=0.004)
    x_cm, y_cm = pixel_middles_cm(optics)
    light = light_of(pictures.shape)
    pixel_cm = 0.25
    inside = arena.polygon.buffer(-arena.ring_cm, join_style="mitre")
    regions = {
        lit: SQUARE.buffer(-pixel_cm),
        floor: inside.buffer(-pixel_cm).difference(SQUARE.buffer(pixel_cm)),
        ring: arena.polygon.buffer(-pixel_cm).difference(inside.buffer(pixel_cm, join_style="mitre")),
    }
    for level, region in regions.items():
        seen = light[shapely.contains_xy(region, x_cm, y_cm)]
        assert len(seen) > 10_000
        assert seen == pytest.approx(np.full(len(seen), level), abs=0.004)


@pytest.mark.parametrize("edge", RINGS)
@pytest.mark.parametrize("kind", ARENAS)
def test_the_ring_covers_what_lies_between_the_wall_and_the_runs(edge, kind, optics):
    """Its light, pixel by pixel on the sensor's plane, adds up to the area between two polygons drawn here."""
    arena = ArenaSettings(edge=edge, ring_cm=7.0, **ARENAS[kind])
    floor, _, ring = RINGS[edge]
    empty = box(-0.5, -0.5, 0.5, 0.5)  # a shape that does not matter
    picture = drawn(arena, optics, empty).shape
    outer, inner = (
        (Point(0, 0).buffer(50, quad_segs=500), Point(0, 0).buffer(43, quad_segs=500))
        if kind == "disc"
        else (box(-60, -45, 60, 45), box(-53, -38, 53, 38))
    )
    areas = pixel_areas_cm2(optics)
    x_cm, y_cm = pixel_middles_cm(optics)
    # Beyond the wall there is floor's light; the shape takes no part in the strip.
    within = shapely.contains_xy(outer.buffer(1).difference(inner.buffer(-1)), x_cm, y_cm)
    share = (light_of(picture)[within] - floor) / (ring - floor)
    covered_cm2 = float((share * areas[within]).sum())
    assert covered_cm2 == pytest.approx(outer.difference(inner).area, rel=0.004)
    for middle_cm in (x_cm, y_cm):
        assert (middle_cm[within] * share * areas[within]).sum() / covered_cm2 == pytest.approx(0, abs=0.05)


def test_the_ring_lies_over_the_shape_where_they_would_overlap(optics):
    """A dark ring eats into a shape that reaches it: the light says where runs end, whatever is drawn."""
    arena = ArenaSettings(edge="dark_ring", ring_cm=8.0)
    picture = drawn(arena, optics, box(20, -10, 56, 10)).shape
    (column, row) = np.rint(optics.project([[55.0, 0.0, SENSOR_CM]]))[0].astype(int)
    assert picture[row, column] == 0
    (column, row) = np.rint(optics.project([[45.0, 0.0, SENSOR_CM]]))[0].astype(int)
    assert picture[row, column] == 255


@pytest.mark.parametrize("kind", ARENAS)
def test_without_a_ring_the_picture_is_the_rendered_shape(kind, optics):
    pictures = drawn(ArenaSettings(**ARENAS[kind]), optics)
    assert np.array_equal(pictures.shape, render(SQUARE, optics, SENSOR_CM))
    assert pictures.ring is None
    assert (pictures.floor == 0).all()
    assert (pictures.lit == 255).all()


def test_a_ring_beyond_the_picture_is_refused_and_named(optics):
    with pytest.raises(RenderError, match="ring") as caught:
        drawn(ArenaSettings(kind="disc", radius_cm=60, edge="dark_ring"), optics)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("edge", "margin_cm"), [("bump", 0.35), ("dark_ring", 1.0), ("bright_ring", 1.0)])
def test_a_shape_keeps_clear_of_the_edge_of_the_runs(edge, margin_cm):
    arena = ArenaSettings(edge=edge, ring_cm=8.0)
    half_cm = 45 - (3.65 if edge == "bump" else 8.0)

    def shape(top_cm):
        return Shape("block", "Block", box(-10, -10, 10, top_cm), "drawn here")

    check_on_floor(shape(half_cm - margin_cm - 0.05), arena)
    with pytest.raises(ShapeError, match="does not fit") as caught:
        check_on_floor(shape(half_cm - margin_cm + 0.05), arena)
    assert isinstance(caught.value, RequestError)
    assert "\n" not in str(caught.value)
