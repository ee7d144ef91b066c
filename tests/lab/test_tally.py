"""The sums of a session against numpy and against the estimator of cut lines, and read back from its tables."""

import itertools
import math

import numpy as np
import pandas as pd
import pytest

from lab.session.run import Run
from lab.session.tally import SharedTally, SoloTally, stored_estimate, tally_for
from lab.settings.load import load_settings
from lab.store.tables import CROSSING_COLUMNS, LINE_COLUMNS
from robot.crossings import Crossing, CrossingDetector, Levels
from robot.cutlines import CutLine, estimate_interrupted
from robot.device import Sample
from robot.turning import Leg

HALF_CM = 22.0  # a square's
SPEED_CM_S = 15.0
SETTINGS = {
    "lambert": {},
    "interior": {"motion.turning": "interior"},
    "uniform": {"motion.turning": "uniform", "motion.weighting": "run_length", "arena.kind": "disc"},
}


def made_run(line, points, length_cm, ended="bump", *, robot="SB-0001", starts_lit=False, measures=True):
    """A run whose crossings are given: ``points`` rise along it, in and out by turns; by odometry."""
    detector = CrossingDetector(Levels(20.0, 120.0, 60.0, 70.0, 80.0))
    run = Run(line, robot, Leg(0.0, None, measures), 0.0, SPEED_CM_S, True, detector)
    run.samples = [Sample(t_host_s=y_cm / SPEED_CM_S, light_lux=20.0, x_cm=0.0, y_cm=y_cm, speed_cm_s=SPEED_CM_S)
                   for y_cm in (0.0, length_cm)]  # fmt: skip
    run.rolled_cm = length_cm
    run.crossings = [Crossing(s_cm / SPEED_CM_S, s_cm, i % 2 == 0) for i, s_cm in enumerate(points)]
    run.starts_lit, run.ends_lit = starts_lit, bool(points) and points[-1] == length_cm
    run.t_end_s, run.ended = length_cm / SPEED_CM_S, ended
    return run


def drawn(rng, n, mean_cut_cm=math.inf):
    """Runs over an annulus-like pattern of one or two chords; with cuts at random along the way."""
    runs = []
    for line in range(n):
        length_cm = rng.uniform(60, 120)
        points = np.sort(rng.uniform(5, length_cm - 5, 2 * rng.integers(0, 3))).tolist()
        cut_cm = rng.exponential(mean_cut_cm) if math.isfinite(mean_cut_cm) else math.inf
        if cut_cm >= length_cm:
            runs.append(made_run(line, points, length_cm, robot=f"SB-{line % 3}"))
            continue
        points = [s_cm for s_cm in points if s_cm < cut_cm]
        if len(points) % 2:
            points.append(cut_cm)  # it ends in the light, where its chord is closed
        runs.append(made_run(line, points, cut_cm, "contact", robot=f"SB-{line % 3}"))
    return runs


def pair_sum(points, power):
    signs = [1 if i % 2 == 0 else -1 for i in range(len(points))]
    return sum(
        -one * two * (b - a) ** power
        for (a, one), (b, two) in itertools.combinations(list(zip(points, signs, strict=True)), 2)
    )


def tables_of(runs, lines):
    """The tables that a log of these runs and sums would give."""
    rows = [
        {
            "line": run.line, "robot": run.robot, "t_start_s": 0.0, "t_rolling_s": 0.0, "t_end_s": run.t_end_s,
            "length_cm": run.length_cm, "end_cm": run.path_cm(run.t_end_s), "speed_cm_s": SPEED_CM_S, "k": line.k,
            "l1_cm": line.l1_cm, "l3_cm3": line.l3_cm3, "ended": run.ended, "counts": line.counts,
            "whole": run.is_line, "weight": line.weight, "starts_lit": run.starts_lit, "ends_lit": run.ends_lit,
        }
        for run, line in zip(runs, lines, strict=True)
    ]  # fmt: skip
    crossings = [
        {"line": run.line, "order": order, "t_s": c.t_s, "s_cm": c.s_cm, "entering": c.entering}
        for run in runs
        for order, c in enumerate(run.crossings)
    ]
    return (
        pd.DataFrame(rows, columns=list(LINE_COLUMNS)).astype(LINE_COLUMNS),
        pd.DataFrame(crossings, columns=list(CROSSING_COLUMNS)).astype(CROSSING_COLUMNS),
    )


@pytest.mark.parametrize("policy", SETTINGS)
def test_one_robots_weighted_sums_against_numpy(policy):
    tally = SoloTally(load_settings(None, SETTINGS[policy]))
    runs = drawn(np.random.default_rng(3), 80)
    lines = [tally.add(run) for run in runs]
    weights, rows = [], []
    for run, line in zip(runs, lines, strict=True):
        points = [crossing.s_cm for crossing in run.crossings]
        assert (line.counts, line.k) == (True, len(points) // 2)
        assert line.l1_cm == pytest.approx(pair_sum(points, 1))
        assert line.l3_cm3 == pytest.approx(pair_sum(points, 3))
        weight = {"lambert": 1.0, "interior": 1 / run.length_cm, "uniform": run.length_cm}[policy]
        assert line.weight == pytest.approx(weight)
        if points:
            weights.append(weight)
            rows.append((len(points) / 2, pair_sum(points, 1), pair_sum(points, 3)))
    k, l1, l3 = np.average(rows, axis=0, weights=weights)
    area = math.pi / 3 * l3 / l1
    perimeter = math.pi * area * k / l1
    estimates = tally.estimates
    assert (estimates.area(), estimates.perimeter()) == (pytest.approx(area), pytest.approx(perimeter))
    assert tally.n == len(rows)
    # The errors by a jackknife over the lines, no derivative: the same to the order 1/n.
    rows, weights = np.array(rows), np.array(weights)[:, None]
    left = (weights * rows).sum(axis=0) - weights * rows
    areas = math.pi / 3 * left[:, 2] / left[:, 1]
    perimeters = math.pi * areas * left[:, 0] / left[:, 1]
    spread = np.cov(areas, perimeters) * (len(rows) - 1) ** 2 / len(rows)
    assert estimates.sigma_area() == pytest.approx(math.sqrt(spread[0, 0]), rel=0.06)
    assert estimates.sigma_perimeter() == pytest.approx(math.sqrt(spread[1, 1]), rel=0.06)
    assert estimates.correlation() == pytest.approx(spread[0, 1] / math.sqrt(spread[0, 0] * spread[1, 1]), abs=0.05)


@pytest.mark.parametrize(
    ("ended", "measures"),
    [("stall", True), ("timeout", True), ("link", True), ("stop", True), ("contact", True), ("bump", False)],
)
def test_one_robots_runs_that_are_no_lines_change_nothing(ended, measures):
    tally = SoloTally(load_settings(None))
    for run in drawn(np.random.default_rng(5), 10):
        tally.add(run)
    before = tally.n, tally.estimates.area(), tally.estimates.sigma_perimeter()
    line = tally.add(made_run(99, [10.0, 40.0], 70.0, ended, measures=measures))
    assert (line.counts, line.k, line.l1_cm) == (False, 1, pytest.approx(30.0))  # told, not counted
    assert (tally.n, tally.estimates.area(), tally.estimates.sigma_perimeter()) == before


def as_cut_line(run):
    """What the estimator of cut lines takes: without the crossings that only close a run."""
    own = list(run.crossings)
    own = own[1:] if run.starts_lit else own
    own = own[:-1] if run.ends_lit else own
    return CutLine(
        [crossing.s_cm for crossing in own],
        [crossing.entering for crossing in own],
        run.starts_lit,
        run.length_cm,
        run.ended != "bump",
    )


def test_several_robots_sums_are_those_of_the_estimator_of_cut_lines():
    runs = drawn(np.random.default_rng(7), 400, mean_cut_cm=150)
    runs += [made_run(400 + i, [0.0, 8.0 + i, 20.0, 30.0], 50.0, starts_lit=True) for i in range(5)]
    tally = SharedTally()
    lines = [tally.add(run) for run in runs]
    found = estimate_interrupted([as_cut_line(run) for run in runs])
    assert found.cuts > 30
    assert sum(not line.counts for line in lines) <= 3  # cut within half a centimetre
    assert {line.weight for line in lines} == {1.0}
    runs = [run for run, line in zip(runs, lines, strict=True) if line.counts]
    # Under a path per cut that may be 2 % old; the area follows it by `reach` times as much.
    assert found.reach < 1
    assert tally.estimates.path_per_cut_cm == pytest.approx(found.path_per_cut_cm, rel=0.0201)
    assert tally.estimates.area() == pytest.approx(found.area(), rel=0.02)
    assert tally.estimates.perimeter() == pytest.approx(found.perimeter(), rel=0.02)
    same = estimate_interrupted([as_cut_line(run) for run in runs], tally.estimates.path_per_cut_cm)
    assert tally.estimates.area() == pytest.approx(same.area())
    assert tally.estimates.perimeter() == pytest.approx(same.perimeter())
    assert tally.n == sum(bool(run.crossings) for run in runs)
    # and the cuts did take something away
    plain = np.mean([(line.k, line.l1_cm, line.l3_cm3) for line in lines if line.k], axis=0)
    assert math.pi / 3 * plain[2] / plain[1] < 0.93 * found.area()


def test_several_robots_without_a_cut_are_as_one():
    runs = drawn(np.random.default_rng(9), 60)
    shared, solo = SharedTally(), SoloTally(load_settings(None))
    for run in runs:
        assert shared.add(run) == solo.add(run)
    for figure in ("area", "perimeter", "sigma_area", "sigma_perimeter", "correlation"):
        assert getattr(shared.estimates, figure)() == pytest.approx(getattr(solo.estimates, figure)())


@pytest.mark.parametrize(("ended", "length_cm", "counts"), [
    ("link", 50.0, False), ("contact", 0.3, False), ("stall", 0.2, False), ("stall", 50.0, True),
    ("contact", 50.0, True), ("timeout", 50.0, True), ("bump", 50.0, True),
])  # fmt: skip
def test_which_runs_of_several_robots_count(ended, length_cm, counts):
    tally = SharedTally()
    points = [10.0, 30.0] if length_cm > 30 else []
    assert tally.add(made_run(0, points, length_cm, ended)).counts is counts
    assert tally.n == (1 if counts else 0)


def test_a_cut_at_the_very_edge_of_the_light_ends_no_session():
    """The first path per cut may be absurdly short: a hair of light, then another robot."""
    tally = SharedTally()
    tally.add(made_run(0, [10.0, 10.001], 10.001, "contact"))
    tally.add(made_run(1, [10.0, 50.0], 100.0))
    for run in drawn(np.random.default_rng(11), 40, mean_cut_cm=200):
        tally.add(run)
    assert 0 < tally.estimates.area() < math.inf


@pytest.mark.parametrize("policy", [*SETTINGS, "several"])
def test_the_tables_make_the_estimate_again(policy):
    tally = SharedTally() if policy == "several" else SoloTally(load_settings(None, SETTINGS[policy]))
    runs = drawn(np.random.default_rng(13), 150, mean_cut_cm=200 if policy == "several" else math.inf)
    if policy != "several":
        for run in runs:
            run.robot = "SB-0001"
        runs[7].ended = "stall"
    runs.append(made_run(150, [4.0, 44.0], 44.0, "link"))
    found = stored_estimate(*tables_of(runs, [tally.add(run) for run in runs]))
    # Several robots' session counts under a path per cut that may be 2 % old; else it is the same to rounding.
    off = {"rel": 0.02} if policy == "several" else {"rel": 1e-9}
    assert found.n == tally.n
    assert found.area_cm2 == pytest.approx(tally.estimates.area(), **off)
    assert found.perimeter_cm == pytest.approx(tally.estimates.perimeter(), **off)
    wide = {"rel": 0.06} if policy == "several" else {"rel": 1e-9}
    assert found.sigma_area_cm2 == pytest.approx(tally.estimates.sigma_area(), **wide)
    assert found.sigma_perimeter_cm == pytest.approx(tally.estimates.sigma_perimeter(), **wide)
    assert found.correlation == pytest.approx(tally.estimates.correlation(), abs=0.02)


def test_tables_of_one_line_make_no_estimate():
    for tally in (SharedTally(), SoloTally(load_settings(None))):
        runs = [made_run(0, [10.0, 30.0], 60.0), made_run(1, [], 60.0, robot="SB-0002")]
        if isinstance(tally, SoloTally):
            runs = runs[:1]
        assert stored_estimate(*tables_of(runs, [tally.add(run) for run in runs])) is None


def test_the_settings_choose_the_sums():
    assert isinstance(tally_for(load_settings(None)), SoloTally)
    assert isinstance(tally_for(load_settings(None, {"robot": ["virtual"] * 2, "camera": "none"})), SharedTally)
