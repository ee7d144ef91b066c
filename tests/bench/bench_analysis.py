"""Monte Carlo lines a second against vectorised shapely on the same lines, and what the random numbers alone cost."""

import numpy as np
import pytest
import shapely

from analysis.montecarlo import simulate
from analysis.quadrature import exact_moments
from projector.dictionary import load_dictionary

LINES = 200_000
SHAPELY_LINES = 5_000


@pytest.fixture(scope="module", params=["triangle", "eiffel"])
def outline(request):
    return load_dictionary()[request.param].geometry


def test_kernel(benchmark, outline):
    benchmark.extra_info["lines"] = LINES
    benchmark(simulate, outline, lines=LINES, runs=1, rng=np.random.default_rng(1))


def test_vectorised_shapely(benchmark, outline):
    """The peer: the same number of crossing lines, cut with the outline by shapely, lit lengths only."""
    rng = np.random.default_rng(1)
    circle = shapely.minimum_bounding_circle(outline)
    radius, centre = shapely.minimum_bounding_radius(outline), shapely.get_coordinates(circle.centroid)[0]
    shapely.prepare(outline)

    def cut():
        theta, p = rng.uniform(0, np.pi, SHAPELY_LINES), rng.uniform(-radius, radius, SHAPELY_LINES)
        normal = np.column_stack([np.cos(theta), np.sin(theta)])
        along = np.column_stack([-np.sin(theta), np.cos(theta)]) * radius
        foot = centre + p[:, None] * normal
        lines = shapely.linestrings(np.stack([foot - along, foot + along], axis=1))
        return shapely.length(shapely.intersection(lines, outline)).sum()

    benchmark.extra_info["lines"] = SHAPELY_LINES
    benchmark(cut)


def test_random_numbers_alone(benchmark):
    rng = np.random.default_rng(1)
    benchmark.extra_info["lines"] = LINES
    benchmark(rng.random, (LINES, 2))


def test_exact_moments(benchmark, outline):
    benchmark(exact_moments, outline)
