"""Estimates from lines cut short, against sums over all pairs, whole-line estimates and simulated sessions."""

from __future__ import annotations

import ast
import math
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import Point, Polygon, box

import robot.interrupted
from robot.contacts import contacts_among
from robot.cutlines import CutLine, estimate_interrupted
from robot.interrupted import InterruptedEstimator, path_per_cut
from robot.onboard import Estimator
from robot.virtual.body import Body, BodySettings
from robot.virtual.crowd import Crowd, draw_places

SHAPES = {
    "square": box(-10, -10, 10, 10),
    "annulus": Point(0, 0).buffer(14, 64).difference(Point(0, 0).buffer(7, 64)),
    "tower": Polygon(
        [(-12, -18), (-7, -18), (-4, -8), (4, -8), (7, -18), (12, -18), (5, 0), (2, 20), (-2, 20), (-5, 0)]
    ),
}
DISC_CM = 45.0


def cut_lines(count, path_cm, rng):
    """Uniform isotropic lines over a disc, cut at random, every piece its own line: (n, 2, 2) of ends."""
    pieces = []
    angle, p = rng.uniform(0, math.tau, count), rng.uniform(-DISC_CM, DISC_CM, count)
    for along, across, half in zip(angle, p, np.sqrt(DISC_CM**2 - p**2), strict=True):
        ends = [-half]
        while ends[-1] < half:
            ends.append(min(half, ends[-1] + rng.exponential(path_cm)))
        s = np.array(ends)
        x, y = (math.cos(along), math.sin(along)), (-math.sin(along), math.cos(along))
        points = s[:, None] * x + across * np.array(y)
        pieces.extend(np.stack([points[:-1], points[1:]], axis=1))
    return np.array(pieces)


def seen(shape, pieces):
    """What a robot reports that rolls from end to end: shapely's crossings."""
    starts = pieces[:, 0]
    lit = shapely.contains_xy(shape, starts[:, 0], starts[:, 1])
    crossings = shapely.intersection(shapely.linestrings(pieces), shape.boundary)
    lengths = np.hypot(*(pieces[:, 1] - starts).T)
    lines = []
    for start, was_lit, points, length in zip(starts, lit, crossings, lengths, strict=True):
        s_cm = np.sort(np.hypot(*(shapely.get_coordinates(points) - start).T)).tolist()
        lines.append(CutLine(s_cm, [(at % 2 == 0) != was_lit for at in range(len(s_cm))], bool(was_lit), length))
    return lines


def pair_sums(line, path_per_cut_cm):
    """(n, L1, L3) of a line by the sum over all its pairs."""
    points = [0.0, *line.s_cm, line.end_cm]
    l1 = sum(b - a for at, (a, b) in enumerate(pairwise(points)) if (at % 2 == 0) == line.starts_lit)
    l3 = 0.0
    for (a, into_a), (b, into_b) in combinations(zip(line.s_cm, line.entering, strict=True), 2):
        l3 += (1 if into_a != into_b else -1) * (b - a) ** 3 * math.exp((b - a) / path_per_cut_cm)
    return len(line.s_cm), l1, l3


steps = st.floats(1e-3, 60.0)


@st.composite
def any_line(draw):
    s_cm = np.cumsum(draw(st.lists(steps, min_size=0, max_size=9))).tolist()
    lit = draw(st.booleans())
    end_cm = (s_cm[-1] if s_cm else 0.0) + draw(steps)
    return CutLine(s_cm, [(at % 2 == 0) != lit for at in range(len(s_cm))], lit, end_cm)


@given(any_line(), st.sampled_from([12.0, 30.0, 300.0, math.inf]))
def test_the_recursion_is_the_sum_over_all_pairs(line, path_per_cut_cm):
    estimator = InterruptedEstimator(path_per_cut_cm)
    estimator.start_line(line.starts_lit)
    for s_cm, entering in zip(line.s_cm, line.entering, strict=True):
        estimator.crossing(s_cm, entering)
    n, l1, l3 = estimator.end_line(line.end_cm)
    expected = pair_sums(line, path_per_cut_cm)
    largest = math.exp(line.end_cm / path_per_cut_cm) * line.end_cm**3
    assert n == expected[0]
    assert l1 == pytest.approx(expected[1], rel=1e-9, abs=1e-12)
    assert l3 == pytest.approx(expected[2], rel=1e-9, abs=1e-10 * largest)
    assert estimator.path_cm == pytest.approx(line.end_cm)
    ends_lit = (len(line.s_cm) % 2 == 0) == line.starts_lit
    assert estimator.cuts == ends_lit


def test_uncut_it_is_the_estimator_to_the_last_bit():
    rng = np.random.default_rng(1)
    plain, cut = Estimator(), InterruptedEstimator(math.inf)
    for line in seen(SHAPES["tower"], cut_lines(400, 1e9, rng)):
        for estimator in (plain, cut):
            estimator.start_line()
            for s_cm, entering in zip(line.s_cm, line.entering, strict=True):
                estimator.crossing(s_cm, entering)
        k, l1, l3 = plain.end_line(line.end_cm)
        assert cut.end_line(line.end_cm) == (2 * k, l1, l3)
    assert (cut.runs, cut.lines, cut.crossings) == (plain.runs, plain.lines, 2 * plain.chords)
    assert cut.area() == pytest.approx(plain.area(), rel=1e-13)
    assert cut.perimeter() == pytest.approx(plain.perimeter(), rel=1e-13)
    assert cut.area_over_perimeter() == pytest.approx(plain.area() / plain.perimeter(), rel=1e-13)
    assert cut.covariance() == pytest.approx(plain.covariance(), rel=1e-9)
    assert cut.correlation() == pytest.approx(plain.correlation(), rel=1e-9)
    assert (cut.reach, cut.cuts) == (0.0, 0)


def test_an_end_in_the_light_at_the_arenas_edge_closes_its_chord():
    plain, cut = Estimator(), InterruptedEstimator(math.inf)
    for estimator, end in ((plain, {}), (cut, {"cut": False})):
        estimator.start_line()
        estimator.crossing(2.0, True)
        assert estimator.end_line(7.0, **end)[1:] == (5.0, 125.0)
    assert (cut.crossings, cut.cuts) == (2, 0)


@pytest.mark.parametrize("name", SHAPES)
def test_weights_restore_the_area_and_need_not_restore_the_ratio(name):
    shape, path_cm = SHAPES[name], 30.0
    lines = seen(shape, cut_lines(12_000, path_cm, np.random.default_rng(2)))
    naive, known, found = (
        estimate_interrupted(lines, math.inf),
        estimate_interrupted(lines, path_cm),
        estimate_interrupted(lines, None),
    )
    assert naive.area() < 0.6 * shape.area
    for weighted in (known, found):
        assert weighted.area() == pytest.approx(shape.area, rel=0.08)
        assert abs(weighted.area() - shape.area) < 3.5 * weighted.sigma_area()
        assert abs(weighted.perimeter() - shape.length) < 3.5 * weighted.sigma_perimeter()
    assert found.path_per_cut_cm == pytest.approx(path_cm, rel=0.05)
    ratio = shape.area / shape.length
    for estimator in (naive, known, found):
        assert estimator.area_over_perimeter() == pytest.approx(ratio, rel=0.03)
        assert abs(estimator.area_over_perimeter() - ratio) < 3.5 * estimator.sigma_area_over_perimeter()
    assert found.warning == ""


@pytest.mark.slow
@pytest.mark.parametrize(("name", "count"), [("square", 400), ("annulus", 400)])
def test_standard_errors_are_those_of_200_sessions(name, count):
    shape = SHAPES[name]
    sessions = [seen(shape, cut_lines(count, 30.0, np.random.default_rng([n, 5]))) for n in range(200)]
    ratio = shape.area / shape.length
    for path_per_cut_cm in (30.0, None):
        ends = [estimate_interrupted(lines, path_per_cut_cm) for lines in sessions]
        area, sigma = np.array([(end.area(), end.sigma_area()) for end in ends]).T
        assert 0.9 < np.std((area - shape.area) / sigma) < 1.15
        assert np.mean(area) == pytest.approx(shape.area, rel=0.05)
    mean = np.mean([estimate_interrupted(lines, math.inf).area_over_perimeter() for lines in sessions])
    assert mean == pytest.approx(ratio, rel=0.02)


def test_merged_robots_are_one():
    lines = seen(SHAPES["annulus"], cut_lines(300, 40.0, np.random.default_rng(3)))
    whole = estimate_interrupted(lines, 40.0)
    first, second = estimate_interrupted(lines[:150], 40.0), estimate_interrupted(lines[150:], 40.0)
    first.merge(second)
    first.merge(InterruptedEstimator(40.0))
    for name in ("runs", "lines", "crossings", "cuts", "path_cm", "lit_cm", "reach", "effective_lines"):
        assert getattr(first, name) == pytest.approx(getattr(whole, name), rel=1e-10)
    assert (first.area(), *first.covariance()) == pytest.approx((whole.area(), *whole.covariance()), rel=1e-9)
    for other in (InterruptedEstimator(50.0), InterruptedEstimator(40.0, found=True)):
        with pytest.raises(ValueError, match="common"):
            first.merge(other)


def test_a_dropped_line_has_never_been():
    lines = seen(SHAPES["tower"], cut_lines(60, 40.0, np.random.default_rng(4)))
    kept, dropped = estimate_interrupted(lines, 40.0), InterruptedEstimator(40.0)
    for line in lines:
        dropped.start_line(True)
        dropped.crossing(1.0, False)
        dropped.crossing(7.0, True)
        dropped.drop_line()
        dropped.start_line(line.starts_lit)
        for s_cm, entering in zip(line.s_cm, line.entering, strict=True):
            dropped.crossing(s_cm, entering)
        dropped.end_line(line.end_cm)
    assert (dropped.covariance(), dropped.runs, dropped.path_cm) == (kept.covariance(), kept.runs, kept.path_cm)


def test_it_warns_where_few_long_pairs_carry_the_area():
    rng = np.random.default_rng(6)
    assert InterruptedEstimator(30.0).warning == ""
    assert "as few as" in estimate_interrupted(seen(SHAPES["square"], cut_lines(60, 30.0, rng)), 30.0).warning
    far = estimate_interrupted(seen(SHAPES["annulus"], cut_lines(3000, 8.0, rng)), 8.0)
    assert far.reach > 2
    assert "paths per cut apart" in far.warning
    inside = InterruptedEstimator(30.0)
    inside.start_line(True)
    inside.end_line(12.0)
    assert "no pair" in inside.warning
    assert math.isnan(inside.area_over_perimeter())
    assert math.isnan(inside.sigma_area())


def test_refused_calls_leave_the_line_as_it_was():
    for bad in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="above 0"):
            InterruptedEstimator(bad)
    estimator = InterruptedEstimator(10.0)
    for call in (lambda: estimator.crossing(1.0, True), lambda: estimator.end_line(1.0)):
        with pytest.raises(ValueError, match="no line is in progress"):
            call()
    estimator.start_line(True)
    with pytest.raises(ValueError, match="in progress"):
        estimator.start_line()
    with pytest.raises(ValueError, match="alternate"):
        estimator.crossing(1.0, True)
    estimator.crossing(3.0, False)
    for s_cm, message in ((2.0, "behind"), (math.nan, "nowhere"), (5100.0, "longer than the path per cut")):
        with pytest.raises(ValueError, match=message):
            estimator.crossing(s_cm, True)
    with pytest.raises(ValueError, match="behind"):
        estimator.end_line(2.0)
    assert estimator.end_line(5.0) == (1, 3.0, 0.0)
    assert path_per_cut(100.0, 0) == math.inf
    assert path_per_cut(100.0, 4) == 25.0


def test_memory_is_constant_and_the_module_keeps_to_micropython():
    estimator = InterruptedEstimator(30.0)
    assert not hasattr(estimator, "__dict__")
    values = [getattr(estimator, slot, 0.0) for slot in InterruptedEstimator.__slots__]
    assert sum(len(value) if hasattr(value, "__len__") else 1 for value in values) < 40
    tree = ast.parse(Path(robot.interrupted.__file__).read_text(encoding="utf-8"))
    imported = {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    imported |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert imported == {"math", "array", "robot.onboard"}
    unsupported = (ast.Match, ast.TryStar, ast.JoinedStr, ast.AsyncFunctionDef, ast.NamedExpr)
    assert not [node for node in ast.walk(tree) if isinstance(node, unsupported)]


def test_contacts_are_the_bumps_of_two_at_once():
    bumps = {"a": [1.0, 5.0, 9.0], "b": [1.02, 5.3, 8.99], "c": [5.31, 9.02]}
    flags, _ = contacts_among(bumps, 0.05)
    assert flags == {"a": [True, False, True], "b": [True, True, True], "c": [True, False]}
    assert contacts_among({"a": [1.0, 1.01], "b": []}, 0.05)[0] == {"a": [False, False], "b": []}
    assert contacts_among({}, 0.05) == ({}, {})
    with pytest.raises(ValueError, match="window"):
        contacts_among(bumps, -1.0)


def test_flags_by_chance_are_as_many_as_expected():
    rng = np.random.default_rng(7)
    shared = np.sort(rng.uniform(0, 20_000, 1500))
    alone = {robot: rng.uniform(0, 20_000, 8000) for robot in "abc"}
    bumps = {
        robot: np.sort(np.concatenate([alone[robot], shared] if robot != "c" else [alone[robot]])) for robot in "abc"
    }
    flags, chance = contacts_among({who: times.tolist() for who, times in bumps.items()}, 0.05)
    for who, times in bumps.items():
        false = sum(flag and t_s not in shared for flag, t_s in zip(flags[who], times, strict=True))
        assert false > 200
        assert chance[who] == pytest.approx(false, rel=0.15)


ARENA = box(-56.35, -41.35, 56.35, 41.35)


def crowd_session(count, duration_s, seed):
    """Robots on Lambert turning that cannot tell a ball from a wall: straight lines (n, 2, 2), and bumps (t, wall)."""
    rng = np.random.default_rng(seed)
    ideal = BodySettings(speed_error=0, drift_rad_per_cm=0, locator_error=0, bump_angle_rad=0, drive_timeout_s=1e9)
    bodies = [
        Body(ARENA, np.add, np.random.default_rng(n), ideal, position_cm=place)
        for n, place in enumerate(draw_places(ARENA, count, rng))
    ]
    crowd = Crowd(bodies)
    crowd.advance(0.0)
    starts, wanted, lines, bumps = [None] * count, [0.0] * count, [], [[] for _ in bodies]

    def bumped(n, impact):
        body = bodies[n]
        if starts[n] is not None:
            lines.append((starts[n], (body.x_cm, body.y_cm)))
        at_wall = max(abs(body.x_cm) - 56.35, abs(body.y_cm) - 41.35) > -1e-5
        bumps[n].append((impact.t_s, at_wall and not body.beside))
        starts[n], wanted[n] = None, impact.normal_heading_rad + math.asin(2 * rng.random() - 1)
        body.drive(wanted[n], 40.0)

    for n, body in enumerate(bodies):
        body.on_bump = lambda impact, n=n: bumped(n, impact)
        body.drive(wanted[n], 40.0)
    for t_s in np.arange(0.02, duration_s, 0.02).tolist():
        crowd.advance(t_s)
        for n, body in enumerate(bodies):
            # It begins once it has braked and turned.
            if starts[n] is None and abs(math.remainder(body.heading_rad - wanted[n], math.tau)) < 1e-9:
                starts[n] = (body.x_cm, body.y_cm)
    return np.array(lines), bumps


@pytest.mark.slow
def test_sessions_whose_standard_errors_deceive_say_so():
    """A tower as long as the path per cut: 400 lines are too few, and the spread is larger than they think."""
    shape = SHAPES["tower"]
    ends = [estimate_interrupted(seen(shape, cut_lines(400, 30.0, np.random.default_rng([n, 5])))) for n in range(100)]
    area, sigma = np.array([(end.area(), end.sigma_area()) for end in ends]).T
    assert np.std((area - shape.area) / sigma) > 1.3
    assert np.mean([bool(end.warning) for end in ends]) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("count", "loss", "falsely"), [(3, 0.02, 0.03), (6, 0.07, 0.06)])
def test_a_real_crowd(count, loss, falsely):
    """Contacts are no Poisson process: they crowd along the walls and repeat. The light's own L is what repairs."""
    sessions = [crowd_session(count, 2000.0, seed) for seed in range(2)]
    pieces = np.concatenate([lines for lines, _ in sessions])
    for name in ("square", "annulus"):
        shape = SHAPES[name]
        lines = seen(shape, pieces)
        naive, found = estimate_interrupted(lines, math.inf), estimate_interrupted(lines, None)
        assert naive.area() < (1 - loss) * shape.area
        assert found.area() == pytest.approx(shape.area, rel=0.04)
        assert abs(found.area() - shape.area) < 3.5 * found.sigma_area()
        assert found.area_over_perimeter() == pytest.approx(shape.area / shape.length, rel=0.04)
    bumps = sessions[0][1]
    flags, chance = contacts_among({str(n): [t_s for t_s, _ in of] for n, of in enumerate(bumps)}, 0.02)
    pairs = [(flag, wall) for n, of in enumerate(bumps) for flag, (_, wall) in zip(flags[str(n)], of, strict=True)]
    walls = sum(wall for _, wall in pairs)
    false = sum(flag and wall for flag, wall in pairs)
    assert false / walls < falsely
    assert false == pytest.approx(sum(chance.values()), rel=0.4)
    assert sum(not flag and not wall for flag, wall in pairs) <= 0.002 * len(pairs)
