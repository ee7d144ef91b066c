"""The manoeuvre that feels the direction of an edge of light, and the lines that it leads to."""

import asyncio
import contextlib
import math

import numpy as np
import pytest
import shapely
from scipy.stats import kstest

from lab.clock import run as run_clock
from robot.bolt import Bolt
from robot.device import Sample
from robot.edge import EdgeDetector, EdgePoint
from robot.feeledge import EdgeError, FeltEdge, feel_edge
from robot.turning import NOWHERE_CM, LegEnd, navigator_for
from robot.virtual.body import Body, BodySettings
from robot.virtual.bolt import VirtualBolt
from robot.virtual.radio import VirtualRadio
from tests.robot.ringlight import ARENAS, LUX, RING_CM, levels_of, light, within_cm

SLOW_CM_S = 12.0


def ball(arena, kind, seed, **start):
    walls = ARENAS[arena].buffer(RING_CM, join_style="mitre")
    return Body(walls, light(arena, kind), np.random.default_rng(seed), BodySettings(), **start)


class BodyRover:
    """Rolls a body directly, sampled every ``interval_s``."""

    def __init__(self, body, interval_s=0.05):
        self.body, self.interval_s = body, interval_s
        body.advance(0.0)

    def sample(self):
        body = self.body
        body.advance(body.t_s + self.interval_s)
        return Sample(body.t_s, body.light_lux(), *body.locator_cm, body.locator_speed_cm_s)

    async def roll(self, heading_rad, speed_cm_s, until, timeout_s):
        end_s, told = self.body.t_s + timeout_s, False
        while not told and self.body.t_s < end_s:
            self.body.drive(heading_rad, speed_cm_s)
            told = until(self.sample())
        self.body.stop()
        while self.body.speed_cm_s > 0:
            until(self.sample())
        return told


class BoltRover:
    """Rolls a BOLT through its driver and its radio."""

    def __init__(self, robot):
        self.robot = robot
        self.heard = asyncio.Queue()
        robot.on_sample = self.heard.put_nowait

    async def roll(self, heading_rad, speed_cm_s, until, timeout_s):
        while not self.heard.empty():
            self.heard.get_nowait()
        told = False
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self.robot.drive(heading_rad, speed_cm_s)
                while not told:
                    told = until(await self.heard.get())
        await self.robot.stop()
        sample = None
        while sample is None or sample.speed_cm_s > 0.1:
            sample = await self.heard.get()
            until(sample)
        return told


async def to_the_ring(rover, levels, heading_rad, speed_cm_s):
    """Roll until the ring; the entry, or None, and the last sample."""
    detector, entries, last = EdgeDetector(levels), [], []

    def until(sample):
        last[:] = [sample]
        passage = detector.feed(sample.t_host_s, sample.x_cm, sample.y_cm, sample.light_lux)
        if passage is not None and passage.into_ring:
            entries.append(passage)
        return bool(entries)

    await rover.roll(heading_rad, speed_cm_s, until, 30.0)
    return (entries[0] if entries else None), last[0]


def error_of(arena, felt: FeltEdge, body):
    """Angle in degrees between the felt normal and the true one where the robot left the ring.

    The gyro's drift turns the robot's frame without its knowing, so the frame is taken as it is now.
    """
    frame = body.facing_rad + body.heading_rad
    dx, dy = felt.left.x_cm - felt.x_cm, felt.left.y_cm - felt.y_cm
    x = body.x_cm + dx * math.sin(frame) + dy * math.cos(frame)
    y = body.y_cm - dx * math.cos(frame) + dy * math.sin(frame)
    if arena == "disc":
        true = math.atan2(-y, -x)
    elif 56 - abs(x) < 41 - abs(y):
        true = math.pi if x > 0 else 0.0
    else:
        true = -math.pi / 2 if y > 0 else math.pi / 2
    return math.degrees(math.remainder(frame - felt.normal_heading_rad - true, math.tau))


def beside_a_corner(arena, body, cut_cm=12.0):
    return arena == "rectangle" and 56 - abs(body.x_cm) < cut_cm and 41 - abs(body.y_cm) < cut_cm


# --- the manoeuvre


async def feel_many(arena, kind, rover, body, levels, rng, count, speed_cm_s=30.0):
    """Roll at uniform headings from near the middle to the ring and feel it; errors away from and at corners."""
    plain, corner, depths = [], [], []
    radius_cm = 46.0 if arena == "disc" else math.inf
    heading_rad = rng.uniform(0, math.tau)
    while len(plain) + len(corner) < count:
        entered, _ = await to_the_ring(rover, levels, heading_rad, speed_cm_s)
        near_corner = beside_a_corner(arena, body)
        felt = await feel_edge(rover, levels, entered, heading_rad, SLOW_CM_S, radius_cm=radius_cm)
        depths.append(within_cm(arena, body.x_cm, body.y_cm))
        (corner if near_corner or beside_a_corner(arena, body) else plain).append(error_of(arena, felt, body))
        heading_rad = felt.normal_heading_rad + math.asin(1.8 * rng.random() - 0.9)
    return np.abs(plain), np.abs(corner), depths


@pytest.mark.parametrize("kind", LUX)
@pytest.mark.parametrize("arena", ARENAS)
def test_the_normal_is_felt_by_a_body(arena, kind):
    body = ball(arena, kind, 3, position_cm=(0.0, 0.0), facing_rad=0.4)
    rng = np.random.default_rng(8)
    feeling = feel_many(arena, kind, BodyRover(body), body, levels_of(kind), rng, 60)
    plain, corner, depths = run_clock(feeling, virtual=True)
    assert min(depths) > 0
    assert np.median(plain) < 5
    assert np.quantile(plain, 0.95) < 15
    assert corner.size == 0 or corner.max() < 100  # a cut corner's normal still leads inwards, give or take


@pytest.mark.parametrize(("arena", "kind"), [("rectangle", "dark"), ("disc", "bright")])
def test_the_normal_is_felt_by_a_virtual_bolt(arena, kind):
    async def session():
        radio = VirtualRadio(rng=np.random.default_rng(1))
        await radio.start()
        body = ball(arena, kind, 4, position_cm=(5.0, -3.0), facing_rad=1.1)
        virtual = VirtualBolt(radio, body, "SB-1234")
        await virtual.start()
        robot = Bolt("SB-1234", backend=radio.client_backend, scanner_backend=radio.scanner_backend)
        try:
            await robot.connect()
            await robot.start_stream(0.05)
            rover, rng = BoltRover(robot), np.random.default_rng(2)
            return await feel_many(arena, kind, rover, body, levels_of(kind), rng, 15)
        finally:
            await robot.disconnect()
            await virtual.close()
            await radio.close()

    plain, _, depths = run_clock(session(), virtual=True)
    assert min(depths) > 0
    assert np.median(plain) < 5


class Stuck:
    """A robot that is told to roll and does not, or sees only what it is given."""

    def __init__(self, samples):
        self.samples = samples

    async def roll(self, heading_rad, speed_cm_s, until, timeout_s):
        answers = [until(sample) for sample in self.samples]
        return any(answers)


def test_a_robot_that_does_not_come_out_says_so():
    entered = EdgePoint(0.0, 0.0, 0.0, into_ring=True)
    held = Stuck([Sample(0.1 * i, 20.0, 0.0, 1.0, 0.0) for i in range(5)])
    with pytest.raises(EdgeError, match="did not find out") as caught:
        run_clock(feel_edge(held, levels_of("dark"), entered, 0.0, 10.0), virtual=True)
    assert caught.value.in_ring
    assert "\n" not in str(caught.value)
    outside = Stuck([Sample(0.1 * i, 60.0, 0.0, 1.0, 0.0) for i in range(5)])
    with pytest.raises(EdgeError, match="outside the edge's ring") as caught:
        run_clock(feel_edge(outside, levels_of("dark"), entered, 0.0, 10.0), virtual=True)
    assert not caught.value.in_ring


def test_the_stretch_behind_the_robot():
    felt = FeltEdge(math.pi / 2, EdgePoint(0.0, 5.0, 7.0, into_ring=False), 7.0, 8.0)  # inwards is +x; 2 cm inside
    assert felt.run_up_cm(math.pi / 2) == pytest.approx(2.0)
    assert felt.run_up_cm(math.pi / 2 + math.pi / 3) == pytest.approx(4.0)
    assert felt.run_up_cm(-math.pi / 2) == 0.0


# --- the whole billiard


async def billiard(arena, kind, runs, seed, interval_s=0.05):
    """Lambert's turn at an edge of light: lengths as the robot knows them, the true lines, depths of their starts."""
    body = ball(arena, kind, seed, position_cm=(0.0, 0.0))
    rover, levels, rng = BodyRover(body, interval_s), levels_of(kind), np.random.default_rng(seed)
    navigator = navigator_for("lambert", rng)
    leg, run_up_cm, found = navigator.first(), 0.0, []
    while len(found) < runs:
        x_cm, y_cm = body.locator_cm
        start = body.x_cm, body.y_cm
        entered, _ = await to_the_ring(rover, levels, leg.heading_rad, 30.0)
        rolled_cm = math.hypot(entered.x_cm - x_cm, entered.y_cm - y_cm)
        if leg.measures and rolled_cm > NOWHERE_CM:
            found.append((run_up_cm + rolled_cm, within_cm(arena, *start), *start, body.x_cm, body.y_cm))
        felt = await feel_edge(
            rover,
            levels,
            entered,
            leg.heading_rad,
            SLOW_CM_S,
            radius_cm=46.0 if arena == "disc" else math.inf,
            rolled_cm=rolled_cm,
        )
        leg = navigator.next(LegEnd(leg, rolled_cm, felt.normal_heading_rad, at_edge=True))
        run_up_cm = felt.run_up_cm(leg.heading_rad)
    return np.array(found).T


def widths_cm(arena, theta, shrunk_cm):
    """Width of the arena, shrunk, across lines whose normal has the direction theta."""
    if arena == "disc":
        return np.full_like(theta, 2 * (46 - shrunk_cm))
    return 2 * ((56 - shrunk_cm) * np.abs(np.cos(theta)) + (41 - shrunk_cm) * np.abs(np.sin(theta)))


def chords_cm(arena, theta, p):
    """Lengths, by shapely, of the lines (theta, p) in the arena."""
    x, y, dx, dy = p * np.cos(theta), p * np.sin(theta), 300 * np.sin(theta), -300 * np.cos(theta)
    ends = np.stack([np.column_stack([x - dx, y - dy]), np.column_stack([x + dx, y + dy])], axis=1)
    return shapely.length(shapely.intersection(ARENAS[arena], shapely.linestrings(ends)))


@pytest.mark.slow
@pytest.mark.parametrize(("arena", "kind"), [("rectangle", "dark"), ("disc", "bright")])
def test_lambert_at_an_edge_of_light_gives_uniform_isotropic_lines(arena, kind):
    """2400 runs against uniform isotropic lines that meet the arena shrunk by the depth of their starts.

    Cut corners cost something: in the rectangle up to 4 % of the lines lie elsewhere, and runs are 1 to 3 % longer.
    """
    lengths, depths, x0, y0, x1, y1 = run_clock(billiard(arena, kind, 2400, 6), virtual=True)
    depth_cm = depths.mean()
    assert 1.0 < depth_cm < 3.0
    theta = np.arctan2(y1 - y0, x1 - x0) + math.pi / 2
    p = x0 * np.cos(theta) + y0 * np.sin(theta)
    p, theta = np.where(theta % math.tau < math.pi, p, -p), theta % math.pi

    grid = np.linspace(0, math.pi, 4001)
    width = widths_cm(arena, grid, depth_cm)
    share = np.concatenate([[0.0], np.cumsum((width[1:] + width[:-1]) / 2)])
    share /= share[-1]
    assert kstest(np.interp(theta, grid, share), "uniform").statistic < 0.03
    assert kstest(p / np.interp(theta, grid, width) + 0.5, "uniform").statistic < 0.035

    rng = np.random.default_rng(1)
    theta_drawn = np.interp(rng.random(20_000), share, grid)
    p_drawn = (rng.random(20_000) - 0.5) * widths_cm(arena, theta_drawn, depth_cm)
    expected_cm = chords_cm(arena, theta_drawn, p_drawn).mean()
    cauchy_cm = math.pi * ARENAS[arena].area / ARENAS[arena].length
    assert cauchy_cm < expected_cm < 1.06 * cauchy_cm
    true_cm = chords_cm(arena, theta, p)
    assert true_cm.mean() == pytest.approx(expected_cm, rel=0.03)
    # A bright ring is placed a quarter of a footprint late, at either end; the odometer's scale is half a per cent off.
    assert np.median(np.abs(lengths - true_cm)) < 2.0
