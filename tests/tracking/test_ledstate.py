import numpy as np
import pytest

from tracking.ledstate import learn_levels, led_states


def test_two_levels_are_told_apart_even_if_one_is_rare():
    rng = np.random.default_rng(2)
    amplitudes = np.concatenate([rng.normal(25, 2, 400), rng.normal(100, 4, 30), [np.nan] * 10])
    levels = learn_levels(amplitudes)
    assert levels.low == pytest.approx(25, rel=0.05)
    assert levels.high == pytest.approx(100, rel=0.05)
    assert levels.threshold == pytest.approx(62.5, rel=0.05)


@pytest.mark.parametrize(
    "amplitudes",
    [
        np.random.default_rng(3).normal(80, 10, 500),
        np.random.default_rng(3).lognormal(3, 0.5, 500),
        np.array([50.0]),
        [np.nan],
    ],
)
def test_one_level_is_not_torn_apart(amplitudes):
    assert learn_levels(np.asarray(amplitudes)).threshold == 0.0


def _way(n, rng):
    """A robot that wanders over a picture of 1280 x 720 and is bright inside a disc about its middle."""
    t = np.arange(n) / 30.0
    x = 640 + 560 * np.sin(0.7 * t + rng.uniform(0, 6))
    y = 360 + 300 * np.sin(1.1 * t + rng.uniform(0, 6))
    return x, y, np.hypot(x - 640, y - 360) < 300


def _falls_off(x, y, loss):
    return 1.0 - loss * (((x - 640) / 640) ** 2 + ((y - 360) / 360) ** 2) / 2.0


@pytest.mark.parametrize("dim", [0.08, 0.25, 0.5])
@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_states_are_right_under_vignetting_and_stray_heights(dim, loss):
    rng = np.random.default_rng(5)
    x, y, on = _way(4000, rng)
    height = np.where(on, 100.0, 100.0 * dim) * _falls_off(x, y, loss) * rng.normal(1, 0.03, 4000)
    height += rng.normal(0, 1.0, 4000)
    stray = rng.choice(4000, 20, replace=False)
    height[stray] *= rng.uniform(0.9, 1.15, 20)
    states = led_states(height, np.full(4000, 1.0), x, y)
    wrong = states.on != on
    assert wrong.mean() <= 0.005
    assert states.confidence[~wrong].mean() > 0.99
    assert states.levels.high > 1.5 * states.levels.low


def test_a_frame_in_which_it_switched_says_so():
    rng = np.random.default_rng(6)
    x, y, on = _way(2000, rng)
    share = on.astype(float)
    switches = np.flatnonzero(np.diff(on.astype(int)))
    share[switches] = rng.uniform(0.2, 0.8, len(switches))
    height = 25.0 + 75.0 * share + rng.normal(0, 2.0, 2000)
    states = led_states(height, np.full(2000, 2.0), x, y)
    assert len(switches) >= 20
    assert states.confidence[switches].mean() < 0.85
    middle = switches[np.abs(share[switches] - 0.5) < 0.1]
    assert states.confidence[middle].max() < 0.8
    steady = np.setdiff1d(np.arange(2000), switches)
    assert (states.on[steady] == on[steady]).all()
    assert states.confidence[steady].min() > 0.95


def test_confidence_is_the_share_of_right_answers():
    # Levels so close, and noise so large, that a few percent of all answers are wrong.
    rng = np.random.default_rng(7)
    x, y, on = _way(20000, rng)
    height = np.where(on, 100.0, 55.0) + rng.normal(0, 11.0, 20000)
    states = led_states(height, np.full(20000, 11.0), x, y)
    right = states.on == on
    assert 0.005 < 1 - right.mean() < 0.08
    for low, high in ((0.5, 0.7), (0.7, 0.9), (0.9, 1.01)):
        here = (states.confidence >= low) & (states.confidence < high)
        assert right[here].mean() == pytest.approx(states.confidence[here].mean(), abs=0.08)


def test_an_led_that_goes_dark_is_off_while_it_is_not_seen():
    rng = np.random.default_rng(8)
    x, y, on = _way(1500, rng)
    height = np.where(on, 100.0, np.nan) * rng.normal(1, 0.04, 1500)
    missed = np.flatnonzero(on)[[40, 90]]
    height[missed] = np.nan
    place = np.where(np.isfinite(height), 1.0, np.nan)
    states = led_states(height, place, x * place, y * place)
    assert states.levels.low == 0.0
    assert (states.on == (on & np.isfinite(height))).all()
    assert states.confidence[missed].max() < 0.7
    first, last = np.flatnonzero(on)[[0, -1]]
    inside = np.arange(first, last)
    sure = np.setdiff1d(inside, missed)
    assert np.median(states.confidence[sure]) > 0.98
    assert states.confidence[sure].min() > 0.6


def test_one_level_without_a_gap_is_on_and_says_that_nothing_tells():
    rng = np.random.default_rng(9)
    x, y, _ = _way(400, rng)
    states = led_states(rng.normal(60, 2, 400), np.full(400, 2.0), x, y)
    assert states.on.all()
    assert (states.confidence == 0.5).all()


def test_an_led_never_seen_is_off_and_nothing_is_known():
    unseen = np.full(20, np.nan)
    states = led_states(unseen, unseen, unseen, unseen)
    assert not states.on.any()
    assert (states.confidence == 0.5).all()
    assert len(led_states(*(np.empty(0),) * 4).on) == 0
