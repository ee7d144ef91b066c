import json
from pathlib import Path

import numpy as np
import pytest
import shapely
import shapely.geometry
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from shapely.geometry import Polygon

from analysis.estimate import (
    Estimate,
    NoLinesError,
    ellipse,
    estimate,
    estimate_from_moments,
    ratio_bias,
    relative_covariance,
    running_estimates,
)
from analysis.montecarlo import simulate, simulate_lines
from analysis.quadrature import exact_moments
from lab.base.errors import RequestError


def test_estimate_finds_the_square_and_its_own_sigma(shapes, rng):
    square = shapes["square"]
    found = estimate(*simulate_lines(square, 20_000, rng))
    assert found.n == 20_000
    assert found.area_cm2 == pytest.approx(square.area, abs=4 * found.sigma_area_cm2)
    assert found.perimeter_cm == pytest.approx(square.length, abs=4 * found.sigma_perimeter_cm)
    exact = exact_moments(square)
    assert_allclose(found.covariance, exact.covariance_at(20_000), rtol=0.1)
    assert found.correlation == pytest.approx(0.03153 / 0.39278 / 0.33730, abs=0.03)


def test_estimate_of_a_disc_by_closed_form(rng):
    # Chords 2√(1 − p²) with p uniform; A = π, P = 2π; σ_A from <𝓛_1²> = 8/3, <𝓛_3²> = 64·16/35, <𝓛_1𝓛_3> = 128/15.
    chord = 2 * np.sqrt(1 - rng.uniform(-1, 1, 400_000) ** 2)
    found = estimate(np.ones(chord.size), chord, chord**3)
    assert found.area_cm2 == pytest.approx(np.pi, rel=0.003)
    assert found.perimeter_cm == pytest.approx(2 * np.pi, rel=0.002)
    l1, l3 = np.pi / 2, 1.5 * np.pi
    a, c, ac = 8 / 3 / l1**2 - 1, 64 * 16 / 35 / l3**2 - 1, 128 / 15 / l1 / l3 - 1
    assert found.sigma_area_cm2 * np.sqrt(found.n) / np.pi == pytest.approx(np.sqrt(a + c - 2 * ac), rel=0.01)
    assert found.sigma_perimeter_cm * np.sqrt(found.n) / 2 / np.pi == pytest.approx(
        np.sqrt(4 * a + c - 4 * ac), rel=0.02
    )


def test_lines_that_miss_are_left_out(shapes, rng):
    k, l1, l3 = simulate_lines(shapes["tower"], 50, rng)
    mixed = [np.insert(np.asarray(column, dtype=float), [0, 10, 50], 0) for column in (k, l1, l3)]
    assert estimate(*mixed).area_cm2 == estimate(k, l1, l3).area_cm2
    running = running_estimates(*mixed)
    assert running.row[0] == 1
    assert running.row[-1] == 51
    assert running.n[-1] == 50


def test_running_estimates_equal_estimates_of_every_beginning(shapes, rng):
    lines = simulate_lines(shapes["statue"], 40, rng)
    running = running_estimates(*lines)
    assert np.isnan(running.sigma_area_cm2[0])
    for n in range(1, 41):
        one = estimate(*(column[:n] for column in lines))
        assert running.area_cm2[n - 1] == pytest.approx(one.area_cm2, rel=1e-12)
        assert running.perimeter_cm[n - 1] == pytest.approx(one.perimeter_cm, rel=1e-12)
        if n > 1:
            assert running.sigma_area_cm2[n - 1] == pytest.approx(one.sigma_area_cm2, rel=1e-9, abs=1e-9)
            assert running.sigma_perimeter_cm[n - 1] == pytest.approx(one.sigma_perimeter_cm, rel=1e-9, abs=1e-9)
        if n > 3:
            assert running.correlation[n - 1] == pytest.approx(one.correlation, abs=1e-9)


def test_nothing_to_estimate_from():
    with pytest.raises(NoLinesError, match="no line has crossed"):
        estimate([0], [0], [0])
    assert running_estimates([], [], []).n.size == 0
    with pytest.raises(RequestError, match="lengths differ"):
        estimate([1], [1, 2], [1])
    with pytest.raises(RequestError, match="finite"):
        estimate([1], [np.nan], [1])
    one = estimate([1], [2.0], [8.0])
    assert one.n == 1
    assert np.isnan(one.sigma_area_cm2)
    assert np.isnan(one.correlation)


@given(st.floats(0.1, 10), st.floats(0.1, 10))
def test_scaling_a_shape_scales_its_estimate(scale, other):
    k, l1 = np.array([1, 2, 1, 3]), np.array([3.0, 5.0, 1.0, 6.0]) * other
    l3 = l1**3 * [1, 1.4, 1, 2]
    small, large = estimate(k, l1, l3), estimate(k, scale * l1, scale**3 * l3)
    assert large.area_cm2 == pytest.approx(scale**2 * small.area_cm2)
    assert large.perimeter_cm == pytest.approx(scale * small.perimeter_cm)
    assert large.correlation == pytest.approx(small.correlation)


def test_delta_method_gradient_by_finite_differences():
    from analysis.invariants import area_cm2, perimeter_cm

    mean = np.array([1.7, 9.0, 3000.0])
    root = np.random.default_rng(3).normal(size=(3, 3)) * mean[:, None] * 0.3
    covariance = root @ root.T

    def logs(point):
        return np.log([float(area_cm2(point[1], point[2])), float(perimeter_cm(*point))])

    step = 1e-6 * mean
    gradient = np.column_stack(
        [(logs(mean + step * axis) - logs(mean - step * axis)) / (2 * step @ axis) for axis in np.eye(3)]
    )
    assert_allclose(relative_covariance(mean, covariance), gradient @ covariance @ gradient.T, rtol=1e-6)


def test_ratio_bias_is_what_short_simulations_show(shapes, rng):
    tower = shapes["tower"]
    exact = exact_moments(tower)
    lines, runs = 60, 60_000
    runs_found = simulate(tower, lines=lines, runs=runs, rng=rng)
    predicted = ratio_bias(exact.mean, exact.covariance) / lines
    seen = np.array([runs_found.area_cm2.mean() / tower.area, runs_found.perimeter_cm.mean() / tower.length]) - 1
    assert (predicted < -0.01).all()
    assert_allclose(seen, predicted, rtol=0.25)


def test_bias_correction_takes_most_of_it_off(shapes, rng):
    tower = shapes["tower"]
    lines, runs = 60, 1500
    columns = [column.reshape(runs, lines) for column in simulate_lines(tower, lines * runs, rng)]
    plain = [estimate(*run) for run in zip(*columns, strict=True)]
    mended = [estimate(*run, correct_bias=True) for run in zip(*columns, strict=True)]
    for truth, name in ((tower.area, "area_cm2"), (tower.length, "perimeter_cm")):
        before = abs(np.mean([getattr(one, name) for one in plain]) / truth - 1)
        after = abs(np.mean([getattr(one, name) for one in mended]) / truth - 1)
        assert after < 0.6 * before


def coverage(geometry, lines, runs, rng):
    exact = exact_moments(geometry)
    found = simulate(geometry, lines=lines, runs=runs, rng=rng)
    contour = ellipse([exact.area_cm2, exact.perimeter_cm], exact.covariance_at(lines), 0.95)
    return shapely.contains_xy(Polygon(np.column_stack(contour)), found.area_cm2, found.perimeter_cm).mean()


@pytest.mark.parametrize("name", ["square", "triangle", "tower"])
def test_95_percent_ellipse_holds_95_percent_of_the_runs(shapes, name, rng):
    assert 0.93 < coverage(shapes[name], 1000, 4000, rng) < 0.97


@pytest.mark.slow
@pytest.mark.parametrize("lines", [300, 3000])
def test_95_percent_ellipse_for_every_shape(shapes, lines, rng, full):
    if lines > 300 and not full:
        pytest.skip("run with --full")
    for name, geometry in shapes.items():
        assert 0.93 < coverage(geometry, lines, 6000, rng) < 0.97, name


SIX = ["circle", "square", "triangle", "chichen_itza", "eiffel", "liberty"]
COVERAGE_RUNS = 3000  # each checked to ±0.4 %


def six_shape(name):
    """One of the paper's shapes, read without the dictionary's code."""
    file = Path(__file__).parents[2] / "data" / "shapes" / f"{name}.geojson"
    found = json.loads(file.read_text(encoding="utf-8"))
    return shapely.geometry.shape(found["geometry"] if "geometry" in found else found["features"][0]["geometry"])


@pytest.mark.parametrize("name", SIX)
def test_95_percent_regions_of_the_six_shapes_at_300_lines(name, rng):
    """Both kinds: the exact ellipse about the truth, for a dictionary, and each run's own region about its estimate."""
    geometry = six_shape(name)
    assert 0.93 < coverage(geometry, 300, COVERAGE_RUNS, rng) < 0.97
    columns = [column.reshape(COVERAGE_RUNS, 300) for column in simulate_lines(geometry, 300 * COVERAGE_RUNS, rng)]
    held = [estimate(*run).holds(geometry.area, geometry.length, 0.95) for run in zip(*columns, strict=True)]
    assert 0.93 < np.mean(held) < 0.97


def test_a_region_is_the_outline_of_what_it_holds(shapes, rng):
    found = estimate(*simulate_lines(shapes["tower"], 40, rng))
    area, perimeter = found.region(0.9)
    assert (area[0], perimeter[0]) == pytest.approx((area[-1], perimeter[-1]))
    assert (area > 0).all()
    for a, p in zip(area[::9], perimeter[::9], strict=True):
        inside, outside = (
            (found.area_cm2 * (a / found.area_cm2) ** s, found.perimeter_cm * (p / found.perimeter_cm) ** s)
            for s in (0.999, 1.001)
        )
        assert found.holds(*inside, 0.9)
        assert not found.holds(*outside, 0.9)
    with pytest.raises(RequestError, match="at least 3"):
        estimate([1, 1], [2.0, 1.0], [8.0, 1.0]).region(0.9)
    with pytest.raises(RequestError, match="level"):
        found.holds(1.0, 1.0, 95)


def test_a_region_of_normal_logs_holds_its_share(rng):
    """Hotelling's T²: with 12 lines the χ² ellipse would hold only 89 %."""
    held = []
    for _ in range(4000):
        logs = rng.multivariate_normal([0, 0], [[1.0, 0.6], [0.6, 0.8]], 12) * 1e-3
        size, spread = np.exp(logs.mean(axis=0)), np.cov(logs, rowvar=False) / 12
        held.append(Estimate(12, *size.tolist(), spread * np.outer(size, size)).holds(1.0, 1.0, 0.95))
    assert np.mean(held) == pytest.approx(0.95, abs=0.012)


@pytest.mark.parametrize("level", [0.75, 0.95, 0.99])
def test_ellipse_holds_its_share_of_a_normal_cloud(level, rng):
    mean, covariance = [3.0, -1.0], [[4.0, 2.5], [2.5, 2.0]]
    x, y = ellipse(mean, covariance, level)
    assert (x[0], y[0]) == pytest.approx((x[-1], y[-1]))
    cloud = rng.multivariate_normal(mean, covariance, 20_000)
    assert shapely.contains_xy(Polygon(np.column_stack([x, y])), *cloud.T).mean() == pytest.approx(level, abs=0.01)
    with pytest.raises(RequestError, match="level"):
        ellipse(mean, covariance, 95)


def test_estimates_merge_through_their_moments(shapes, rng):
    columns = np.column_stack(simulate_lines(shapes["ell"], 500, rng)).astype(float)
    merged = estimate_from_moments(500, columns.mean(axis=0), np.cov(columns, rowvar=False))
    whole = estimate(*columns.T)
    assert merged.area_cm2 == pytest.approx(whole.area_cm2)
    assert_allclose(merged.covariance, whole.covariance)
