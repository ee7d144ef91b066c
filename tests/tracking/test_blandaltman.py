"""Limits of agreement: the worked example of the paper, coverage of the intervals, the trend."""

import json

import numpy as np
import pytest
from scipy import stats

from lab.base.blandaltman import bland_altman

# Peak expiratory flow by two meters, l/min: Bland and Altman, Lancet 1986, table 1 (first measurements).
WRIGHT = [494, 395, 516, 434, 476, 557, 413, 442, 650, 433, 417, 656, 267, 478, 178, 423, 427]
MINI = [512, 430, 520, 428, 500, 600, 364, 380, 658, 445, 432, 626, 260, 477, 259, 350, 451]


def test_the_papers_own_example():
    found = bland_altman(WRIGHT, MINI)
    assert found.n == 17
    assert found.bias == pytest.approx(-2.1, abs=0.05)
    assert found.sd == pytest.approx(38.8, abs=0.05)
    # the paper doubles the sd where we take 1.96 times: -79.7 and 75.5
    assert found.limits == pytest.approx((-2.1 - 1.96 * 38.8, -2.1 + 1.96 * 38.8), abs=0.2)
    assert found.bias_interval == pytest.approx((-22.0, 17.8), abs=0.2)


def test_intervals_cover_what_they_should():
    rng = np.random.default_rng(1)
    n, runs = 25, 3000
    hits = np.zeros(2)
    for _ in range(runs):
        truth = rng.uniform(2, 40, n)
        found = bland_altman(truth + 0.3 + 0.5 * rng.standard_normal(n), truth)
        hits += (
            found.bias_interval[0] < 0.3 < found.bias_interval[1],
            found.upper_limit_interval[0] < 0.3 + 1.96 * 0.5 < found.upper_limit_interval[1],
        )
    assert hits / runs == pytest.approx(0.95, abs=0.02)


def test_the_trend_is_least_squares():
    rng = np.random.default_rng(2)
    truth = rng.uniform(2, 40, 300)
    measured = 1.04 * truth + 0.2 + 0.3 * rng.standard_normal(300)
    found = bland_altman(measured, truth)
    other = stats.linregress((measured + truth) / 2, measured - truth)
    assert (found.trend, found.trend_sigma, found.trend_p, found.trend_at_zero) == pytest.approx(
        (other.slope, other.stderr, other.pvalue, other.intercept)
    )
    assert found.trend == pytest.approx(0.04 / 1.02, abs=4 * found.trend_sigma)
    flat = [
        bland_altman(truth + 0.3 * rng.standard_normal(300), truth + 0.3 * rng.standard_normal(300)).trend_p
        for _ in range(400)
    ]
    assert stats.kstest(flat, "uniform").pvalue > 1e-3


def test_what_cannot_be_known_is_none():
    assert bland_altman([1.0, np.nan], [1.0, 2.0]) is None
    two = bland_altman([1.0, 2.0, np.nan], [1.5, 2.0, 7.0])
    assert two.n == 2
    assert json.loads(json.dumps(two.to_dict()))["trend"] is None
    same = bland_altman(np.arange(9.0), np.arange(9.0))
    assert (same.sd, same.trend, same.trend_p) == (0.0, 0.0, 1.0)
