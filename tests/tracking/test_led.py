import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracking.led import find_peaks, fit_spot, learn_levels

_AT, _OFF = st.floats(20.0, 40.0), st.floats(-1.0, 1.0)


def _gauss(shape, x, y, sigma, height):
    """A Gaussian by pixel centres, written apart from the code under test."""
    rows, columns = np.indices(shape)
    return height * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))


def _plane(values, rng=None, noise=0.0):
    if rng is not None:
        values = values + rng.normal(0.0, noise, np.shape(values))
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


@settings(max_examples=40, deadline=None)
@given(st.tuples(_AT, _AT), st.floats(1.5, 5.0), st.floats(30.0, 150.0), st.tuples(_OFF, _OFF))
def test_a_clean_spot_is_found_to_a_twentieth_of_a_pixel(at, sigma, height, off):
    (x, y), (off_x, off_y) = at, off
    floor = np.full((60, 60), 40, dtype=np.uint8)
    spot = fit_spot(
        _plane(40 + _gauss((60, 60), x, y, sigma, height)), floor, x + off_x, y + off_y, sigma, free_sigma=True
    )
    assert spot is not None
    assert np.hypot(spot.x_px - x, spot.y_px - y) < 0.05
    assert spot.sigma_px == pytest.approx(sigma, rel=0.05)
    assert spot.amplitude == pytest.approx(height, rel=0.05)


@pytest.mark.parametrize("snr", [5, 10, 20])
def test_error_reaches_the_cramer_rao_bound_and_is_stated(snr):
    # The Fisher information of x is the sum of (dG/dx)² / noise² = (height / noise)² pi / 2: the bound is 0.80 / SNR.
    rng = np.random.default_rng(snr)
    height, floor = 100.0, np.full((61, 61), 60, dtype=np.uint8)
    errors, stated = [], []
    for _ in range(150):
        x, y = rng.uniform(29, 31, 2)
        plane = _plane(60 + _gauss((61, 61), x, y, 3.0, height), rng, height / snr)
        spot = fit_spot(plane, floor, 30.0, 30.0, 3.0)
        errors += [spot.x_px - x, spot.y_px - y]
        stated.append(spot.var_x_px2)
    rms = np.sqrt(np.mean(np.square(errors)))
    bound = np.sqrt(2.0 / np.pi) / snr
    assert rms < 1.15 * bound
    assert np.sqrt(np.median(stated)) == pytest.approx(rms, rel=0.2)


def test_the_floor_seen_through_the_ball_does_not_pull_the_spot():
    # An edge of light right through the patch, dimmed by the ball to a factor that is not known.
    rng = np.random.default_rng(1)
    floor = np.full((61, 61), 25.0)
    floor[:, 32:] = 120.0
    seen = 10 + 0.4 * floor + _gauss((61, 61), 30.3, 29.8, 3.0, 60.0)
    spot = fit_spot(_plane(seen, rng, 1.0), _plane(floor), 31.0, 29.0, 3.0)
    assert np.hypot(spot.x_px - 30.3, spot.y_px - 29.8) < 0.1
    plain = fit_spot(_plane(seen, rng, 1.0), np.full((61, 61), 25, dtype=np.uint8), 31.0, 29.0, 3.0)
    assert plain is None or np.hypot(plain.x_px - 30.3, plain.y_px - 29.8) > 0.5


def test_a_clipped_spot_keeps_its_place_and_its_height():
    floor = np.full((61, 61), 30, dtype=np.uint8)
    spot = fit_spot(_plane(30 + _gauss((61, 61), 30.4, 30.6, 3.0, 400.0)), floor, 30.0, 30.0, 3.0)
    assert np.hypot(spot.x_px - 30.4, spot.y_px - 30.6) < 0.03
    assert spot.amplitude == pytest.approx(400.0, rel=0.05)


def test_nothing_is_found_where_nothing_is():
    floor = np.full((40, 40), 50, dtype=np.uint8)
    assert fit_spot(floor, floor, 20.0, 20.0, 3.0) is None
    assert fit_spot(floor, floor, 500.0, 20.0, 3.0) is None
    dark = _plane(50 - _gauss((40, 40), 20, 20, 3.0, 40.0))
    assert fit_spot(dark, floor, 20.0, 20.0, 3.0) is None
    far = _plane(50 + _gauss((40, 40), 33, 33, 3.0, 40.0))
    spot = fit_spot(far, floor, 14.0, 14.0, 3.0)
    assert spot is None or spot.explained < 0.9


def test_peaks_prefer_narrow_spots_and_what_is_expected():
    floor = np.full((200, 300), 40, dtype=np.uint8)
    wide = _gauss((200, 300), 220, 100, 25.0, 90.0)
    narrow = _gauss((200, 300), 80, 60, 3.0, 50.0) + _gauss((200, 300), 120, 60, 3.0, 60.0)
    plane = _plane(40 + wide + narrow)
    first, second = find_peaks(plane, floor, 3.0, count=2)
    assert first[:2] == (120.0, 60.0)
    assert second[:2] == (80.0, 60.0)
    assert find_peaks(plane, floor, 3.0, near=(82.0, 61.0))[0][:2] == (80.0, 60.0)
    assert find_peaks(floor, floor, 3.0) == []


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
