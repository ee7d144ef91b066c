"""Which shapes are one and the same to a robot that knows neither where it is nor which way it faces.

Lines at random say nothing about where a shape lies, how it is turned, or whether it is seen in a mirror: mirror
twins, a 6 and a 9, cannot be told apart by any line statistics, and make one class.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.affinity import affine_transform

from analysis.boundary import Geometry

Floats = NDArray[np.float64]

SAME_SHARE = 1e-3  # of the area: less than that between two shapes no robot sees
_ALIKE = 1e-3  # relative, of the figures that are compared first
_MOST_TURNS = 48  # candidate rotations that are tried for a pair; a disc fits at the first


def congruence_classes(geometries: Mapping[str, Geometry]) -> list[tuple[str, ...]]:
    """Sort shapes into classes of those that are equal up to moving, turning and mirroring.

    In the order of the first name of each class. Two shapes are equal when one laid on the other leaves less than
    `SAME_SHARE` of the area uncovered.
    """
    if not geometries:
        return []
    shapes = list(geometries.values())
    figures = np.log([_figures(geometry) for geometry in shapes])
    classes: dict[int, list[str]] = {}
    for number, name in enumerate(geometries):
        heads = np.fromiter(classes, dtype=np.int64)
        alike = heads[np.all(np.abs(figures[heads] - figures[number]) <= _ALIKE, axis=1)]
        same = next((head for head in map(int, alike) if are_congruent(shapes[head], shapes[number])), number)
        classes.setdefault(same, []).append(name)
    return [tuple(members) for members in classes.values()]


def rivals_of(classes: Sequence[Sequence[str]], names: Sequence[str]) -> NDArray[np.bool_]:
    """(names, names) whether taking the first for the second is a mistake: all but the members of one class."""
    of = {name: number for number, members in enumerate(classes) for name in members}
    numbers = np.array([of[name] for name in names])
    return numbers[:, None] != numbers


def are_congruent(one: Geometry, other: Geometry) -> bool:
    """Whether ``other``, moved, turned and perhaps mirrored, covers ``one`` but for `SAME_SHARE` of its area.

    The outermost vertex of ``one`` must fall on one of the outermost of ``other``: each of these is a candidate turn.
    """
    still, moving = _centred(one), _centred(other)
    corners = shapely.get_coordinates(still)
    radius: Floats = np.hypot(*corners.T)
    start = corners[int(np.argmax(radius))]
    most = float(radius.max())
    for mirror in (1.0, -1.0):
        turned_over = affine_transform(moving, [1, 0, 0, mirror, 0, 0])
        points = shapely.get_coordinates(turned_over)
        outermost = points[np.hypot(*points.T) > most * (1 - _ALIKE)]
        angles: Floats = np.arctan2(start[1], start[0]) - np.arctan2(outermost[:, 1], outermost[:, 0])
        turns = np.asarray(np.round(np.mod(angles, 2 * np.pi), 5), dtype=float)
        for angle in np.unique(turns)[:_MOST_TURNS]:
            cosine, sine = float(np.cos(angle)), float(np.sin(angle))
            laid_on = affine_transform(turned_over, [cosine, -sine, sine, cosine, 0, 0])
            if shapely.symmetric_difference(still, laid_on).area <= SAME_SHARE * still.area:
                return True
    return False


def _centred(geometry: Geometry) -> Geometry:
    centre = geometry.centroid
    return affine_transform(geometry, [1, 0, 0, 1, -centre.x, -centre.y])


def _figures(geometry: Geometry) -> Floats:
    """Some figures that moving, turning and mirroring leave alone."""
    corners = shapely.get_coordinates(_centred(geometry))
    reach = float(np.hypot(*corners.T).max())
    return np.array([geometry.area, geometry.length, geometry.convex_hull.length, geometry.convex_hull.area, reach])
