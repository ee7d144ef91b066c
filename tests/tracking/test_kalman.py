import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.base.errors import RequestError
from tracking.kalman import KalmanSettings, fast_axes, reference_axes, smooth_track
from tracking.recursion import process_noise


def _uneven_times(rng, n):
    return np.cumsum(rng.uniform(0.02, 0.06, n))


def _roll(t_s, turn_s, speed_cm_s=25.0):
    """Straight along x, back again from turn_s; y goes on."""
    x_cm = speed_cm_s * (turn_s - np.abs(t_s - turn_s))
    vx_cm_s = np.where(t_s < turn_s, speed_cm_s, -speed_cm_s)
    return x_cm, 0.4 * speed_cm_s * t_s, vx_cm_s


@settings(max_examples=25, deadline=None)
@given(st.integers(2, 70), st.integers(0, 10_000), st.floats(1.0, 500.0))
def test_written_out_recursion_equals_filterpy(n, seed, q):
    rng = np.random.default_rng(seed)
    t = _uneven_times(rng, n)
    x, y = rng.normal(0.0, 20.0, (2, n))
    rx, ry = rng.uniform(1e-4, 0.1, (2, n))
    use = rng.random(n) < 0.8
    use[n // 3 : n // 2] = False  # and a long one
    use[0] = True
    x[~use] = y[~use] = np.nan
    kicks = np.where(rng.random(n) < 0.1, 1600.0, 0.0)
    arguments = (t, x, y, rx, ry, use, kicks, q, 1600.0)
    fast, reference = fast_axes(*arguments), reference_axes(*arguments)
    scale = np.maximum(1.0, np.abs(reference))
    assert np.abs((fast - reference) / scale).max() < 1e-9


def test_smoothing_equals_the_least_squares_solution_of_the_whole_track():
    # Independent path: all positions and velocities at once, prior and steps as weighted equations.
    rng = np.random.default_rng(3)
    n, q, start_var = 12, 30.0, 900.0
    t = _uneven_times(rng, n)
    z = np.column_stack([25.0 * t, -3.0 * t]) + rng.normal(0.0, 0.1, (n, 2))
    r = rng.uniform(0.005, 0.02, (n, 2))
    use = np.ones(n, dtype=bool)
    use[4:6] = False
    information, right = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
    information[1, 1] += 1.0 / start_var
    for k in range(n):
        if use[k]:
            information[2 * k, 2 * k] += 1.0 / r[k, 0]
            right[2 * k] += z[k, 0] / r[k, 0]
        if k:
            dt = t[k] - t[k - 1]
            noise = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            step = np.hstack([-np.array([[1.0, dt], [0.0, 1.0]]), np.eye(2)])
            at = slice(2 * k - 2, 2 * k + 2)
            information[at, at] += step.T @ np.linalg.inv(noise) @ step
    covariance = np.linalg.inv(information)
    solution = covariance @ right
    got = fast_axes(t, z[:, 0], z[:, 1], r[:, 0], r[:, 1], use, np.zeros(n), q, start_var)
    assert np.allclose(got[0], solution[::2], atol=1e-7)
    assert np.allclose(got[2], solution[1::2], atol=1e-6)
    assert np.allclose(got[4], np.sqrt(np.diag(covariance)[::2]), atol=1e-8)


def test_process_noise_of_two_steps_is_that_of_one():
    a, b, q = 0.02, 0.05, 7.0
    first, second, both = (
        np.array([[v[0], v[1]], [v[1], v[2]]]) for v in (process_noise(d, q, 0.0) for d in (a, b, a + b))
    )
    move = np.array([[1.0, b], [0.0, 1.0]])
    assert np.allclose(move @ first @ move.T + second, both)


@pytest.mark.parametrize("reference_until", [0, 10_000])
def test_a_bounce_is_found_and_sigma_is_honest(reference_until):
    rng = np.random.default_rng(5)
    t = _uneven_times(rng, 200)
    errors, kicks = [], []
    for _ in range(20):
        x, y, vx = _roll(t, 4.0)
        got = smooth_track(
            t, x + rng.normal(0, 0.05, 200), y + rng.normal(0, 0.05, 200), np.full(200, 0.05**2), np.full(200, 0.05**2),
            KalmanSettings(reference_until=reference_until),
        )  # fmt: skip
        errors.append((got.x_cm - x) / got.sigma_x_cm)
        kicks.append(t[got.kicked])
        steady = np.abs(t - 4.0) > 0.3
        assert np.sqrt(np.mean((got.x_cm - x) ** 2)) < 0.04
        assert np.abs(got.vx_cm_s - vx)[steady].max() < 4.0
    assert all(np.abs(found - 4.0).min() < 0.1 for found in kicks)
    assert sum(map(len, kicks)) <= 40
    assert 0.3 < np.mean(np.square(errors)) < 1.6


def test_outliers_are_left_out():
    rng = np.random.default_rng(6)
    t = np.arange(100) / 30.0
    x, y, _ = _roll(t, 99.0)
    seen = x + rng.normal(0, 0.03, 100)
    # The first is so near that a turn could explain it, were it not for what follows.
    seen[[18, 30, 60, 61]] += (0.8, 8.0, -15.0, -15.0)
    got = smooth_track(t, seen, y, np.full(100, 9e-4), np.full(100, 9e-4))
    assert not got.used[[18, 30, 60, 61]].any()
    assert not got.kicked[10:].any()
    assert got.used.sum() >= 96
    assert np.abs(got.x_cm - x).max() < 0.1


def test_gaps_are_bridged_with_growing_sigma_and_ends_are_not():
    t = np.arange(90) / 30.0
    x, y, _ = _roll(t, 99.0)
    seen = x.copy()
    seen[:5] = seen[40:60] = seen[85:] = np.nan
    got = smooth_track(t, seen, y, np.full(90, 1e-4), np.full(90, 1e-4))
    assert np.isnan(got.x_cm[:5]).all() and np.isnan(got.x_cm[85:]).all()
    assert np.abs(got.x_cm - x)[5:85].max() < 0.05
    assert got.sigma_x_cm[50] > 3 * got.sigma_x_cm[20]
    assert np.isfinite(got.sigma_y_cm[5:85]).all()


def test_understated_noise_is_scaled_up():
    rng = np.random.default_rng(7)
    t = np.arange(300) / 30.0
    x, y, _ = _roll(t, 99.0)
    noise = rng.normal(0, 0.1, (2, 300))
    got = smooth_track(t, x + noise[0], y + noise[1], np.full(300, 1e-4), np.full(300, 1e-4))
    error = np.sqrt(np.mean((got.x_cm - x)[10:-10] ** 2))
    assert 0.5 < error / np.median(got.sigma_x_cm) < 2.0


@pytest.mark.parametrize("seen", [0, 1, 2])
def test_tracks_with_hardly_any_sighting(seen):
    x = np.full(10, np.nan)
    x[3 : 3 + seen] = 5.0
    got = smooth_track(np.arange(10.0), x, x, np.full(10, 0.01), np.full(10, 0.01))
    assert np.isfinite(got.x_cm).sum() == seen
    assert np.isfinite(smooth_track([], [], [], [], []).x_cm).sum() == 0


def test_bad_input_is_named():
    with pytest.raises(RequestError, match="equally many"):
        smooth_track([0.0, 1.0], [0.0], [0.0], [1.0], [1.0])
    with pytest.raises(RequestError, match="must rise"):
        smooth_track([0.0, 0.0], [0.0, 1.0], [0.0, 1.0], [1.0, 1.0], [1.0, 1.0])
