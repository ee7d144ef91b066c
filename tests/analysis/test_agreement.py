"""Quadrature, Monte Carlo and closed forms agree, on plain shapes and on random polygons with holes."""

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose
from shapely.geometry import MultiPolygon, Point, Polygon, box

from analysis import blocks, montecarlo
from analysis.invariants import signed_moment
from analysis.kernels import chord_moments
from analysis.quadrature import exact_moments

LINES = 400_000  # per shape; the slow test throws the full number
FULL_LINES = 10_000_000
RANDOM_POLYGONS = 24
STANDARD_ERRORS = 4.0


def random_polygon_with_holes(seed):
    """A star of 8 to 60 corners with up to five corner-cut holes, sometimes with an island in one."""
    rng = np.random.default_rng([seed, 7])
    corners = int(rng.integers(8, 60))
    angle = np.sort(rng.uniform(0, 2 * np.pi, corners))
    reach = rng.uniform(8, 20, corners)
    shape = Polygon(np.column_stack([reach * np.cos(angle), reach * np.sin(angle)])).buffer(0)
    for _ in range(int(rng.integers(1, 6))):
        hole = Point(rng.uniform(-9, 9, 2)).buffer(rng.uniform(1, 3), quad_segs=int(rng.integers(1, 5)))
        shape = shape.difference(hole)
    if seed % 3 == 0:
        shape = shapely.union_all([shape, box(25, -3, 30, 2)])
    return shape


def plain_shapes():
    side = 18.0
    return {
        "disc": Point(2, 1).buffer(10, quad_segs=250),
        "square": box(-6, -6, 6, 6),
        "triangle": Polygon([(0, 0), (side, 0), (side / 2, side * 3**0.5 / 2)]),
        "L": Polygon([(0, 0), (20, 0), (20, 6), (6, 6), (6, 20), (0, 20)]),
        "ring": Point(0, 0).buffer(12, quad_segs=60).difference(Point(1, 2).buffer(7, quad_segs=60)),
        "two squares": MultiPolygon([box(0, 0, 8, 8), box(15, 3, 23, 11)]),
        **{f"random {seed}": random_polygon_with_holes(seed) for seed in range(RANDOM_POLYGONS)},
    }


SHAPES = plain_shapes()


def sample(geometry, lines, rng):
    """Mean and covariance of (k, 𝓛_1, 𝓛_3, 𝓛_4, 𝓛_5), half a million lines at a time."""
    total, squares, done = np.zeros(5), np.zeros((5, 5)), 0
    while done < lines:
        values = montecarlo.simulate_crossings(geometry, min(500_000, lines - done), rng).moments()
        total += values.sum(axis=0)
        squares += values.T @ values
        done += len(values)
    mean = total / lines
    return mean, squares / lines - np.outer(mean, mean)


def agree(geometry, lines, rng):
    exact = exact_moments(geometry)
    # Closed forms: ∫k = P, ∫𝓛_1 = πA, ∫𝓛_3 = 3A².
    area, length = geometry.area, geometry.length
    assert_allclose(exact.mean * exact.hitting_measure_cm, [length, np.pi * area, 3 * area**2], rtol=1e-6)
    assert exact.error < 1e-6
    mean, covariance = sample(geometry, lines, rng)
    spread = np.sqrt(np.diag(exact.every_covariance))
    assert (
        np.abs(mean - exact.every_mean) <= STANDARD_ERRORS * spread / np.sqrt(lines) + 1e-9 * exact.every_mean
    ).all()
    # Correlated and heavy in the tail: some percent at 4·10⁵ lines.
    scaled = np.maximum(spread, 1e-2 * exact.every_mean)  # k does not scatter on convex shapes
    scale = np.outer(scaled, scaled)
    assert_allclose(covariance / scale, exact.every_covariance / scale, atol=40 / np.sqrt(lines))


@pytest.mark.parametrize("name", SHAPES)
def test_quadrature_monte_carlo_and_closed_forms(name, rng):
    agree(SHAPES[name], LINES, rng)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", SHAPES)
def test_the_same_at_ten_million_lines(name, rng, full):
    """All shapes with --full; else the random ones at a tenth of that."""
    agree(SHAPES[name], FULL_LINES if full or not name.startswith("random") else FULL_LINES // 10, rng)


@pytest.mark.parametrize("chords", [1, 2, 3, 7, 12])
def test_higher_moments_equal_their_definition(chords, rng):
    t_cm = np.cumsum(rng.uniform(0.1, 3, 2 * chords))
    expected = [chords, *(signed_moment(t_cm, n) for n in (1, 3, 4, 5))]
    assert_allclose(chord_moments(t_cm, 0, t_cm.size), expected, rtol=1e-9)
    assert_allclose(chord_moments.py_func(t_cm, 0, t_cm.size), expected, rtol=1e-9)


@pytest.mark.parametrize("total", [1, 9, 10, 11, 95])
def test_blocks_come_in_order_and_are_complete(total):
    seen = []
    found = list(
        blocks.run_blocks(
            lambda first, last, stream: (first, last, stream.random()),
            total,
            10,
            np.random.default_rng(1),
            threads=3,
            progress=lambda *done: seen.append(done),
        )
    )
    assert [first for first, _, _ in found] == list(range(0, total, 10))
    assert found[-1][1] == total
    assert seen == [(last, total) for _, last, _ in found]
    assert len({number for _, _, number in found}) == len(found)


def test_a_block_that_fails_ends_the_rest():
    worked = []

    def work(first, last, stream):
        worked.append(first)
        if first == 20:
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        list(blocks.run_blocks(work, 10_000, 10, np.random.default_rng(1), threads=2))
    assert len(worked) < 20
