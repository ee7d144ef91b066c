import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracking.led import find_peaks
from tracking.spot import Shell, fit_spot

_AT, _OFF = st.floats(20.0, 40.0), st.floats(-1.0, 1.0)


def _gauss(shape, x, y, sigma, height):
    """A Gaussian by pixel centres, written apart from the code under test."""
    rows, columns = np.indices(shape)
    return height * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))


def _plane(values, rng=None, noise=0.0):
    if rng is not None:
        values = values + rng.normal(0.0, noise, np.shape(values))
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _light(values):
    """What a floor throws on the ball: luma over black, as the background gives it."""
    return cv2.GaussianBlur(np.maximum(values - 16.0, 0.0).astype(np.float32), (0, 0), 2.0)


@settings(max_examples=40, deadline=None)
@given(st.tuples(_AT, _AT), st.floats(1.5, 5.0), st.floats(30.0, 150.0), st.tuples(_OFF, _OFF))
def test_a_clean_spot_is_found_to_a_twentieth_of_a_pixel(at, sigma, height, off):
    (x, y), (off_x, off_y) = at, off
    plane = _plane(40 + _gauss((60, 60), x, y, sigma, height))
    spot, evidence = fit_spot(plane, x + off_x, y + off_y, sigma, free_sigma=True)
    assert evidence is None
    assert np.hypot(spot.x_px - x, spot.y_px - y) < 0.05
    assert spot.sigma_px == pytest.approx(sigma, rel=0.05)
    assert spot.amplitude == pytest.approx(height, rel=0.05)


@pytest.mark.parametrize("sigma", [2.0, 3.0, 5.0])
@pytest.mark.parametrize("snr", [5, 10, 20])
def test_error_reaches_the_cramer_rao_bound_and_is_stated(snr, sigma):
    # The Fisher information of x is the sum of (dG/dx)² / noise² = (height / noise)² pi / 2: the bound is 0.80 / SNR.
    rng = np.random.default_rng(snr)
    height = 100.0
    errors, stated = [], []
    for _ in range(200):
        x, y = rng.uniform(29, 31, 2)
        plane = _plane(60 + _gauss((61, 61), x, y, sigma, height), rng, height / snr)
        spot, _ = fit_spot(plane, 30.0, 30.0, sigma)
        errors += [spot.x_px - x, spot.y_px - y]
        stated.append(spot.var_x_px2)
    rms = np.sqrt(np.mean(np.square(errors)))
    bound = np.sqrt(2.0 / np.pi) / snr
    assert rms < 1.2 * bound
    assert np.sqrt(np.mean(stated)) == pytest.approx(rms, rel=0.2)


@pytest.mark.parametrize("at", [-6.0, -3.0, 0.0, 3.0, 6.0])
def test_an_edge_of_light_on_the_ball_does_not_pull_the_spot(at):
    # The edge lies elsewhere on the ball than on the floor, and by how much is not known.
    rng = np.random.default_rng(1)
    floor, on_ball = np.full((61, 61), 30.0), np.full((61, 61), 30.0)
    floor[:, 30 + round(at) + 4 :] = 120.0
    on_ball[:, 30 + round(at) :] = 120.0
    errors, plain = [], []
    for _ in range(20):
        x, y = rng.uniform(29, 31, 2)
        seen = 16 + 0.6 * _light(on_ball) + _gauss((61, 61), x, y, 3.0, 30.0)
        spot, _ = fit_spot(_plane(seen, rng, 1.0), 30.0, 30.0, 3.0, floor=_light(floor), noise=1.0)
        errors.append([spot.x_px - x, spot.y_px - y])
        without = fit_spot(_plane(seen, rng, 1.0), 30.0, 30.0, 3.0)
        plain.append(np.inf if without is None else without[0].x_px - x)
    assert np.sqrt(np.mean(np.square(errors))) < 0.25
    assert np.median(np.abs(plain)) > 0.5


def test_a_patch_says_how_far_the_edge_is_shifted_and_only_across_it():
    floor, on_ball = np.full((61, 61), 30.0), np.full((61, 61), 30.0)
    floor[:, 31:], on_ball[:, 28:] = 120.0, 120.0
    seen = 16 + 0.6 * _light(on_ball) + _gauss((61, 61), 30.0, 30.0, 3.0, 80.0)
    vague = Shell(np.array([0.5, 0, 0, 0, 0, 0]), np.diag([4.0, 0.06, 0.06, 1e3, 1e3, 1e3]))
    _, evidence = fit_spot(_plane(seen), 30.2, 29.8, 3.0, floor=_light(floor), shell=vague, noise=1.0)
    assert evidence.precision[1, 1] > 100.0 > evidence.precision[2, 2]
    joint = np.linalg.solve(evidence.precision + vague.precision, evidence.weighted + vague.precision @ vague.mean)
    assert joint[:2] == pytest.approx([0.6, 3.0], abs=0.1)
    # Known for sure, the same shell gives the same spot, and nothing is learnt.
    known = Shell(joint, np.zeros((6, 6)))
    spot, nothing = fit_spot(_plane(seen), 30.2, 29.8, 3.0, floor=_light(floor), shell=known, learn=False)
    assert nothing is None
    assert np.hypot(spot.x_px - 30.0, spot.y_px - 30.0) < 0.03


def test_a_piece_of_the_picture_gives_what_the_whole_one_gives():
    rng = np.random.default_rng(3)
    floor = np.full((90, 120), 30.0)
    floor[:, 61:] = 110.0
    seen = _plane(16 + 0.6 * _light(floor) + _gauss((90, 120), 60.3, 50.2, 3.0, 60.0), rng, 1.0)
    whole, _ = fit_spot(seen, 60.0, 50.0, 3.0, floor=_light(floor))
    piece, _ = fit_spot(seen[30:70, 40:80], 20.0, 20.0, 3.0, floor=_light(floor), origin=(40, 30))
    assert (piece.x_px + 40, piece.y_px + 30) == pytest.approx((whole.x_px, whole.y_px), abs=1e-6)


def test_residuals_that_belong_together_are_not_taken_for_noise():
    rng = np.random.default_rng(4)
    errors, stated = [], []
    for _ in range(150):
        blotches = cv2.GaussianBlur(rng.normal(0, 1, (61, 61)), (0, 0), 1.5)
        plane = _plane(60 + _gauss((61, 61), 30.0, 30.0, 3.0, 80.0) + 3.0 * blotches / blotches.std())
        spot, _ = fit_spot(plane, 30.0, 30.0, 3.0)
        errors += [spot.x_px - 30.0, spot.y_px - 30.0]
        stated += [spot.var_x_px2, spot.var_y_px2]
    ratio = np.mean(np.square(errors)) / np.mean(stated)
    # Taken for white noise, their error would be stated more than ten times too small (in variance).
    assert 0.5 < ratio < 5.0


def test_a_clipped_spot_keeps_its_place_and_its_height():
    spot, _ = fit_spot(_plane(30 + _gauss((61, 61), 30.4, 30.6, 3.0, 400.0)), 30.0, 30.0, 3.0)
    assert np.hypot(spot.x_px - 30.4, spot.y_px - 30.6) < 0.03
    assert spot.amplitude == pytest.approx(400.0, rel=0.05)


def test_nothing_is_found_where_nothing_is():
    floor = np.full((40, 40), 50, dtype=np.uint8)
    flat = fit_spot(floor, 20.0, 20.0, 3.0)
    assert flat is None or flat[0].explained < 0.1
    assert fit_spot(floor, 500.0, 20.0, 3.0) is None
    dark = _plane(50 - _gauss((40, 40), 20, 20, 3.0, 40.0))
    below = fit_spot(dark, 20.0, 20.0, 3.0)
    assert below is None or below[0].explained < 0.5


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
