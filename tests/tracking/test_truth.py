"""True crossings of shapes, and the robot's chords against them."""

import json

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import MultiPolygon, Point, Polygon, box
from shapely.affinity import rotate, translate

from lab.base.errors import RequestError
from tracking.chords import align, chord_table
from tracking.linespace import roll
from tracking.matching import match_crossings
from tracking.runs import TrackError, fit_lines
from tracking.truth import TRUE_CROSSINGS, true_crossings

ARENA = box(-60, -45, 60, 45)
ANNULUS = Point(5, -4).buffer(20, quad_segs=60).difference(Point(5, -4).buffer(9, quad_segs=60))
ELL = Polygon([(-25, -20), (20, -20), (20, -8), (-10, -8), (-10, 25), (-25, 25)])
TWO = MultiPolygon([box(-40, -20, -10, 10), translate(rotate(box(0, 0, 18, 25), 20), 8, -10)])


def line(start, end, number=0, t=(0.0, 1.0)):
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    return {
        "line": number,
        "x_start_cm": start[0],
        "y_start_cm": start[1],
        "x_end_cm": end[0],
        "y_end_cm": end[1],
        "t_start_s": t[0],
        "t_end_s": t[1],
        "length_cm": float(np.hypot(*(end - start))),
        "rms_cm": 0.05,
    }


def table(*lines):
    return pd.DataFrame(list(lines))


def runs_in_arena(n, seed):
    """True lines of a perfect session: chords of the arena, either way round."""
    rolls = roll(ARENA, 1, n, np.random.default_rng(seed))
    theta, p = rolls.theta_rad[0], rolls.p_cm[0]
    rows = []
    for number, (t, q) in enumerate(zip(theta, p, strict=True)):
        normal, along = np.array([np.cos(t), np.sin(t)]), np.array([-np.sin(t), np.cos(t)])
        with np.errstate(divide="ignore"):
            reach = np.sort(((np.array([[-60, 60], [-45, 45]]) - (q * normal)[:, None]) / along[:, None]), axis=1)
        ends = q * normal + np.array([[reach[:, 0].max()], [reach[:, 1].min()]]) * along
        rows.append(line(*(ends if number % 2 else ends[::-1]), number, t=(10.0 * number, 10.0 * number + 4)))
    return table(*rows)


def crossings(*chords, number=0, rate=0.04, delay=0.0):
    """A table of crossings from (in, out) pairs in cm."""
    s = np.ravel(chords).astype(float)
    return pd.DataFrame(
        {
            "line": number,
            "order": np.arange(len(s)),
            "t_s": 100.0 * number + rate * s + delay,
            "s_cm": s,
            "entering": np.arange(len(s)) % 2 == 0,
            "x_cm": s,
            "y_cm": 0.0,
        }
    )


# --- true crossings


def test_annulus_along_a_diameter():
    found = true_crossings(table(line((-45, -4), (55, -4), 3, t=(20, 24))), ANNULUS)
    assert tuple(found.columns) == TRUE_CROSSINGS
    assert found["line"].tolist() == [3] * 4
    assert found["order"].tolist() == [0, 1, 2, 3]
    assert found["entering"].tolist() == [True, False, True, False]
    assert found["s_cm"].to_numpy() == pytest.approx([30, 41, 59, 70])
    assert found["t_s"].to_numpy() == pytest.approx(20 + 4 * np.array([30, 41, 59, 70]) / 100)
    assert found["x_cm"].to_numpy() == pytest.approx([-15, -4, 14, 25])


def test_distance_runs_in_the_order_of_travel():
    there = true_crossings(table(line((-50, 2), (50, -5))), TWO)
    back = true_crossings(table(line((50, -5), (-50, 2))), TWO)
    length = np.hypot(100, 7)
    assert len(there) == 4
    np.testing.assert_allclose(back["s_cm"], length - there["s_cm"].to_numpy()[::-1])
    assert back["entering"].tolist() == [True, False, True, False]


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([ANNULUS, ELL, TWO]))
def test_lit_where_the_shape_is(seed, shape):
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-55, 55, (2, 2))
    if np.hypot(*(b - a)) < 1:
        return
    found = true_crossings(table(line(a, b)), shape)
    length = np.hypot(*(b - a))
    s = np.linspace(0, length, 400)[1:-1]
    place = a + s[:, None] / length * (b - a)
    lit = np.searchsorted(found["s_cm"], s) % 2 == 1
    away = np.array([shape.boundary.distance(Point(q)) for q in place]) > 1e-6
    assert (lit == np.array([shape.covers(Point(q)) for q in place]))[away].all()


def test_touching_is_no_crossing():
    square = box(0, 0, 10, 10)
    for touch in [
        line((-5, 5), (5, -5)),  # a corner
        line((-5, 10), (15, 10)),  # along an edge
        line((-30, 40), (30, 40)),  # far off
    ]:
        empty = true_crossings(table(touch), square)
        assert len(empty) == 0
        assert tuple(empty.columns) == TRUE_CROSSINGS
    # through the point where two pieces meet: one lit stretch, and through the hole's corner as well
    corner_to_corner = MultiPolygon([box(0, 0, 10, 10), box(10, 10, 20, 20)])
    found = true_crossings(table(line((-5, -5), (25, 25))), corner_to_corner)
    assert found["s_cm"].to_numpy() == pytest.approx(np.array([5, 25]) * np.sqrt(2))
    holed = box(0, 0, 20, 20).difference(box(5, 5, 10, 10))
    assert len(true_crossings(table(line((5, -5), (15, 25))), holed)) == 2 * 2
    assert len(true_crossings(table(line((1, 19), (19, 1))), holed)) == 2


def test_a_run_that_ends_inside_is_closed_there():
    found = true_crossings(table(line((-5, 5), (4, 5))), box(0, 0, 10, 10))
    assert found["s_cm"].tolist() == pytest.approx([5, 9])


def test_lines_without_a_fit_are_skipped():
    lines = table(line((-5, 5), (np.nan, 5), 0), line((-5, 5), (15, 5), 1))
    assert set(true_crossings(lines, box(0, 0, 10, 10))["line"]) == {1}


@pytest.mark.parametrize("shape", [ANNULUS, ELL, TWO])
def test_crossings_of_many_lines_measure_area_and_perimeter(shape):
    """Integral geometry as referee: lit path / path = A/A_arena, chords per run = P/P_arena."""
    lines = runs_in_arena(6000, 5)
    chords = chord_table(true_crossings(lines, shape))
    assert chords["length_cm"].sum() / lines["length_cm"].sum() == pytest.approx(shape.area / ARENA.area, rel=0.03)
    assert len(chords) / len(lines) == pytest.approx(shape.length / ARENA.length, rel=0.04)


def test_times_follow_the_robot_and_not_a_mean_speed():
    t = np.arange(0, 5, 1 / 30)
    s = 60 * (t / 5) ** 2 * (3 - 2 * t / 5)
    track = pd.DataFrame({"line": 9, "t_s": 50 + t, "x_cm": s - 30, "y_cm": 0.5 + 0 * s})
    lines = fit_lines(track)
    square = box(-20, -10, 4, 10)
    by_speed = true_crossings(lines, square)
    by_track = true_crossings(lines, square, track=track)
    true_t = 50 + np.interp([10, 34], s, t)
    assert by_track["t_s"].to_numpy() == pytest.approx(true_t, abs=0.005)
    assert np.abs(by_speed["t_s"].to_numpy() - true_t).max() > 0.2
    np.testing.assert_allclose(by_track["s_cm"], by_speed["s_cm"])
    np.testing.assert_allclose(by_track["x_cm"], [-20, 4], atol=1e-6)


def test_shapes_that_are_none():
    for shape in (Polygon(), Polygon([(0, 0), (2, 2), (2, 0), (0, 2)])):
        with pytest.raises(RequestError, match="no valid polygon"):
            true_crossings(table(line((0, 0), (1, 1))), shape)
    with pytest.raises(TrackError, match="x_start_cm"):
        true_crossings(pd.DataFrame({"line": [1]}), box(0, 0, 1, 1))


# --- chords


def test_chords_pair_entering_with_leaving():
    whole = crossings((5, 9), (12, 30), number=2)
    chords = chord_table(pd.concat([whole, crossings((1, 2), number=4)]).sample(frac=1, random_state=1))
    assert chords["line"].tolist() == [2, 2, 4]
    assert chords["chord"].tolist() == [0, 1, 0]
    assert chords["length_cm"].tolist() == [4, 18, 1]
    assert chords["x_cm"].tolist() == [7, 21, 1.5]
    assert chords["t_out_s"].iloc[0] == pytest.approx(200.36)
    # a missed edge costs its chord only
    assert chord_table(whole.iloc[[0, 2, 3]])["length_cm"].tolist() == [18]
    assert chord_table(whole.iloc[[1, 2, 3]])["length_cm"].tolist() == [18]
    assert chord_table(whole.iloc[:0]).empty
    assert chord_table(whole.drop(columns=["t_s", "x_cm"]))["t_in_s"].isna().all()


# --- the robot's chords against the true ones


def test_a_perfect_robot_with_another_origin():
    true = true_crossings(runs_in_arena(80, 6), ELL)
    robot = true.assign(s_cm=true["s_cm"] - 3.1, t_s=true["t_s"] + 0.12).drop(columns=["x_cm", "y_cm"])
    match = match_crossings(robot, true)
    assert (match.matched, match.missed, match.extra) == (len(true) // 2, 0, 0)
    assert match.lines == true["line"].nunique()
    assert match.bias_cm == pytest.approx(0, abs=1e-9)
    assert match.rms_cm == pytest.approx(0, abs=1e-9)
    assert match.scale == pytest.approx(1)
    assert match.offset_cm == pytest.approx(3.1)
    assert match.offset_s == pytest.approx(0.12)
    assert match.jitter_s == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(match.pairs["robot_centre_cm"], match.pairs["true_centre_cm"])
    assert match.pairs["overlap"].to_numpy() == pytest.approx(1)


def test_bias_noise_and_scale_are_told_apart():
    rng = np.random.default_rng(7)
    true = true_crossings(runs_in_arena(900, 8), ANNULUS)
    sign = np.where(true["entering"], -1, 1)
    s = true["s_cm"] * 1.06 + sign * 0.25 + rng.normal(0, 0.2, len(true)) - 2.0
    match = match_crossings(true.assign(s_cm=s), true)
    assert match.matched > 0.98 * len(true) / 2
    assert match.scale == pytest.approx(1.06, abs=5 * match.scale_sigma)
    assert match.scale_sigma < 0.005
    longer = 0.06 * match.pairs["true_length_cm"]
    assert match.bias_cm == pytest.approx(0.5 + longer.mean(), abs=0.05)
    assert match.sd_cm == pytest.approx(np.hypot(0.2 * np.sqrt(2), longer.std()), rel=0.1)
    assert match.rms_cm == pytest.approx(np.hypot(match.bias_cm, match.sd_cm), rel=1e-3)
    assert match.limits_cm == pytest.approx((match.bias_cm - 1.96 * match.sd_cm, match.bias_cm + 1.96 * match.sd_cm))
    outside = (match.pairs["difference_cm"] < match.limits_cm[0]) | (match.pairs["difference_cm"] > match.limits_cm[1])
    assert 0.02 < outside.mean() < 0.08
    fields = json.loads(json.dumps(match.to_dict()))
    assert fields["matched"] == match.matched
    assert "pairs" not in fields


def test_missed_and_extra_chords_are_counted():
    true = pd.concat([crossings((10, 25), (31, 33), (40, 60), number=n) for n in range(12)])
    robot = pd.concat(
        [
            crossings((9.5, 24.5), (39.5, 59.5), number=0),  # one missed
            crossings((9.5, 24.5), (30.5, 32.5), (34, 36), (39.5, 59.5), number=1),  # one extra
            *[crossings((9.5, 24.5), (30.5, 32.5), (39.5, 59.5), number=n) for n in range(2, 11)],
            crossings((5, 15), number=20),  # a line the camera never saw
        ]
    )
    match = match_crossings(robot, true)
    assert (match.matched, match.missed, match.extra) == (12 * 3 - 4, 4, 2)
    assert match.lines == 13
    assert match.pairs.groupby("line").size().tolist() == [2] + [3] * 10
    seen = match_crossings(robot, true, lines=range(12))
    assert (seen.matched, seen.missed, seen.extra) == (32, 4, 1)
    assert match_crossings(robot, true, lines=[0, 1, 15]).lines == 3


def test_the_offset_of_one_line_bows_to_that_of_all():
    """A lone chord 4 cm off is another chord, though its own offset would explain it."""
    true = pd.concat([crossings((10, 14), (30, 34), number=n) for n in range(20)])
    robot = pd.concat(
        [crossings((11, 15), (31, 35), number=n) for n in range(19)] + [crossings((24.5, 28.5), number=19)]
    )
    match = match_crossings(robot, true)
    assert match.offset_cm == pytest.approx(-1)
    assert (match.matched, match.missed, match.extra) == (38, 2, 1)


def test_merged_chords_match_the_greater_part():
    true = pd.concat([crossings((10, 30), (30.6, 35), (50, 60), number=n) for n in range(9)])
    robot = pd.concat([crossings((10, 35), (50, 60), number=n) for n in range(9)])
    match = match_crossings(robot, true)
    assert (match.matched, match.missed, match.extra) == (18, 9, 0)
    assert set(match.pairs["true_length_cm"]) == {20, 10}


def test_merged_chords_do_not_feign_a_scale():
    true = pd.concat([crossings((10, 30), (30.6, 32), (50, 60), number=n) for n in range(9)])
    robot = pd.concat([crossings((10, 32), (50, 60), number=n) for n in range(9)])
    match = match_crossings(robot, true)
    assert (match.matched, match.missed, match.extra) == (18, 9, 0)
    assert match.pairs["robot_centre_cm"].tolist() == pytest.approx([21, 55] * 9, abs=1.01)


def test_a_scale_far_off_is_found_before_chords_are_told_missing():
    rng = np.random.default_rng(12)
    pairs = [np.sort(rng.uniform(5, 115, 6)) for _ in range(60)]
    true = pd.concat([crossings(*s.reshape(3, 2), number=n) for n, s in enumerate(pairs)])
    robot = true.assign(s_cm=true["s_cm"] * 1.12)
    match = match_crossings(robot, true)
    assert match.matched == 180
    assert match.scale == pytest.approx(1.12)
    np.testing.assert_allclose(match.pairs["robot_centre_cm"], match.pairs["true_centre_cm"], atol=1e-6)
    assert match_crossings(robot, true, fit_scale=False).matched < 150


def test_gross_mismatches_do_not_bend_the_scale():
    rng = np.random.default_rng(13)
    lengths = rng.uniform(5, 30, 60)
    true = pd.concat([crossings((10, 10 + a), number=n) for n, a in enumerate(lengths)])
    seen = np.where(lengths > np.quantile(lengths, 0.9), lengths * 0.75, lengths * 1.02)
    robot = pd.concat([crossings((10, 10 + a), number=n) for n, a in enumerate(seen)])
    assert match_crossings(robot, true).scale == pytest.approx(1.02, abs=1e-6)


def test_short_chords_side_by_side_are_matched_once():
    true = pd.concat([crossings((10, 10.6), (11.2, 11.8), (30, 40), number=n) for n in range(3)])
    robot = pd.concat([crossings((10.6, 11.2), (30, 40), number=n) for n in range(3)])
    match = match_crossings(robot, true)
    assert (match.matched, match.missed, match.extra) == (6, 3, 0)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_matching_is_the_best_that_keeps_the_order(seed):
    rng = np.random.default_rng(seed)
    robot_s, true_s = (np.sort(rng.uniform(0, 14, 2 * rng.integers(1, 6))).reshape(-1, 2) for _ in range(2))

    def overlap(a, b):
        shared = min(a[1], b[1]) - max(a[0], b[0]) + 2
        return shared / (max(a[1], b[1]) - min(a[0], b[0]) + 2)

    def best(i, j):
        if i == len(robot_s) or j == len(true_s):
            return 0.0
        gain = overlap(robot_s[i], true_s[j])
        return max(best(i + 1, j), best(i, j + 1), best(i + 1, j + 1) + (gain if gain >= 0.5 else 0.0))

    tables = [chord_table(crossings(*s)) for s in (robot_s, true_s)]
    found = align(*tables, scale=1.0, near_cm=0.0, reach_cm=0.0, least=0.5)
    assert (np.diff(found.robot) > 0).all()
    assert (np.diff(found.true) > 0).all()
    assert (found.overlap >= 0.5).all()
    assert found.overlap.sum() == pytest.approx(best(0, 0))


def test_scale_is_not_fitted_where_it_cannot_be():
    true = pd.concat([crossings((10, 20), number=n) for n in range(20)])
    match = match_crossings(true.assign(s_cm=true["s_cm"] * 1.02), true)
    assert np.isnan(match.scale)
    assert match.bias_cm == pytest.approx(0.2)
    assert match.to_dict()["scale"] is None
    fixed = match_crossings(true.assign(s_cm=true["s_cm"] * 1.02), true, fit_scale=False)
    assert fixed.matched == 20


def test_nothing_to_match():
    true = crossings((10, 20))
    for robot in (true.iloc[:0], crossings((300, 310)), crossings((10, 20), number=4)):
        match = match_crossings(robot, true, lines=[0])
        assert (match.matched, match.missed) == (0, 1)
        assert np.isnan(match.bias_cm)
        assert match.to_dict()["limits_cm"] == [None, None]
        assert len(match.pairs) == 0
    with pytest.raises(TrackError, match="`entering`"):
        match_crossings(true.drop(columns="entering"), true)


def test_without_robot_times_there_is_no_latency():
    true = crossings((10, 20), (30, 35))
    assert np.isnan(match_crossings(true.drop(columns="t_s"), true).offset_s)
