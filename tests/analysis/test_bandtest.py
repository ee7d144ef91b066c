"""The whole-curve test: its level by simulated sessions, its envelope, its power; with ranks counted by hand."""

import numpy as np
import pytest
from scipy.stats import binomtest
from shapely.geometry import box

from analysis.bandtest import Curves, band_test, checkpoints_to, curve_of, independent_curves, rolled_curves
from analysis.exploration import Turning, explore, rectangle_arena
from analysis.montecarlo import simulate_lines
from analysis.sensor import SensorModel
from lab.base.errors import RequestError

ARENA = rectangle_arena(120, 110)


def one(curves, session):
    return Curves(curves.n, curves.area_cm2[session], curves.perimeter_cm[session])


def test_the_p_value_by_hand(rng):
    """Curve by curve and point by point, as the paper defines the directional deviation."""
    n = np.array([10, 20])
    areas, perimeters = np.exp(rng.normal(size=(2, 40, 2)))
    logs = np.log(np.hstack([areas, perimeters]))
    farthest = []
    for curve in logs:
        ways = []
        for point, value in enumerate(curve):
            column = logs[:, point]
            side = np.quantile(column, 0.975 if value > column.mean() else 0.025)
            ways.append((value - column.mean()) / (side - column.mean()))
        farthest.append(max(ways))
    found = band_test(Curves(n, areas[0], perimeters[0]), Curves(n, areas[1:], perimeters[1:]))
    assert found.p_value == pytest.approx(np.mean([far >= farthest[0] for far in farthest]))


def test_curves_are_eq_1_of_the_lines_so_far(shapes, rng):
    k, l1, l3 = simulate_lines(shapes["tower"], 100, rng)
    curve = curve_of(k, l1, l3, checkpoints_to(100))
    for place, n in enumerate(curve.n):
        area = np.pi / 3 * l3[:n].mean() / l1[:n].mean()
        assert curve.area_cm2[place] == pytest.approx(area)
        assert curve.perimeter_cm[place] == pytest.approx(np.pi * area * k[:n].mean() / l1[:n].mean())
    doubled = curve_of(k, l1, l3, curve.n, weights=np.full(100, 2.0))
    assert doubled.area_cm2 == pytest.approx(curve.area_cm2)


def test_rolled_curves_end_where_explored_sessions_do(shapes):
    """The same sessions by the same seed, followed on the way or not."""
    ends = explore(shapes["square"], ARENA, lines=80, runs=30, rng=np.random.default_rng(4))
    curves = rolled_curves(shapes["square"], ARENA, np.array([10, 40, 80]), 30, np.random.default_rng(4))
    assert curves.area_cm2[:, -1] == pytest.approx(ends.area_cm2)
    assert curves.perimeter_cm[:, -1] == pytest.approx(ends.perimeter_cm)


def rejected(sessions, reference_of, tests):
    """How many of the first ``tests`` curves are rejected, each against its own fresh reference."""
    verdicts = [band_test(one(sessions, index), reference_of()) for index in range(tests)]
    assert all(found.inside == (found.leaves_at is None) for found in verdicts)
    return sum(not found.inside for found in verdicts)


@pytest.mark.parametrize(("name", "tests"), [("tower", 250)])
def test_false_alarms_are_one_in_twenty(shapes, rng, name, tests):
    """A few hundred sessions here; `test_false_alarms_in_full` has two thousand."""
    n = checkpoints_to(100)
    sessions = independent_curves(shapes[name], n, tests, rng)
    wrong = rejected(sessions, lambda: independent_curves(shapes[name], n, 199, rng), tests)
    assert binomtest(wrong, tests, 0.05).pvalue > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["independent", "rolled"])
def test_false_alarms_in_full(shapes, rng, kind, full):
    """5 % within 1 % over 2000 sessions, for lines that are independent and (fewer, but for --full) wall to wall."""
    n, tests = checkpoints_to(60), 2000 if full or kind == "independent" else 500

    def draw(sessions):
        if kind == "independent":
            return independent_curves(shapes["tower"], n, sessions, rng)
        return rolled_curves(shapes["tower"], ARENA, n, sessions, rng)

    wrong = rejected(draw(tests), lambda: draw(199), tests)
    slack = 0.01 * np.sqrt(2000 / tests)  # two standard errors of a rate from so many
    assert abs(wrong / tests - 0.05) < slack, wrong / tests


def test_lines_from_wall_to_wall_scatter_more_than_independent_ones(shapes, rng):
    """Why successive lines have a band of their own: of the tower's sessions some 8 % would leave the other one."""
    n = np.array([300])
    rolled = rolled_curves(shapes["tower"], ARENA, n, 4000, rng).area_cm2
    independent = independent_curves(shapes["tower"], n, 4000, rng).area_cm2
    assert rolled.mean() == pytest.approx(independent.mean(), rel=0.005)
    assert rolled.std() / independent.std() > 1.03


def test_a_robot_that_turns_by_a_uniform_angle_is_found_out(shapes, rng):
    n = checkpoints_to(3000)
    wrong = rolled_curves(shapes["tower"], ARENA, n, 20, rng, turning=Turning.UNIFORM)
    reference = rolled_curves(shapes["tower"], ARENA, n, 199, rng)
    found = [band_test(one(wrong, index), reference) for index in range(20)]
    assert sum(not test.inside for test in found) > 10
    assert {test.leaves_at for test in found if not test.inside} <= set(n.tolist())


def test_a_wrong_speed_leaves_the_band_that_its_own_lines_stay_in(shapes, rng):
    """Lengths 7 % short: A 14 % and P 7 % too small. Both seen through one sensor."""
    n, sensor = checkpoints_to(400), SensorModel(step_cm=1.0, footprint_cm=0.5)
    curves = rolled_curves(shapes["square"], ARENA, n, 209, rng, sensor=sensor)
    right = Curves(n, curves.area_cm2[10:], curves.perimeter_cm[10:])
    slow = Curves(n, 0.93**2 * curves.area_cm2, 0.93 * curves.perimeter_cm)
    assert not any(band_test(one(slow, index), right).inside for index in range(10))
    assert sum(band_test(one(curves, index), right).inside for index in range(10)) >= 8


def test_the_envelope_holds_the_share_of_curves_that_it_says(shapes, rng):
    n = checkpoints_to(60)
    curves = independent_curves(shapes["square"], n, 400, rng)
    found = band_test(one(curves, 0), Curves(n, curves.area_cm2[1:], curves.perimeter_cm[1:]), level=0.9)
    low, high = np.concatenate([found.area_cm2, found.perimeter_cm], axis=1)
    inside = ((curves.joined >= np.log(low)) & (curves.joined <= np.log(high))).all(axis=1)
    assert inside.mean() == pytest.approx(0.9, abs=0.006)


def test_what_cannot_be_tested(shapes, rng):
    with pytest.raises(RequestError, match="too short"):
        checkpoints_to(19)
    curves = independent_curves(box(0, 0, 9, 9), checkpoints_to(20), 30, rng)
    other = independent_curves(box(0, 0, 9, 9), checkpoints_to(30), 30, rng)
    with pytest.raises(RequestError, match="same numbers"):
        band_test(one(curves, 0), other)
    few = Curves(curves.n, curves.area_cm2[:10], curves.perimeter_cm[:10])
    with pytest.raises(RequestError, match="simulate more"):
        band_test(one(curves, 0), few)
