"""Turning policies in a numeric billiard: Lambert's law alone gives uniform isotropic lines."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import ks_1samp, kstest
from shapely import Point, box
from shapely.geometry.polygon import orient

from lab.base.errors import RequestError
from robot.turning import ANGLES, Policy, PolicyError, turn

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


@given(st.sampled_from(list(Policy)), st.floats(-50.0, 50.0), st.integers(0, 2**32))
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


def test_every_policy_has_its_law():
    assert set(ANGLES) == set(Policy)


def test_unknown_policy():
    with pytest.raises(PolicyError, match=r"'specular': choose lambert or uniform") as caught:
        turn("specular", 0.0, np.random.default_rng(0))
    assert isinstance(caught.value, RequestError)
    assert caught.value.policy == "specular"
