"""Arenas whose edge is a ring of light, dark or bright: the light field, and the levels learnt under it."""

import numpy as np
from shapely import Point, box

from robot.edge import learn_edge_levels

FLOOR, SHAPE, RING = 0, 1, 2
LUX = {"dark": (60.0, 120.0, 20.0), "bright": (20.0, 70.0, 120.0)}
ARENAS = {"rectangle": box(-56, -41, 56, 41), "disc": Point(0, 0).buffer(46, quad_segs=90)}
RING_CM = 16.0


def levels_of(kind, noise_lux=1.0, samples=40):
    rng = np.random.default_rng(5)
    return learn_edge_levels(*(level + noise_lux * rng.standard_normal(samples) for level in LUX[kind]))


def within_cm(arena, x, y):
    """How far inside the ring's inner outline."""
    return 46 - np.hypot(x, y) if arena == "disc" else np.minimum(56 - np.abs(x), 41 - np.abs(y))


def light(arena, kind, shape=None):
    """The light field: the ring around the arena, perhaps a disc-shaped shape (x, y, radius) in it."""
    floor, lit, ring = LUX[kind]

    def at(x, y):
        lux = np.where(within_cm(arena, x, y) > 0, floor, ring)
        if shape is not None:
            lux = np.where(np.hypot(x - shape[0], y - shape[1]) < shape[2], lit, lux)
        return lux

    return at
