"""The statistics on the unit square, against pair sums, closed forms and SciPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tracking.uniformity import (
    cramer_von_mises,
    cramer_von_mises_weights,
    hermans_rasson,
    hermans_rasson_weights,
    holm,
    neyman,
    rayleigh,
    smooth_functions,
    smooth_means,
    smooth_terms,
)


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 60), st.integers(0, 2**32 - 1))
def test_hermans_rasson_is_the_sum_over_all_pairs(n, seed):
    u = np.random.default_rng(seed).random((3, n)).round(2)  # ties too
    angle = 2 * np.pi * u
    apart = np.abs(angle[:, :, None] - angle[:, None, :])
    terms = np.abs(np.pi - apart) - np.pi / 2 - 2.895 * (np.abs(np.sin(apart)) - 2 / np.pi)
    np.testing.assert_allclose(hermans_rasson(u), terms.sum(axis=(1, 2)) / n, atol=1e-9)


def test_statistics_against_closed_forms():
    v = np.random.default_rng(8).random(83)
    assert cramer_von_mises(v) == pytest.approx(stats.cramervonmises(v, "uniform").statistic)
    assert rayleigh(np.full(7, 0.3)) == pytest.approx(14.0)
    assert rayleigh(np.arange(8) / 8) == pytest.approx(0.0)
    assert holm([0.04, 0.01, 0.03, 0.9]) == pytest.approx([0.09, 0.04, 0.09, 0.9])


def test_smooth_functions_are_orthonormal_and_blind_to_the_sense_of_the_normal():
    nodes, weights = np.polynomial.legendre.leggauss(24)
    u, v = (grid.ravel() for grid in np.meshgrid((nodes + 1) / 2, (nodes + 1) / 2))
    weight = np.outer(weights, weights).ravel() / 4
    # rows of one point each are the functions themselves
    functions = smooth_means(u[:, None], v[:, None])
    assert functions.shape[1] == 14
    np.testing.assert_allclose(functions.T @ (functions * weight[:, None]), np.eye(14), atol=1e-9)
    np.testing.assert_allclose(weight @ functions, 0, atol=1e-9)
    np.testing.assert_allclose(smooth_means(u[:, None] + 1, 1 - v[:, None]), functions, atol=1e-9)


def test_neyman_of_independent_lines_is_chi_square():
    u, v = np.random.default_rng(9).random((2, 2000, 100))
    statistic = neyman(smooth_means(u, v), 100 * np.eye(14))
    assert stats.kstest(statistic, stats.chi2(14).cdf).pvalue > 1e-3


@pytest.mark.parametrize(("order", "count"), [(4, 14), (6, 27)])
def test_smooth_functions_are_those_of_the_means(order, count):
    u, v = np.random.default_rng(10).random((2, 5, 30))
    functions = smooth_functions(u, v, order)
    assert functions.shape == (5, 30, count)
    np.testing.assert_allclose(functions.mean(axis=1), smooth_means(u, v, order), atol=1e-12)
    terms = smooth_terms(order)
    assert len(terms) == count
    # scipy's Legendre polynomial times a wave
    for index, (half_waves, degree) in enumerate(terms):
        part = np.sin if terms[:index].count((half_waves, degree)) else np.cos
        norm = np.sqrt((2 * degree + 1) * (2 if half_waves else 1))
        height = np.polynomial.legendre.Legendre.basis(degree)(2 * v - 1)
        np.testing.assert_allclose(functions[..., index], norm * part(np.pi * half_waves * u) * height, atol=1e-12)


@pytest.mark.parametrize(
    ("statistic", "weights", "wave"),
    [
        (hermans_rasson, hermans_rasson_weights, lambda m, x: np.exp(2j * np.pi * m * x)),
        (cramer_von_mises, cramer_von_mises_weights, lambda j, x: np.cos(np.pi * j * x)),
    ],
)
def test_statistics_are_their_series(statistic, weights, wave):
    x, waves = np.random.default_rng(12).random(40), 4000
    power = np.abs([wave(m, x).mean() for m in range(1, waves + 1)]) ** 2
    assert 40 * power @ weights(waves) == pytest.approx(float(statistic(x)), abs=1e-3)
