"""Turning policies in a numeric billiard: Lambert's law alone gives uniform isotropic lines."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import ks_1samp, kstest
from shapely import Point, Polygon, box
from shapely.affinity import scale
from shapely.geometry.polygon import orient

from lab.base.errors import RequestError
from robot.turning import (
    ANGLES,
    NOWHERE_CM,
    LegEnd,
    Policy,
    PolicyError,
    Weighting,
    check_weighting,
    line_weight,
    navigator_for,
    turn,
)

BALL_CM = 3.65
ARENAS = {
    "rectangle": box(-60, -45, 60, 45).buffer(-BALL_CM, join_style="mitre"),
    "disc": Point(0, 0).buffer(50, quad_segs=90).buffer(-BALL_CM, join_style="mitre"),
}
FRAME_OFFSET_RAD = 0.7  # arena angle of the robot's forward; the robot's headings run clockwise


def roll(reachable, policy, runs, rng):
    """Lengths and (theta, p) of successive runs of a point billiard in a convex polygon."""
    corners = np.array(orient(reachable).exterior.coords)  # anticlockwise
    edges = np.diff(corners, axis=0)
    inward = np.column_stack([-edges[:, 1], edges[:, 0]]) / np.hypot(*edges.T)[:, None]
    side = 0
    x = (corners[0] + corners[1]) / 2
    length_cm, theta_rad, p_cm = np.empty(runs), np.empty(runs), np.empty(runs)
    for run in range(runs):
        normal_heading = FRAME_OFFSET_RAD - math.atan2(inward[side, 1], inward[side, 0])
        alpha = FRAME_OFFSET_RAD - turn(policy, normal_heading, rng)
        direction = np.array([math.cos(alpha), math.sin(alpha)])
        closing = inward @ direction
        closing[side] = 0.0  # it leaves the wall it stands at
        distance = -np.einsum("ij,ij->i", inward, x - corners[:-1])
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.where(closing < -1e-12, distance / closing, np.inf)
        side = int(np.argmin(reach))
        length_cm[run] = reach[side]
        theta = (alpha + math.pi / 2) % math.tau
        sign = 1 if theta < math.pi else -1
        theta_rad[run] = theta % math.pi
        p_cm[run] = sign * float(x @ [math.cos(theta), math.sin(theta)])
        x = x + reach[side] * direction
    return length_cm, theta_rad, p_cm


def uniforms(reachable, theta_rad, p_cm):
    """(U, V), both uniform for lines of density dp dtheta: theta by the polygon's width, p within it."""
    corners = np.array(reachable.exterior.coords)[:-1]

    def support(angles):
        along = np.outer(np.cos(angles), corners[:, 0]) + np.outer(np.sin(angles), corners[:, 1])
        return along.min(axis=1), along.max(axis=1)

    grid = np.linspace(0.0, math.pi, 2001)
    low, high = support(grid)
    width = high - low
    share = np.concatenate([[0.0], np.cumsum((width[1:] + width[:-1]) / 2)])
    low, high = support(theta_rad)
    return np.interp(theta_rad, grid, share / share[-1]), (p_cm - low) / (high - low)


def cauchy_cm(reachable):
    return math.pi * reachable.area / reachable.length


@pytest.mark.parametrize("arena", ARENAS)
def test_lambert_gives_uniform_isotropic_lines(arena):
    reachable = ARENAS[arena]
    length_cm, theta_rad, p_cm = roll(reachable, Policy.LAMBERT, 8000, np.random.default_rng(1))
    # Successive runs are correlated (0.24 at lag 1): blocks of 40 are near enough independent.
    blocks = length_cm.reshape(-1, 40).mean(axis=1)
    assert abs(blocks.mean() - cauchy_cm(reachable)) < 3.5 * blocks.std(ddof=1) / math.sqrt(blocks.size)
    assert blocks.std(ddof=1) / math.sqrt(blocks.size) < 0.02 * cauchy_cm(reachable)
    u, v = uniforms(reachable, theta_rad[::5], p_cm[::5])
    assert ks_1samp(u, lambda value: value).pvalue > 0.01
    assert ks_1samp(v, lambda value: value).pvalue > 0.01


@pytest.mark.parametrize("arena", ARENAS)
def test_uniform_angles_give_too_many_short_runs(arena):
    """The documented sign: shorter than Cauchy's mean, by 1 - 8/pi^2 = 19 % in a disc, and uneven across it."""
    reachable = ARENAS[arena]
    length_cm, theta_rad, p_cm = roll(reachable, Policy.UNIFORM, 4000, np.random.default_rng(2))
    assert length_cm.mean() < 0.95 * cauchy_cm(reachable)
    _, v = uniforms(reachable, theta_rad[::5], p_cm[::5])
    assert ks_1samp(v, lambda value: value).pvalue < 1e-4
    assert np.mean(np.abs(v - 0.5) > 0.4) > 0.25  # the outer fifth gets more than a quarter
    if arena == "disc":
        assert length_cm.mean() / cauchy_cm(reachable) == pytest.approx(8 / math.pi**2, abs=0.02)


def test_angles_follow_their_densities():
    u = np.linspace(0.0, 1.0, 20_001)[:-1] + 2.5e-5
    cosine = [ANGLES[Policy.LAMBERT](value) for value in u]
    even = [ANGLES[Policy.UNIFORM](value) for value in u]
    assert kstest(cosine, lambda phi: (1 + np.sin(phi)) / 2).statistic < 1e-4
    assert kstest(even, lambda phi: phi / math.pi + 0.5).statistic < 1e-4


@given(st.sampled_from(list(ANGLES)), st.floats(-50.0, 50.0), st.integers(0, 2**32))
def test_headings_lead_inwards_and_are_wrapped(policy, normal_heading_rad, seed):
    heading_rad = turn(policy, normal_heading_rad, np.random.default_rng(seed))
    assert 0.0 <= heading_rad < math.tau
    assert math.cos(heading_rad - normal_heading_rad) > -1e-9


def test_a_negative_hair_does_not_wrap_to_a_full_turn():
    class Middle:
        def random(self):
            return 0.5

    assert turn("lambert", -1e-20, Middle()) == 0.0


def test_one_draw_a_turn_and_the_same_seed_the_same_heading():
    first, second = np.random.default_rng(3), np.random.default_rng(3)
    assert turn("uniform", 1.0, first) == turn(Policy.UNIFORM, 1.0, second)
    second = np.random.default_rng(3)
    second.random()
    assert first.random() == second.random()


def test_every_policy_that_turns_has_its_law():
    assert set(ANGLES) == set(Policy) - {Policy.INTERIOR}


@pytest.mark.parametrize("policy", ["specular", "interior"])
def test_policies_that_do_not_turn(policy):
    with pytest.raises(PolicyError, match=rf"{policy}' turns at the edge: choose lambert or uniform") as caught:
        turn(policy, 0.0, np.random.default_rng(0))
    assert isinstance(caught.value, RequestError)
    assert caught.value.policy == policy


def test_unknown_policy():
    with pytest.raises(PolicyError, match="'specular': choose lambert, uniform, interior"):
        navigator_for("specular", np.random.default_rng(0))


# --- navigators


def ended(leg, length_cm, normal_rad=None, at_edge=None):
    return LegEnd(leg, length_cm, normal_rad, normal_rad is not None if at_edge is None else at_edge)


@pytest.mark.parametrize("policy", [Policy.LAMBERT, Policy.UNIFORM])
def test_a_wall_turner_measures_from_edge_to_edge_only(policy):
    navigator = navigator_for(policy, np.random.default_rng(1))
    leg = navigator.first()
    assert (leg.stop_after_cm, leg.measures) == (None, False)
    leg = navigator.next(ended(leg, 30.0, 2.0))
    assert leg.measures
    assert math.cos(leg.heading_rad - 2.0) > 0
    for end in (ended(leg, 12.0), ended(leg, 12.0, 1.0, at_edge=False), ended(leg, 12.0, at_edge=True)):
        assert navigator.next(ended(leg, 30.0, 2.0)).measures
        lost = navigator.next(end)  # a stall in mid-arena, or an edge whose normal was not felt
        assert (lost.stop_after_cm, lost.measures) == (None, False)
        assert not navigator.next(ended(lost, 0.2)).measures  # it never knew an edge here


@pytest.mark.parametrize("at_edge", [True, False])
def test_a_leg_that_went_nowhere_keeps_the_normal(at_edge):
    navigator = navigator_for("lambert", np.random.default_rng(1))
    leg = navigator.next(ended(navigator.first(), 30.0, 2.0))
    for _ in range(20):
        leg = navigator.next(ended(leg, NOWHERE_CM, at_edge=at_edge))
        assert leg.measures
        assert math.cos(leg.heading_rad - 2.0) > 0
    # A touch that was felt has the last word, however short the way.
    leg = navigator.next(ended(leg, 0.1, 5.0))
    assert math.cos(leg.heading_rad - 5.0) > 0


def test_lost_headings_are_uniform():
    navigator = navigator_for("lambert", np.random.default_rng(1))
    headings = [navigator.next(ended(navigator.first(), 9.0)).heading_rad for _ in range(2000)]
    assert kstest(np.array(headings) / math.tau, "uniform").pvalue > 0.01
    headings = [navigator.first().heading_rad for _ in range(2000)]
    assert kstest(np.array(headings) / math.tau, "uniform").pvalue > 0.01


def test_interior_stops_go_out_back_across_and_to_a_point_of_the_chord():
    navigator = navigator_for("interior", np.random.default_rng(4))
    shares = []
    leg = navigator.first()
    for _ in range(500):
        assert (leg.stop_after_cm, leg.measures) == (None, False)
        across = navigator.next(ended(leg, 20.0, at_edge=True))
        assert (across.stop_after_cm, across.measures) == (None, True)
        assert across.heading_rad == pytest.approx((leg.heading_rad + math.pi) % math.tau)
        back = navigator.next(ended(across, 50.0, at_edge=True))
        assert not back.measures
        assert back.heading_rad == pytest.approx((across.heading_rad + math.pi) % math.tau)
        shares.append(back.stop_after_cm / 50.0)
        leg = navigator.next(ended(back, back.stop_after_cm))
    assert kstest(shares, "uniform").pvalue > 0.01


@pytest.mark.parametrize("at_edge", [True, False])
def test_interior_starts_anew_where_a_leg_ended_amiss(at_edge):
    navigator = navigator_for("interior", np.random.default_rng(4))
    out = navigator.first()
    across = navigator.next(ended(out, 20.0, at_edge=True))
    stop = navigator.next(ended(across, 50.0, at_edge=True))
    # A stop that met the edge first, or a leg that stalled on its way there.
    leg = navigator.next(ended(stop if at_edge else across, 3.0, at_edge=at_edge))
    assert (leg.stop_after_cm, leg.measures) == (None, False)


# --- weights


def test_weights():
    assert line_weight(Policy.LAMBERT, Weighting.NONE, 80.0) == 1.0
    assert line_weight(Policy.UNIFORM, Weighting.NONE, 80.0) == 1.0
    assert line_weight(Policy.UNIFORM, Weighting.RUN_LENGTH, 80.0) == 80.0
    assert line_weight(Policy.INTERIOR, Weighting.NONE, 80.0) == pytest.approx(1 / 80)
    assert line_weight(Policy.INTERIOR, Weighting.NONE, 0.0) == 1 / NOWHERE_CM  # finite


@pytest.mark.parametrize("policy", Policy)
@pytest.mark.parametrize("disc", [True, False])
def test_weights_that_do_not_mend_are_refused(policy, disc):
    check_weighting(policy, Weighting.NONE, disc)
    if policy is Policy.UNIFORM and disc:
        check_weighting(policy, Weighting.RUN_LENGTH, disc)
        return
    with pytest.raises(PolicyError, match=r"(disc arena alone|would bias).*: (turn by|set the)") as caught:
        check_weighting(policy, Weighting.RUN_LENGTH, disc)
    assert caught.value.policy == policy
    assert "\n" not in str(caught.value)


# --- the whole thing: area and perimeter of a tower, by shapely's intersections

RIGHT = [(14.0, -25.0), (6.0, -9.0), (3.0, 5.0), (1.0, 25.0)]
TOWER = Polygon(
    [*RIGHT, *((-x, y) for x, y in reversed(RIGHT)), (-9.0, -25.0), (-5.0, -17.0), (5.0, -17.0), (9.0, -25.0)]
)


def ride(reachable, navigator, legs):
    """(x0, y0, x1, y1) of the measured legs of a navigator in a convex polygon."""
    corners = np.array(orient(reachable).exterior.coords)
    edges = np.diff(corners, axis=0)
    inward = (np.column_stack([-edges[:, 1], edges[:, 0]]) / np.hypot(*edges.T)[:, None]).tolist()
    offset = [nx * x + ny * y for (nx, ny), (x, y) in zip(inward, corners[:-1].tolist(), strict=True)]
    x, y, side, leg, measured = 7.0, -3.0, -1, navigator.first(), []
    for _ in range(legs):
        alpha = FRAME_OFFSET_RAD - leg.heading_rad
        dx, dy = math.cos(alpha), math.sin(alpha)
        reach, hit = math.inf, -1
        for number, ((nx, ny), at) in enumerate(zip(inward, offset, strict=True)):
            closing = nx * dx + ny * dy
            if closing < -1e-12 and number != side:
                distance = (at - nx * x - ny * y) / closing
                if distance < reach:
                    reach, hit = max(distance, 0.0), number
        if leg.stop_after_cm is not None and leg.stop_after_cm < reach:
            reach, hit = leg.stop_after_cm, -1
        if leg.measures:
            measured.append((x, y, x + reach * dx, y + reach * dy))
        x, y, side = x + reach * dx, y + reach * dy, hit
        normal = FRAME_OFFSET_RAD - math.atan2(inward[hit][1], inward[hit][0]) if hit >= 0 else None
        leg = navigator.next(LegEnd(leg, reach, normal, at_edge=hit >= 0))
    return np.array(measured)


def ride_disc(radius_cm, navigator, legs):
    """The same in a disc, in closed form."""
    x, y, leg, measured = 7.0, -3.0, navigator.first(), []
    for _ in range(legs):
        alpha = FRAME_OFFSET_RAD - leg.heading_rad
        dx, dy = math.cos(alpha), math.sin(alpha)
        along = x * dx + y * dy
        reach = max(0.0, -along + math.sqrt(max(0.0, along**2 + radius_cm**2 - x * x - y * y)))
        stops = leg.stop_after_cm is not None and leg.stop_after_cm < reach
        reach = leg.stop_after_cm if stops else reach
        if leg.measures:
            measured.append((x, y, x + reach * dx, y + reach * dy))
        x, y = x + reach * dx, y + reach * dy
        normal = None if stops else FRAME_OFFSET_RAD - math.atan2(-y, -x)
        leg = navigator.next(LegEnd(leg, reach, normal, at_edge=not stops))
    return np.array(measured)


def estimates(shape, lines, weights):
    """(A, P) of a shape by Eq. 1, with the signed moments summed over all pairs, and their errors by blocks."""
    legs = shapely.linestrings(lines.reshape(-1, 2, 2))
    values = np.zeros((len(lines), 3))
    for row, piece in zip(np.arange(len(lines)), shapely.intersection(shape, legs), strict=True):
        if piece.is_empty or piece.length == 0:
            continue
        parts = [part for part in getattr(piece, "geoms", [piece]) if part.length > 0]
        ends = np.array([shapely.get_coordinates(part)[[0, -1]] for part in parts])
        s = np.sort(np.hypot(*(ends.reshape(-1, 2) - lines[row, :2]).T))
        sign = (-1.0) ** np.arange(s.size)
        l3 = -np.sum(np.triu(np.outer(sign, sign) * np.abs(s[:, None] - s) ** 3))
        values[row] = len(parts), piece.length, l3
    weighted = values * weights[:, None]

    def sizes(sums):
        area = math.pi / 3 * sums[..., 2] / sums[..., 1]
        return np.stack([area, math.pi * area * sums[..., 0] / sums[..., 1]], axis=-1)

    blocks = np.array([part.sum(axis=0) for part in np.array_split(weighted, 50)])
    total = blocks.sum(axis=0)
    jackknife = sizes(total - blocks)
    errors = np.sqrt(49 / 50 * np.sum((jackknife - jackknife.mean(axis=0)) ** 2, axis=0))
    truth = np.array([shape.area, shape.length])
    return sizes(total) / truth - 1, errors / truth


NONE, RUN_LENGTH = Weighting.NONE, Weighting.RUN_LENGTH


def ridden(arena, policy, weighting):
    """(A, P) of the tower relative to the truth, less 1, and their errors; in the disc the tower all but fills it."""
    navigator = navigator_for(policy, np.random.default_rng(12))
    legs = 210_000 if policy is Policy.INTERIOR else 90_000
    lines = ride(ARENAS[arena], navigator, legs) if arena == "rectangle" else ride_disc(46.35, navigator, legs)
    lengths = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
    weights = np.array([line_weight(policy, weighting, length) for length in lengths])
    return estimates(TOWER if arena == "rectangle" else scale(TOWER, 1.6, 1.6, origin=(0, 0)), lines, weights)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arena", "policy", "weighting"),
    [
        ("rectangle", Policy.LAMBERT, NONE),
        ("disc", Policy.LAMBERT, NONE),
        ("rectangle", Policy.INTERIOR, NONE),
        ("disc", Policy.INTERIOR, NONE),
        ("disc", Policy.UNIFORM, RUN_LENGTH),
    ],
)
def test_a_tower_is_measured_without_bias(arena, policy, weighting):
    bias, errors = ridden(arena, policy, weighting)
    assert max(errors) < 0.02
    assert np.all(np.abs(bias) < 3.5 * errors), (bias, errors)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arena", "weighting", "area", "perimeter"),
    [
        ("rectangle", NONE, (-0.17, -0.09), (-0.13, -0.05)),
        ("rectangle", RUN_LENGTH, (-0.24, -0.14), (-0.20, -0.10)),  # weights do not mend it: worse
        ("disc", NONE, (-0.10, -0.03), (0.0, 0.06)),
    ],
)
def test_uniform_angles_measure_a_tower_wrong(arena, weighting, area, perimeter):
    bias, errors = ridden(arena, Policy.UNIFORM, weighting)
    assert max(errors) < 0.02
    assert area[0] < bias[0] < area[1], (bias, errors)
    assert perimeter[0] < bias[1] < perimeter[1], (bias, errors)
