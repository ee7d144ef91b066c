"""Lines, runs and times: closed forms, and simulated robots in an arena."""

import math

import numpy as np
import pytest
from shapely.geometry import Point, box

from analysis.billiard import roll
from analysis.boundary import Boundary
from analysis.exploration import disc_arena, rectangle_arena
from analysis.montecarlo import cross_lines, simulate
from analysis.planning import Pace, lines_for_precision, middle_and_likely, need_of, sessions_until
from analysis.quadrature import exact_moments
from lab.base.errors import RequestError


def pace(reachable=None, *, speed=15.0, pause=0.5, robots=1):
    return Pace.on(reachable or rectangle_arena(120, 90), speed, pause, robots=robots, diameter_cm=7.3)


def test_a_discs_precision_is_the_closed_form():
    # σ_0 of a disc: 0.30437 and 0.17118 for one line
    area, perimeter = lines_for_precision(exact_moments(Point(0, 0).buffer(15, quad_segs=180)), 0.01)
    assert area == pytest.approx(0.30437**2 * 1e4, abs=2)
    assert perimeter == pytest.approx(0.17118**2 * 1e4, abs=2)


def test_that_many_lines_give_that_precision(shapes, rng):
    area, _ = lines_for_precision(exact_moments(shapes["tower"]), 0.05)
    found = simulate(shapes["tower"], lines=area, runs=4000, rng=rng)
    assert found.area_cm2.std() / shapes["tower"].area == pytest.approx(0.05, rel=0.06)


@pytest.mark.parametrize("reachable", [rectangle_arena(120, 90), disc_arena(50)], ids=["rectangle", "disc"])
def test_runs_and_their_length_are_those_of_simulated_robots(shapes, rng, reachable):
    rolls = roll(reachable, 400, 500, rng)
    assert pace(reachable).mean_run_cm == pytest.approx(rolls.length_cm.mean(), rel=0.01)
    square = shapes["square"]
    k, _, _ = cross_lines(Boundary.of(square), rolls.theta_rad.ravel(), rolls.p_cm.ravel())
    share = exact_moments(square).hitting_measure_cm / reachable.length
    assert share == pytest.approx((k > 0).mean(), rel=0.01)
    crossed = np.cumsum((k > 0).reshape(400, 500), axis=1)
    needed = (crossed < 60).sum(axis=1) + 1
    need = need_of(60, share, pace(reachable))
    assert need.runs == pytest.approx(np.median(needed), rel=0.02)
    assert need.runs_likely == pytest.approx(np.quantile(needed, 0.9), rel=0.03)


def test_a_time_by_hand():
    # π · 60 · 90 / (2 (60 + 90)) = 56.5 cm at 10 cm/s and half a second
    alone = pace(box(0, 0, 60, 90), speed=10.0)
    assert alone.mean_run_cm == pytest.approx(18 * math.pi)
    assert alone.run_s == pytest.approx(1.8 * math.pi + 0.5)
    need = need_of(40, 1.0, alone)
    assert (need.runs, need.lines_likely) == (40, 40)
    assert need.seconds == pytest.approx(40 * alone.run_s)
    longer = need_of(40, 0.5, alone, likely=70)
    assert longer.runs < 70 * 2 < longer.runs_likely


def test_more_robots_are_quicker_but_meet():
    one, two, four = (pace(robots=robots) for robots in (1, 2, 4))
    assert one.meetings_per_s == 0
    assert four.meetings_per_s == pytest.approx(3 * two.meetings_per_s)
    assert one.paths_per_s < two.paths_per_s < 2 * one.paths_per_s
    assert two.whole_runs_per_s < two.paths_per_s
    assert four.whole_runs_per_s < 4 * one.whole_runs_per_s
    # so rarely that nothing is cut: the limit is that of robots alone
    vast = Pace.on(rectangle_arena(1e5, 1e5), 15.0, 0.5, robots=3, diameter_cm=1e-6)
    assert vast.whole_runs_per_s == pytest.approx(vast.paths_per_s, rel=1e-4)
    assert vast.paths_per_s == pytest.approx(3 / vast.run_s, rel=1e-4)


def test_when_sessions_stop_by_hand():
    n = np.array([10, 20, 30])
    log = np.zeros((2, 3, 3))
    log[0, :, 0] = [0, 5, 9]  # posterior 1/3, 0.987, 0.9998
    log[1, :, 2] = [0, 1, 2]  # never
    own = np.array([True, False, False])
    assert sessions_until(log, n, own, 0.95).tolist() == [20, np.inf]
    # a twin's share counts as its own
    log[1, :, 0] = log[1, :, 1] = [0, 4, 8]
    assert sessions_until(log, n, np.array([True, True, False]), 0.95)[1] == 20
    assert middle_and_likely(np.array([10.0, 20, np.inf])) == (20, None)
    assert middle_and_likely(np.arange(1.0, 102.0)) == (51, 91)


def test_what_cannot_be_planned():
    moments = exact_moments(box(0, 0, 9, 9))
    with pytest.raises(RequestError, match="precision"):
        lines_for_precision(moments, 0)
    with pytest.raises(RequestError, match="do not roll"):
        pace(speed=0)
    with pytest.raises(RequestError, match="share"):
        need_of(10, 0, pace())
