"""Where a robot's crossings lie beside a shape's edge, and how wide the light's ramp is there: causes, from places.

At a crossing the robot travels along **t** through an edge with the outward normal **n**. What can move the place where
it finds the edge by e along **t** shows in e (t·n), the shift along the normal:

    the image is larger by ε about c, and moved by u      ε (x − c)·n + u·n
    every crossing is found d later                       d (t·n)
    a leaving crossing by a later than an entering one    (a/2) |t·n|

and a linear fit tells them apart. For a disc or a square about c the first and the last differ only through the angle
at which edges are met, and the errors of both say so.

The ramp: near a straight edge a sensor that averages over a disc of radius ρ reads F(d/ρ) at the distance d, and
∫F(1 − F) dd = 128 ρ/(45 π²), so that summing L(1 − L) over the readings gives ρ whatever the phase of the readings or
an error in the place of the edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely import Polygon
from shapely.geometry.polygon import orient

from analysis.boundary import Geometry

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

RAMP_PER_RADIUS = 128 / (45 * np.pi**2)  # half of the mean distance of two points of a disc, projected (Gini)
FEWEST_EDGES = 20
_STEEPEST = 0.3  # |t·n| below which an edge is grazed: its place along the line is too uncertain
_TUKEY = 4.685
_ROUNDS = 10
_CORNER_RAD = np.radians(20.0)  # a sharper turn of the outline is a corner, not a curve's facet
_AT_ONCE = 2_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """The edges of a shape, the outside to the right of every one: start and end (m, 2); its corners (c, 2). In cm."""

    start_cm: Floats
    end_cm: Floats
    corners_cm: Floats

    @classmethod
    def of(cls, geometry: Geometry) -> Outline:
        """Take a shape apart."""
        starts: list[Floats] = []
        ends: list[Floats] = []
        corners: list[Floats] = []
        for part in [geometry] if isinstance(geometry, Polygon) else list(geometry.geoms):
            facing = orient(part)
            for ring in (facing.exterior, *facing.interiors):
                xy = np.asarray(shapely.get_coordinates(ring), dtype=float)
                xy = xy[np.concatenate([[True], (np.diff(xy, axis=0) != 0).any(axis=1)])]
                along = np.diff(xy, axis=0)
                heading = np.arctan2(along[:, 1], along[:, 0])
                turn = np.abs(np.angle(np.exp(1j * (heading - np.roll(heading, 1)))))
                starts.append(xy[:-1])
                ends.append(xy[1:])
                corners.append(xy[:-1][turn > _CORNER_RAD])
        return cls(np.concatenate(starts), np.concatenate(ends), np.concatenate(corners))

    def normals_at(self, points_cm: Floats) -> Floats:
        """(n, 2) outward unit normals of the edges that lie nearest to (n, 2) points."""
        along = self.end_cm - self.start_cm
        size2 = (along**2).sum(axis=1)
        nearest = np.empty(len(points_cm), dtype=np.int64)
        step = max(1, _AT_ONCE // len(along))
        for first in range(0, len(points_cm), step):
            away = points_cm[first : first + step, None, :] - self.start_cm
            share = np.clip((away * along).sum(axis=2) / size2, 0.0, 1.0)
            rest = away - share[:, :, None] * along
            nearest[first : first + step] = (rest**2).sum(axis=2).argmin(axis=1)
        found = along[nearest] / np.sqrt(size2[nearest])[:, None]
        return np.column_stack([found[:, 1], -found[:, 0]])

    def corner_distance_cm(self, points_cm: Floats) -> Floats:
        """(n,) distance of each point to the nearest corner; infinite where there are none."""
        nearest = np.full(len(points_cm), np.inf)
        for corner in self.corners_cm:
            np.minimum(nearest, np.hypot(*(points_cm - corner).T), out=nearest)
        return nearest


@dataclass(frozen=True, slots=True, eq=False)
class EdgeShift:
    """Why the crossings lie where they lie, each figure with its delete-a-group values.

    Attributes:
        values: (4,) of the image's scale error ε, its shift u_x and u_y in cm, and a, how much later a leaving
            crossing is found than an entering one, in cm.
        replicates: (groups, 4) the same without each group of lines.
        delay_cm: d, how late all crossings are found.
        spread_cm: what is left of e (t·n), standard deviation (1.4826 MAD).
        edges: crossings used.
    """

    values: Floats
    replicates: Floats
    delay_cm: float
    spread_cm: float
    edges: int


def fit_edge_shift(
    late_cm: Floats, travel: Floats, normal: Floats, from_nadir_cm: Floats, group: Ints, groups: int
) -> EdgeShift | None:
    """Fit the shifts of crossings (n,) by Tukey's biweight; None with too few, or alike, edges.

    Args:
        late_cm: (n,) how far along the way each crossing was found behind its true place.
        travel: (n, 2) unit vectors **t**.
        normal: (n, 2) outward unit normals **n**.
        from_nadir_cm: (n, 2) x − c, c being the point under the projector.
        group: (n,) group of each crossing's line, 0 … ``groups`` − 1.
        groups: number of groups.
    """
    met = (travel * normal).sum(axis=1)
    used = (np.abs(met) > _STEEPEST) & np.isfinite(late_cm)
    if int(used.sum()) < FEWEST_EDGES:
        return None
    met, normal, group = met[used], normal[used], group[used]
    along = (from_nadir_cm[used] * normal).sum(axis=1)
    causes = np.column_stack([along, normal, np.abs(met) / 2, met])
    shift = late_cm[used] * met
    weight: Floats = np.ones(len(shift))
    fitted: list[Floats] = []
    spread = 0.0
    for _ in range(_ROUNDS):
        scaled = causes * weight[:, None]
        if np.linalg.matrix_rank(scaled.T @ causes, tol=1e-9 * len(shift)) < causes.shape[1]:
            return None
        fitted.append(np.asarray(np.linalg.solve(scaled.T @ causes, scaled.T @ shift), dtype=float))
        rest = np.asarray(shift - causes @ fitted[-1], dtype=float)
        spread = max(1.4826 * float(np.median(np.abs(rest))), 1e-6)
        weight = np.asarray(np.clip(1 - (rest / (_TUKEY * spread)) ** 2, 0.0, None) ** 2, dtype=float)
    squares = np.zeros((groups, 5, 5))
    products = np.zeros((groups, 5))
    np.add.at(squares, group, causes[:, :, None] * (causes * weight[:, None])[:, None, :])
    np.add.at(products, group, causes * (weight * shift)[:, None])
    short = (products.sum(axis=0) - products)[:, :, None]
    left: Floats = np.asarray(np.linalg.solve(squares.sum(axis=0) - squares, short), dtype=float)[:, :, 0]
    values = fitted[-1]
    return EdgeShift(values[:4], left[:, :4], float(values[4]), spread, int((weight > 0).sum()))


@dataclass(frozen=True, slots=True, eq=False)
class Ramps:
    """The light's ramps at clean straight edges, summed by line: Σ L(1 − L) across the edge in cm, and their number."""

    width_cm: Floats
    edges: Floats

    def radius_cm(self, group: Ints, groups: int) -> tuple[float, Floats] | None:
        """The footprint's radius, and (groups,) the same without each group of lines; None with too few edges."""
        if self.edges.sum() < FEWEST_EDGES:
            return None
        width, edges = (np.bincount(group, weights=values, minlength=groups) for values in (self.width_cm, self.edges))
        left = np.maximum((width.sum() - width) / np.maximum(edges.sum() - edges, 1.0), 0.0)
        return max(0.0, float(width.sum() / edges.sum())) / RAMP_PER_RADIUS, left / RAMP_PER_RADIUS


def ramp_of_line(
    s_cm: Floats, light: Floats, edges_cm: Floats, met: Floats, clean: ArrayLike, reach_cm: float
) -> tuple[float, int]:
    """(Σ L(1 − L) in cm across the edges, number of edges) of the clean edges of one line.

    Args:
        s_cm: (n,) places of the readings along the line, rising.
        light: (n,) what was read, 0 in the dark and 1 in the shape.
        edges_cm: (m,) where the robot found its crossings.
        met: (m,) t·n at each.
        clean: (m,) whether the edge is straight within ``reach_cm``.
        reach_cm: how far to either side, across the edge, its ramp may extend.
    """
    if len(s_cm) < 3 or not len(edges_cm):
        return 0.0, 0
    spacing = np.gradient(s_cm)
    partial = light * (1 - light)
    # readings far from all edges say what noise and ill-known levels make of L(1 - L) by themselves
    nearest = np.abs(s_cm[:, None] - edges_cm[None, :]).min(axis=1)
    far = nearest > 2 * reach_cm / _STEEPEST
    ground = float(partial[far].mean()) if far.any() else 0.0
    apart = np.diff(edges_cm)
    room = np.minimum(np.append(apart, np.inf), np.append(np.inf, apart))
    total, count = 0.0, 0
    for place, slope, straight, free in zip(edges_cm, np.abs(met), np.asarray(clean, dtype=bool), room, strict=True):
        if not straight or slope < 0.5 or free < 2 * reach_cm / slope:
            continue
        near = np.abs(s_cm - place) * slope < reach_cm
        total += float(((partial[near] - ground) * spacing[near]).sum() * slope)
        count += 1
    return total, count
