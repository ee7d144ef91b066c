"""The on-board estimator against exact pair sums, closed forms and NumPy's covariance."""

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.onboard import Estimator
from tests.robot.drawnlines import annulus_lines, disc_lines, roll, rolled, signed_pair_sum, square_lines

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


def test_single_precision_is_enough(full):
    """float32 operands keep every operation in single precision, as a robot's own does; stored pairs fail there."""
    lines = 1_000_000 if full else 100_000
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
