from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import LineString, MultiPoint, Point, Polygon, box

from lab.base.errors import RequestError
from robot.virtual.body import Body, BodySettings, Impact
from robot.virtual.walls import Walls

RECTANGLE = box(-56.35, -41.35, 56.35, 41.35)
DISC = Point(0, 0).buffer(60, quad_segs=90)


def dark(x, y):
    return np.full(x.shape, 20.0)


def make(reachable=RECTANGLE, physics=None, *, light_at=dark, seed=1, **start) -> Body:
    body = Body(reachable, light_at, np.random.default_rng(seed), physics, **start)
    body.advance(0.0)
    return body


def roll(body: Body, heading_rad: float, speed_cm_s: float, duration_s: float, step_s: float = 0.05) -> None:
    """Keep it rolling, as a host does."""
    start_s = body.t_s
    for n in range(1, round(duration_s / step_s) + 1):
        body.drive(heading_rad, speed_cm_s)
        body.advance(start_s + n * step_s)


def test_it_speeds_up_and_brakes_at_the_set_rate(ideal) -> None:
    body = make(physics=ideal, position_cm=(-50.0, 0.0), facing_rad=0.0)
    body.drive(0.0, 40.0)
    body.advance(0.25)
    assert body.speed_cm_s == pytest.approx(20.0)
    assert body.x_cm == pytest.approx(-50 + 80 * 0.25**2 / 2)
    body.advance(1.5)
    # v²/2a to reach the speed, then the speed.
    assert body.distance_cm == pytest.approx(40**2 / 160 + 40 * 1.0)
    body.stop()
    body.advance(3.0)
    assert body.distance_cm == pytest.approx(2 * 40**2 / 160 + 40 * 1.0)
    assert body.speed_cm_s == 0.0
    assert not body.moving
    assert body.locator_cm == pytest.approx((0.0, body.distance_cm))


@pytest.mark.parametrize("facing_rad", [0.0, 1.0, 4.0])
@pytest.mark.parametrize("heading_rad", [0.0, math.pi / 2, 3.5])
def test_headings_are_clockwise_from_the_way_it_faced(ideal, facing_rad: float, heading_rad: float) -> None:
    body = make(physics=ideal, position_cm=(0.0, 0.0), facing_rad=facing_rad)
    roll(body, heading_rad, 30.0, 1.0)
    arena_rad = facing_rad - heading_rad
    way_cm = body.distance_cm
    assert way_cm > 10
    assert (body.x_cm, body.y_cm) == pytest.approx((way_cm * math.cos(arena_rad), way_cm * math.sin(arena_rad)))
    # Locator: x to the right, y forward, in the frame of the start.
    assert body.locator_cm == pytest.approx((way_cm * math.sin(heading_rad), way_cm * math.cos(heading_rad)))
    assert math.cos(body.facing_rad - arena_rad) == pytest.approx(1.0)


def test_resetting_the_yaw_makes_the_present_way_forward(ideal) -> None:
    body = make(physics=ideal, position_cm=(0.0, 0.0), facing_rad=0.3)
    roll(body, math.pi / 2, 20.0, 1.0)
    body.stop()
    body.advance(body.t_s + 1.0)
    body.reset_yaw()
    body.reset_locator()
    x_cm, y_cm = body.x_cm, body.y_cm
    roll(body, 0.0, 20.0, 0.5)
    assert math.atan2(body.y_cm - y_cm, body.x_cm - x_cm) == pytest.approx(0.3 - math.pi / 2)
    assert body.locator_cm[0] == pytest.approx(0.0, abs=1e-9)


def test_where_it_is_does_not_depend_on_how_often_it_is_asked() -> None:
    physics = BodySettings(drift_rad_per_cm=2e-3)
    ends = []
    for steps in (7, 100, 5000):
        body = make(physics=physics, seed=5, position_cm=(0.0, 0.0), facing_rad=0.4)
        hits: list[Impact] = []
        body.on_bump = hits.append
        body.drive(1.0, 45.0)
        for n in range(1, steps + 1):
            body.advance(3.5 * n / steps)
        assert len(hits) == 1
        ends.append((body.x_cm, body.y_cm, body.distance_cm, hits[0].t_s, *body.locator_cm))
    assert ends[0] == pytest.approx(ends[1], abs=1e-4)
    assert ends[1] == pytest.approx(ends[2], abs=1e-4)


@pytest.mark.parametrize("reachable", [RECTANGLE, DISC], ids=["rectangle", "disc"])
@given(angle_rad=st.floats(0, 6.28), x=st.floats(-30, 30), y=st.floats(-30, 30), speed=st.floats(5, 150))
@settings(max_examples=60, deadline=None)
def test_it_meets_the_wall_where_a_ray_does(reachable: Polygon, angle_rad, x, y, speed) -> None:
    ideal = BodySettings(speed_error=0, drift_rad_per_cm=0, locator_error=0, bump_angle_rad=0, drive_timeout_s=60)
    body = make(reachable, ideal, position_cm=(x, y), facing_rad=angle_rad)
    hits: list[Impact] = []
    body.on_bump = hits.append
    body.drive(0.0, speed)
    body.advance(40.0)
    along = np.array([math.cos(angle_rad), math.sin(angle_rad)])
    ray = LineString([(x, y), np.array([x, y]) + 500 * along])
    wall = Point(ray.intersection(reachable).coords[-1])
    assert len(hits) == 1
    assert wall.distance(Point(body.x_cm, body.y_cm)) < 1e-6
    assert body.pressed
    assert body.speed_cm_s == 0.0
    # The felt normal, turned back into the arena, points inwards from the wall.
    inward_rad = angle_rad - hits[0].normal_heading_rad
    normal = np.array([math.cos(inward_rad), math.sin(inward_rad)])
    assert normal @ along < 0
    assert reachable.contains(Point(np.array([body.x_cm, body.y_cm]) + 0.01 * normal))
    edge = np.array([-normal[1], normal[0]])
    beside = (
        Point(np.array([body.x_cm, body.y_cm]) + 1e-5 * edge),
        Point(np.array([body.x_cm, body.y_cm]) - 1e-5 * edge),
    )
    # Along the edge one stays on the wall (a corner may be on one side).
    assert min(reachable.exterior.distance(point) for point in beside) < 1e-9


def test_it_bumps_once_and_stays_until_it_is_sent_away(ideal) -> None:
    body = make(physics=ideal, position_cm=(50.0, 0.0), facing_rad=0.0)
    hits: list[Impact] = []
    body.on_bump = hits.append
    roll(body, 0.0, 30.0, 3.0)
    assert [round(hit.normal_heading_rad, 6) for hit in hits] == [round(math.pi, 6)]
    assert hits[0].speed_cm_s == pytest.approx(30.0)
    assert body.x_cm == pytest.approx(56.35)
    # Outwards again: it pushes and does not move, and it does not bump again.
    roll(body, 0.5, 30.0, 1.0)
    assert (body.x_cm, len(hits)) == (pytest.approx(56.35), 1)
    roll(body, hits[0].normal_heading_rad, 30.0, 1.0)
    assert body.x_cm < 50.0
    assert len(hits) == 1


def test_it_stops_by_itself_when_the_host_is_silent(ideal) -> None:
    body = make(physics=ideal, position_cm=(-50.0, 0.0), facing_rad=0.0)
    body.drive(0.0, 16.0)
    body.advance(1.9)
    assert body.speed_cm_s == pytest.approx(16.0)
    body.advance(30.0)
    assert body.distance_cm == pytest.approx(16.0 * 2.0)
    assert body.speed_cm_s == 0.0


def test_the_errors_of_runs_have_the_set_spread() -> None:
    physics = BodySettings(speed_error=0.05, drift_rad_per_cm=1e-3)
    speeds, turns = [], []
    body = make(physics=physics, position_cm=(0.0, 0.0), facing_rad=0.0)
    for n in range(400):
        start = (body.x_cm, body.y_cm, body.facing_rad, body.distance_cm)
        heading_rad = 0.0 if n % 2 == 0 else math.pi
        roll(body, heading_rad, 20.0, 1.2, 0.6)
        speeds.append(body.speed_cm_s / 20.0)
        way_cm = body.distance_cm - start[3]
        turned_rad = math.remainder(body.facing_rad - start[2] - math.pi * (n > 0), 2 * math.pi)
        turns.append(turned_rad / way_cm)
        body.x_cm, body.y_cm = 0.0, 0.0
    assert np.mean(speeds) == pytest.approx(1.0, abs=0.01)
    assert np.std(speeds) == pytest.approx(0.05, rel=0.15)
    # A run brakes along the path of the run before, so the spread is that of nearly one run.
    assert np.std(turns) == pytest.approx(1e-3, rel=0.2)


def test_mean_run_length_in_lambert_rolling_is_cauchys() -> None:
    """Cosine-law turns give isotropic uniform lines, of mean length πA/P."""
    physics = BodySettings(drive_timeout_s=60.0, acceleration_cm_s2=1e4)
    body = make(DISC, physics, seed=3)
    hits: list[Impact] = []
    body.on_bump = hits.append
    rng = np.random.default_rng(4)
    body.drive(0.0, 100.0)
    lengths = []
    for _ in range(600):
        before = len(hits)
        start_cm = body.distance_cm
        while len(hits) == before:
            body.advance(body.t_s + 0.5)
        lengths.append(body.distance_cm - start_cm)
        body.drive(hits[-1].normal_heading_rad + math.asin(2 * rng.random() - 1), 100.0)
    expected_cm = math.pi * DISC.area / DISC.length
    assert np.mean(lengths[1:]) == pytest.approx(expected_cm, rel=0.04)


def test_light_is_averaged_over_the_footprint(ideal) -> None:
    """The mean of a quadratic over a disc is known: of x² it is x0² + R²/4."""
    physics = replace(ideal, footprint_cm=2.0, led_leak_lux=8.0)
    body = make(physics=physics, light_at=lambda x, y: 100 + 3 * x - y + x * x, position_cm=(5.0, -4.0))
    assert body.light_lux() == pytest.approx(100 + 15 + 4 + 25 + 1.0, abs=0.02)
    body.led_level = 0.5
    assert body.light_lux() == pytest.approx(145 + 4.0, abs=0.02)
    assert make(physics=physics, light_at=lambda x, y: -10 + 0 * x).light_lux() == 0.0


def test_light_noise_has_the_set_spread() -> None:
    body = make(physics=BodySettings(light_noise_lux=2.0))
    readings = [body.light_lux() for _ in range(2000)]
    assert np.mean(readings) == pytest.approx(20.0, abs=0.2)
    assert np.std(readings) == pytest.approx(2.0, rel=0.1)


def test_the_battery_runs_down_faster_on_the_roll(ideal) -> None:
    body = make(physics=ideal, position_cm=(-50.0, 0.0), facing_rad=0.0)
    assert body.battery_v == pytest.approx(4.1)
    body.advance(3600.0)
    assert body.battery_v == pytest.approx(4.1 - 0.7 * 0.1)
    before_v = body.battery_v
    roll(body, 0.0, 20.0, 3.0)
    assert (before_v - body.battery_v) == pytest.approx(0.7 * 3.0 / 9000, rel=0.01)
    body.advance(1e6)
    assert body.battery_v == pytest.approx(3.4)


def test_it_starts_anywhere_and_faces_any_way() -> None:
    bodies = [make(DISC, seed=seed) for seed in range(300)]
    points = MultiPoint([(body.x_cm, body.y_cm) for body in bodies])
    assert DISC.covers(points)
    # Even over the disc: the mean of r² is R²/2.
    assert np.mean([body.x_cm**2 + body.y_cm**2 for body in bodies]) == pytest.approx(1800, rel=0.12)
    assert abs(np.mean([np.exp(1j * body.facing_rad) for body in bodies])) < 0.15
    again = make(DISC, seed=17)
    assert (again.x_cm, again.facing_rad) == (bodies[17].x_cm, bodies[17].facing_rad)


def test_time_never_runs_backwards(ideal) -> None:
    body = make(physics=ideal, position_cm=(0.0, 0.0))
    body.advance(2.0)
    body.drive(0.0, 10.0)
    body.advance(1.0)
    assert (body.t_s, body.distance_cm) == (2.0, 0.0)


@pytest.mark.parametrize(
    ("polygon", "message"),
    [
        (Polygon(), "no room"),
        (box(0, 0, 10, 10).difference(box(4, 4, 6, 6)), "convex"),
        (box(0, 0, 10, 10).union(box(0, 0, 3, 30)), "convex"),
    ],
)
def test_an_arena_that_will_not_do(polygon: Polygon, message: str) -> None:
    with pytest.raises(RequestError, match=message):
        Walls(polygon)


def test_bad_settings_and_starts_are_refused() -> None:
    with pytest.raises(RequestError, match="acceleration_cm_s2"):
        BodySettings(acceleration_cm_s2=0.0)
    with pytest.raises(RequestError, match="light_noise_lux"):
        BodySettings(light_noise_lux=-1.0)
    with pytest.raises(RequestError, match="outside the arena"):
        make(position_cm=(100.0, 0.0))


def test_a_biased_drift_bends_every_run_clockwise(ideal) -> None:
    physics = replace(ideal, drift_bias_rad_per_cm=4e-3, drive_timeout_s=60.0)
    body = make(physics=physics, position_cm=(0.0, 0.0), facing_rad=0.0)
    body.drive(0.0, 40.0)
    body.advance(1.2)
    # An arc of the circle about (0, -1/curvature).
    turned = 4e-3 * body.distance_cm
    assert body.facing_rad == pytest.approx(-turned % math.tau)
    assert (body.x_cm, body.y_cm) == pytest.approx((250 * math.sin(turned), -250 * (1 - math.cos(turned))), abs=1e-3)
    assert body.heading_rad == 0.0


def test_a_biased_odometer_reports_its_share_of_the_way(ideal) -> None:
    body = make(physics=replace(ideal, locator_bias=-0.04), position_cm=(0.0, 0.0), facing_rad=0.0)
    roll(body, 0.0, 30.0, 1.0)
    assert body.locator_cm[1] == pytest.approx(0.96 * body.distance_cm)
    assert body.locator_speed_cm_s == pytest.approx(0.96 * 30.0)


def test_held_wheels_neither_roll_nor_turn_nor_bump(ideal) -> None:
    body = make(physics=ideal, position_cm=(50.0, 0.0), facing_rad=0.0)
    hits: list[Impact] = []
    body.on_bump = hits.append
    roll(body, 0.0, 20.0, 0.2)
    body.held = True
    stood = (body.x_cm, body.y_cm, body.locator_cm, body.distance_cm, body.facing_rad)
    roll(body, 1.0, 40.0, 2.0)
    assert (body.x_cm, body.y_cm, body.locator_cm, body.distance_cm, body.facing_rad) == stood
    assert (body.speed_cm_s, body.locator_speed_cm_s, hits, body.moving) == (0.0, 0.0, [], True)
    body.held = False
    roll(body, 0.0, 40.0, 1.0)
    assert (body.x_cm, len(hits)) == (pytest.approx(56.35), 1)


def test_a_stuck_sensor_reads_the_same_whatever_it_sees(ideal) -> None:
    body = make(physics=ideal, light_at=lambda x, y: 100 + x, position_cm=(0.0, 0.0))
    body.stuck_lux = 33.0
    assert body.light_lux() == 33.0
    body.x_cm = 20.0
    assert body.light_lux() == 33.0
    body.stuck_lux = None
    assert body.light_lux() == pytest.approx(120.0, abs=0.1)


def test_the_battery_can_be_drained(ideal) -> None:
    body = make(physics=ideal)
    body.battery_charge = 0.1
    assert body.battery_v == pytest.approx(3.4 + 0.07)
    body.advance(3600.0)
    assert body.battery_charge == 0.0


def test_what_it_touches_stops_it_unless_it_moves_away(ideal) -> None:
    body = make(physics=ideal, position_cm=(0.0, 0.0), facing_rad=0.5)
    hits: list[Impact] = []
    body.on_bump = hits.append
    roll(body, 0.0, 20.0, 1.0)
    body.touch(0.5)
    assert (body.speed_cm_s, hits[0].speed_cm_s) == (pytest.approx(20.0), 0.0)
    body.touch(0.5 + math.pi - 1.0)
    assert body.speed_cm_s == 0.0
    assert hits[1].speed_cm_s == pytest.approx(20.0 * math.cos(1.0))
    # The normal points back, 1 rad to the right of straight back as headings go clockwise.
    assert hits[1].normal_heading_rad == pytest.approx(math.pi + 1.0)
    body.touch(0.5, 7.0)
    assert hits[2].speed_cm_s == 7.0


def test_it_spins_on_the_spot_until_the_time_out(ideal) -> None:
    body = make(physics=ideal, position_cm=(0.0, 0.0), facing_rad=0.0)
    roll(body, 0.0, 20.0, 1.0)
    body.spin(0.5)
    body.advance(2.0)
    x_cm = body.x_cm
    turned = 0.5 * (1.0 - 20.0 / 80.0)  # once it has braked
    assert body.heading_rad == pytest.approx(turned)
    assert body.facing_rad == pytest.approx(-turned % math.tau)
    body.advance(60.0)
    assert body.heading_rad == pytest.approx(0.5 * (2.0 - 20.0 / 80.0))
    assert body.x_cm == x_cm


def test_biases_may_be_negative_but_not_absurd() -> None:
    BodySettings(drift_bias_rad_per_cm=-0.01, locator_bias=-0.1)
    with pytest.raises(RequestError, match="drift_bias_rad_per_cm"):
        BodySettings(drift_bias_rad_per_cm=math.inf)
    with pytest.raises(RequestError, match="locator_bias"):
        BodySettings(locator_bias=-1.0)
