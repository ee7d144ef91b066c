"""The budget's arithmetic, its replay of given lines, what it reads off crossings and ramps: against closed forms."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely import MultiPolygon, Point, Polygon, box

from analysis.budget import (
    CAUSES,
    Expected,
    Fitted,
    Stage,
    budget_of,
    groups_of,
    predicted_budget,
)
from analysis.edgeshift import RAMP_PER_RADIUS, Outline, Ramps, fit_edge_shift, ramp_of_line
from analysis.estimate import ratio_bias
from analysis.invariants import sizes
from analysis.quadrature import exact_moments
from analysis.replay import Passes, sensed_sums, true_sums
from analysis.sensor import SensorModel
from lab.base.errors import RequestError
from lab.base.jackknife import jackknife_sigma

L_SHAPE = Polygon([(0, 0), (24, 0), (24, 10), (12, 10), (12, 24), (0, 24)])
ANNULUS = Point(3, 1).buffer(15, quad_segs=64).difference(Point(3, 1).buffer(7, quad_segs=64))
SESSIONS = 400  # the proof in full: 4000
PIECES = MultiPolygon([box(-20, -8, -6, 8), box(4, -10, 18, 3)])


def chain(rng, lines=90, stages=5, anisotropy=None):
    """A made-up chain: every stage changes the lines a little."""
    sums = np.abs(rng.normal([1.2, 20, 9000], [0.3, 5, 3000], (lines, 3)))
    names = ("image", "footprint", "sampling", "latency", "rest", "speed")
    made = []
    for name in names[: stages + 1]:
        made.append(Stage(name, sums, name, np.zeros((1, 3))))
        sums = sums * (1 + 0.01 * rng.standard_normal(3)) * (1 + 0.02 * rng.standard_normal((lines, 1)))
    group, groups = groups_of(np.ones(lines, dtype=bool))
    fitted = Fitted(np.array([0.01]), 0.01 + 0.001 * rng.standard_normal((groups, 1)))
    truth = np.array([480.0, 90.0])
    chance = Expected(np.array([0.002, 0.001]), np.array([0.05, 0.04]), "chance")
    return truth, made, group, groups, fitted, chance, anisotropy


@given(st.integers(0, 2**32), st.integers(10, 300), st.booleans())
def test_the_terms_add_up_to_what_was_seen(seed, lines, uneven):
    rng = np.random.default_rng(seed)
    anisotropy = Expected(np.array([-0.02, 0.01]), np.array([0.01, 0.01]), "") if uneven else None
    truth, stages, group, groups, fitted, chance, anisotropy = chain(rng, lines, anisotropy=anisotropy)
    every = stages[-1].sums * (1 + 0.1 * rng.random((lines, 1)))
    found = budget_of(truth, stages, every, group, groups, fitted, chance, anisotropy)
    seen = 100 * (sizes(every.sum(axis=0)) / truth - 1)
    for side, deviation in ((found.area, seen[0]), (found.perimeter, seen[1])):
        assert sum(term.percent for term in side.terms) == pytest.approx(deviation, abs=1e-9)
        assert side.seen_percent == pytest.approx(deviation, abs=1e-9)
        assert side.sum_percent == pytest.approx(deviation - side.of("rest").percent, abs=1e-9)
        assert ("anisotropy" in {term.term for term in side.terms}) == uneven


def test_predictions_and_the_remainder_add_up_too():
    causes = {"sampling": Expected(np.array([0.001, -0.02]), np.array([0.001, 0.002]), "")}
    chance = Expected(np.zeros(2), np.array([0.05, 0.05]), "")
    found = predicted_budget(np.array([0.03, 0.2]), causes, chance, 50)
    assert [term.percent for term in found.perimeter.terms] == pytest.approx([-2.0, 22.0])
    assert found.area.closes
    assert not found.perimeter.closes  # 22 % where chance makes 5 %
    assert found.perimeter.counting_sigmas == pytest.approx(0.22 / np.hypot(0.05, 0.002))
    assert not found.closes
    assert found.largest() == "sampling"
    assert found.to_dict()["seen_percent"] == pytest.approx({"area": 3.0, "perimeter": 20.0})


def test_a_cause_that_is_lost_in_its_error_is_not_named():
    chance = Expected(np.zeros(2), np.array([0.05, 0.05]), "")
    causes = {"footprint": Expected(np.array([0.03, 0.03]), np.array([0.02, 0.02]), "")}
    assert predicted_budget(np.array([0.03, 0.02]), causes, chance, 50).largest() is None


def test_groups_are_blocks_with_equally_many_crossing_lines():
    rng = np.random.default_rng(3)
    crossed = rng.random(500) < 0.4
    group, groups = groups_of(crossed)
    assert (np.diff(group) >= 0).all()
    counts = np.bincount(group[crossed], minlength=groups)
    assert np.ptp(counts) <= 1
    with pytest.raises(RequestError, match="9 crossing lines are too few"):
        groups_of(np.arange(40) < 9)


def test_the_jackknife_gives_the_error_of_a_mean():
    values = np.random.default_rng(1).normal(size=40)
    left = (values.sum() - values) / 39
    assert jackknife_sigma(left[:, None])[0] == pytest.approx(values.std(ddof=1) / np.sqrt(40))


# --- replay -----------------------------------------------------------------------------------------------------


def by_shapely(geometry, passes):
    """(k, L1, L3) of segments by intersection and the sum over pairs."""
    rows = []
    low_cm, high_cm = np.clip(passes.low_cm, -200, 200), np.clip(passes.high_cm, -200, 200)
    for theta, p, low, high in zip(passes.theta_rad, passes.p_cm, low_cm, high_cm, strict=True):
        normal, along = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
        cut = shapely.intersection(shapely.LineString([p * normal + low * along, p * normal + high * along]), geometry)
        parts = [part for part in shapely.get_parts(cut) if part.length > 0]
        s = np.sort(np.concatenate([np.asarray(part.coords) @ along for part in parts])) if parts else np.empty(0)
        sign = np.where(np.arange(len(s)) % 2 == 0, 1, -1)
        i, j = np.triu_indices(len(s), 1)
        l3 = -(sign[i] * sign[j] * np.abs(s[j] - s[i]) ** 3).sum()
        rows.append((len(s) / 2, sum(part.length for part in parts), l3))
    return np.array(rows)


@pytest.mark.parametrize("geometry", [L_SHAPE, ANNULUS, PIECES])
def test_given_lines_are_crossed_as_by_geometry(geometry):
    rng = np.random.default_rng(4)
    whole = Passes.thrown(geometry, 150, rng)
    assert true_sums(geometry, whole) == pytest.approx(by_shapely(geometry, whole), abs=1e-6)
    ends = np.sort(rng.uniform(-25, 25, (150, 2)), axis=1)
    cut = Passes(whole.theta_rad, whole.p_cm, ends[:, 0], ends[:, 1], np.zeros((150, 2), dtype=bool))
    assert true_sums(geometry, cut) == pytest.approx(by_shapely(geometry, cut), abs=1e-6)


def test_lines_that_robots_cut_short_weigh_pairs_by_the_path_per_cut():
    geometry, inside = box(-10, -10, 10, 10), np.array([[True, True]])
    one = Passes(np.array([0.0]), np.array([0.0]), np.array([-4.0]), np.array([30.0]), inside, 40.0)
    # in the light from its beginning: no pair of crossings, half a chord, 14 cm of light
    assert true_sums(geometry, one)[0] == pytest.approx([0.5, 14.0, 0.0])
    whole = Passes(np.array([0.0]), np.array([0.0]), np.array([-30.0]), np.array([30.0]), inside, 40.0)
    assert true_sums(geometry, whole)[0] == pytest.approx([1.0, 20.0, 8000 * np.exp(0.5)])
    model = SensorModel(0.02)
    rng = np.random.default_rng(1)
    assert sensed_sums(geometry, one, np.array([0.02]), model, rng)[0] == pytest.approx([0.5, 14.0, 0.0], abs=0.03)


def test_a_step_costs_area_and_chords_as_the_formulas_say():
    square, step = box(-14, -14, 14, 14), 1.5
    passes = Passes.thrown(square, 30_000, np.random.default_rng(5))
    model = SensorModel(step, footprint_cm=0.0, margin=0.01)
    read = sensed_sums(square, passes, np.full(len(passes), step), model, np.random.default_rng(6), phases=4)
    change = read.mean(axis=0) / true_sums(square, passes).mean(axis=0) - 1
    corners = step / 4 * 4  # Σ 1 + (π − α) cot α = 1 for each right angle, per perimeter
    assert change[0] == pytest.approx(-corners / 112, abs=0.0015)
    assert change[2] - change[1] == pytest.approx(np.pi * step**2 / 6 / 784, abs=4e-4)


def test_lateness_makes_every_chord_longer():
    square = box(-14, -14, 14, 14)
    passes = Passes.thrown(square, 2000, np.random.default_rng(5))
    steps, model = np.full(2000, 0.05), SensorModel(0.05)
    still = sensed_sums(square, passes, steps, model, np.random.default_rng(1), phases=1)
    late = sensed_sums(square, passes, steps, model, np.random.default_rng(1), late_cm=0.4, phases=1)
    assert late[:, 0] == pytest.approx(still[:, 0])
    assert late[:, 1] - still[:, 1] == pytest.approx(0.4 * still[:, 0])


# --- edges ------------------------------------------------------------------------------------------------------


def test_normals_point_out_of_the_shape_and_into_its_holes():
    outline = Outline.of(ANNULUS)
    angle = np.linspace(0, 2 * np.pi, 50)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    centre = np.array([3, 1])
    outer, inner = outline.normals_at(centre + 15 * ring), outline.normals_at(centre + 7 * ring)
    assert (outer * ring).sum(axis=1) == pytest.approx(1.0, abs=1e-3)
    assert (inner * ring).sum(axis=1) == pytest.approx(-1.0, abs=1e-3)
    assert np.isinf(outline.corner_distance_cm(centre + 15 * ring)).all()  # a circle's facets are no corners
    assert Outline.of(L_SHAPE).corner_distance_cm(np.array([[24.0, 5.0], [12.0, 10.5]])) == pytest.approx([5.0, 0.5])


def test_planted_shifts_are_told_apart():
    rng = np.random.default_rng(8)
    size, groups = 400, 20
    angle, heading = rng.uniform(0, 2 * np.pi, (2, size))
    normal, travel = (np.column_stack([np.cos(a), np.sin(a)]) for a in (angle, heading))
    place = rng.uniform(-20, 20, (size, 2))
    met = (normal * travel).sum(axis=1)
    eps, u, late, delay = -0.0238, np.array([0.4, -0.2]), 0.45, 0.7
    moved = eps * (place * normal).sum(axis=1) + normal @ u
    along = moved / met + np.sign(met) * late / 2 + delay + 0.05 * rng.standard_normal(size)
    along[:12] += 3.0  # crossings that belong to other edges
    found = fit_edge_shift(along, travel, normal, place, np.arange(size) * groups // size, groups)
    sigma = jackknife_sigma(found.replicates)
    assert (
        np.abs(found.values - [eps, *u, late]) == pytest.approx(0, abs=1)
        and (np.abs(found.values - [eps, *u, late]) < 4 * sigma).all()
    )
    assert sigma[0] < 0.001
    assert found.delay_cm == pytest.approx(delay, abs=0.03)
    assert fit_edge_shift(along[:15], travel[:15], normal[:15], place[:15], np.zeros(15, dtype=int), 1) is None


@pytest.mark.parametrize("radius", [0.3, 1.0])
def test_a_ramp_tells_the_footprint_whatever_the_phase_and_the_angle(radius):
    rng = np.random.default_rng(2)
    width, edges = np.zeros(300), np.zeros(300)
    for line in range(300):
        met, place = rng.uniform(0.55, 1.0), 20 + 0.3 * rng.standard_normal()
        s = np.arange(rng.uniform(0, 0.7), 40, 0.7)
        u = np.clip((s - 20) * met / radius, -1, 1)
        light = 0.5 + (u * np.sqrt(1 - u**2) + np.arcsin(u)) / np.pi + 0.02 * rng.standard_normal(len(s))
        width[line], edges[line] = ramp_of_line(s, light, np.array([place]), np.array([-met]), [True], 3.0)
    value, left = Ramps(width, edges).radius_cm(np.arange(300) // 15, 20)
    sigma = float(jackknife_sigma(left))
    assert abs(value - radius) < 4 * sigma
    assert sigma < 0.05


def test_the_ramps_constant_is_half_the_mean_distance_in_a_projected_disc():
    rng = np.random.default_rng(1)
    radius = np.sqrt(rng.random((2, 400_000)))
    x = radius * np.cos(2 * np.pi * rng.random((2, 400_000)))
    assert np.abs(x[0] - x[1]).mean() / 2 == pytest.approx(RAMP_PER_RADIUS, rel=0.005)


def test_the_order_of_the_causes_is_the_report_s():
    assert CAUSES == ("speed", "latency", "sampling", "footprint", "parallax", "anisotropy")


@pytest.mark.parametrize("geometry", [box(-14, -10, 14, 10), L_SHAPE])
def test_counting_is_as_large_as_chance_makes_it(geometry):
    """Sessions without any fault: the pulls are standard normal, the ratio's bias taken off."""
    rng = np.random.default_rng(11)
    moments = exact_moments(geometry)
    pulls = []
    for _ in range(SESSIONS):
        sums = true_sums(geometry, Passes.thrown(geometry, 300, rng))
        lines = int((sums[:, 0] > 0).sum())
        group, groups = groups_of(sums[:, 0] > 0)
        sigma = np.sqrt(np.diag(moments.relative) / lines)
        chance = Expected(ratio_bias(moments.mean, moments.covariance) / lines, sigma, "")
        stages = [Stage("image", sums, ""), Stage("rest", sums, "")]
        fitted = Fitted(np.zeros(1), np.zeros((groups, 1)))
        truth = np.array([geometry.area, geometry.length])
        found = budget_of(truth, stages, sums, group, groups, fitted, chance)
        pulls.append((found.area.counting_sigmas, found.perimeter.counting_sigmas))
    pulls = np.array(pulls)
    assert np.abs(pulls.mean(axis=0)) * np.sqrt(SESSIONS) == pytest.approx(0, abs=3.5)
    assert pulls.std(axis=0) == pytest.approx(1.0, abs=3.5 / np.sqrt(2 * SESSIONS))
    assert (np.abs(pulls) < 3).mean() > 0.985
