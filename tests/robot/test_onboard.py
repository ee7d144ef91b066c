"""The on-board estimator against exact pair sums, closed forms and NumPy's covariance."""

import ast
import math
from fractions import Fraction
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robot.onboard
from robot.onboard import Estimator


def signed_pair_sum(s_cm, n):
    """Eq. 1's L_n over all pairs of crossings, O(k^2), exact in rational numbers."""
    total = Fraction(0)
    for (i, a), (j, b) in combinations(enumerate(s_cm), 2):
        total += (1 if (i + j) % 2 else -1) * abs(Fraction(b) - Fraction(a)) ** n
    return total


def roll(estimator, s_cm, weight=1.0):
    estimator.start_line()
    for order, s in enumerate(s_cm):
        estimator.crossing(s, order % 2 == 0)
    return estimator.end_line(None, weight)


def rolled(lines, **kept):
    estimator = Estimator(**kept)
    for s_cm in lines:
        roll(estimator, s_cm)
    return estimator


def disc_lines(n, radius, rng):
    half = np.sqrt(radius**2 - rng.uniform(-radius, radius, n) ** 2)
    return np.column_stack([-half, half]).tolist()


def annulus_lines(n, outer, inner, rng):
    p = rng.uniform(-outer, outer, n)
    half = np.sqrt(outer**2 - p**2)
    hole = np.sqrt(np.maximum(inner**2 - p**2, 0.0))
    return [[-h, -g, g, h] if g > 0 else [-h, h] for h, g in zip(half.tolist(), hole.tolist(), strict=True)]


def square_lines(n, side, rng):
    """Uniform lines that meet a square, by clipping those that meet its circumscribed circle."""
    half, lines = side / 2, []
    while len(lines) < n:
        theta, p = rng.uniform(0, math.pi), rng.uniform(-half * math.sqrt(2), half * math.sqrt(2))
        x, y, dx, dy = p * math.cos(theta), p * math.sin(theta), -math.sin(theta), math.cos(theta)
        slab_x = sorted(((-half - x) / dx, (half - x) / dx))
        slab_y = sorted(((-half - y) / dy, (half - y) / dy))
        entry, leave = max(slab_x[0], slab_y[0]), min(slab_x[1], slab_y[1])
        if entry < leave:
            lines.append([entry, leave])
    return lines


steps = st.floats(min_value=1e-3, max_value=80.0)


@given(st.integers(1, 10).flatmap(lambda k: st.lists(steps, min_size=2 * k, max_size=2 * k)))
def test_recursion_equals_the_sum_over_all_pairs(widths):
    s_cm = np.cumsum(widths).tolist()
    plain, higher = Estimator(), Estimator(higher=True)
    k, l1, l3 = roll(higher, s_cm)
    assert (k, l1, l3) == roll(plain, s_cm)
    assert k == len(widths) // 2
    sums = [float(signed_pair_sum(s_cm, n)) for n in (1, 3, 4, 5)]
    assert [l1, l3, *higher.higher_of_line()] == pytest.approx(sums, rel=1e-12)
    assert all(math.isnan(value) for value in plain.higher_of_line())


def test_lines_are_forgotten_between_lines():
    estimator = Estimator()
    first = roll(estimator, [1.0, 4.0, 9.0, 11.0])
    roll(estimator, [0.5, 30.0])
    assert roll(estimator, [1.0, 4.0, 9.0, 11.0]) == first


def distances(lines):
    """(Radius of gyration, mean pair distance) and their standard errors, from ten blocks of the lines."""
    blocks = [rolled(lines[i::10], higher=True) for i in range(10)]
    whole = rolled(lines, higher=True)
    found = np.array([[block.radius_of_gyration(), block.mean_pair_distance()] for block in blocks])
    return (whole.radius_of_gyration(), whole.mean_pair_distance()), found.std(axis=0, ddof=1) / math.sqrt(10)


def test_distances_within_a_disc_and_a_square():
    """Closed forms: a disc R/sqrt(2) and 128 R/(45 pi), a square side/sqrt(6) and Robbins' 0.5214 side."""
    rng = np.random.default_rng(12)
    robbins = (2 + math.sqrt(2) + 5 * math.log(1 + math.sqrt(2))) / 15
    for lines, expected in (
        (disc_lines(40_000, 12.0, rng), (12.0 / math.sqrt(2), 128 * 12.0 / (45 * math.pi))),
        (square_lines(40_000, 20.0, rng), (20.0 / math.sqrt(6), 20.0 * robbins)),
    ):
        found, sigmas = distances(lines)
        assert np.all(sigmas < 0.01 * np.array(expected))
        assert np.all(np.abs(np.subtract(found, expected)) < 4.5 * sigmas)


def test_distances_in_an_annulus_by_pairs_of_points():
    rng = np.random.default_rng(13)
    found, sigmas = distances(annulus_lines(30_000, 12.0, 6.0, rng))
    radius, angle = np.sqrt(rng.uniform(36.0, 144.0, (2, 200_000))), rng.uniform(0, math.tau, (2, 200_000))
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    pair = np.hypot(x[0] - x[1], y[0] - y[1]).mean()
    assert abs(found[0] - math.sqrt((144 + 36) / 2)) < 4.5 * sigmas[0]
    assert abs(found[1] - pair) < 4.5 * math.hypot(sigmas[1], 6.0 / math.sqrt(200_000))


def test_distances_that_are_not_kept_are_not_known():
    plain = rolled([[0.0, 3.0]])
    assert math.isnan(plain.radius_of_gyration())
    assert math.isnan(plain.mean_pair_distance())
    assert math.isnan(Estimator(higher=True).mean_pair_distance())
    with pytest.raises(ValueError, match="give add_line both"):
        Estimator(higher=True).add_line(1, 3.0, 27.0)
    lines = [[0.0, 3.0], [0.0, 5.0], [0.0, 4.0]]
    first, second, whole = (rolled(part, higher=True) for part in (lines[:2], lines[2:], lines))
    first.merge(second)
    assert first.mean_pair_distance() == pytest.approx(whole.mean_pair_distance(), rel=1e-14)
    assert first.radius_of_gyration() == pytest.approx(whole.radius_of_gyration(), rel=1e-14)
    first.merge(plain)
    assert math.isnan(first.mean_pair_distance())
    assert (first.lines, math.isnan(first.sigma_area())) == (4, False)


def test_weights_undo_unequal_probabilities():
    """Lines of a disc drawn in proportion to their chord: unweighted the area is far off, with 1/chord it is true."""
    rng = np.random.default_rng(14)
    even = disc_lines(120_000, 12.0, rng)
    drawn = [line for line in even if rng.random() < (line[1] - line[0]) / 24.0]
    plain, weighted = rolled(drawn), Estimator(higher=True)
    for line in drawn:
        roll(weighted, line, 24.0 / (line[1] - line[0]))
    area, perimeter = math.pi * 144, 24 * math.pi
    assert plain.area() > 1.05 * area
    assert (weighted.lines, weighted.runs, weighted.chords) == (len(drawn),) * 3
    assert abs(weighted.area() - area) < 4 * weighted.sigma_area() < 0.02 * area
    assert abs(weighted.perimeter() - perimeter) < 4 * weighted.sigma_perimeter() < 0.02 * perimeter
    assert weighted.mean_pair_distance() == pytest.approx(128 * 12.0 / (45 * math.pi), rel=0.01)


@given(st.lists(st.tuples(st.integers(1, 10), steps, steps, st.floats(1e-3, 1e3)), min_size=2, max_size=20))
def test_weighted_sums_are_those_of_the_weighted_lines(rows):
    weighted = Estimator()
    for k, l1, l3, weight in rows:
        weighted.add_line(k, l1, l3, weight)
    area, perimeter, expected = by_numpy([(k * w, l1 * w, l3 * w) for k, l1, l3, w in rows])
    assert (weighted.area(), weighted.perimeter()) == pytest.approx((area, perimeter), rel=1e-9)
    scale = max(area, perimeter) ** 2
    assert weighted.covariance() == pytest.approx(expected[[0, 0, 1], [0, 1, 1]].tolist(), rel=1e-6, abs=1e-9 * scale)
    assert weighted.chords == sum(row[0] for row in rows)


@pytest.mark.parametrize("weight", [0.0, -1.0, math.nan, math.inf])
def test_a_weight_that_is_none_is_refused(weight):
    estimator = Estimator()
    estimator.start_line()
    estimator.crossing(1.0, True)
    with pytest.raises(ValueError, match="weight must be a finite number above 0"):
        estimator.end_line(3.0, weight)
    with pytest.raises(ValueError, match="weight"):
        estimator.add_line(0, 0.0, 0.0, weight)
    assert estimator.runs == 0
    assert estimator.end_line(3.0) == (1, 2.0, 8.0)


class Lanes(np.ndarray):
    """Many lines at once, in single precision: an array that the estimator takes for a number."""

    def __bool__(self):
        return bool(np.asarray(self).all())

    def __float__(self):
        return float(np.asarray(self).flat[0])

    def __iadd__(self, other):
        return self + other  # a number does not change under its other names


def pair_sums(s_cm, n, precision):
    """L_n of each row by the sum over all pairs of crossings, in the precision given."""
    total = np.zeros(len(s_cm), dtype=precision)
    for i, j in combinations(range(s_cm.shape[1]), 2):
        apart = s_cm[:, j].astype(precision) - s_cm[:, i].astype(precision)
        power = np.prod([apart] * n, axis=0)
        total += power if (i + j) % 2 else -power
    return total


@pytest.mark.parametrize("lines", [100_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_single_precision_is_enough(lines):
    """float32 operands keep every operation in single precision, as a robot's own does; stored pairs fail there."""
    rng = np.random.default_rng(15)
    worst, naive = np.zeros(4), 0.0
    for k in range(1, 11):
        s_cm = np.cumsum(10 ** rng.uniform(-2.0, 1.5, (lines // 10, 2 * k)), axis=1).astype(np.float32)
        estimator = Estimator(higher=True)
        _, *told = (*roll(estimator, list(s_cm.T.copy().view(Lanes))), *estimator.higher_of_line())
        assert {lanes.dtype for lanes in told} == {np.dtype(np.float32)}
        exact = [pair_sums(s_cm, n, np.longdouble) for n in (1, 3, 4, 5)]
        for row in rng.integers(lines // 10, size=5).tolist():
            single = Estimator(higher=True)
            alone = [*roll(single, list(s_cm[row]))[1:], *single.higher_of_line()]
            assert {type(value) for value in alone} == {np.float32}
            assert alone == [lanes[row] for lanes in told]  # one by one it is the same
            rational = [float(signed_pair_sum(s_cm[row].tolist(), n)) for n in (1, 3, 4, 5)]
            assert [float(sums[row]) for sums in exact] == pytest.approx(rational, rel=1e-8)
        errors = [np.abs(np.asarray(lanes) / sums - 1).max() for lanes, sums in zip(told, exact, strict=True)]
        worst = np.maximum(worst, np.array(errors, dtype=float))
        naive = max(naive, float(np.abs(pair_sums(s_cm, 3, np.float32) / exact[1] - 1).max()))
    assert np.all(worst <= 1e-6), worst
    assert naive > 1e-2


# (lines, A, P, relative sigma of A and of P for one line, from quadrature)
SHAPES = {
    "disc": (lambda n, rng: disc_lines(n, 12.0, rng), math.pi * 144, 24 * math.pi, 0.30437, 0.17118),
    "square": (lambda n, rng: square_lines(n, 20.0, rng), 400.0, 80.0, 0.39278, 0.33730),
}


@pytest.mark.parametrize("name", SHAPES)
def test_closed_forms_within_standard_errors(name):
    draw, area, perimeter, sigma_area, sigma_perimeter = SHAPES[name]
    n = 40_000
    estimator = rolled(draw(n, np.random.default_rng(5)))
    assert estimator.lines == estimator.runs == estimator.chords == n
    assert abs(estimator.area() - area) < 3.5 * area * sigma_area / math.sqrt(n)
    assert abs(estimator.perimeter() - perimeter) < 3.5 * perimeter * sigma_perimeter / math.sqrt(n)
    assert estimator.sigma_area() == pytest.approx(area * sigma_area / math.sqrt(n), rel=0.03)
    assert estimator.sigma_perimeter() == pytest.approx(perimeter * sigma_perimeter / math.sqrt(n), rel=0.03)


def test_correlation_of_a_square():
    estimator = rolled(square_lines(40_000, 20.0, np.random.default_rng(6)))
    assert estimator.correlation() == pytest.approx(0.03153 / (0.39278 * 0.33730), abs=0.03)


def test_a_hole_is_measured_and_naive_chord_cubes_are_not_enough():
    outer, inner, n = 12.0, 6.0, 20_000
    lines = annulus_lines(n, outer, inner, np.random.default_rng(7))
    estimator = rolled(lines)
    area, perimeter = math.pi * (outer**2 - inner**2), 2 * math.pi * (outer + inner)
    assert abs(estimator.area() - area) < 3.5 * estimator.sigma_area()
    assert abs(estimator.perimeter() - perimeter) < 3.5 * estimator.sigma_perimeter()
    cubes = np.mean([sum((b - a) ** 3 for a, b in zip(line[::2], line[1::2], strict=True)) for line in lines])
    naive = math.pi / 3 * cubes / estimator.means()[1]
    assert naive < 0.7 * area


def test_the_printed_prefactor_fails_on_a_disc():
    """Eq. 1 as printed has 3/pi: 9/pi^2 = 0.912 of the area, far outside the error of 20 000 lines."""
    estimator = rolled(disc_lines(20_000, 12.0, np.random.default_rng(8)))
    area, sigma = math.pi * 144, estimator.sigma_area()
    _, l1, l3 = estimator.means()
    printed = 3 / math.pi * l3 / l1
    assert abs(estimator.area() - area) < 3.5 * sigma
    assert printed < area - 30 * sigma
    assert printed == pytest.approx(9 / math.pi**2 * area, rel=0.01)


def test_standard_errors_are_those_of_repeated_sessions():
    rng = np.random.default_rng(9)
    sessions = [rolled(annulus_lines(150, 12.0, 6.0, rng)) for _ in range(400)]
    areas = [session.area() for session in sessions]
    perimeters = [session.perimeter() for session in sessions]
    # The spread of 400 sessions is itself known to 1/sqrt(800) = 3.5 %.
    assert np.mean([session.sigma_area() for session in sessions]) == pytest.approx(np.std(areas), rel=0.12)
    assert np.mean([session.sigma_perimeter() for session in sessions]) == pytest.approx(np.std(perimeters), rel=0.12)
    assert np.mean([session.correlation() for session in sessions]) == pytest.approx(
        np.corrcoef(areas, perimeters)[0, 1], abs=0.12
    )


lines_of = st.lists(st.tuples(st.integers(1, 10), st.floats(0.5, 80.0), st.floats(0.5, 1e5)), min_size=2, max_size=30)


def by_numpy(rows):
    """(A, P) and their covariance by the delta method in matrix form, on NumPy's covariance."""
    table = np.array(rows, dtype=float)
    k, l1, l3 = table.mean(axis=0)
    area = math.pi / 3 * l3 / l1
    perimeter = math.pi * area * k / l1
    jacobian = np.array([[0, -area / l1, area / l3], [perimeter / k, -2 * perimeter / l1, perimeter / l3]])
    return area, perimeter, jacobian @ np.cov(table, rowvar=False) @ jacobian.T / len(rows)


@given(lines_of)
def test_covariance_is_the_delta_method(rows):
    estimator = Estimator()
    for row in rows:
        estimator.add_line(*row)
    area, perimeter, expected = by_numpy(rows)
    assert (estimator.area(), estimator.perimeter()) == pytest.approx((area, perimeter), rel=1e-12)
    tiny = 1e-9
    assert estimator.covariance() == pytest.approx(
        (expected[0, 0], expected[0, 1], expected[1, 1]),
        rel=1e-6,
        abs=tiny * max(area, perimeter) ** 2,
    )


@given(lines_of, st.data())
def test_merged_robots_are_one(rows, data):
    cut = data.draw(st.integers(0, len(rows)))
    first, second, whole = Estimator(), Estimator(), Estimator()
    for at, row in enumerate([*rows, (0, 0.0, 0.0)]):
        (first if at < cut else second).add_line(*row)
        whole.add_line(*row)
    first.merge(second)
    assert (first.runs, first.lines, first.chords) == (whole.runs, whole.lines, whole.chords)
    assert first.means() == pytest.approx(whole.means(), rel=1e-12)
    scale = max(whole.area(), whole.perimeter()) ** 2
    assert first.covariance() == pytest.approx(whole.covariance(), rel=1e-6, abs=1e-9 * scale)


def test_merging_with_a_session_without_covariance_leaves_none():
    first, second = rolled([[0.0, 3.0], [0.0, 4.0]]), rolled([[0.0, 5.0]], covariance=False)
    first.merge(second)
    assert first.means()[1] == pytest.approx(4.0)
    assert math.isnan(first.sigma_area())


def test_runs_that_miss_the_shape_do_not_count_as_lines():
    estimator = Estimator()
    assert roll(estimator, []) == (0, 0.0, 0.0)
    assert math.isnan(estimator.area())
    assert math.isnan(estimator.means()[0])
    roll(estimator, [1.0, 4.0])
    area = estimator.area()
    roll(estimator, [])
    assert (estimator.runs, estimator.lines, estimator.chords) == (3, 1, 1)
    assert estimator.area() == area == pytest.approx(math.pi / 3 * 9)
    assert estimator.perimeter() == pytest.approx(math.pi * area / 3)


def test_a_dropped_line_has_never_been():
    rng = np.random.default_rng(10)
    kept, dropped = Estimator(), Estimator()
    for line in annulus_lines(20, 12.0, 6.0, rng):
        roll(kept, line)
        dropped.start_line()
        for order, s_cm in enumerate(line[: rng.integers(1, len(line) + 1)]):
            dropped.crossing(s_cm, order % 2 == 0)
        dropped.drop_line()
        roll(dropped, line)
    assert dropped.covariance() == kept.covariance()
    assert (dropped.runs, dropped.lines, dropped.chords) == (kept.runs, kept.lines, kept.chords)
    kept.drop_line()  # none in progress: harmless
    assert dropped.area() == kept.area()


def test_a_line_that_ends_lit_is_closed_at_its_end():
    estimator = Estimator()
    estimator.start_line()
    estimator.crossing(2.0, True)
    with pytest.raises(ValueError, match="ended in the light"):
        estimator.end_line()
    assert estimator.runs == 0
    assert estimator.end_line(7.0) == (1, 5.0, 125.0)
    estimator.start_line()
    estimator.crossing(2.0, True)
    estimator.crossing(7.0, False)
    assert estimator.end_line(9.0) == (1, 5.0, 125.0)  # in the dark, the end adds nothing


def test_refused_calls_leave_the_line_as_it_was():
    estimator = Estimator()
    for call in (lambda: estimator.crossing(1.0, True), estimator.end_line):
        with pytest.raises(ValueError, match="no line is in progress"):
            call()
    estimator.start_line()
    with pytest.raises(ValueError, match="in progress"):
        estimator.start_line()
    with pytest.raises(ValueError, match="alternate"):
        estimator.crossing(1.0, False)
    with pytest.raises(ValueError, match="nowhere"):
        estimator.crossing(math.nan, True)
    estimator.crossing(1.0, True)
    with pytest.raises(ValueError, match="alternate"):
        estimator.crossing(2.0, True)
    with pytest.raises(ValueError, match="behind"):
        estimator.crossing(0.5, False)
    estimator.crossing(3.0, False)
    with pytest.raises(ValueError, match="behind"):
        estimator.crossing(2.5, True)
    assert estimator.end_line() == (1, 2.0, 8.0)


def test_sigmas_where_they_are_not_known():
    single = rolled([[0.0, 3.0]])
    assert all(math.isnan(value) for value in (single.sigma_area(), single.sigma_perimeter(), single.correlation()))
    alike = rolled([[0.0, 3.0]] * 5)
    assert alike.sigma_area() == pytest.approx(0.0, abs=1e-9)
    assert math.isnan(alike.correlation())
    without = rolled([[0.0, 3.0], [0.0, 4.0]], covariance=False)
    assert math.isnan(without.sigma_perimeter())
    assert without.area() == pytest.approx(math.pi / 3 * 91 / 7)
    nothing = rolled([[1.0, 1.0]])  # a chord of no length
    assert math.isnan(nothing.area() + nothing.perimeter())


def test_memory_is_constant():
    """No attribute beyond the slots, and none of them grows with the session."""

    def size(estimator):
        values = [getattr(estimator, slot) for slot in Estimator.__slots__]
        return sum(len(value) if hasattr(value, "__len__") else 1 for value in values)

    estimator = Estimator()
    before = size(estimator)
    for line in annulus_lines(500, 12.0, 6.0, np.random.default_rng(11)):
        roll(estimator, line)
    assert not hasattr(estimator, "__dict__")
    assert size(estimator) == before == 24


def test_module_keeps_to_micropython():
    """Imports, syntax and ``math`` names that every MicroPython build has; none of its gaps."""
    tree = ast.parse(Path(robot.onboard.__file__).read_text(encoding="utf-8"))
    imported = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(node.module)
    assert imported == {"math", "array"}
    unsupported = (ast.Match, ast.TryStar, ast.JoinedStr, ast.AsyncFunctionDef, ast.Starred, ast.NamedExpr)
    assert [type(node).__name__ for node in ast.walk(tree) if isinstance(node, unsupported)] == []
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    assert all(not function.args.posonlyargs and not function.decorator_list for function in functions)
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    assert all(len(cls.bases) < 2 and not cls.keywords and not cls.decorator_list for cls in classes)
    math_names = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "math"
    }
    assert math_names <= {"pi", "sqrt", "isfinite"}
