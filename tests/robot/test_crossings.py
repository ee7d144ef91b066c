"""Light to crossings, against light computed from known chords by a sensor with a round footprint."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr

from lab.base.errors import ChordlabError
from robot.crossings import Crossing, CrossingDetector, Levels, LevelsError, crossings_of, learn_levels

DARK, BRIGHT = 20.0, 120.0
LEVELS = Levels(DARK, BRIGHT, 55.0, 70.0, 85.0)


def lit_fraction(depth_cm, footprint_cm):
    """Part of a disc of floor that lies beyond a straight edge, its centre ``depth_cm`` past it."""
    x = np.clip(depth_cm / footprint_cm, -1.0, 1.0)
    return 0.5 + (x * np.sqrt(1.0 - x**2) + np.arcsin(x)) / math.pi


def light(s_cm, edges_cm, *, footprint_cm=0.5, slant_rad=0.0):
    """Lux along a run that crosses parallel edges in, out, in, out at ``slant_rad`` from their normal."""
    s_cm = np.asarray(s_cm, dtype=float)
    total = np.zeros_like(s_cm)
    for order, edge in enumerate(edges_cm):
        sign = 1 if order % 2 == 0 else -1
        total += sign * lit_fraction((s_cm - edge) * math.cos(slant_rad), footprint_cm)
    return DARK + (BRIGHT - DARK) * total


def found(s_cm, lux):
    s_cm = np.asarray(s_cm, dtype=float)
    return crossings_of(s_cm / 25.0, s_cm, lux, LEVELS)


def test_levels_and_thresholds():
    rng = np.random.default_rng(1)
    levels = learn_levels(rng.normal(20.0, 2.0, 400), rng.normal(120.0, 2.0, 400))
    assert levels.dark_lux == pytest.approx(20.0, abs=0.5)
    assert levels.bright_lux == pytest.approx(120.0, abs=0.5)
    # six noise widths of 2 lux to either side of the middle
    assert levels.mid_lux == pytest.approx(70.0, abs=0.5)
    assert levels.mid_lux - levels.low_lux == pytest.approx(12.0, abs=1.5)
    assert levels.high_lux - levels.mid_lux == pytest.approx(12.0, abs=1.5)


@pytest.mark.parametrize(("noise_lux", "margin_lux"), [(0.1, 5.0), (1.5, 9.0), (8.0, 15.0)])
def test_the_hysteresis_follows_the_noise_within_bounds(noise_lux, margin_lux):
    """At least 5 % of the span of 100 lux, at most 15 %, six noise widths between."""
    rng = np.random.default_rng(2)
    levels = learn_levels(rng.normal(20.0, noise_lux, 2000), rng.normal(120.0, noise_lux, 2000))
    assert levels.high_lux - levels.mid_lux == pytest.approx(margin_lux, rel=0.1)
    assert levels.mid_lux - levels.low_lux == pytest.approx(margin_lux, rel=0.1)


def test_levels_survive_strays_and_lost_samples():
    rng = np.random.default_rng(2)
    dark, bright = rng.normal(20.0, 2.0, 200), rng.normal(120.0, 2.0, 200)
    dark[:50], bright[:50] = 120.0, 20.0  # a quarter was taken on the wrong side
    dark[60], bright[60] = math.nan, math.inf
    levels = learn_levels(dark, bright)
    assert levels.dark_lux == pytest.approx(20.0, abs=2.0)
    assert levels.bright_lux == pytest.approx(120.0, abs=2.0)


def test_levels_that_do_not_separate_are_refused():
    rng = np.random.default_rng(3)
    dark, bright = rng.normal(20.0, 3.0, 300), rng.normal(35.0, 1.0, 300)
    with pytest.raises(LevelsError, match=r"dark \(.* lux\) and light \(.* lux\) .* darken the room") as caught:
        learn_levels(dark, bright)
    error = caught.value
    assert isinstance(error, ChordlabError)
    assert "\n" not in str(error)
    assert (error.dark_lux, error.bright_lux) == (np.median(dark), np.median(bright))
    assert error.noise_lux == pytest.approx(3.0, rel=0.2)  # the noisier side decides
    assert learn_levels(dark, bright, separation=4.0).mid_lux == pytest.approx(27.5, abs=0.5)


def test_a_sensor_that_repeats_itself_still_has_noise():
    with pytest.raises(LevelsError, match="noise widths"):
        learn_levels([20.0] * 50, [21.0] * 50)
    assert learn_levels([20.0] * 50, [26.0] * 50).mid_lux == 23.0


def test_swapped_levels_are_called_swapped():
    with pytest.raises(LevelsError, match="swapped"):
        learn_levels([120.0] * 20, [20.0] * 20)


def test_too_few_samples():
    with pytest.raises(LevelsError, match="4 samples of the dark") as caught:
        learn_levels([20.0] * 4 + [math.nan], [120.0] * 20)
    assert math.isnan(caught.value.noise_lux)
    with pytest.raises(LevelsError, match="0 of the light"):
        learn_levels([20.0] * 10, [])


def test_levels_out_of_order_are_refused():
    with pytest.raises(LevelsError, match="must rise"):
        Levels(20.0, 120.0, 85.0, 70.0, 55.0)


@given(
    st.lists(st.floats(4.0, 25.0), min_size=2, max_size=12).filter(lambda widths: len(widths) % 2 == 0),
    st.floats(0.1, 1.5),
    st.floats(0.0, 1.2),
    st.floats(0.05, 1.0),
)
def test_every_crossing_within_a_sample_of_the_edge(widths, step_cm, slant_rad, footprint_cm):
    edges = np.cumsum(widths).tolist()
    s_cm = np.arange(0.0, edges[-1] + 5.0, step_cm)
    crossings = found(s_cm, light(s_cm, edges, footprint_cm=footprint_cm, slant_rad=slant_rad))
    assert [crossing.entering for crossing in crossings] == [order % 2 == 0 for order in range(len(edges))]
    errors = np.abs([crossing.s_cm - edge for crossing, edge in zip(crossings, edges, strict=True)])
    assert errors.max() <= step_cm / 2 + 1e-9
    for crossing in crossings:
        assert crossing.t_s == pytest.approx(crossing.s_cm / 25.0)


@pytest.mark.parametrize("slant_rad", [0.0, 1.0])
def test_positions_are_unbiased_at_the_lab_s_rate(slant_rad):
    """25 cm/s, 50 ms, 2 lux of noise: the samples' phase is random, the mean error nil."""
    rng = np.random.default_rng(4)
    errors = {True: [], False: []}
    for _ in range(1500):
        edges = [10.0, 10.0 + rng.uniform(5.0, 15.0)]
        s_cm = np.arange(rng.uniform(0.0, 1.25), 40.0, 1.25)
        lux = light(s_cm, edges, slant_rad=slant_rad) + rng.normal(0.0, 2.0, s_cm.size)
        crossings = found(s_cm, lux)
        assert len(crossings) == 2
        for crossing, edge in zip(crossings, edges, strict=True):
            errors[crossing.entering].append(crossing.s_cm - edge)
    for entering in (True, False):
        sample = np.array(errors[entering])
        assert abs(sample.mean()) < 4 * sample.std() / math.sqrt(sample.size)
        assert sample.std() < 1.25 / math.sqrt(12)  # no worse than halfway between the samples


def test_noise_on_a_finely_sampled_ramp_neither_multiplies_nor_shifts_the_crossing():
    """Noise passes the middle tens of times on the ramp; the first passage alone would come ~0.06 cm early."""
    rng = np.random.default_rng(5)
    errors, passages, first = [], [], []
    for _ in range(250):
        s_cm = np.arange(3.0, 7.0, 0.002)
        lux = light(s_cm, [5.0]) + rng.normal(0.0, 5.0, s_cm.size)
        above = lux >= LEVELS.mid_lux
        passages.append(np.count_nonzero(above[1:] != above[:-1]))
        first.append(s_cm[np.argmax(above)] - 5.0)
        entry, end = found(s_cm, lux)
        assert (entry.entering, end.entering) == (True, False)
        errors.append(entry.s_cm - 5.0)
    assert np.mean(passages) > 5  # else this would prove nothing
    assert np.mean(first) < -0.03
    assert abs(np.mean(errors)) < 4 * np.std(errors) / math.sqrt(len(errors))
    assert np.std(errors) < 0.02


def test_the_crossing_stands_where_the_middle_was_passed_not_where_it_was_confirmed():
    s_cm = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    entry, leave = found(s_cm, [20.0, 60.0, 80.0, 84.0, 120.0, 120.0, 20.0])
    assert entry == Crossing(1.5 / 25.0, 1.5, entering=True)
    assert leave.s_cm == pytest.approx(5.5)


@pytest.mark.parametrize("blip", [69.0, 71.0, 84.9])
def test_a_wiggle_that_does_not_reach_the_far_threshold_is_no_crossing(blip):
    lux = np.array([20.0, 20.0, blip, 20.0, 40.0, blip, 40.0, 20.0, 120.0, 20.0])
    s_cm = np.arange(lux.size)
    crossings = found(s_cm, lux)
    assert [crossing.s_cm for crossing in crossings] == [7.5, 8.5]  # nor does it shift the one after it
    mirrored = DARK + BRIGHT - lux  # the same in the light
    crossings = found(s_cm, mirrored)
    assert [(crossing.s_cm, crossing.entering) for crossing in crossings] == [
        (0.0, True),
        (7.5, False),
        (8.5, True),
        (9.0, False),
    ]


@given(st.lists(st.floats(0.0, 140.0), max_size=40))
def test_rolled_backwards_the_crossings_are_the_same(lux):
    lux = [DARK, *lux, DARK]
    s_cm = np.arange(len(lux), dtype=float)
    forwards = found(s_cm, lux)
    backwards = found(s_cm, lux[::-1])[::-1]
    assert [c.s_cm for c in forwards] == pytest.approx([s_cm[-1] - c.s_cm for c in backwards])
    assert [c.entering for c in forwards] == [not c.entering for c in backwards]


@given(st.lists(st.floats(0.0, 140.0) | st.just(math.nan), max_size=60))
def test_crossings_alternate_advance_and_pair(lux):
    crossings = found(np.arange(len(lux)) * 1.25, lux)
    assert [crossing.entering for crossing in crossings] == [order % 2 == 0 for order in range(len(crossings))]
    assert len(crossings) % 2 == 0
    places = [crossing.s_cm for crossing in crossings]
    assert places == sorted(places)


def test_a_run_that_starts_and_ends_in_the_light():
    detector = CrossingDetector(LEVELS)
    assert detector.start(10.0, 0.0, 120.0) == Crossing(10.0, 0.0, entering=True)
    assert detector.lit
    leave = detector.feed(11.0, 4.0, 20.0)
    assert leave == Crossing(10.5, 2.0, entering=False)
    assert detector.feed(12.0, 8.0, 120.0) == Crossing(11.5, 6.0, entering=True)
    assert detector.finish(13.0, 12.0) == Crossing(13.0, 12.0, entering=False)
    assert not detector.lit
    assert detector.start(20.0, 0.0, 20.0) is None
    assert detector.feed(21.0, 4.0, 20.0) is None
    assert detector.finish(22.0, 8.0) is None


def test_start_forgets_the_run_before():
    detector = CrossingDetector(LEVELS)
    detector.start(0.0, 0.0, 20.0)
    detector.feed(1.0, 1.0, 80.0)  # past the middle, not confirmed
    detector.start(5.0, 0.0, 20.0)
    assert detector.feed(6.0, 2.0, 120.0) == Crossing(5.5, 1.0, entering=True)


def test_lost_samples_are_passed_over():
    detector = CrossingDetector(LEVELS)
    assert detector.start(0.0, 0.0, math.nan) is None
    assert detector.feed(1.0, 1.0, 120.0) == Crossing(1.0, 1.0, entering=True)
    assert detector.feed(2.0, 2.0, math.inf) is None
    assert detector.feed(3.0, 3.0, 20.0) == Crossing(2.0, 2.0, entering=False)


def test_stored_samples_agree_with_the_stream():
    rng = np.random.default_rng(6)
    s_cm = np.arange(0.0, 60.0, 1.25)
    lux = light(s_cm, [0.0, 12.0, 20.0, 31.0, 50.0]) + rng.normal(0.0, 3.0, s_cm.size)
    detector = CrossingDetector(LEVELS)
    streamed = [detector.start(0.0, 0.0, lux[0])]
    streamed += [detector.feed(s / 25.0, s, value) for s, value in zip(s_cm[1:], lux[1:], strict=True)]
    streamed.append(detector.finish(s_cm[-1] / 25.0, s_cm[-1]))
    assert [crossing for crossing in streamed if crossing] == found(s_cm, lux)
    assert found([], []) == []


def test_ten_noise_widths_make_false_crossings_rare():
    """From the stated margins: half a span of 10 sigma, plus 15 %, is 6.5 sigma."""
    levels = learn_levels([20.0] * 9, [25.0] * 9)  # a span of just ten noise floors
    assert ndtr(-(levels.high_lux - levels.dark_lux) / 0.5) < 1e-10
    assert ndtr(-(levels.bright_lux - levels.low_lux) / 0.5) < 1e-10
