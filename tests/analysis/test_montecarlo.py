import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from shapely import affinity
from shapely.geometry import LineString, MultiPolygon, Point, Polygon, box

from analysis import montecarlo
from analysis.boundary import Boundary
from analysis.kernels import available_cores, trace_lines
from analysis.montecarlo import running_bands, simulate, simulate_chords, simulate_crossings, simulate_lines
from analysis.quadrature import exact_moments
from lab.base.errors import RequestError


def comb(teeth):
    return shapely.union_all([box(0, -1, 4 * teeth, 0), *(box(4 * i, 0, 4 * i + 2, 30) for i in range(teeth))])


def random_polygon(seed):
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 25))
    reach = rng.uniform(6, 15, 25)
    outer = Polygon(np.column_stack([reach * np.cos(angle), reach * np.sin(angle)])).buffer(0)
    hole = Point(rng.uniform(-1, 1, 2)).buffer(2.5, quad_segs=3)
    return shapely.union_all([outer.difference(hole), Point(25, 3).buffer(4, quad_segs=4)])


@pytest.mark.parametrize("seed", range(3))
def test_every_line_crosses_where_shapely_says(seed):
    geometry = random_polygon(seed)
    boundary = Boundary.of(geometry)
    uniforms = np.random.default_rng(seed).random((400, 2))
    args = (boundary.x_cm, boundary.y_cm, boundary.chunks, boundary.discs)
    s, counts = np.empty(20_000), np.empty(400, np.int64)
    hits, used, filled = trace_lines(uniforms, 400, boundary.radius_cm, args, (s, counts))
    assert used == 400
    s2, counts2 = np.empty(20_000), np.empty(400, np.int64)
    assert trace_lines.py_func(uniforms, 400, boundary.radius_cm, args, (s2, counts2)) == (hits, used, filled)
    assert_allclose(s2[:filled], s[:filled], atol=1e-9)
    owned = iter(np.split(s[:filled], np.cumsum(counts[:hits])[:-1]))
    far = 3 * boundary.radius_cm
    for u, v in uniforms:
        theta, p = np.pi * u, boundary.radius_cm * (2 * v - 1)
        normal, along = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
        foot = np.array(boundary.centre_cm) + p * normal
        lit = geometry.intersection(LineString([foot - far * along, foot + far * along]))
        if lit.length:
            ends = np.sort((shapely.get_coordinates(lit) - foot) @ along)
            assert_allclose(next(owned), ends, atol=1e-8)
    assert next(owned, None) is None


def test_estimates_scatter_about_the_truth_as_the_quadrature_says(shapes, rng):
    for name in ("circle", "ell", "tower", "two discs"):
        exact = exact_moments(shapes[name])
        found = simulate(shapes[name], lines=2000, runs=1000, rng=rng)
        assert_allclose(found.covariance, exact.covariance_at(2000), rtol=0.25, atol=0.2 * found.covariance[1, 1])
        assert found.area_cm2.mean() == pytest.approx(exact.area_cm2, rel=5e-3)
        assert found.perimeter_cm.mean() == pytest.approx(exact.perimeter_cm, rel=5e-3)
        assert found.lines_per_second > 0


def test_sample_moments_equal_the_exact_ones(shapes, rng):
    values = np.column_stack(simulate_lines(shapes["statue"], 400_000, rng))
    exact = exact_moments(shapes["statue"])
    sigma = np.sqrt(np.diag(exact.covariance) / len(values))
    assert (np.abs(values.mean(axis=0) - exact.mean) < 4.5 * sigma).all()
    scale = np.sqrt(np.outer(np.diag(exact.covariance), np.diag(exact.covariance)))
    assert_allclose(np.cov(values, rowvar=False) / scale, exact.covariance / scale, atol=0.02)


def test_disc_chords_follow_their_law(rng):
    r = 10.0
    chords = simulate_chords(Point(40, -7).buffer(r, quad_segs=400), 20_000, rng)
    assert stats.kstest(chords, lambda c: 1 - np.sqrt(np.clip(1 - (c / 2 / r) ** 2, 0, 1))).pvalue > 1e-3


def test_lines_that_hit_are_uniform_and_isotropic(rng):
    # Two thin bars at right angles, far apart: either is hit as often as its hull is long, from any side.
    bar = box(0, 0, 40, 0.5)
    both = MultiPolygon([bar, affinity.translate(affinity.rotate(bar, 90, origin=(0, 0)), -60, 0)])
    exact = exact_moments(both)
    k, l1, _ = simulate_lines(both, 300_000, rng)
    assert k.mean() == pytest.approx(exact.chords_per_line, rel=0.003)
    assert l1.mean() == pytest.approx(np.pi * both.area / exact.hitting_measure_cm, rel=0.02)


def test_the_same_seed_gives_the_same_whatever_the_threads(shapes):
    for threads in (1, 2, 5):
        found = simulate(shapes["ell"], lines=50_001, runs=3, rng=np.random.default_rng(5), threads=threads)
        lines = simulate_lines(shapes["ell"], 70_000, np.random.default_rng(5), threads=threads)
        if threads == 1:
            first, first_lines = found, lines
        assert_array_equal(found.area_cm2, first.area_cm2)
        assert_array_equal(found.perimeter_cm, first.perimeter_cm)
        assert_array_equal(lines, first_lines)
    assert len(set(first.area_cm2)) == 3
    other = simulate(shapes["ell"], lines=50_001, runs=3, rng=np.random.default_rng(6))
    assert not np.isin(other.area_cm2, first.area_cm2).any()


def test_one_generator_gives_new_lines_at_every_call(shapes, rng):
    assert (
        simulate(shapes["ell"], lines=9, runs=1, rng=rng).area_cm2
        != simulate(shapes["ell"], lines=9, runs=1, rng=rng).area_cm2
    )


@pytest.mark.parametrize("lines", [1, 7, 1000])
def test_runs_are_cut_where_they_should_be(shapes, lines, monkeypatch):
    monkeypatch.setattr(montecarlo, "BLOCK_LINES", 64)
    runs = 12
    found = simulate(shapes["tower"], lines=lines, runs=runs, rng=np.random.default_rng(2))
    k, l1, l3 = (
        column.reshape(runs, lines).mean(axis=1)
        for column in simulate_lines(shapes["tower"], lines * runs, np.random.default_rng(2))
    )
    assert_allclose(found.area_cm2, np.pi / 3 * l3 / l1, rtol=1e-9)
    assert_allclose(found.perimeter_cm, np.pi**2 / 3 * k * l3 / l1**2, rtol=1e-9)


def test_no_crossing_is_dropped_however_many_there_are(rng):
    # A comb of 400 teeth: some lines have hundreds of chords, many times more than the room set aside.
    geometry = comb(400)
    thrown = simulate_crossings(geometry, 4000, rng)
    assert thrown.counts.max() > 500
    assert (thrown.counts % 2 == 0).all()
    assert thrown.counts.sum() == thrown.s_cm.size
    assert thrown.counts.mean() / 2 == pytest.approx(exact_moments(geometry, tolerance=1e-3).chords_per_line, rel=0.1)


def test_small_room_changes_nothing(shapes, monkeypatch):
    boundary = Boundary.of(shapes["statue"])
    whole = montecarlo._trace(boundary, 500, np.random.default_rng(1))
    stream = np.random.default_rng(1)
    real = np.empty

    class Tight:
        def __getattr__(self, name):
            return getattr(np, name)

        def empty(self, shape, dtype=float):
            return real(boundary.x_cm.size + 2 if dtype is float and np.isscalar(shape) else shape, dtype)

    monkeypatch.setattr(montecarlo, "np", Tight())
    tight = montecarlo._trace(boundary, 500, stream)
    assert_allclose(tight.s_cm, whole.s_cm)
    assert_array_equal(tight.counts, whole.counts)


def test_running_bands_narrow_like_one_over_root_n(shapes, rng):
    bands = running_bands(shapes["square"], [1, 10, 100, 1000], 500, rng)
    exact = exact_moments(shapes["square"])
    assert bands.area_quantiles_cm2.shape == (5, 4)
    assert (np.diff(bands.area_quantiles_cm2, axis=0) >= 0).all()
    assert bands.area_std_cm2[3] == pytest.approx(exact.sigma_area_rel * exact.area_cm2 / np.sqrt(1000), rel=0.15)
    assert bands.perimeter_std_cm[3] == pytest.approx(
        exact.sigma_perimeter_rel * exact.perimeter_cm / np.sqrt(1000), rel=0.15
    )
    assert bands.area_mean_cm2[3] == pytest.approx(exact.area_cm2, rel=0.01)
    assert bands.perimeter_mean_cm[3] == pytest.approx(exact.perimeter_cm, rel=0.01)
    assert bands.area_runs_cm2.shape == (500, 4)


def test_bands_continue_a_run(shapes):
    bands = running_bands(shapes["ell"], [3, 40], 6, np.random.default_rng(4), quantiles=[0.5])
    _, l1, l3 = (c.reshape(6, 40) for c in simulate_lines(shapes["ell"], 240, np.random.default_rng(4)))
    for column, n in ((0, 3), (1, 40)):
        area = np.pi / 3 * l3[:, :n].sum(axis=1) / l1[:, :n].sum(axis=1)
        assert_allclose(bands.area_runs_cm2[:, column], area, rtol=1e-9)


@pytest.mark.parametrize("lines", [10, 200_000])
def test_progress_reaches_the_end(shapes, lines, rng):
    seen = []
    simulate(shapes["square"], lines=lines, runs=1, rng=rng, progress=lambda *done: seen.append(done))
    assert seen[-1] == (lines, lines)
    assert seen == sorted(seen)


def test_requests_that_make_no_sense(shapes, rng, monkeypatch):
    square = shapes["square"]
    with pytest.raises(RequestError, match="`lines` must be at least 1"):
        simulate(square, lines=0, runs=1, rng=rng)
    with pytest.raises(RequestError, match="`runs`"):
        running_bands(square, [1, 2], 0, rng)
    with pytest.raises(RequestError, match="checkpoints"):
        running_bands(square, [2, 2], 3, rng)
    assert np.isnan(simulate(square, lines=5, runs=1, rng=rng).covariance).all()
    monkeypatch.delattr("os.sched_getaffinity", raising=False)
    assert available_cores() >= 1


@pytest.mark.slow
def test_a_hundred_million_lines_agree_to_a_part_in_a_thousand(shapes, rng):
    found = simulate(shapes["tower"], lines=100_000_000, runs=1, rng=rng)
    assert found.area_cm2[0] == pytest.approx(shapes["tower"].area, rel=1e-3)
    assert found.perimeter_cm[0] == pytest.approx(shapes["tower"].length, rel=1e-3)
