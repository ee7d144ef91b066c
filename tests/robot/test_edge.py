"""The edge by light: levels, passages, crossings beside a bright ring."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.crossings import LevelsError
from robot.edge import EdgeDetector, RingedDetector, learn_edge_levels
from tests.robot.ringlight import FLOOR, LUX, RING, SHAPE, levels_of

# --- levels


@pytest.mark.parametrize("kind", LUX)
def test_the_kind_of_ring_follows_from_the_light(kind):
    levels = levels_of(kind)
    assert levels.bright == (kind == "bright")
    floor, shape, ring = LUX[kind]
    assert levels.shape.mid_lux == pytest.approx((floor + shape) / 2, abs=1)
    assert levels.ring.mid_lux == pytest.approx(((shape if kind == "bright" else floor) + ring) / 2, abs=1)


@pytest.mark.parametrize(
    ("levels", "says"),
    [
        ((20.0, 120.0, 60.0), "darker than the floor"),
        ((20.0, 21.0, 90.0), "light of floor and shape"),
        ((30.0, 120.0, 27.0), "light of ring and floor"),
        ((20.0, 100.0, 104.0), "light of shape and ring"),
    ],
)
def test_levels_that_do_not_separate_are_refused_in_one_line(levels, says):
    rng = np.random.default_rng(1)
    with pytest.raises(LevelsError, match=says) as caught:
        learn_edge_levels(*(level + rng.standard_normal(30) for level in levels))
    assert "\n" not in str(caught.value)


def test_too_few_samples_of_the_ring():
    with pytest.raises(LevelsError, match="ring"):
        learn_edge_levels(np.full(20, 60.0), np.full(20, 120.0), [math.nan, 20.0])


# --- passages


def ramped(kind, x_cm, bounds, rho_cm=0.5):
    """Light along a straight path x: footprint-wide linear ramps at each bound; levels between them by index."""
    lux = np.zeros_like(x_cm)
    for begin, end, level in bounds:
        share = np.clip((x_cm - begin) / (2 * rho_cm) + 0.5, 0, 1) - np.clip((x_cm - end) / (2 * rho_cm) + 0.5, 0, 1)
        lux += share * LUX[kind][level]
    return lux


@pytest.mark.parametrize("kind", LUX)
@given(speed=st.floats(5, 40), slant=st.floats(0, 1.2), phase=st.floats(0, 1), seed=st.integers(0, 999))
def test_passages_are_placed_in_time_and_space(kind, speed, slant, phase, seed):
    """Out of the ring at 3 cm, into it at 60 cm, met at a slant; noise of a percent of the span."""
    rng = np.random.default_rng(seed)
    way = (np.arange(0, 65 / math.cos(slant), speed * 0.025) + phase * speed * 0.025) * math.cos(slant)
    lux = ramped(kind, way, [(-1e9, 3, RING), (3, 60, FLOOR), (60, 1e9, RING)]) + rng.standard_normal(way.size)
    t = way / math.cos(slant) / speed
    detector = EdgeDetector(levels_of(kind))
    points = [detector.feed(*sample) for sample in zip(t, way, way * math.tan(slant), lux, strict=True)]
    found = [point for point in points if point is not None]
    assert [point.into_ring for point in found] == [False, True]
    for point, place in zip(found, (3, 60), strict=True):
        # Half a footprint for the bright ring's middle level, and half a step.
        assert point.x_cm == pytest.approx(place, abs=0.35 + speed * 0.0125)
        assert point.y_cm == pytest.approx(point.x_cm * math.tan(slant), abs=1e-6)
        assert point.t_s == pytest.approx(point.x_cm / math.cos(slant) / speed, abs=1e-6)
    assert detector.in_ring


def test_light_that_comes_late_is_taken_back():
    way = np.arange(0, 30, 0.4)
    lux = ramped("dark", way - 40 * 0.03, [(-1e9, 20, FLOOR), (20, 1e9, RING)])  # 40 cm/s, 30 ms late
    for latency_s, place in ((0.0, 21.2), (0.03, 20.0)):
        detector = EdgeDetector(levels_of("dark"), light_latency_s=latency_s)
        points = [detector.feed(x / 40, x, 0.0, value) for x, value in zip(way, lux, strict=True)]
        (point,) = [point for point in points if point is not None]
        assert point.x_cm == pytest.approx(place, abs=0.1)
        assert point.t_s == pytest.approx(place / 40, abs=0.003)


def test_the_first_sample_decides_the_side_and_gaps_are_passed_over():
    levels = levels_of("dark")
    detector = EdgeDetector(levels)
    assert not detector.in_ring
    assert detector.feed(0.0, 0.0, 0.0, math.nan) is None
    assert detector.feed(0.1, 0.0, 0.0, 20.0) is None
    assert detector.in_ring
    point = detector.feed(0.2, 1.0, 2.0, 60.0)
    assert point is not None
    assert (point.x_cm, point.y_cm, point.into_ring) == (pytest.approx(0.5, abs=0.05), pytest.approx(1, abs=0.1), False)


# --- crossings beside a ring


@pytest.mark.parametrize("kind", LUX)
@given(speed=st.floats(5, 40), slant=st.floats(0, 1.3), phase=st.floats(0, 1), chords=st.integers(0, 3))
def test_a_ring_gives_no_crossing_of_the_shape(kind, speed, slant, phase, chords):
    """From ring to ring, over 0 to 3 pieces of the shape; the ring's ramp may last for many samples."""
    pieces = [(10.0 + 15 * i, 15.0 + 15 * i, SHAPE) for i in range(chords)]
    edges = [2.0, *(value for begin, end, _ in pieces for value in (begin, end)), 62.0]
    bounds = [(-1e9, 2, RING), *pieces, (62, 1e9, RING)]
    bounds += [(begin, end, FLOOR) for begin, end in zip(edges[::2], edges[1::2], strict=True)]
    way = (np.arange(0, 65 / math.cos(slant), speed * 0.025) + phase * speed * 0.025) * math.cos(slant)
    path = way / math.cos(slant)
    rng = np.random.default_rng(3)
    lux = ramped(kind, way, bounds) + rng.standard_normal(way.size)
    detector = RingedDetector(levels_of(kind))
    seen = [detector.feed(s / speed, s, x, 0.0, value) for s, x, value in zip(path, way, lux, strict=True)]
    crossings = [crossing for one in seen for crossing in one.crossings] + list(detector.finish(99.0, path[-1]))
    assert [crossing.entering for crossing in crossings] == [True, False] * chords
    truth = [value / math.cos(slant) for begin, end, _ in pieces for value in (begin, end)]
    assert [crossing.s_cm for crossing in crossings] == pytest.approx(truth, abs=0.3 / math.cos(slant) + speed * 0.0125)
    assert [one.edge.into_ring for one in seen if one.edge] == [False, True]
    assert detector.in_ring
    assert not detector.lit


def test_a_run_that_ends_in_the_shape_closes_its_chord():
    detector = RingedDetector(levels_of("bright"))
    for s in np.arange(0, 20, 0.5):
        seen = detector.feed(s, s, s, 0.0, 20.0 if s < 12 else 70.0)
        assert seen.crossings == ()
    assert detector.lit
    entry, out = detector.finish(20.0, 20.0)
    assert (entry.entering, out.entering, out.s_cm) == (True, False, 20.0)
    assert entry.s_cm == pytest.approx(11.75, abs=0.1)
    assert detector.finish(20.0, 20.0) == ()
