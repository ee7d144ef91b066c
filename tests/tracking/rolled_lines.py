"""Lines of simulated robots, right and wrong ones, mostly without the package's own geometry."""

import numpy as np
import shapely
from shapely import Point, Polygon, box

from tracking.linespace import LineSpace, Wall, corners
from tracking.nulltable import Sums

ARENA = box(-60, -45, 60, 45)
DISC = Point(0, 0).buffer(50, quad_segs=90)
OBLIQUE = Polygon([(-40, -20), (30, -35), (55, 5), (10, 40), (-25, 30)])


def billiard(width, height, chains, runs, rng, uniform_angle=False, skip=30):
    """Rectangle billiards by reflection-free axis-wise ray casting: none of the package's geometry."""
    half = np.array([width / 2, height / 2])
    x = np.column_stack([rng.uniform(-half[0], half[0], chains), np.full(chains, -half[1])])
    inward = np.tile([0.0, 1.0], (chains, 1))
    points = [x]
    for _ in range(runs + skip):
        phi = (rng.random(chains) - 0.5) * np.pi if uniform_angle else np.arcsin(2 * rng.random(chains) - 1)
        c, s = np.cos(phi), np.sin(phi)
        d = np.column_stack([inward[:, 0] * c - inward[:, 1] * s, inward[:, 0] * s + inward[:, 1] * c])
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.where(np.abs(d) > 1e-12, (np.sign(d) * half - x) / d, np.inf)
        axis = reach.argmin(axis=1)
        x = x + reach.min(axis=1)[:, None] * d
        rows = np.arange(chains)
        x[rows, axis] = np.sign(d[rows, axis]) * half[axis]
        inward = np.zeros_like(d)
        inward[rows, axis] = -np.sign(d[rows, axis])
        points.append(x)
    return lines_through(np.stack(points[skip:], axis=1))


def lines_through(points):
    """(theta, p, length) of the legs of paths (chains, n + 1, 2)."""
    leg = np.diff(points, axis=1)
    theta = np.arctan2(leg[..., 0], -leg[..., 1])
    p = points[:, :-1, 0] * np.cos(theta) + points[:, :-1, 1] * np.sin(theta)
    turn = np.floor(theta / np.pi)
    return theta - turn * np.pi, np.where(turn == 0, p, -p), np.hypot(leg[..., 0], leg[..., 1])


def thrown(region, n, rng):
    """Lines thrown at the circumscribed disc, those that miss the region dropped: isotropic by definition."""
    radius = max(np.hypot(*np.transpose(region.exterior.coords)))
    theta, p = rng.uniform(0, np.pi, 4 * n), rng.uniform(-radius, radius, 4 * n)
    foot = np.column_stack([p * np.cos(theta), p * np.sin(theta)])
    along = np.column_stack([-np.sin(theta), np.cos(theta)]) * 3 * radius
    chords = shapely.intersection(shapely.linestrings(np.stack([foot - along, foot + along], axis=1)), region)
    hit = shapely.length(chords) > 0
    return theta[hit][:n], p[hit][:n], shapely.length(chords)[hit][:n]


def place(density, peak, chains, n, rng):
    """Points (U, V) of a density by rejection: lines drawn afresh each."""
    u, v = rng.random((2, chains, 4 * n))
    first = np.argsort(density(u, v) / peak < rng.random(u.shape), axis=1, kind="stable")[:, :n]
    return np.take_along_axis(u, first, 1), np.take_along_axis(v, first, 1)


def chained(region, density, peak, chains, n, rng, skip=25):
    """(theta, p, length, wall places (chains, n + 1)) of robots whose lines have a density on the square.

    At every wall Lambert turns are drawn until one is accepted with a chance ~ density. The chain of wall points
    is that of a graph with edges of this weight, reversible, and so its lines have the density exactly.
    """
    wall, space = Wall.of(region), LineSpace.of(region)
    at = rng.random(chains) * wall.perimeter_cm
    out = [[], [], [], [at]]
    for _ in range(n + skip):
        found, waiting = np.empty((4, chains)), np.arange(chains)
        while len(waiting):
            start, edge = wall.at(at[waiting])
            heading = wall.heading(edge, 2 * rng.random(len(waiting)) - 1)
            reached = wall.next_edge(start, heading, edge)
            away = np.einsum("ij,ij->i", wall.points[reached] - start, wall.inward[reached])
            length = away / np.einsum("ij,ij->i", heading, wall.inward[reached])
            theta, p = np.arctan2(heading[:, 0], -heading[:, 1]), start[:, 1] * heading[:, 0]
            p -= start[:, 0] * heading[:, 1]
            kept = rng.random(len(waiting)) * peak < density(*space.uniforms(theta, p))
            end = wall.place_cm(start + length[:, None] * heading, reached)
            found[:, waiting[kept]] = np.stack([theta, p, length, end])[:, kept]
            waiting = waiting[~kept]
        for rows, row in zip(out, found, strict=True):
            rows.append(row)
        at = found[3]
    return tuple(np.stack(rows[-(n + (rows is out[3])) :], axis=1) for rows in out)


def sums_of(null, theta, p, length, at=None):
    """Sessions reduced, with the ends at (sessions, n + 1) on the wall; without, of lines that share no ends."""
    u, v = LineSpace.of(null.reachable).uniforms(theta, p)
    inner = np.zeros((len(u), 1)) if at is None else at[:, 1:-1]
    return Sums.of(u, np.clip(v, 0, 1), length, null.ends.total(inner, np.full(inner.shape, at is not None)))


def rates(null, sums):
    """Share of sessions that each test rejects at 5 %, and that the family of four rejects."""
    found = null.statistics_of(sums)
    rejected = {name: float(np.mean(null.p_values(name, values) < 0.05)) for name, values in found.items()}
    return rejected | {"family": float(np.mean(null.family_p(null.smallest_p(sums)) < 0.05))}


def ends_of(theta, p, region):
    """Wall places (chains, n + 1) of successive lines: where each meets the next, shapely's way."""
    rows = []
    for row_theta, row_p in zip(theta, p, strict=True):
        normal = np.column_stack([np.cos(row_theta), np.sin(row_theta)])
        met = np.linalg.solve(
            np.stack([normal[:-1], normal[1:]], axis=1), np.stack([row_p[:-1], row_p[1:]], axis=1)[..., None]
        )
        ring = shapely.linearrings(np.vstack([corners(region), corners(region)[:1]]))
        inner = shapely.line_locate_point(ring, shapely.points(met[..., 0]))
        rows.append(np.concatenate([[0.0], inner, [0.0]]))
    return np.array(rows)


def disc(chains, runs, rng):
    """Chords of the circle by its own trigonometry: a run at the inward angle phi turns its end by pi + 2 phi."""
    turns = np.pi + 2 * np.arcsin(2 * rng.random((chains, runs)) - 1)
    angle = np.cumsum(np.column_stack([2 * np.pi * rng.random(chains), turns]), axis=1)
    return lines_through(50 * np.stack([np.cos(angle), np.sin(angle)], axis=-1))


def thrown_at_arena(n, rng):
    """The same at the rectangle in closed form (slabs): quick for millions."""
    theta, p = rng.uniform(0, np.pi, 2 * n), rng.uniform(-75, 75, 2 * n)
    hit = np.abs(p) < 60 * np.abs(np.cos(theta)) + 45 * np.abs(np.sin(theta))
    theta, p = theta[hit][:n], p[hit][:n]
    c, s = np.cos(theta), np.sin(theta)
    across, up = (
        np.sort([(-half - foot) / way, (half - foot) / way], axis=0)
        for half, foot, way in ((60, p * c, -s), (45, p * s, c))
    )
    return theta, p, np.maximum(np.minimum(across[1], up[1]) - np.maximum(across[0], up[0]), 0)


def thrown_at_disc(n, rng):
    """The same at the disc of 50 cm."""
    theta, p = rng.uniform(0, np.pi, n), rng.uniform(-50, 50, n)
    return theta, p, 2 * np.sqrt(2500 - p**2)
