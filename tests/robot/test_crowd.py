"""Several balls in one arena against closed forms, brute force and the ball alone."""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.stats import ks_2samp
from shapely.geometry import Point, box

from lab.base.errors import RequestError
from lab.clock import run
from robot.bolt import Bolt
from robot.virtual.body import Body, BodySettings, Impact
from robot.virtual.bolt import VirtualBolt
from robot.virtual.crowd import BOLT_RADIUS_CM, Crowd, draw_places
from robot.virtual.radio import VirtualRadio

ARENA = box(-56.35, -41.35, 56.35, 41.35)
R = BOLT_RADIUS_CM


def dark(x, y):
    return np.full(x.shape, 20.0)


@pytest.fixture
def smooth(ideal) -> BodySettings:
    return replace(ideal, drive_timeout_s=1e6)


def balls(physics, *starts) -> tuple[Crowd, list[list[Impact]]]:
    """A crowd at t = 0 with a ball for each ``(x, y, facing)``, and what each will feel."""
    bodies = [
        Body(ARENA, dark, np.random.default_rng(n), physics, position_cm=(x, y), facing_rad=facing)
        for n, (x, y, facing) in enumerate(starts)
    ]
    felt: list[list[Impact]] = [[] for _ in bodies]
    for body, impacts in zip(bodies, felt, strict=True):
        body.on_bump = impacts.append
    crowd = Crowd(bodies)
    crowd.advance(0.0)
    return crowd, felt


def normal_of(body: Body, impact: Impact) -> float:
    """The felt normal as an arena angle."""
    return (body.facing_rad + impact.heading_rad - impact.normal_heading_rad) % math.tau


def way_s(way_cm: float, speed: float, rate: float = 80.0) -> float:
    """Time to roll a way from rest."""
    ramp = speed**2 / (2 * rate)
    return math.sqrt(2 * way_cm / rate) if way_cm < ramp else speed / rate + (way_cm - ramp) / speed


@pytest.mark.parametrize("cadence_s", [5.0, 0.1, 0.007])
def test_head_on_they_meet_where_and_when_they_must(smooth, cadence_s: float) -> None:
    crowd, felt = balls(smooth, (-40.0, 5.0, 0.0), (40.0, 5.0, math.pi))
    one, two = crowd.bodies
    one.drive(0.0, 30.0)
    two.drive(0.0, 20.0)
    for n in range(1, round(5.0 / cadence_s) + 1):
        one.advance(n * cadence_s)
    # Both at speed, less what speeding up costs each: v t - v²/2a.
    meet_s = (80 - 2 * R + (30**2 + 20**2) / 160) / 50
    x_cm = -40 + 30 * meet_s - 30**2 / 160
    assert [len(impacts) for impacts in felt] == [1, 1]
    assert felt[0][0].t_s == pytest.approx(meet_s, abs=1e-6)
    assert felt[1][0].t_s == felt[0][0].t_s
    assert (one.x_cm, two.x_cm) == pytest.approx((x_cm, x_cm + 2 * R), abs=2e-6)
    assert [impacts[0].speed_cm_s for impacts in felt] == pytest.approx([50.0, 50.0])
    assert math.cos(normal_of(one, felt[0][0]) - math.pi) == pytest.approx(1.0)
    assert math.cos(normal_of(two, felt[1][0])) == pytest.approx(1.0)
    assert (one.speed_cm_s, two.speed_cm_s) == (0.0, 0.0)
    assert one.pressed
    assert crowd.touching == {(0, 1)}


@given(offset=st.floats(-2 * R + 1e-3, 2 * R - 1e-3), speed=st.floats(5, 200), facing=st.floats(0, math.tau))
@hypothesis_settings(max_examples=60, deadline=None)
def test_a_ball_at_rest_is_hit_where_two_circles_touch(offset: float, speed: float, facing: float) -> None:
    physics = BodySettings(speed_error=0, drift_rad_per_cm=0, locator_error=0, bump_angle_rad=0, drive_timeout_s=1e6)
    along, across = (np.array([math.cos(facing + turn), math.sin(facing + turn)]) for turn in (0.0, math.pi / 2))
    start = -25.0 * along + offset * across
    crowd, felt = balls(physics, (start[0], start[1], facing), (0.0, 0.0, 1.0))
    moving, resting = crowd.bodies
    moving.drive(0.0, speed)
    crowd.advance(20.0)
    back_cm = math.sqrt((2 * R) ** 2 - offset**2)
    assert (moving.x_cm, moving.y_cm) == pytest.approx(tuple(-back_cm * along + offset * across), abs=1e-4)
    assert (resting.x_cm, resting.y_cm) == (0.0, 0.0)
    assert [len(impacts) for impacts in felt] == [1, 1]
    assert felt[0][0].t_s == pytest.approx(way_s(25.0 - back_cm, speed), abs=1e-4)
    met_cm_s = min(speed, math.sqrt(2 * 80 * (25.0 - back_cm)))
    assert felt[1][0].speed_cm_s == pytest.approx(met_cm_s * back_cm / (2 * R), rel=1e-3, abs=1e-3)
    to_resting = math.atan2(*(-np.array([moving.x_cm, moving.y_cm]))[::-1])
    assert math.cos(normal_of(resting, felt[1][0]) - to_resting) == pytest.approx(1.0)


@pytest.mark.parametrize("beside_cm", [2 * R + 1e-3, 20.0])
def test_a_ball_that_just_misses_rolls_by(smooth, beside_cm: float) -> None:
    crowd, felt = balls(smooth, (-50.0, -10.0, 0.0), (0.0, -10.0 + beside_cm, 0.0))
    crowd.bodies[0].drive(0.0, 120.0)
    crowd.advance(10.0)
    assert crowd.bodies[0].x_cm == pytest.approx(56.35)
    assert [len(impacts) for impacts in felt] == [1, 0]


def test_side_by_side_they_do_not_feel_each_other(smooth) -> None:
    """Parallel runs at a hair's breadth, and at none."""
    for gap_cm in (0.0, 1e-4):
        crowd, felt = balls(smooth, (-50.0, 0.0, 0.0), (-50.0, 2 * R + gap_cm, 0.0))
        for body in crowd.bodies:
            body.drive(0.0, 40.0)
        crowd.advance(2.0)
        assert [body.x_cm for body in crowd.bodies] == pytest.approx([-50 + 80 - 10] * 2)
        assert felt == [[], []]


def test_a_bent_run_hits_what_a_straight_one_would_miss(smooth) -> None:
    curvature = 3e-3
    bends = replace(smooth, drift_bias_rad_per_cm=curvature)
    crowd, felt = balls(bends, (-50.0, 0.0, 0.0), (10.0, -2 * R - 2.0, 0.0))
    crowd.bodies[0].drive(0.0, 100.0)
    crowd.advance(10.0)
    assert [len(impacts) for impacts in felt] == [1, 1]
    # Clockwise: the centre of the arc is to the right; where it is 2 R from the other ball they meet.
    arc = Point(-50.0, -1 / curvature).buffer(1 / curvature, quad_segs=20_000).exterior
    meets = arc.intersection(Point(10.0, -2 * R - 2.0).buffer(2 * R, quad_segs=2000).exterior)
    assert meets.distance(Point(crowd.bodies[0].x_cm, crowd.bodies[0].y_cm)) < 2e-3


def test_a_ball_caught_up_with_feels_it_and_rolls_on(smooth) -> None:
    crowd, felt = balls(smooth, (-50.0, 0.0, 0.0), (-30.0, 0.0, 0.0))
    slow = crowd.bodies[1]
    crowd.bodies[0].drive(0.0, 50.0)
    slow.drive(0.0, 10.0)
    while not felt[1]:
        crowd.advance(slow.t_s + 0.01)
    assert felt[1][0].speed_cm_s == pytest.approx(40.0)
    assert math.cos(normal_of(slow, felt[1][0])) == pytest.approx(1.0)
    assert slow.speed_cm_s == pytest.approx(10.0)
    assert crowd.bodies[0].speed_cm_s < 2.0


def test_one_that_stops_at_the_wall_is_run_into(smooth) -> None:
    """Its speed falls from 60 to 0 at once: no bound on accelerations covers that."""
    crowd, felt = balls(smooth, (-30.0, 0.0, 0.0), (-30.0 + 2 * R + 0.05, 0.0, 0.0))
    for body in crowd.bodies:
        body.drive(0.0, 60.0)
    crowd.advance(20.0)
    assert [round(body.x_cm, 4) for body in crowd.bodies] == [round(56.35 - 2 * R, 4), 56.35]
    assert [len(impacts) for impacts in felt] == [1, 2]
    assert math.cos(normal_of(crowd.bodies[1], felt[1][0]) - math.pi) == pytest.approx(1.0)
    assert math.cos(normal_of(crowd.bodies[1], felt[1][1])) == pytest.approx(1.0)


def test_held_by_a_ball_it_stays_until_sent_away_or_the_way_is_free(smooth) -> None:
    crowd, felt = balls(smooth, (-20.0, 0.0, 0.0), (0.0, 0.0, math.pi / 2))
    pusher, other = crowd.bodies
    pusher.drive(0.0, 30.0)
    crowd.advance(5.0)
    x_cm = pusher.x_cm
    assert x_cm == pytest.approx(-2 * R)
    pusher.drive(0.4, 30.0)  # still into it
    crowd.advance(8.0)
    assert (pusher.x_cm, [len(impacts) for impacts in felt]) == (pytest.approx(x_cm), [1, 1])
    other.drive(math.pi / 2, 30.0)  # to the arena's right, away
    crowd.advance(8.5)
    assert other.x_cm > 1.0
    assert pusher.x_cm > x_cm + 1.0
    for body in crowd.bodies:
        body.stop()
    crowd.advance(12.0)
    pusher.drive(math.pi, 30.0)
    crowd.advance(13.0)
    assert pusher.x_cm < x_cm + 1.0
    assert not crowd.touching


def test_when_the_way_is_felt_to_be_free_does_not_depend_on_how_often_they_are_asked(smooth) -> None:
    ends = []
    for cadence_s in (4.0, 0.0007):
        crowd, _ = balls(smooth, (-20.0, 0.0, 0.0), (0.0, 0.0, math.pi / 2))
        crowd.bodies[0].drive(0.0, 30.0)
        crowd.advance(2.0)
        crowd.bodies[1].drive(0.3, 25.0)
        for t_s in np.arange(2.0 + cadence_s, 4.0, cadence_s).tolist():
            crowd.advance(t_s)
        crowd.advance(4.0)
        ends.append([(body.x_cm, body.y_cm, body.distance_cm) for body in crowd.bodies])
    assert ends[0][0][2] > 30.0
    assert np.allclose(ends[0], ends[1], atol=1e-3)


@pytest.mark.parametrize("curvature", [-0.03, 0.03])
def test_a_bend_that_reaches_far_in_one_step_does_not_overlap(smooth, curvature: float) -> None:
    bends = replace(smooth, drift_bias_rad_per_cm=curvature, acceleration_cm_s2=1e4)
    for aside_cm in np.linspace(0.1, 1.5 * R, 12).tolist():
        crowd, felt = balls(bends, (-15.0, 0.0, 0.0), (0.0, -math.copysign(aside_cm, curvature), 0.0))
        crowd.bodies[0].drive(0.0, 250.0)
        while not any(felt):
            crowd.advance(crowd.bodies[0].t_s + 0.5)
        assert crowd.gap_cm(0, 1) > -1e-4


def test_three_at_once(smooth) -> None:
    crowd, felt = balls(smooth, (-30.0, 0.0, 0.0), (0.0, 0.0, 0.0), (30.0, 0.0, math.pi))
    for n in (0, 2):
        crowd.bodies[n].drive(0.0, 40.0)
    crowd.advance(6.0)
    assert [body.x_cm for body in crowd.bodies] == pytest.approx([-2 * R, 0.0, 2 * R], abs=1e-5)
    assert [len(impacts) for impacts in felt] == [1, 2, 1]
    assert sorted(round(math.cos(normal_of(crowd.bodies[1], impact))) for impact in felt[1]) == [-1, 1]
    assert crowd.touching == {(0, 1), (1, 2)}


def wander(count: int, seed: int, *, cadence_s: float, duration_s: float, look=lambda crowd: None, **physics):
    """Balls that turn at whatever they meet; what each felt."""
    rng = np.random.default_rng(seed)
    settings = BodySettings(**{"drive_timeout_s": 1e6, **physics})
    bodies = [
        Body(ARENA, dark, np.random.default_rng([seed, n]), settings, position_cm=place)
        for n, place in enumerate(draw_places(ARENA, count, rng))
    ]
    crowd = Crowd(bodies)
    crowd.advance(0.0)
    felt: list[tuple[int, float, float, float]] = []
    turns = [np.random.default_rng([seed, n, 1]) for n in range(count)]

    def turn(n: int, impact: Impact) -> None:
        felt.append((n, impact.t_s, bodies[n].x_cm, bodies[n].y_cm))
        heading = impact.normal_heading_rad + math.asin(2 * turns[n].random() - 1)
        bodies[n].drive(heading, turns[n].uniform(5, 80))

    for n, body in enumerate(bodies):
        body.on_bump = lambda impact, n=n: turn(n, impact)
        body.drive(turns[n].uniform(0, math.tau), 40.0)
    steps = round(duration_s / cadence_s)
    for n in range(1, steps + 1):
        bodies[n % count].advance(n * duration_s / steps)
        look(crowd)
    return felt


@pytest.mark.parametrize(
    ("seed", "count"), [(1, 2), (2, 4), *(pytest.param(s, 6, marks=pytest.mark.slow) for s in range(8))]
)
def test_in_random_minutes_no_two_ever_overlap(seed: int, count: int) -> None:
    least = [math.inf]

    def look(crowd: Crowd) -> None:
        places = [Point(body.x_cm, body.y_cm) for body in crowd.bodies]
        least[0] = min(least[0], *(one.distance(two) for one, two in combinations(places, 2)))
        assert all(ARENA.distance(place) < 1e-6 for place in places)

    felt = wander(count, seed, cadence_s=0.004, duration_s=60.0, look=look, drift_rad_per_cm=1e-3)
    assert len(felt) > 20
    assert 2 * R - 1e-3 < least[0] < 2 * R + 0.01


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_what_they_feel_does_not_depend_on_how_often_they_are_asked(seed: int) -> None:
    runs = [wander(4, seed, cadence_s=cadence_s, duration_s=9.0) for cadence_s in (9.0, 0.25, 0.011)]
    assert len(runs[0]) > 8
    for other in runs[1:]:
        assert [who for who, *_ in sorted(other, key=lambda one: one[1])] == [
            who for who, *_ in sorted(runs[0], key=lambda one: one[1])
        ]
        # Bounces spread what the drift's chords differ by.
        assert np.allclose(sorted(other), sorted(runs[0]), atol=2e-2)


def test_a_crowd_of_one_is_the_ball_alone() -> None:
    ends = []
    for together in (False, True):
        body = Body(ARENA, dark, np.random.default_rng(8))
        if together:
            Crowd([body])
        body.advance(0.0)
        felt: list[Impact] = []
        body.on_bump = felt.append
        for n in range(1, 400):
            body.drive(0.7 * (n // 50), 35.0)
            body.advance(0.03 * n)
        ends.append((body.x_cm, body.y_cm, body.t_s, body.distance_cm, body.battery_v, body.light_lux(), felt))
    assert ends[0] == ends[1]


def test_time_never_runs_backwards_nor_into_itself(smooth) -> None:
    crowd, _ = balls(smooth, (-20.0, 0.0, 0.0), (20.0, 0.0, 0.0))
    one = crowd.bodies[0]
    one.on_bump = lambda impact: one.advance(1e9)
    one.drive(0.0, 50.0)
    crowd.advance(4.0)
    crowd.advance(3.0)
    assert [body.t_s for body in crowd.bodies] == pytest.approx([4.0, 4.0])
    assert one.x_cm == pytest.approx(20 - 2 * R, abs=1e-5)


def test_a_minute_at_rest_is_one_step(smooth) -> None:
    crowd, _ = balls(smooth, (0.0, 0.0, 0.0), (2 * R, 0.0, 0.0))
    crowd.advance(1e7)
    assert crowd.touching == {(0, 1)}
    assert crowd.bodies[0].t_s == 1e7


def test_places_are_drawn_evenly_without_overlap() -> None:
    rng, room = np.random.default_rng(5), box(0, 0, 25, 15)
    drawn = np.array([draw_places(room, 3, rng) for _ in range(1500)])
    every = rng.uniform((0, 0), (25, 15), (20_000, 3, 2))
    apart = [np.hypot(*(every[:, i] - every[:, j]).T) >= 2 * R for i, j in ((0, 1), (0, 2), (1, 2))]
    even = every[np.logical_and.reduce(apart)]
    for of in (lambda p: p[:, 2, 0], lambda p: p[:, 0, 1], lambda p: np.hypot(*(p[:, 0] - p[:, 1]).T)):
        assert ks_2samp(of(drawn), of(even)).pvalue > 1e-3
    with pytest.raises(RequestError, match="no room for 9 robots"):
        draw_places(room, 9, rng)


def test_bad_crowds_are_refused(smooth) -> None:
    def body(x: float) -> Body:
        return Body(ARENA, dark, np.random.default_rng(1), smooth, position_cm=(x, 0.0))

    with pytest.raises(RequestError, match="robots 0 and 1 overlap"):
        Crowd([body(0.0), body(7.0)])
    with pytest.raises(RequestError, match="radius must be above 0"):
        Crowd([body(0.0)], radius_cm=0.0)
    one = body(0.0)
    with pytest.raises(RequestError, match="in a crowd already"):
        Crowd([one, one])
    started = body(20.0)
    started.advance(3.0)
    with pytest.raises(RequestError, match="clocks differ"):
        Crowd([one, started])
    Crowd([one])
    with pytest.raises(RequestError, match="in a crowd already"):
        Crowd([one, body(20.0)])


def test_hosts_hear_of_a_contact_over_the_radio(ideal) -> None:
    """Two robots driven at each other by two hosts: both report a bump, their bodies apart."""

    async def main() -> None:
        radio = VirtualRadio()
        await radio.start()
        names = ("SB-0001", "SB-0002", "SB-0003")
        bodies = [
            Body(ARENA, dark, np.random.default_rng(n), ideal, position_cm=(30.0 * n - 30, 0.0), facing_rad=0.0)
            for n in range(3)
        ]
        crowd = Crowd(bodies)
        bumps: dict[str, int] = dict.fromkeys(names, 0)
        async with contextlib.AsyncExitStack() as stack:
            stack.push_async_callback(radio.close)
            robots = []
            for name, body in zip(names, bodies, strict=True):
                twin = VirtualBolt(radio, body, name)
                await twin.start()
                stack.push_async_callback(twin.close)
                robot = Bolt(name, backend=radio.client_backend, scanner_backend=radio.scanner_backend)
                robot.on_bump = lambda bump, name=name: bumps.update({name: bumps[name] + 1})
                await robot.connect()
                stack.push_async_callback(robot.disconnect)
                robots.append(robot)
            for _ in range(8):
                await asyncio.gather(robots[0].drive(0.0, 30.0), robots[1].drive(math.pi, 30.0))
                await asyncio.sleep(0.25)
        assert bumps["SB-0001"] == bumps["SB-0002"] == 1
        assert bumps["SB-0003"] == 0
        assert abs(crowd.gap_cm(0, 1)) < 1e-3

    run(main(), virtual=True)
