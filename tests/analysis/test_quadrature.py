import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from shapely import affinity
from shapely.geometry import MultiPolygon, Point, Polygon, box
from shapely.ops import unary_union

from analysis.boundary import Boundary, BoundaryError
from analysis.estimate import ratio_bias
from analysis.quadrature import exact_moments
from analysis.quadraturekernels import direction_integrals
from lab.base.errors import RequestError


def by_grid(geometry, directions=200, offsets=1200):
    """(hit, k, l1, l3) and their products over a plain midpoint grid of lines: its own geometry, its own pairs."""
    edges = []
    for part in getattr(geometry, "geoms", [geometry]):
        for ring in (part.exterior, *part.interiors):
            c = np.array(ring.coords)
            edges.append(np.hstack([c[:-1], c[1:]]))
    x0, y0, x1, y1 = np.vstack(edges).T
    total = np.zeros((4, 4))
    for theta in (np.arange(directions) + 0.5) * np.pi / directions:
        cos, sin = np.cos(theta), np.sin(theta)
        p0, p1, t0, t1 = x0 * cos + y0 * sin, x1 * cos + y1 * sin, y0 * cos - x0 * sin, y1 * cos - x1 * sin
        low, high = min(p0.min(), p1.min()), max(p0.max(), p1.max())
        p = low + (np.arange(offsets) + 0.5) * (high - low) / offsets
        crossed = (p0 > p[:, None]) != (p1 > p[:, None])
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.where(crossed, t0 + (p[:, None] - p0) / (p1 - p0) * (t1 - t0), np.inf)
        t = np.sort(t, axis=1)[:, : crossed.sum(axis=1).max()]
        finite = np.isfinite(t)
        sign = np.where(np.arange(t.shape[1]) % 2 == 0, 1.0, -1.0) * finite
        t = np.where(finite, t, 0.0)
        apart = np.abs(t[:, :, None] - t[:, None, :])
        weight = -0.5 * sign[:, :, None] * sign[:, None, :]
        line = np.column_stack(
            [
                finite.any(axis=1),
                finite.sum(axis=1) / 2,
                (weight * apart).sum(axis=(1, 2)),
                (weight * apart**3).sum(axis=(1, 2)),
            ]
        )
        total += line.T @ line * (high - low) / offsets
    return total * np.pi / directions


# From the closed integrals of the disc, and independent evaluations of the square and the triangle.
PINNED = {
    "square": (box(-7, -7, 7, 7), 0.39278, 0.33730, 0.03153),
    "triangle": (Polygon([(0, 0), (30, 0), (15, 15 * 3**0.5)]), 0.66568, 0.48214, None),
    "disc": (Point(5, 5).buffer(20, quad_segs=250), 0.30437, 0.17118, None),
}


@pytest.mark.parametrize("name", PINNED)
def test_known_sigmas(name):
    geometry, area, perimeter, covariance = PINNED[name]
    moments = exact_moments(geometry)
    assert moments.sigma_area_rel == pytest.approx(area, abs=1e-4)
    assert moments.sigma_perimeter_rel == pytest.approx(perimeter, abs=1e-4)
    if covariance is not None:
        assert moments.covariance_rel == pytest.approx(covariance, abs=1e-4)
    assert moments.chords_per_line == pytest.approx(1.0, abs=1e-6)


def test_square_by_closed_form():
    # For the unit square <𝓛_1> = π/4 and <𝓛_3> = 3/4; at θ ≤ π/4 a chord is full, 1/cos θ, over a width cos θ − sin θ
    # and falls linearly to 0 over sin θ on either side.
    theta = (np.arange(200_000) + 0.5) * np.pi / 4 / 200_000
    h, full, side = 1 / np.cos(theta), np.cos(theta) - np.sin(theta), np.sin(theta)
    # [0, π) is four times [0, π/4], and the hitting measure is the perimeter, 4.
    square1 = np.mean(h**2 * (full + 2 * side / 3)) * np.pi / 4
    square3 = np.mean(h**6 * (full + 2 * side / 7)) * np.pi / 4
    mixed = np.mean(h**4 * (full + 2 * side / 5)) * np.pi / 4
    moments = exact_moments(box(0, 0, 1, 1))
    assert_allclose(moments.mean, [1, np.pi / 4, 3 / 4], rtol=1e-10)
    second = moments.covariance + np.outer(moments.mean, moments.mean)
    assert_allclose([second[1, 1], second[2, 2], second[1, 2]], [square1, square3, mixed], rtol=1e-8)


def test_disc_by_closed_form():
    r = 3.0
    moments = exact_moments(Point(0, 0).buffer(r, quad_segs=500), tolerance=1e-8)
    assert_allclose(moments.mean, [1, np.pi * r / 2, 1.5 * np.pi * r**3], rtol=5e-6)
    second = moments.covariance + np.outer(moments.mean, moments.mean)
    assert second[1, 1] == pytest.approx(8 / 3 * r**2, rel=1e-5)
    assert second[2, 2] == pytest.approx(64 * 16 / 35 * r**6, rel=1e-5)
    assert second[1, 2] == pytest.approx(128 / 15 * r**4, rel=1e-5)


@pytest.mark.parametrize("name", ["ell", "annulus", "two discs", "tower", "pyramid"])
def test_moments_against_a_plain_grid(shapes, name):
    moments = exact_moments(shapes[name])
    grid = by_grid(shapes[name])
    hitting = grid[0, 0]
    assert moments.hitting_measure_cm == pytest.approx(hitting, rel=1e-3)
    assert_allclose(moments.mean, grid[0, 1:] / hitting, rtol=3e-3)
    second = moments.covariance + np.outer(moments.mean, moments.mean)
    assert_allclose(second, grid[1:, 1:] / hitting, rtol=6e-3)
    assert moments.error < 1e-5


def test_hull_and_hitting_measure(shapes):
    tower = exact_moments(shapes["tower"])
    assert tower.hitting_measure_cm == pytest.approx(shapes["tower"].convex_hull.length, rel=1e-6)
    assert tower.chords_per_line == pytest.approx(tower.perimeter_cm / tower.hull_perimeter_cm, rel=1e-6)
    # Two discs r1, r2, centres d apart: 2π(r1 + r2) less the lines through both, (crossed belt − open belt).
    r1, r2, d = 6.0, 9.0, 25.0
    two = MultiPolygon([Point(0, 0).buffer(r1, quad_segs=250), Point(d, 0).buffer(r2, quad_segs=250)])
    crossed = 2 * np.sqrt(d**2 - (r1 + r2) ** 2) + (r1 + r2) * (np.pi + 2 * np.arcsin((r1 + r2) / d))
    opened = 2 * np.sqrt(d**2 - (r1 - r2) ** 2) + np.pi * (r1 + r2) + 2 * abs(r1 - r2) * np.arcsin(abs(r1 - r2) / d)
    moments = exact_moments(two)
    assert moments.hitting_measure_cm == pytest.approx(2 * np.pi * (r1 + r2) - (crossed - opened), rel=1e-4)
    assert moments.hull_perimeter_cm == pytest.approx(opened, rel=1e-4)


corners = st.lists(
    st.tuples(st.integers(-8, 8), st.integers(-8, 8), st.integers(1, 6), st.integers(1, 6)), min_size=1, max_size=3
)


@settings(max_examples=25, deadline=None)
@given(corners, st.floats(-50, 50), st.floats(-50, 50), st.floats(0, 7), st.booleans(), st.floats(0.5, 2))
def test_moments_do_not_see_where_a_shape_lies(boxes, dx, dy, angle, mirror, scale):
    geometry = unary_union([box(x, y, x + w, y + h) for x, y, w, h in boxes])
    moved = affinity.translate(affinity.rotate(geometry, angle, use_radians=True), dx, dy)
    moved = affinity.scale(moved, -scale if mirror else scale, scale, origin=(0, 0))
    here, there = exact_moments(geometry, tolerance=1e-11), exact_moments(moved, tolerance=1e-11)
    size = np.array([1, scale, scale**3])
    assert_allclose(there.mean, here.mean * size, rtol=1e-9)
    spread = np.outer(here.mean * size, here.mean * size)
    assert_allclose(there.covariance / spread, here.covariance / np.outer(here.mean, here.mean), atol=1e-9)
    assert_allclose(there.relative, here.relative, atol=1e-8)


def test_cutting_at_every_critical_angle_or_adaptively_gives_the_same(monkeypatch, shapes):
    few = exact_moments(shapes["tower"], tolerance=1e-11)
    monkeypatch.setattr("analysis.quadrature._ALL_CRITICAL_UP_TO", 0)
    monkeypatch.setattr("analysis.quadrature._LONG_EDGES", 3)
    for tolerance in (1e-4, 1e-6, 1e-8):
        adaptive = exact_moments(shapes["tower"], tolerance=tolerance)
        assert adaptive.error <= tolerance
        off = np.abs(adaptive.mean / few.mean - 1).max(), np.abs(adaptive.relative / few.relative - 1).max()
        assert max(off) < 2 * tolerance


def test_error_is_honest_when_the_work_is_bounded(shapes):
    rough = exact_moments(shapes["statue"], tolerance=1e-12, max_directions=100)
    fine = exact_moments(shapes["statue"], tolerance=1e-9)
    assert np.abs(rough.mean / fine.mean - 1).max() < rough.error
    assert fine.error < 1e-8 < rough.error


def test_dictionary_keys_of_the_command(shapes):
    moments = exact_moments(shapes["square"])
    found = moments.to_dict()
    assert found["correlation"] == pytest.approx(0.03153 / 0.39278 / 0.33730, abs=1e-3)
    assert found["sigma_area_cm2"] == pytest.approx(0.39278 * 576, rel=1e-4)
    assert found["sigma_perimeter_cm"] == pytest.approx(0.33730 * 96, rel=1e-4)
    assert (found["bias_area_rel"], found["bias_perimeter_rel"]) == pytest.approx(
        tuple(ratio_bias(moments.mean, moments.covariance))
    )
    assert all(type(value) is float for value in moments.to_dict().values())
    size = np.array([576.0, 96.0])
    assert_allclose(moments.covariance_at(25), moments.relative * np.outer(size, size) / 25, rtol=1e-9)


@pytest.mark.parametrize(
    "bad", [Polygon(), Polygon([(0, 0), (2, 2), (2, 0), (0, 2)]), Point(0, 0), MultiPolygon([box(0, 0, 2, 2)] * 2)]
)
def test_shapes_without_an_inside_are_refused(bad):
    with pytest.raises(BoundaryError, match="cannot be measured") as caught:
        exact_moments(bad)
    assert isinstance(caught.value, RequestError)
    assert caught.value.reason


def test_doubled_vertices_and_touching_rings_do_no_harm():
    plain = exact_moments(box(0, 0, 10, 10))
    doubled = Polygon([(0, 0), (0, 0), (5, 0), (10, 0), (10, 10), (10, 10), (0, 10)])
    assert_allclose(exact_moments(doubled).relative, plain.relative, rtol=1e-9)
    pinched = box(0, 0, 10, 10).difference(Polygon([(0, 5), (4, 3), (4, 7)]))
    assert exact_moments(pinched).error < 1e-6


def test_the_compiled_kernel_does_what_its_python_says(shapes):
    x, y, previous, following = Boundary.of(shapes["tower"]).open_rings()
    theta = np.array([0.1, 0.5, 0.51, 2.0])
    compiled = direction_integrals(theta, x, y, previous, following)
    assert_allclose(direction_integrals.py_func(theta, x, y, previous, following), compiled, rtol=1e-11)


def test_mean_distance_and_gyration_radius_in_closed_form(shapes):
    """A square's mean distance (2 + √2 + 5 asinh 1)/15 · a, a disc's 128/(45π) · r; R_g² is a²/6 and r²/2."""
    square, disc = exact_moments(box(0, 0, 3, 3)), exact_moments(Point(4, 1).buffer(2, quad_segs=400))
    assert square.mean_distance_cm == pytest.approx(3 * (2 + 2**0.5 + 5 * np.arcsinh(1)) / 15, rel=1e-9)
    assert square.gyration_radius_cm == pytest.approx(3 / 6**0.5, rel=1e-9)
    assert disc.mean_distance_cm == pytest.approx(2 * 128 / 45 / np.pi, rel=1e-5)
    assert disc.gyration_radius_cm == pytest.approx(2**0.5, rel=1e-5)


@pytest.mark.parametrize("name", ["ell", "annulus", "two discs", "tower", "statue"])
def test_gyration_radius_is_that_of_the_triangles_of_the_shape(shapes, name):
    """∫|v|² over a triangle is its area/12 · (Σ|v_i|² + |Σv_i|²): exact, over a triangulation by shapely."""
    corners = np.array(
        [t.exterior.coords[:3] for t in shapely.constrained_delaunay_triangles(shapes[name]).geoms]
    ) - np.array(shapes[name].centroid.coords[0])
    area = np.abs(np.cross(*np.diff(np.pad(corners, ((0, 0), (0, 0), (0, 1))), axis=1).swapaxes(0, 1)))[:, 2] / 2
    second = area / 12 * ((corners**2).sum(axis=(1, 2)) + (corners.sum(axis=1) ** 2).sum(axis=1))
    assert area.sum() == pytest.approx(shapes[name].area, rel=1e-9)
    assert exact_moments(shapes[name]).gyration_radius_cm ** 2 == pytest.approx(second.sum() / area.sum(), rel=1e-6)
