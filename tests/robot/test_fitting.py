"""The arithmetic of characterising a robot, against closed forms and simulated instruments."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.collision import collision_acceleration
from robot.fitting import (
    ALL_AXES,
    Hit,
    axes_of,
    combine,
    fit_path,
    latency_of,
    mean_of,
    onset_s,
    path_of,
    slope,
    steady_window,
    wall_through,
)


def ramped(t_s, onset, acceleration, cruising):
    """Path of a body at rest until ``onset``, then evenly accelerated up to ``cruising``."""
    since = np.maximum(np.asarray(t_s) - onset, 0.0)
    ramp = cruising / acceleration
    return np.where(since < ramp, acceleration * since**2 / 2, cruising * (since - ramp / 2))


@given(
    onset=st.floats(0.02, 0.3),
    acceleration=st.floats(40.0, 200.0),
    cruising=st.floats(15.0, 35.0),
    interval=st.floats(0.02, 0.06),
    phase=st.floats(0.0, 1.0),
)
def test_onset_is_found_far_more_finely_than_samples_are_spaced(onset, acceleration, cruising, interval, phase) -> None:
    t = interval * phase + np.arange(0.0, onset + cruising / acceleration + 0.3, interval)
    t = np.concatenate([[interval * phase - interval], t])
    assert onset_s(t, 3.0 + ramped(t, onset, acceleration, cruising)) == pytest.approx(onset, abs=1e-3)


def test_onset_bears_the_jitter_of_a_coarse_odometer() -> None:
    rng = np.random.default_rng(4)
    errors = []
    for _ in range(40):
        onset = rng.uniform(0.05, 0.15)
        t = rng.uniform(0, 0.04) + np.arange(-0.04, 0.7, 0.04)
        errors.append(onset_s(t, ramped(t, onset, 80.0, 22.0) + rng.normal(0, 0.05, len(t))) - onset)
    assert abs(float(np.mean(errors))) < 0.004
    assert float(np.std(errors)) < 0.015


def test_no_onset_in_what_does_not_roll() -> None:
    t = np.arange(10) * 0.05
    assert math.isnan(onset_s(t, np.zeros(10)))
    assert math.isnan(onset_s(t[:3], [0.0, 1.0, 2.0]))


@pytest.mark.parametrize("latency", [0.0, 0.031, 0.09])
def test_latency_is_resolved_below_the_interval(latency: float) -> None:
    rng, interval = np.random.default_rng(1), 0.05
    flips = rng.uniform(0.0, 500.0, 4000)
    # A frame at k·interval shows what was there a latency before.
    shown = np.ceil((flips + latency) / interval) * interval
    figure = latency_of(shown - flips, interval)
    assert figure.value == pytest.approx(latency, abs=4 * figure.error)
    assert figure.error < 3e-4


def test_mean_leaves_out_strays_but_not_agreement() -> None:
    assert mean_of([1.0, 1.0 + 1e-9, 1.0, 1.0 - 3e-6]).n == 4
    assert mean_of([*np.random.default_rng(0).normal(5.0, 0.1, 50), 40.0]).value == pytest.approx(5.0, abs=0.06)
    assert math.isnan(mean_of([math.nan]).value)


def test_combined_weights_are_those_of_the_errors_alone_without_scatter() -> None:
    figure = combine([2.0, 2.0, 2.0], [0.1, 0.2, 0.4])
    assert (figure.value, figure.scatter) == (pytest.approx(2.0), 0.0)
    assert figure.error == pytest.approx((100 + 25 + 6.25) ** -0.5)


def test_combined_error_covers_the_scatter() -> None:
    rng = np.random.default_rng(2)
    figures = []
    for _ in range(400):
        errors = rng.uniform(0.001, 0.01, 20)
        figures.append(combine(1.0 + rng.normal(0, 0.02, 20) + rng.normal(0, errors), errors))
    pulls = [(figure.value - 1.0) / figure.error for figure in figures]
    assert float(np.std(pulls)) == pytest.approx(1.0, abs=0.15)
    assert float(np.mean([figure.scatter for figure in figures])) == pytest.approx(0.02, rel=0.1)


def test_combine_of_few() -> None:
    assert combine([3.0], [0.5]).value == 3.0
    assert math.isnan(combine([], []).value)


@pytest.mark.parametrize("clockwise", [8e-4, -2e-4])
def test_curvature_is_clockwise_positive_and_speed_is_the_paths(clockwise: float) -> None:
    rng = np.random.default_rng(6)
    t = np.arange(0.0, 4.0, 1 / 30)
    # Turning clockwise lowers the arena angle, which is counter-clockwise.
    angle = 0.7 - clockwise * 20.0 * t
    x = np.cumsum(20.0 / 30 * np.cos(angle)) + rng.normal(0, 0.01, len(t))
    y = np.cumsum(20.0 / 30 * np.sin(angle)) + rng.normal(0, 0.01, len(t))
    x[17] += 5.0  # a reflection
    y[40] = math.nan  # an LED not seen
    fitted = fit_path(t, x, y)
    assert fitted is not None
    bend = fitted.curvature_rad_per_cm
    assert bend.value == pytest.approx(clockwise, abs=4 * bend.error + 1e-6)
    assert bend.error < 1e-5
    assert fitted.speed_cm_s.value == pytest.approx(20.0, rel=1e-3)
    assert fitted.length_cm == pytest.approx(20.0 * (4.0 - 1 / 30), rel=0.01)


def test_too_few_places_or_none_at_all_fit_no_path() -> None:
    assert fit_path([0, 1, 2], [0, 1, 2], [0, 0, 0]) is None
    assert fit_path(np.arange(20.0), np.full(20, 3.0), np.full(20, 1.0)) is None
    assert math.isnan(slope([0.0, 1.0], [0.0, 1.0]).value)


def test_steady_window_is_the_longest_stretch_at_speed() -> None:
    t = np.arange(0.0, 6.0, 0.05)
    speed = np.interp(t, [0.0, 0.3, 1.0, 1.05, 1.3, 1.6, 5.0, 5.2], [0, 20, 20, 0, 0, 20, 20, 0])
    window = steady_window(t, speed, 0.2)
    assert window == (pytest.approx(1.8, abs=0.08), pytest.approx(4.8, abs=0.05))
    assert steady_window(t, np.zeros(len(t)), 0.2) is None
    assert steady_window(t[:8], speed[:8], 0.2) is None


def test_path_is_the_length_of_the_way() -> None:
    assert path_of([0, 3, 3], [0, 4, 5]).tolist() == [0, 5, 6]
    assert len(path_of([], [])) == 0


def bumps(axes, incidences, noise_rad, rng) -> list[Hit]:
    """What a robot with these axes reports of walls met at these angles from head-on."""
    hits = []
    for incidence in incidences:
        heading = rng.uniform(0, math.tau)
        normal = heading + math.pi + incidence
        x, y = collision_acceleration(normal + rng.normal(0, noise_rad), heading, 2.0, axes)
        # As the driver has it under a neutral profile: x right, y forward.
        hits.append(Hit(heading, heading + math.atan2(x, y), normal))
    return hits


@pytest.mark.parametrize("axes", ALL_AXES)
def test_every_order_of_axes_is_told_by_head_on_and_oblique_bumps(axes: tuple[str, str]) -> None:
    rng = np.random.default_rng(3)
    found = axes_of(bumps(axes, [0.0, 0.0, 0.5, -0.5, 0.7, -0.6], 0.1, rng))
    assert found is not None
    assert found.axes == axes
    assert found.certain
    assert found.spread_rad < 0.3


def test_there_are_eight_orders() -> None:
    assert len(set(ALL_AXES)) == 8


def test_bumps_round_a_corner_do_not_outweigh_the_rest() -> None:
    rng = np.random.default_rng(5)
    axes = ("back", "right")
    # Two that met the next wall of the room, at an angle that speaks for the wrong side.
    strays = [replace(hit, normal_rad=hit.normal_rad + math.pi / 2) for hit in bumps(axes, [-0.6, -0.6], 0.0, rng)]
    found = axes_of([*bumps(axes, [0.0, 0.0, 0.3, 0.3, -0.3, -0.3, 0.35, -0.35], 0.02, rng), *strays])
    assert found is not None
    assert found.axes == axes
    assert found.certain


def test_head_on_bumps_alone_do_not_tell_left_from_right() -> None:
    rng = np.random.default_rng(8)
    found = axes_of(bumps(("right", "forward"), [0.0] * 8, 0.02, rng))
    assert found is not None
    assert not found.certain
    assert axes_of([]) is None


def test_random_reports_tell_nothing() -> None:
    rng = np.random.default_rng(9)
    noise = [Hit(0.0, rng.uniform(0, math.tau), math.pi + rng.uniform(-0.6, 0.6)) for _ in range(12)]
    found = axes_of(noise)
    assert found is not None
    assert not found.certain


@given(normal=st.floats(0.0, 6.28), distance=st.floats(5.0, 60.0))
def test_wall_through_places_points_inside(normal: float, distance: float) -> None:
    across = np.array([math.sin(normal), math.cos(normal)])
    along = np.array([across[1], -across[0]])
    places = [tuple(-distance * across + step * along) for step in (-9.0, 1.0, 12.0)]
    wall = wall_through(places, (0.0, 0.0))
    assert wall is not None
    for place in places:
        assert math.remainder(wall.normal_rad(place) - normal, math.tau) == pytest.approx(0.0, abs=1e-6)
    assert wall.radius_cm == math.inf
    assert wall.stray_cm == pytest.approx(0.0, abs=1e-6)
    assert wall.reach_cm == pytest.approx(21.0)


def test_no_wall_through_one_spot() -> None:
    assert wall_through([(1.0, 2.0)], (0.0, 0.0)) is None
    assert wall_through([(1.0, 2.0), (1.0, 2.0)], (0.0, 0.0)) is None


def test_a_round_wall_has_its_normal_at_each_place() -> None:
    centre, radius = np.array([3.0, -20.0]), 50.0
    angles = (0.6, 0.8, 1.05)
    places = [tuple(centre + radius * np.array([math.sin(a), math.cos(a)])) for a in angles]
    wall = wall_through(places, (3.0, -20.0))
    assert wall is not None
    assert wall.radius_cm == pytest.approx(radius, rel=0.1)
    for angle, place in zip(angles, places, strict=True):
        # Back to the centre: the heading opposite to the one out.
        assert math.remainder(wall.normal_rad(place) - angle - math.pi, math.tau) == pytest.approx(0.0, abs=0.03)
