"""Does the filter state its error truly, and is it caught where it does not? Tracks are simulated in continuous time.

``TRACKS`` and ``HEALTHS`` scale the proofs: more of them narrow the intervals that the figures are held to.
"""

import numpy as np
import pandas as pd
import pytest

from lab.base.errors import RequestError
from tracking.clusters import clustered_mean
from tracking.innovations import filter_health
from tracking.kalman import DEFAULT_SETTINGS, KalmanSettings, smooth_track

TRACKS = 60
HEALTHS = 500
FPS = 30.0


def rolled(rng, frames=300, q=2.0, speed=25.0, bounces=2, uneven=False):
    """Times, true places (n, 2) and the bounces' times: white acceleration, and turns at any instant."""
    t = np.cumsum(rng.uniform(0.6, 1.6, frames)) / FPS if uneven else np.arange(1, frames + 1) / FPS
    at = np.sort(rng.uniform(1.0, t[-1] - 1.0, bounces))
    heading = rng.uniform(0, 2 * np.pi)
    velocity = speed * np.array([np.cos(heading), np.sin(heading)])
    place, now, places = np.zeros(2), 0.0, np.empty((frames, 2))
    events = sorted([(time, -1) for time in at] + [(time, k) for k, time in enumerate(t)])
    for time, k in events:
        dt, now = time - now, time
        # exact step of integrated white noise, by its Cholesky factor
        a, b = rng.standard_normal((2, 2))
        place = place + velocity * dt + np.sqrt(q * dt**3 / 3) * a
        velocity = velocity + np.sqrt(q * dt) * (np.sqrt(0.75) * a + 0.5 * b)
        if k < 0:
            heading = np.arctan2(velocity[1], velocity[0]) + rng.choice([-1, 1]) * rng.uniform(0.3, np.pi)
            velocity = speed * np.array([np.cos(heading), np.sin(heading)])
        else:
            places[k] = place
    return t, places, at


def smoothed(rng, *, sigma=0.05, stated=1.0, tails=0.0, settings=DEFAULT_SETTINGS, dark=0.0, **kind):
    """A filtered track with its truth; ``stated``: variance told over variance true."""
    t, places, at = rolled(rng, **kind)
    noise = sigma * rng.standard_normal(places.shape)
    if tails:
        noise[rng.random(len(t)) < tails] *= 4.0
    seen = places + noise
    if dark:
        # the LED is hidden for stretches of half a second
        hidden = np.convolve(rng.random(len(t)) < dark / 15, np.ones(15))[: len(t)] > 0
        hidden[:10] = hidden[-10:] = False
        seen[hidden] = np.nan
    var = np.full(len(t), sigma**2 * stated)
    got = smooth_track(t, *seen.T, var, var, settings)
    return t, places, at, got


def nees(places, got):
    return ((got.x_cm - places[:, 0]) / got.sigma_x_cm) ** 2 + ((got.y_cm - places[:, 1]) / got.sigma_y_cm) ** 2


def mean_nees(seed, tracks=TRACKS, **kind):
    """Mean NEES with its error from track to track: on straight stretches, and within 0.2 s of a bounce."""
    rng = np.random.default_rng(seed)
    straight, turning = ([], []), ([], [])
    for number in range(tracks):
        t, places, at, got = smoothed(rng, **kind)
        value = nees(places, got)
        near = np.abs(t[:, None] - at).min(axis=1) < 0.2
        for kept, found in ((~near, straight), (near, turning)):
            found[0].extend(value[kept])
            found[1].extend([number] * int(kept.sum()))
    return [clustered_mean(*found) for found in (straight, turning)]


@pytest.mark.parametrize("q", [0.5, 2.0, 50.0])
@pytest.mark.parametrize("kind", [{}, {"uneven": True}, {"dark": 0.15}])
def test_the_stated_error_is_the_true_one(q, kind):
    """Two degrees of freedom: the mean NEES is 2, straight on and through the bounces, whatever was told before."""
    straight, turning = mean_nees(1, q=q, **kind)
    low, high = straight.interval(0.999)
    assert low < 2.0 < high or 1.75 < straight.value < 2.15
    # A turn in the dark is drawn as Gaussian though it was a corner somewhere in the gap: there the filter is bolder.
    assert 1.5 < turning.value < (3.0 if "dark" in kind else 2.4)


@pytest.mark.parametrize("stated", [0.25, 0.5, 2.0])
def test_variances_told_wrongly_are_put_right(stated):
    rng = np.random.default_rng(2)
    scales = [smoothed(rng, stated=stated)[3].scale for _ in range(20)]
    assert np.median(scales) * stated == pytest.approx(1.0, rel=0.1)
    straight, _ = mean_nees(3, tracks=30, stated=stated)
    assert straight.value == pytest.approx(2.0, abs=0.35)


def test_the_process_noise_is_learnt():
    rng = np.random.default_rng(4)
    for q in (0.5, 5.0, 50.0):
        learnt = [smoothed(rng, q=q)[3].q_cm2_s3 for _ in range(20)]
        assert np.exp(np.mean(np.log(learnt))) == pytest.approx(q, rel=0.4)


def test_a_slight_turn_is_put_where_it_was():
    """It shows some frames late; the kick belongs to where it happened."""
    rng = np.random.default_rng(5)
    t = np.arange(160) / FPS
    errors = []
    for _ in range(40):
        turn = rng.uniform(2.4, 2.8)
        y = np.where(t < turn, 0.0, 25.0 * np.sin(0.3) * (t - turn))
        noise = rng.normal(0, 0.08, (2, 160))
        got = smooth_track(t, 25 * t + noise[0], y + noise[1], np.full(160, 0.0064), np.full(160, 0.0064))
        errors.append(np.mean(((got.y_cm - y) / got.sigma_y_cm)[np.abs(t - turn) < 0.3] ** 2))
    assert 0.4 < np.mean(errors) < 1.6


# --- innovations


def track_of(rng, runs=1, **kind):
    parts = []
    for line in range(runs):
        t, _, _, got = smoothed(rng, **kind)
        parts.append(
            pd.DataFrame(
                {
                    "line": line, "t_s": t, "vx_cm_s": got.vx_cm_s, "vy_cm_s": got.vy_cm_s, "nis": got.nis,
                    "innovation_x": got.innovation_x, "innovation_y": got.innovation_y,
                }
            )
        )  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def healths(seed, many, **kind):
    rng = np.random.default_rng(seed)
    return [filter_health(track_of(rng, **kind)) for _ in range(many)]


def test_true_models_are_seldom_called_liars():
    found = healths(1, HEALTHS, frames=260)
    assert np.mean([not one.honest for one in found]) <= 0.05
    # significance alone, before asking whether it matters
    assert np.mean([one.p_value < 0.05 for one in found]) <= 0.075
    covered = np.mean([one.mean_nis_interval[0] < 2 < one.mean_nis_interval[1] for one in found])
    assert covered == pytest.approx(0.95, abs=0.03)
    assert np.mean([one.mean_nis for one in found]) == pytest.approx(2.0, abs=0.03)
    assert np.mean([one.lag1 for one in found]) == pytest.approx(0.0, abs=0.02)
    assert np.mean([one.tail_share for one in found]) == pytest.approx(0.02, abs=0.003)
    assert np.mean([one.stretch for one in found]) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(
    ("lie", "says"),
    [
        ({"stated": 0.5}, "times smaller"),
        ({"stated": 2.0}, "times larger"),
        ({"q": 2.0, "settings": KalmanSettings(q_cm2_s3=50.0)}, "too loose"),
        ({"q": 50.0, "settings": KalmanSettings(q_cm2_s3=2.0)}, "too stiff"),
        ({"tails": 0.15, "frames": 1000}, "heavy tails"),
    ],
)
def test_lies_are_told(lie, says):
    found = healths(2, 25, **({"frames": 300} | lie))
    assert np.mean([not one.honest for one in found]) >= 0.9
    assert np.mean([says in one.verdict for one in found]) >= 0.8
    assert all("\n" not in one.verdict for one in found)


def test_many_runs_count_as_what_belongs_together():
    rng = np.random.default_rng(7)
    one = filter_health(track_of(rng, runs=24, frames=90, bounces=0))
    assert one.honest
    assert one.frames > 1500
    # runs whose errors are each on its own scale: right on the mean, but the interval must widen
    parts = [track_of(rng, frames=90, bounces=0, stated=s).assign(line=n) for n, s in enumerate([0.5, 1.0, 2.0] * 8)]
    mixed = filter_health(pd.concat(parts))
    width = [h.mean_nis_interval[1] - h.mean_nis_interval[0] for h in (one, mixed)]
    assert width[1] > 3 * width[0]


def test_too_little_to_judge():
    rng = np.random.default_rng(8)
    few = filter_health(track_of(rng, frames=80, bounces=0))
    assert few.honest
    assert "too few" in few.verdict
    assert few.to_dict()["mean_nis_interval"] == [None, None]
    empty = filter_health(track_of(rng, frames=80).iloc[:0])
    assert empty.frames == 0
    with pytest.raises(RequestError, match="`nis`"):
        filter_health(track_of(rng, frames=80).drop(columns="nis"))


def test_nis_is_that_of_the_forward_filter():
    """Independent path: the innovation covariance from the joint distribution of all measurements so far."""
    rng = np.random.default_rng(9)
    n, q, start_var = 9, 3.0, 1600.0
    t = np.cumsum(rng.uniform(0.02, 0.06, n))
    z, r = np.column_stack([20 * t, 5 * t]) + rng.normal(0, 0.05, (n, 2)), rng.uniform(0.001, 0.01, (n, 2))
    z[4] = np.nan
    got = smooth_track(t, *z.T, *r.T, KalmanSettings(q_cm2_s3=q))
    since = t - t[0]
    early = np.minimum(since[:, None], since)
    late = np.maximum(since[:, None], since)
    for axis, found in ((0, got.innovation_x), (1, got.innovation_y)):
        # place = z0 + v0 s + integrated acceleration; the first measurement's error is shared by all that follow
        joint = r[0, axis] + start_var * np.outer(since, since) + q * early**2 * (3 * late - early) / 6
        for k in range(1, n):
            past = [m for m in range(1, k) if m != 4]
            if k == 4:
                assert np.isnan(found[k])
                continue
            cov = joint[np.ix_(past, past)] + np.diag(r[past, axis])
            weights = np.linalg.solve(cov, joint[past, k]) if past else np.empty(0)
            expected = z[0, axis] + weights @ (z[past, axis] - z[0, axis])
            variance = joint[k, k] + r[k, axis] - weights @ joint[past, k]
            assert found[k] == pytest.approx((z[k, axis] - expected) / np.sqrt(variance), rel=1e-6)
    assert np.isnan(got.nis[0])
