"""A robot that turns otherwise is caught from its run lengths and crossings alone.

The truth comes from closed forms, from shapely and from a billiard of its own, not from the simulation under test.
"""

import math

import numpy as np
import pytest
from scipy.stats import kstest
from shapely import LineString, Point, Polygon, box

from analysis.billiard import ArenaError, hit_and_run, roll
from analysis.runlengths import arena_consistency, examine_runs, expected_bias, tabulate_runs
from lab.base.errors import RequestError

BALL_CM = 3.65
RECTANGLE = box(-60, -45, 60, 45).buffer(-BALL_CM, join_style="mitre")
DISC = Point(0, 0).buffer(50 - BALL_CM, quad_segs=90)
ARENAS = {"rectangle": RECTANGLE, "disc": DISC}
RADIUS_CM = 50 - BALL_CM
HALF_WIDTH_CM, HALF_HEIGHT_CM = 60 - BALL_CM, 45 - BALL_CM
RIGHT = [(14.0, -25.0), (6.0, -9.0), (3.0, 5.0), (1.0, 25.0)]
TOWER = Polygon(
    [*RIGHT, *((-x, y) for x, y in reversed(RIGHT)), (-9.0, -25.0), (-5.0, -17.0), (5.0, -17.0), (9.0, -25.0)]
)


def cauchy_cm(arena):
    return math.pi * arena.area / arena.length


def own_billiard(angle, runs, seed):
    """Successive run lengths in the rectangle, with the angle from the normal drawn by ``angle(u)``; scalar code."""
    rng = np.random.default_rng(seed)
    x, y, normal, lengths = 0.3 * HALF_WIDTH_CM, -HALF_HEIGHT_CM, math.pi / 2, []
    for _ in range(runs):
        alpha = normal + angle(rng.random())
        dx, dy = math.cos(alpha), math.sin(alpha)
        to_x = ((HALF_WIDTH_CM if dx > 0 else -HALF_WIDTH_CM) - x) / dx if dx else math.inf
        to_y = ((HALF_HEIGHT_CM if dy > 0 else -HALF_HEIGHT_CM) - y) / dy if dy else math.inf
        reach = max(0.0, min(to_x, to_y))
        normal = (math.pi if dx > 0 else 0.0) if to_x < to_y else (-math.pi / 2 if dy > 0 else math.pi / 2)
        x, y = x + reach * dx, y + reach * dy
        lengths.append(reach)
    return np.array(lengths)


def lambert(u):
    return math.asin(2 * u - 1)


def even(u):
    return math.pi * (u - 0.5)


@pytest.fixture(scope="module")
def tables():
    """Tables for 150 runs, once for the whole module."""
    rng = np.random.default_rng(20260101)
    return {name: tabulate_runs(arena, 150, rng, sessions=999) for name, arena in ARENAS.items()}


# --- the simulated robots


@pytest.mark.parametrize("name", ARENAS)
def test_lambert_rolls_cauchys_mean(name):
    lengths = roll(ARENAS[name], 400, 200, np.random.default_rng(1)).length_cm
    sessions = lengths.mean(axis=1)
    assert abs(sessions.mean() - cauchy_cm(ARENAS[name])) < 3.5 * sessions.std(ddof=1) / 20
    assert sessions.std(ddof=1) / 20 < 0.005 * cauchy_cm(ARENAS[name])


@pytest.mark.parametrize("exponent", [-0.5, 0.0, 1.0, 3.0])
def test_the_angle_in_a_disc_follows_its_density(exponent):
    """A chord is 2R cos(phi) long: its distribution is that of the angle, by numerical integration."""
    lengths = roll(DISC, 60, 100, np.random.default_rng(2), exponent=exponent).length_cm.ravel()
    phi = np.linspace(0, math.pi / 2, 200_001)
    middle = (phi[1:] + phi[:-1]) / 2
    share = np.concatenate([[0.0], np.cumsum(np.cos(middle) ** exponent)])
    share /= share[-1]
    angles = np.arccos(np.clip(lengths / (2 * RADIUS_CM), 0, 1))
    assert kstest(np.interp(angles, phi, share), "uniform").pvalue > 0.01


def test_rolls_lie_on_their_lines_and_follow_each_other():
    rolls = roll(RECTANGLE, 3, 40, np.random.default_rng(3))
    for theta, p, length in zip(rolls.theta_rad[0], rolls.p_cm[0], rolls.length_cm[0], strict=True):
        x, y, dx, dy = p * math.cos(theta), p * math.sin(theta), 200 * math.sin(theta), -200 * math.cos(theta)
        chord = RECTANGLE.intersection(LineString([(x - dx, y - dy), (x + dx, y + dy)]))
        assert chord.length == pytest.approx(length, abs=1e-6)


@pytest.mark.parametrize("name", ARENAS)
def test_hit_and_run_lines_come_by_their_length(name):
    """Weighted by 1/length they have Cauchy's mean: 1/<1/length>, over runs that are not of almost no length."""
    rolls = hit_and_run(ARENAS[name], 300, 200, np.random.default_rng(4))
    p, length = rolls.p_cm.ravel(), rolls.length_cm.ravel()
    if name == "disc":
        # density of |p| ∝ 2 sqrt(R² − p²)
        share = np.abs(p) / RADIUS_CM
        share = 2 / math.pi * (np.arcsin(np.minimum(share, 1)) + share * np.sqrt(np.maximum(1 - share**2, 0)))
        assert kstest(share[::10], "uniform").pvalue > 0.01
    sessions = (1 / np.maximum(rolls.length_cm, 0.5)).mean(axis=1)
    assert 1 / sessions.mean() == pytest.approx(cauchy_cm(ARENAS[name]), rel=0.02)
    assert length.mean() > 1.05 * cauchy_cm(ARENAS[name])


@pytest.mark.parametrize(
    "bad", [Polygon(), Point(0, 0).buffer(9).difference(Point(0, 0).buffer(2)), TOWER], ids=["empty", "hole", "hollow"]
)
def test_an_arena_is_one_convex_polygon(bad):
    with pytest.raises(ArenaError, match="convex"):
        roll(bad, 1, 1, np.random.default_rng(0))


@pytest.mark.parametrize("exponent", [-1.0, math.nan, math.inf])
def test_exponents_that_are_none(exponent):
    with pytest.raises(RequestError, match="above −1"):
        roll(RECTANGLE, 1, 1, np.random.default_rng(0), exponent=exponent)


# --- run lengths


def test_right_and_wrong_turns_of_another_billiard(tables):
    rng = np.random.default_rng(5)
    right = examine_runs(own_billiard(lambert, 150, 1), RECTANGLE, rng, table=tables["rectangle"])
    assert right.passed
    assert right.p_value > 0.05
    assert right.exponent_low < 1 < right.exponent_high
    assert right.expected_cm == pytest.approx(cauchy_cm(RECTANGLE))
    assert "No fault found" in right.verdict
    wrong = examine_runs(own_billiard(even, 150, 1), RECTANGLE, rng, table=tables["rectangle"])
    assert not wrong.passed
    assert wrong.exponent_low < 0.15
    assert wrong.exponent_high < 1
    assert "not to turn by Lambert" in wrong.verdict
    assert right.mean_cm > wrong.mean_cm


def test_a_long_session_pins_the_exponent_down():
    lengths = own_billiard(even, 3000, 2)
    seen = examine_runs(lengths, RECTANGLE, np.random.default_rng(6))
    assert seen.p_value < 0.002
    assert seen.exponent == pytest.approx(0.0, abs=0.15)
    assert seen.exponent_high - seen.exponent_low < 0.4
    assert seen.exponent_low < 0 < seen.exponent_high


def test_a_wrong_scale_is_no_wrong_turn(tables):
    lengths = 0.8 * np.minimum(own_billiard(lambert, 150, 3), 80.0)
    seen = examine_runs(lengths, RECTANGLE, np.random.default_rng(7), table=tables["rectangle"])
    assert not seen.passed
    assert seen.mean_p < 0.05


@pytest.mark.parametrize("scale", [0.99, 1.0, 1.01])
def test_a_scale_that_is_off_a_little_is_no_wrong_turn(scale, tables):
    """Runs straight across pile up at the height of a rectangle: all of them move together, and mean nothing."""
    rng = np.random.default_rng(14)
    sessions = [scale * own_billiard(lambert, 150, seed) for seed in range(100, 160)]
    seen = [examine_runs(lengths, RECTANGLE, rng, table=tables["rectangle"]) for lengths in sessions]
    assert 0.7 < np.median([one.exponent for one in seen]) < 1.4
    assert np.mean([one.passed for one in seen]) > 0.85


def test_interior_stops():
    rng = np.random.default_rng(8)
    table = tabulate_runs(RECTANGLE, 200, rng, length_weighted=True, sessions=499)
    sessions = hit_and_run(RECTANGLE, 200, 200, rng).length_cm
    seen = [examine_runs(row, RECTANGLE, rng, length_weighted=True, table=table) for row in sessions]
    assert np.mean([one.passed for one in seen]) > 0.88
    assert math.isnan(seen[0].exponent)
    assert math.isnan(seen[0].law_p)
    assert "cos" not in seen[0].verdict
    assert not examine_runs(own_billiard(lambert, 200, 1), RECTANGLE, rng, length_weighted=True, table=table).passed
    # The mean of a line drawn by its length is <l²>/<l> of uniform isotropic ones.
    lines = own_billiard(lambert, 40_000, 4)
    assert table.expected_cm == pytest.approx(np.mean(lines**2) / np.mean(lines), rel=0.01)


def test_requests_that_cannot_be_examined(tables):
    rng = np.random.default_rng(9)
    with pytest.raises(RequestError, match="9 edge-to-edge runs are too few"):
        examine_runs([*range(1, 10), math.nan], RECTANGLE, rng)
    lengths = own_billiard(lambert, 150, 1)
    for wrong in (lengths[:100], lengths):
        with pytest.raises(RequestError, match="tabulate again"):
            examine_runs(wrong, RECTANGLE if len(wrong) == 100 else DISC, rng, table=tables["rectangle"])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "power"), [("rectangle", 0.7), ("disc", 0.99)])
def test_false_alarms_and_power_at_150_runs(name, power, tables):
    """2000 right sessions: 5 ± 1.5 % are suspected, 95 ± 1.5 % of the intervals hold 1. 300 uniform ones are caught.

    Their lengths are off by 1 % from session to session, as the table supposes.
    """
    rng = np.random.default_rng(10)
    table = tabulate_runs(ARENAS[name], 150, rng)

    def seen(exponent, sessions):
        rows = roll(ARENAS[name], sessions, 150, rng, exponent=exponent).length_cm
        rows *= rng.normal(1.0, 0.01, (sessions, 1))
        return [examine_runs(row, ARENAS[name], rng, table=table) for row in rows]

    right = seen(1.0, 2000)
    assert np.mean([not one.passed for one in right]) == pytest.approx(0.05, abs=0.015)
    for name_p in ("mean_p", "distribution_p", "law_p"):
        assert np.mean([getattr(one, name_p) < 0.05 for one in right]) == pytest.approx(0.05, abs=0.015)
    assert np.mean([one.exponent_low <= 1 <= one.exponent_high for one in right]) == pytest.approx(0.95, abs=0.02)
    assert np.median([one.exponent for one in right]) == pytest.approx(1.0, abs=0.06)
    wrong = seen(0.0, 300)
    assert np.mean([not one.passed for one in wrong]) > power
    assert np.mean([one.exponent_low <= 0 <= one.exponent_high for one in wrong]) == pytest.approx(0.95, abs=0.04)


# --- the bias to expect


@pytest.mark.parametrize("name", ARENAS)
def test_lambert_has_no_bias(name):
    bias = expected_bias(TOWER, ARENAS[name], 1.0, np.random.default_rng(11), runs=800_000)
    assert abs(bias.area_rel) < 3.5 * bias.sigma_area_rel < 0.03
    assert abs(bias.perimeter_rel) < 3.5 * bias.sigma_perimeter_rel < 0.03


def test_uniform_turning_measures_a_tower_in_a_rectangle_too_small():
    bias = expected_bias(TOWER, RECTANGLE, 0.0, np.random.default_rng(12), runs=800_000)
    assert bias.area_rel == pytest.approx(-0.14, abs=0.025)
    assert bias.perimeter_rel == pytest.approx(-0.10, abs=0.02)
    assert bias.sigma_area_rel < 0.01
    assert "area by -14" in bias.verdict


@pytest.mark.parametrize("radius_cm", [20.0, 40.0])
def test_a_disc_in_a_disc_has_a_closed_bias(radius_cm):
    """Uniform angles in a disc arena give p the density 1/(π sqrt(R² − p²)); integrate the chords of a small disc."""
    arena = Point(0, 0).buffer(50, quad_segs=180)
    p = (np.arange(100_000) + 0.5) / 100_000 * radius_cm
    chord = 2 * np.sqrt(radius_cm**2 - p**2)
    density = 1 / np.sqrt(50**2 - p**2)
    area = math.pi / 3 * np.sum(density * chord**3) / np.sum(density * chord) / (math.pi * radius_cm**2)
    perimeter = (
        math.pi * area * math.pi * radius_cm**2 * np.sum(density) / np.sum(density * chord) / (2 * math.pi * radius_cm)
    )
    assert -0.10 < area - 1 < -0.005
    bias = expected_bias(
        Point(0, 0).buffer(radius_cm, quad_segs=90), arena, 0.0, np.random.default_rng(13), runs=800_000
    )
    assert bias.area_rel == pytest.approx(area - 1, abs=4 * bias.sigma_area_rel + 1e-3)
    assert bias.perimeter_rel == pytest.approx(perimeter - 1, abs=4 * bias.sigma_perimeter_rel + 1e-3)


def test_a_shape_outside_the_arena_has_no_bias_to_expect():
    rng = np.random.default_rng(14)
    with pytest.raises(RequestError, match="reaches out"):
        expected_bias(box(50, 0, 70, 10), RECTANGLE, 1.0, rng)
    with pytest.raises(RequestError, match="too seldom"):
        expected_bias(Point(0, 0).buffer(0.5), RECTANGLE, 1.0, rng, runs=1000)
    with pytest.raises(RequestError, match="above −1"):
        expected_bias(TOWER, RECTANGLE, -2.0, rng)


# --- the known arena


def crossed(rolls, centre=(8.0, -5.0), outer_cm=25.0, inner_cm=12.0):
    """(k, L1, L3) of an annulus on every line, in closed form: L3 by its definition on the four crossings."""
    p = rolls.p_cm - centre[0] * np.cos(rolls.theta_rad) - centre[1] * np.sin(rolls.theta_rad)
    a = np.sqrt(np.maximum(outer_cm**2 - p**2, 0))
    b = np.sqrt(np.maximum(inner_cm**2 - p**2, 0))
    # Crossings at -a, -b, b, a: in, out, in, out.
    l3 = 2 * (a - b) ** 3 + (2 * a) ** 3 + (2 * b) ** 3 - 2 * (a + b) ** 3
    return (a > 0).astype(float) + (b > 0), 2 * (a - b), l3


ANNULUS_AREA_CM2 = math.pi * (25**2 - 12**2)
ANNULUS_PERIMETER_CM = 2 * math.pi * (25 + 12)


@pytest.mark.parametrize("name", ARENAS)
def test_the_arena_gives_the_same_size(name):
    rolls = roll(ARENAS[name], 1, 40_000, np.random.default_rng(15))
    seen = arena_consistency(*(values[0] for values in crossed(rolls)), rolls.length_cm[0], ARENAS[name])
    assert seen.area_cm2 == pytest.approx(ANNULUS_AREA_CM2, rel=0.03)
    assert seen.perimeter_cm == pytest.approx(ANNULUS_PERIMETER_CM, rel=0.03)
    assert abs(seen.area_ratio - 1) < 4 * seen.sigma_area_ratio < 0.1
    assert abs(seen.perimeter_ratio - 1) < 4 * seen.sigma_perimeter_ratio < 0.1
    assert "agree" in seen.verdict


def test_the_wrong_arena_or_the_wrong_turns_are_noticed():
    rng = np.random.default_rng(16)
    rolls = roll(RECTANGLE, 1, 3000, rng)
    values = [value[0] for value in crossed(rolls)]
    larger = arena_consistency(*values, rolls.length_cm[0], RECTANGLE.buffer(8, join_style="mitre"))
    assert larger.perimeter_ratio > 1.05
    assert not larger.passed
    assert "disagree" in larger.verdict
    rolls = roll(RECTANGLE, 1, 3000, rng, exponent=0.0)
    assert not arena_consistency(*(value[0] for value in crossed(rolls)), rolls.length_cm[0], RECTANGLE).passed


def test_weights_make_interior_stops_agree():
    rolls = hit_and_run(DISC, 1, 20_000, np.random.default_rng(17))
    values = [value[0] for value in crossed(rolls)]
    weights = 1 / np.maximum(rolls.length_cm[0], 0.5)
    seen = arena_consistency(*values, rolls.length_cm[0], DISC, weights=weights)
    assert seen.passed
    assert seen.area_cm2 == pytest.approx(ANNULUS_AREA_CM2, rel=0.05)
    assert not arena_consistency(*values, rolls.length_cm[0], DISC).passed


def test_requests_that_cannot_be_compared():
    ones = np.ones(60)
    with pytest.raises(RequestError, match="40 runs are too few"):
        arena_consistency(*[ones[:40]] * 4, RECTANGLE)
    with pytest.raises(RequestError, match="one value for each run"):
        arena_consistency(ones, ones, ones, ones[:50], RECTANGLE)
    with pytest.raises(RequestError, match="finite"):
        arena_consistency(ones, ones, math.nan * ones, ones, RECTANGLE)
    with pytest.raises(RequestError, match="hardly a run"):
        arena_consistency(0 * ones, 0 * ones, 0 * ones, ones, RECTANGLE)


@pytest.mark.slow
@pytest.mark.parametrize("name", ARENAS)
def test_false_alarms_of_the_arena(name):
    """1500 right sessions of 300 runs: the chance of a false alarm is 5 ± 2 %."""
    rolls = roll(ARENAS[name], 1500, 300, np.random.default_rng(18))
    values = crossed(rolls)
    seen = [
        arena_consistency(*(value[row] for value in values), rolls.length_cm[row], ARENAS[name]) for row in range(1500)
    ]
    assert np.mean([one.area_p < 0.05 for one in seen]) == pytest.approx(0.05, abs=0.02)
    assert np.mean([one.perimeter_p < 0.05 for one in seen]) == pytest.approx(0.05, abs=0.02)
    assert np.mean([not one.passed for one in seen]) < 0.07
