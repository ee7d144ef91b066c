import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import Point, Polygon, box

from lab.base.pinhole import Pinhole
from projector.dictionary import load_dictionary
from projector.render import RenderError, code_to_light, coverage, light_to_code, render

SENSOR_CM = 6.0
STRAIGHT = Pinhole.looking_down((1920, 1080), height_cm=250, field_width_cm=180)
CROOKED = Pinhole.looking_down(
    (1920, 1080),
    height_cm=250,
    field_width_cm=200,
    centre_cm=(5, -3),
    tilt_rad=(0.03, -0.02),
    distortion=(0.06, -0.03, 0.001, -0.001, 0.01),
)


def lit_moments(image, projector, height_cm):
    """Area and centroid of the light in the plane, from where the corners of all pixels fall."""
    rows, columns = np.nonzero(image.any(axis=1))[0], np.nonzero(image.any(axis=0))[0]
    image = image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    u, v = np.meshgrid(np.arange(columns[0], columns[-1] + 2) - 0.5, np.arange(rows[0], rows[-1] + 2) - 0.5)
    x, y = projector.to_plane(np.column_stack([u.ravel(), v.ravel()]), height_cm).T.reshape(2, *u.shape)
    # the area of a quadrilateral is half the cross product of its diagonals
    d1x, d1y = x[1:, 1:] - x[:-1, :-1], y[1:, 1:] - y[:-1, :-1]
    d2x, d2y = x[1:, :-1] - x[:-1, 1:], y[1:, :-1] - y[:-1, 1:]
    light = code_to_light(image) * np.abs(d1x * d2y - d1y * d2x) / 2
    cx, cy = (x[1:, 1:] + x[:-1, :-1]) / 2, (y[1:, 1:] + y[:-1, :-1]) / 2
    total = light.sum()
    return total, (light * cx).sum() / total, (light * cy).sum() / total


DRAWN = load_dictionary("paper") | load_dictionary("monuments")


@pytest.mark.parametrize("name", DRAWN)
def test_every_shape_has_its_true_area_in_the_sensors_plane(name):
    shape = DRAWN[name]
    area, x, y = lit_moments(render(shape.geometry, STRAIGHT, SENSOR_CM), STRAIGHT, SENSOR_CM)
    assert area == pytest.approx(shape.area_cm2, rel=5e-4)
    assert (x, y) == pytest.approx(shape.geometry.centroid.coords[0], abs=0.01)


def test_tilt_and_distortion_are_undone():
    shape = load_dictionary()["liberty"]
    area, x, y = lit_moments(render(shape.geometry, CROOKED, SENSOR_CM), CROOKED, SENSOR_CM)
    assert area == pytest.approx(shape.area_cm2, rel=1e-3)
    assert (x, y) == pytest.approx(shape.geometry.centroid.coords[0], abs=0.01)


def test_on_the_floor_the_picture_is_larger_than_the_shape():
    square = box(-20, -20, 20, 20)
    area, _, _ = lit_moments(render(square, STRAIGHT, SENSOR_CM), STRAIGHT, 0.0)
    assert area == pytest.approx(1600 * (250 / 244) ** 2, rel=1e-3)


def test_rows_run_down_and_columns_right():
    image = render(box(10, 10, 20, 15), STRAIGHT, 0.0)
    rows, columns = np.nonzero(image)
    assert rows.max() < 540
    assert columns.min() > 960
    assert image.dtype == np.uint8
    assert image.shape == (1080, 1920)


def test_a_shape_beyond_the_picture_is_refused():
    with pytest.raises(RenderError, match="beyond the projector's 1920 x 1080 image") as caught:
        render(box(-40, -70, 40, 40), STRAIGHT, SENSOR_CM)
    assert 0.1 < caught.value.outside_share < 0.3
    with pytest.raises(RenderError, match="not above the plane"):
        render(box(-4, -7, 4, 4), STRAIGHT, 250.0)


@given(
    st.lists(st.tuples(st.floats(0, 9), st.floats(0, 7)), min_size=3, max_size=9),
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 7)), min_size=0, max_size=4),
)
def test_coverage_is_each_pixels_shared_area(loose, on_grid):
    # vertices on the grid and edges along it are the cases that go wrong
    hull = Polygon(shapely.convex_hull(shapely.MultiPoint([*loose, *on_grid])).buffer(0.0))
    if hull.area < 0.01:
        return
    holed = hull.difference(hull.centroid.buffer(0.4))
    shared = [[holed.intersection(box(i, j, i + 1, j + 1)).area for i in range(9)] for j in range(7)]
    assert coverage(holed, (9, 7)) == pytest.approx(np.array(shared), abs=1e-9)


def test_coverage_to_the_very_edge():
    assert coverage(box(0, 0, 3, 2), (3, 2)) == pytest.approx(np.ones((2, 3)))


def test_codes_and_light_are_inverse():
    codes = np.arange(256, dtype=np.uint8)
    assert (light_to_code(code_to_light(codes)) == codes).all()
    # half the light needs code 186, not 128
    assert light_to_code(0.5) == round(255 * 0.5 ** (1 / 2.2)) == 186
    assert light_to_code(2.0) == 255


def test_gamma_of_the_projector_is_respected():
    disc = Point(3.3, 1.7).buffer(20, quad_segs=90)
    plain = render(disc, STRAIGHT, SENSOR_CM, gamma=1.0)
    share = plain[plain > 0] / 255
    edge = (share > 0.05) & (share < 0.95)
    coded = render(disc, STRAIGHT, SENSOR_CM)[plain > 0]
    assert coded[edge] == pytest.approx(255 * share[edge] ** (1 / 2.2), abs=3)
