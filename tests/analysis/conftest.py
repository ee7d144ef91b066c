"""Shapes drawn here, independent of the dictionary's files."""

import numpy as np
import pytest
from shapely import affinity
from shapely.geometry import MultiPolygon, Point, Polygon, box
from shapely.ops import unary_union


def draw_shapes():
    circle = Point(3, -2).buffer(15, quad_segs=90)
    square = affinity.rotate(box(-12, -12, 12, 12), 17)
    triangle = Polygon([(-14, -8), (16, -9), (1, 18)])
    ell = Polygon([(0, 0), (20, 0), (20, 6), (6, 6), (6, 20), (0, 20)])
    annulus = Point(0, 0).buffer(14, quad_segs=45).difference(Point(2, 1).buffer(9, quad_segs=45))
    two_discs = MultiPolygon([Point(-12, 0).buffer(6, quad_segs=45), Point(13, 3).buffer(9, quad_segs=45)])
    pyramid = unary_union([box(-20 + 4 * i, 3 * i, 20 - 4 * i, 3 * i + 3) for i in range(5)])
    right = [(14, 0), (6, 16), (3, 30), (1, 50)]
    left = [(-x, y) for x, y in reversed(right)]
    tower = Polygon([*right, *left, (-9, 0), (-5, 8), (5, 8), (9, 0)])
    tower = tower.difference(Polygon([(-4, 11), (4, 11), (2.5, 17), (-2.5, 17)]))
    tips = 7 * np.cos(np.linspace(0, np.pi, 5))
    crown = unary_union([Polygon([(0, 37), (x - 0.5, 44), (x + 0.5, 44)]) for x in tips])
    statue = unary_union(
        [
            box(-8, 0, 8, 6),
            Polygon([(-6, 6), (6, 6), (4, 32), (-4, 32)]),
            Point(0, 35).buffer(3.2, quad_segs=12),
            crown,
            Polygon([(2, 30), (5, 29), (11, 46), (9, 47)]),
            Polygon([(9, 46), (12, 46), (10.5, 51)]),
        ]
    )
    return {
        "circle": circle,
        "square": square,
        "triangle": triangle,
        "ell": ell,
        "annulus": annulus,
        "two discs": two_discs,
        "pyramid": pyramid,
        "tower": tower,
        "statue": statue,
    }


@pytest.fixture(scope="session")
def shapes():
    return draw_shapes()


@pytest.fixture
def rng():
    return np.random.default_rng(20260101)
