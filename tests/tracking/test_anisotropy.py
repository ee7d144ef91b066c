"""How large faults are, what they do to area and perimeter, and how often the intervals hold."""

import json

import numpy as np
import pytest
import shapely
from shapely import MultiPolygon, Point, Polygon, affinity, box

from lab.base.errors import RequestError
from tests.tracking.rolled_lines import ARENA, billiard, chained, rates, sums_of, thrown_at_arena
from tracking.anisotropy import (
    Evidence,
    TooFewHitsError,
    bias_from,
    effects_of,
    line_invariants,
)
from tracking.isotropy import examine_lines, tabulate
from tracking.linespace import uniforms

TOWER = Polygon([(-15, -35), (-10, -35), (-6, -10), (6, -10), (10, -35), (15, -35), (4, 0), (1, 38), (-1, 38), (-4, 0)])
HOLED = Point(3, -2).buffer(20).difference(box(-5, -5, 4, 9)).union(affinity.rotate(box(24, -6, 31, 20), 20))


def sides_of(shape):
    rings = [r for part in shapely.get_parts(shape) for r in (part.exterior, *part.interiors)]
    return np.concatenate([np.stack([c[:-1], c[1:]], axis=1) for c in map(shapely.get_coordinates, rings)])


def by_pairs(theta, p, shape):
    """(k, L1, L3) of one line, from shapely's crossings and the sum over all pairs."""
    along, foot = np.array([-np.sin(theta), np.cos(theta)]), p * np.array([np.cos(theta), np.sin(theta)])
    line = shapely.LineString([foot - 500 * along, foot + 500 * along])
    met = shapely.get_parts(shapely.intersection(line, shape))
    ends = [sorted(shapely.get_coordinates(part) @ along) for part in met if part.length > 0]
    marks = sorted([(a, 1) for a, _ in ends] + [(b, -1) for _, b in ends])
    sums = [-sum(s * t * (b - a) ** n for i, (a, s) in enumerate(marks) for b, t in marks[i + 1 :]) for n in (1, 3)]
    return [len(ends), *sums]


def measured(theta, p, shape, weight=None):
    """(A, P) relative to the truth, less 1, of lines by the formulas, by pairs."""
    hull = shape.convex_hull
    _, v = uniforms(theta, p, hull)
    hit = np.flatnonzero((v > 0) & (v < 1))
    rows = np.array([by_pairs(theta[i], p[i], shape) for i in hit])
    k, l1, l3 = np.average(rows, axis=0, weights=None if weight is None else weight[hit])
    area = np.pi / 3 * l3 / l1
    return area / shape.area - 1, np.pi * area * k / l1 / shape.length - 1


def evidence_of(theta, p):
    """What `bias_from` reads of a report."""
    return Evidence(theta, p, len(theta) * np.eye(14), 25.0)


@pytest.fixture(scope="module")
def null():
    return tabulate(ARENA, 200, np.random.default_rng(1))


@pytest.mark.parametrize("shape", [TOWER, HOLED, MultiPolygon([box(-9, -9, -2, 8), box(3, -4, 8, 11)])])
def test_invariants_are_those_of_all_pairs(shape):
    rng = np.random.default_rng(2)
    for theta in rng.uniform(0, np.pi, 12):
        p = rng.uniform(-40, 40, 9)
        found = line_invariants(theta, p, sides_of(shape))
        np.testing.assert_allclose(found.T, [by_pairs(theta, one, shape) for one in p], rtol=1e-9, atol=1e-7)


def test_right_lines_have_no_bias():
    theta, p, _ = thrown_at_arena(100_000, np.random.default_rng(3))
    found = bias_from(evidence_of(theta, p), ARENA, TOWER)
    assert abs(found.area_rel) < 3 * found.area_rel_sigma < 0.03
    assert abs(found.perimeter_rel) < 3 * found.perimeter_rel_sigma < 0.03


@pytest.mark.parametrize("shape", [TOWER, HOLED])
def test_bias_of_a_known_density(shape):
    """Against right lines weighted by the density, each crossed with the shape by shapely."""
    rng = np.random.default_rng(4)

    def density(u, v):
        return 1 + 0.4 * np.cos(2 * np.pi * (u - 0.1)) + 0.3 * np.cos(2 * np.pi * v)

    theta, p, _ = thrown_at_arena(100_000, rng)
    weight = density(*uniforms(theta, p, ARENA))
    kept = rng.random(len(theta)) * 1.7 < weight
    found = bias_from(evidence_of(theta[kept], p[kept]), ARENA, shape)
    some = slice(0, 8_000)
    weighted = measured(theta[some], p[some], shape, weight[some])
    right = measured(theta[some], p[some], shape)
    # the same lines unweighted err by chance in the same way
    assert found.area_rel == pytest.approx((1 + weighted[0]) / (1 + right[0]) - 1, abs=0.03)
    assert found.perimeter_rel == pytest.approx((1 + weighted[1]) / (1 + right[1]) - 1, abs=0.03)
    assert abs(found.area_rel) > 0.02


def test_bias_of_a_uniform_angle_at_the_wall():
    """A tower measured a quarter too small: predicted from 200 lines within their error, from many to 5 %."""
    theta, p, _ = billiard(120, 90, 150, 200, np.random.default_rng(5), uniform_angle=True)
    truth = measured(theta.ravel(), p.ravel(), TOWER)
    assert truth[0] < -0.15
    assert truth[1] < -0.09
    many = bias_from(evidence_of(theta.ravel(), p.ravel()), ARENA, TOWER)
    assert many.area_rel == pytest.approx(truth[0], abs=0.05)
    assert many.perimeter_rel == pytest.approx(truth[1], abs=0.05)
    few = [bias_from(evidence_of(*row), ARENA, TOWER) for row in zip(theta[:60], p[:60], strict=True)]
    within = [abs(one.area_rel - many.area_rel) < 1.96 * one.area_rel_sigma for one in few]
    assert np.mean(within) > 0.75


def test_intervals_hold(null):
    rng = np.random.default_rng(6)
    faults = {
        (0.0, 0.0, 0.0): (lambda u, v: np.ones_like(u), 1.0),
        (0.25, 0.0, 0.0): (lambda u, v: 1 + 0.25 * np.cos(2 * np.pi * u), 1.25),
        (0.0, 0.3, 0.0): (lambda u, v: 1 + 0.3 * np.cos(4 * np.pi * u), 1.3),
        # 1 + c f with f = sqrt 5 P_2, of which the pull is -2 c / sqrt 5
        (0.0, 0.0, 0.24): (lambda u, v: 1 + 0.3 * (1 - 3 * (2 * v - 1) ** 2), 1.3),
    }
    for sizes, fault in faults.items():
        theta, p, _, _ = chained(ARENA, *fault, 250, 200, rng)
        u, v = uniforms(theta, p, ARENA)
        found = [effects_of(*row, null)[0] for row in zip(u, np.clip(v, 0, 1), strict=True)]
        for index, size in enumerate(sizes):
            held = np.mean([one[index].low <= size <= one[index].high for one in found])
            assert 0.905 < held <= 0.995, (sizes, index)
        assert [one.name for one in found[0]] == ["one_axis", "four_arms", "centre_pull"]


def test_least_seen_is_seen_in_eight_sessions_of_ten(null):
    rng = np.random.default_rng(7)
    axis, pull = null.least_seen["one_axis"], null.least_seen["centre_pull"]
    for fault in (
        (lambda u, v: 1 + axis * np.cos(2 * np.pi * (u - 0.15)), 1 + axis),
        (lambda u, v: 1 + 1.25 * pull * (1 - 3 * (2 * v - 1) ** 2), 1 + 1.25 * pull),
    ):
        theta, p, length, at = chained(ARENA, *fault, 500, 200, rng)
        assert 0.68 < rates(null, sums_of(null, theta, p, length, at))["family"] < 0.9


def test_least_bias_shrinks_with_more_lines():
    rng = np.random.default_rng(8)
    found = []
    for n in (100, 400):
        rows = (a[0] for a in billiard(120, 90, 1, n, rng))
        found.append(bias_from(examine_lines(*rows, ARENA, rng).evidence, ARENA, TOWER))
    assert found[1].least_area_rel == pytest.approx(found[0].least_area_rel / 2, rel=0.12)
    assert found[1].least_perimeter_rel == pytest.approx(found[0].least_perimeter_rel / 2, rel=0.12)
    assert set(json.loads(json.dumps(found[0].to_dict()))) == set(type(found[0]).__slots__)
    assert f"{100 * found[0].area_rel:+.1f} ±" in found[0].sentence()


def test_requests_that_cannot_be_met():
    theta, p, _ = thrown_at_arena(40, np.random.default_rng(9))
    with pytest.raises(TooFewHitsError, match="lines that meet the shape are too few") as caught:
        bias_from(evidence_of(theta, p), ARENA, Point(0, 0).buffer(2))
    assert caught.value.hits < caught.value.needed == 10
    with pytest.raises(RequestError, match="no area within"):
        bias_from(evidence_of(theta, p), ARENA, box(200, 200, 210, 210))
