"""Lines on the unit square, the statistics, and how often perfect and faulty sessions are rejected."""

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from shapely import LineString, MultiPoint, Point, Polygon, box

from lab.base.errors import RequestError
from tests.tracking.rolled_lines import (
    ARENA,
    DISC,
    OBLIQUE,
    billiard,
    chained,
    disc,
    ends_of,
    lines_through,
    place,
    rates,
    sums_of,
    thrown,
    thrown_at_arena,
    thrown_at_disc,
)
from tracking.isotropy import TooFewLinesError, examine_lines, tabulate
from tracking.linespace import LineSpace, RegionError, Wall, corners, roll, support, uniforms
from tracking.nulltable import Sums
from tracking.uniformity import cramer_von_mises, holm, neyman, rayleigh, smooth_means


@pytest.fixture(scope="module")
def null():
    return tabulate(ARENA, 200, np.random.default_rng(11), sessions=3999)


@pytest.fixture(scope="module")
def null_afresh():
    return tabulate(ARENA, 200, np.random.default_rng(12), sessions=3999, successive=False)


# --- the space of lines


def test_corners_are_counter_clockwise_whatever_the_input():
    for ring in (box(0, 0, 2, 1), box(0, 0, 2, 1).reverse()):
        points = corners(ring)
        assert len(points) == 4
        assert Polygon(points).exterior.is_ccw


@pytest.mark.parametrize(
    "region",
    [
        Polygon(),
        Polygon([(0, 0), (4, 0), (4, 1), (1, 1), (1, 4), (0, 4)]),
        Point(0, 0).buffer(5).difference(Point(0, 0).buffer(1)),
    ],
)
def test_only_convex_regions(region):
    with pytest.raises(RegionError, match="convex"):
        uniforms(0.3, 0.0, region)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(-60, 60), st.integers(-60, 60)), min_size=4, max_size=12, unique=True))
def test_shares_of_directions_are_integrals_of_the_width(points):
    region = MultiPoint(points).convex_hull
    if region.geom_type != "Polygon" or region.area < 1:
        return
    grid = np.linspace(0, np.pi, 20001)
    width = support(grid, region) + support(grid + np.pi, region)
    integral = np.concatenate([[0], np.cumsum((width[1:] + width[:-1]) / 2 * np.diff(grid))])
    space = LineSpace.of(region)
    assert space.perimeter_cm == pytest.approx(region.length, rel=1e-12)
    u, v = space.uniforms(grid[:-1], support(grid[:-1], region))
    np.testing.assert_allclose(u, integral[:-1] / integral[-1], atol=1e-6)
    np.testing.assert_allclose(v, 1.0, atol=1e-9)
    for share in (0.0, 0.31, 0.77, 1.0):
        assert np.interp(space.direction(share), grid, integral / integral[-1]) == pytest.approx(share, abs=1e-4)


def test_either_normal_is_the_same_line():
    theta, p = np.array([0.2, 1.4, 3.0]), np.array([5.0, -8.0, 1.0])
    for turns in (-1, 1, 2):
        u, v = uniforms(theta + turns * np.pi, p * (-1.0) ** turns, OBLIQUE)
        np.testing.assert_allclose([u, v], uniforms(theta, p, OBLIQUE), atol=1e-12)


def test_isotropic_lines_are_uniform_on_the_square():
    theta, p, _ = thrown(OBLIQUE, 20000, np.random.default_rng(1))
    u, v = uniforms(theta, p, OBLIQUE)
    assert stats.kstest(u, "uniform").pvalue > 0.01
    assert stats.kstest(v, "uniform").pvalue > 0.01
    assert abs(np.corrcoef(u, v)[0, 1]) < 0.02
    assert stats.kstest(theta / np.pi, "uniform").pvalue < 1e-3


def test_ends_of_lines_on_the_wall():
    for region in (ARENA, OBLIQUE, DISC):
        rolls = roll(region, 1, 200, np.random.default_rng(2))
        found = Wall.of(region).ends_cm(rolls.theta_rad[0], rolls.p_cm[0])
        np.testing.assert_allclose(
            np.sort(found, axis=1), np.sort(np.column_stack([rolls.start_cm[0], rolls.end_cm[0]]), axis=1), atol=1e-6
        )


# --- the rolls


@pytest.mark.parametrize("region", [ARENA, OBLIQUE, Point(0, 0).buffer(50, quad_segs=90)])
def test_rolls_are_chords_of_the_region_and_join_on_its_wall(region):
    rolls = roll(region, 3, 60, np.random.default_rng(3))
    for theta, p, length in zip(rolls.theta_rad, rolls.p_cm, rolls.length_cm, strict=True):
        normal = np.column_stack([np.cos(theta), np.sin(theta)])
        along = np.column_stack([-np.sin(theta), np.cos(theta)]) * 500
        whole = [LineString([q * m - a, q * m + a]) for q, m, a in zip(p, normal, along, strict=True)]
        np.testing.assert_allclose([region.intersection(chord).length for chord in whole], length, atol=1e-6)
        for one, other in pairwise(whole):
            assert region.exterior.distance(one.intersection(other)) < 1e-6


def test_mean_run_is_pi_area_over_perimeter():
    for successive in (True, False):
        rolls = roll(OBLIQUE, 500, 200, np.random.default_rng(4), successive=successive)
        assert rolls.length_cm.mean() == pytest.approx(np.pi * OBLIQUE.area / OBLIQUE.length, rel=0.01)


def test_rolls_follow_the_law_of_an_independent_billiard():
    mine = roll(ARENA, 400, 50, np.random.default_rng(5))
    theirs = billiard(120, 90, 400, 50, np.random.default_rng(6))
    for a, b in zip((mine.theta_rad, mine.p_cm, mine.length_cm), theirs, strict=True):
        assert stats.ks_2samp(a[:, -1], b[:, -1]).pvalue > 0.01
    # and so does what joins neighbours: the share of short runs after short runs
    follow = [np.mean((x[:, 1:] < 40) & (x[:, :-1] < 40)) for x in (mine.length_cm, theirs[2])]
    assert follow[0] == pytest.approx(follow[1], abs=0.01)


# --- false alarms and power


def test_false_alarms_of_perfect_sessions(null):
    theta, p, length = billiard(120, 90, 1000, 200, np.random.default_rng(20))
    for name, rate in rates(null, sums_of(null, theta, p, length, ends_of(theta, p, ARENA))).items():
        assert 0.03 < rate < 0.075, name
    rng = np.random.default_rng(21)
    reports = [examine_lines(*rows, ARENA, rng, null=null) for rows in zip(theta[:200], p[:200], length, strict=False)]
    assert np.mean([not report.passed for report in reports]) < 0.09
    assert np.mean([report.run_length_p < 0.05 for report in reports]) < 0.09
    assert np.mean([report.bias_low > 0 for report in reports]) < 0.07


# the proof in full; the normal run takes a tenth of the sessions
FULL_SESSIONS = 20000


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("lines", [100, 200, 500])
@pytest.mark.parametrize("arena", ["rectangle", "disc"])
@pytest.mark.parametrize("successive", [True, False], ids=["chains", "lines"])
def test_false_alarms_are_five_percent(arena, lines, successive, full):
    """2000 sessions of 200 lines; of the other numbers a quarter of that, but for a run with --full."""
    sessions = FULL_SESSIONS if full else 2000 if lines == 200 else 500
    region = ARENA if arena == "rectangle" else DISC
    rng = np.random.default_rng(30)
    simulated = 5000 if full or lines == 200 else 2000
    table = tabulate(region, lines, rng, sessions=simulated, successive=successive)
    if successive:
        theta, p, length = (
            billiard(120, 90, sessions, lines, rng) if arena == "rectangle" else disc(sessions, lines, rng)
        )
        at = ends_of(theta, p, region)
    else:
        throw = thrown_at_arena if arena == "rectangle" else thrown_at_disc
        theta, p, length = (a.reshape(sessions, lines) for a in throw(sessions * lines, rng))
        at = None
    # 0.01, and twice the error of a rate from so many sessions and that of the table's own quantile
    slack = 0.01 + 2 * np.sqrt(0.05 * 0.95 * (1 / sessions + 1 / simulated)) * (not full)
    for name, rate in rates(table, sums_of(table, theta, p, length, at)).items():
        assert abs(rate - 0.05) < slack, name


def test_tests_for_independent_lines_would_condemn_perfect_sessions():
    """The reason for the simulated null: runs that share an end point are not independent."""
    theta, p, _ = billiard(120, 90, 600, 200, np.random.default_rng(22))
    u, v = uniforms(theta, p, ARENA)
    assert np.mean(neyman(smooth_means(u, v), 200 * np.eye(14)) > stats.chi2(14).isf(0.05)) > 0.2


def test_raw_angles_condemn_perfect_lines():
    theta, p, _ = billiard(150, 100, 500, 500, np.random.default_rng(23))
    raw = rayleigh(theta / np.pi)
    assert 0.35 < np.mean(raw > stats.chi2(2).isf(0.05)) < 0.65
    mapped = rayleigh(uniforms(theta, p, box(-75, -50, 75, 50))[0])
    assert np.mean(mapped > stats.chi2(2).isf(0.05)) < 0.13


FAULTS = {
    "axis": (lambda u, v: 1 + 0.25 * np.cos(2 * np.pi * u), 1.25),
    "oblique axis": (lambda u, v: 1 + 0.25 * np.cos(2 * np.pi * (u - 0.3)), 1.25),
    "four arms": (lambda u, v: 1 + 0.3 * np.cos(4 * np.pi * u), 1.3),
    "centre": (lambda u, v: 1 - 0.3 * np.cos(2 * np.pi * v), 1.3),
}


@pytest.mark.parametrize(
    ("fault", "least"),
    [
        ("axis", {"rayleigh": 0.54, "hermans_rasson": 0.42, "neyman": 0.23}),
        ("oblique axis", {"rayleigh": 0.54, "hermans_rasson": 0.42, "neyman": 0.23}),
        ("four arms", {"hermans_rasson": 0.60, "neyman": 0.41}),
        ("centre", {"cramer_von_mises": 0.24, "neyman": 0.36}),
    ],
)
def test_power_over_independent_lines(null_afresh, fault, least):
    density, peak = FAULTS[fault]
    u, v = place(density, peak, 1000, 200, np.random.default_rng(24))
    sums = Sums.of(u, v, np.full(u.shape, 80.0), null_afresh.ends.total(np.zeros((1000, 1)), np.zeros((1000, 1), bool)))
    found = rates(null_afresh, sums)
    assert {name: found[name] for name, power in least.items() if found[name] < power} == {}


@pytest.mark.parametrize(
    ("fault", "least"),
    [
        ("axis", {"rayleigh": 0.45, "hermans_rasson": 0.36, "neyman": 0.23}),
        ("oblique axis", {"rayleigh": 0.54, "hermans_rasson": 0.42, "neyman": 0.28}),
        ("four arms", {"hermans_rasson": 0.60, "neyman": 0.46}),
        ("centre", {"cramer_von_mises": 0.25, "neyman": 0.34}),
    ],
)
def test_power_over_chains(null, fault, least):
    theta, p, length, at = chained(ARENA, *FAULTS[fault], 1000, 200, np.random.default_rng(25))
    found = rates(null, sums_of(null, theta, p, length, at))
    assert {name: found[name] for name, power in least.items() if found[name] < power} == {}


def test_shared_ends_hide_faults_of_place_from_plain_means(null):
    """Means from which the common part of shared ends is taken find twice as many pulls to the centre."""
    theta, p, length, at = chained(ARENA, *FAULTS["centre"], 600, 200, np.random.default_rng(28))
    freed = rates(null, sums_of(null, theta, p, length, at))["cramer_von_mises"]
    v = uniforms(theta, p, ARENA)[1]
    perfect = roll(ARENA, 2000, 200, np.random.default_rng(29))
    bound = np.quantile(cramer_von_mises(uniforms(perfect.theta_rad, perfect.p_cm, ARENA)[1]), 0.95)
    assert freed > 1.6 * np.mean(cramer_von_mises(np.clip(v, 0, 1)) > bound)


def test_power_against_a_uniform_angle_at_the_wall(null):
    rng = np.random.default_rng(26)
    theta, p, length = billiard(120, 90, 500, 200, rng, uniform_angle=True)
    found = rates(null, sums_of(null, theta, p, length, ends_of(theta, p, ARENA)))
    assert found["neyman"] > 0.92
    assert found["cramer_von_mises"] > 0.56


def test_power_against_waypoints(null):
    rng = np.random.default_rng(27)
    points = np.stack([rng.uniform(-60, 60, (50, 201)), rng.uniform(-45, 45, (50, 201))], axis=-1)
    theta, p, length = lines_through(points)
    reports = [examine_lines(*row, ARENA, rng, null=null) for row in zip(theta, p, length, strict=True)]
    assert not any(report.passed for report in reports)
    assert max(report.homogeneity_p for report in reports) < 0.01
    assert np.mean([report.isotropy_p < 0.05 for report in reports]) > 0.9
    assert "not isotropic and homogeneous" in reports[0].verdict
    assert "cut short" in reports[0].verdict


# --- the report


def test_report_of_a_perfect_session(null):
    theta, p, length = (a[0] for a in billiard(120, 90, 1, 200, np.random.default_rng(40)))
    report = examine_lines(theta, p, length, ARENA, np.random.default_rng(41), null=null)
    assert report.passed
    assert report.family_p >= 0.05
    assert report.lines == 200
    assert report.outside == 0
    assert report.predicted_run_cm == pytest.approx(np.pi * 120 * 90 / 420)
    assert report.mean_run_cm == pytest.approx(length.mean())
    assert 0.35 < report.smallest_bias < 0.45
    assert report.linked == 199
    assert report.bias_low <= report.bias <= report.bias_high
    assert [test.name for test in report.tests] == ["rayleigh", "hermans_rasson", "cramer_von_mises", "neyman"]
    assert [t.holm_p_value for t in report.tests] == pytest.approx(holm([t.p_value for t in report.tests]))
    assert report.joint_p == report.tests[3].p_value
    assert report.verdict.startswith("No fault found in 200 lines")
    fields = json.loads(json.dumps(report.to_dict()))
    assert fields["tests"][0]["name"] == "rayleigh"
    assert fields["passed"] is True


def test_report_names_the_favoured_direction_of_travel():
    rng = np.random.default_rng(42)
    region = Point(0, 0).buffer(50, quad_segs=40)
    travel = rng.vonmises(2 * 0.6, 1.0, 300) / 2
    theta, p = np.mod(travel + np.pi / 2, np.pi), rng.uniform(-50, 50, 300)
    length = 2 * np.sqrt(2500 - p**2)
    report = examine_lines(theta, p, length, region, rng, successive=False)
    assert not report.passed
    assert report.isotropy_p < 0.01
    assert report.favoured_rad == pytest.approx(0.6, abs=0.15)
    # of von Mises angles R = I1(1)/I0(1)
    assert report.bias_low < 2 * 0.4464 < report.bias_high
    assert report.bias_low > 0.4
    assert "Travel near 3" in report.verdict


def test_unusable_lines_are_counted():
    rng = np.random.default_rng(43)
    theta, p, length = (a[0] for a in billiard(120, 90, 1, 40, rng))
    theta[3] = np.nan
    p[7] = 300.0
    report = examine_lines(theta, p, length, ARENA, rng)
    assert report.lines == 39
    assert report.skipped == 1
    assert report.outside == 1
    # it counts as a line along the rim, not as one three arenas away
    assert report.joint_p > 0.01


def test_runs_the_camera_cannot_see_are_no_fault():
    """Runs below 12 cm hug the corners; leaving them out here and in the null keeps the level."""
    rng = np.random.default_rng(44)
    theta, p, length = billiard(120, 90, 150, 260, rng)
    table = tabulate(ARENA, 200, rng, sessions=1999, shortest_cm=12.0)
    reports = []
    for row in zip(theta, p, length, strict=True):
        kept = row[2] >= 12.0
        reports.append(examine_lines(*(a[kept][:200] for a in row), ARENA, rng, null=table, shortest_cm=12.0))
    assert np.mean([not report.passed for report in reports]) < 0.11
    assert reports[0].predicted_run_cm > np.pi * 120 * 90 / 420 + 2
    assert np.mean([report.run_length_p < 0.05 for report in reports]) < 0.11


def test_requests_that_cannot_be_met(null):
    rng = np.random.default_rng(45)
    few = np.linspace(0.1, 3, 9)
    with pytest.raises(TooFewLinesError, match="9 usable lines") as caught:
        examine_lines(few, few, few, ARENA, rng)
    assert (caught.value.lines, caught.value.needed) == (9, 10)
    with pytest.raises(RequestError, match="differ in length"):
        examine_lines(few, few[:-1], few, ARENA, rng)
    many = np.linspace(0.1, 3, 50)
    with pytest.raises(RequestError, match="tabulate again"):
        examine_lines(many, many, many, ARENA, rng, null=null)
    with pytest.raises(RequestError, match="hardly occur"):
        tabulate(ARENA, 20, rng, sessions=20, shortest_cm=500.0)


def test_same_generator_same_report():
    theta, p, length = (a[0] for a in billiard(120, 90, 1, 60, np.random.default_rng(46)))
    reports = [examine_lines(theta, p, length, ARENA, np.random.default_rng(5)) for _ in range(2)]
    assert reports[0] == reports[1]


def test_several_robots_each_roll_a_chain_of_their_own():
    rng = np.random.default_rng(47)
    two = [a.T.ravel() for a in billiard(120, 90, 2, 60, rng)]
    names = np.tile(["a", "b"], 60)
    mixed = examine_lines(*two, ARENA, np.random.default_rng(5), chain=names)
    assert mixed.linked == 118
    parted = [np.concatenate([a[names == name] for name in "ab"]) for a in two]
    assert examine_lines(*parted, ARENA, np.random.default_rng(5), chain=np.sort(names)) == mixed
    # what the shared ends explain is lost where the chains are not told apart
    assert examine_lines(*two, ARENA, np.random.default_rng(5)).linked < 30


def test_a_lost_run_breaks_the_chain():
    rng = np.random.default_rng(48)
    theta, p, length = (a[0] for a in billiard(120, 90, 1, 81, rng))
    theta[40] = np.nan
    report = examine_lines(theta, p, length, ARENA, rng)
    assert (report.lines, report.skipped) == (80, 1)
    assert report.linked in (78, 79)  # the runs either side may end near each other by chance
    assert examine_lines(theta, p, length, ARENA, rng, successive=False).linked == 0


def test_links_survive_the_cameras_errors():
    rng = np.random.default_rng(49)
    theta, p, length = (a[0] for a in billiard(120, 90, 1, 150, rng))
    noisy = theta + rng.normal(0, 0.003, 150), p + rng.normal(0, 0.15, 150), length
    assert examine_lines(*noisy, ARENA, rng).linked >= 147
