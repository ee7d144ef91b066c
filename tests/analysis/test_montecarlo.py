import threading

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from shapely import affinity
from shapely.geometry import LineString, MultiPolygon, Point, Polygon, box

from analysis import lanes, linekernels, montecarlo
from analysis.boundary import Boundary
from analysis.invariants import signed_moment
from analysis.lanes import LANES
from analysis.montecarlo import (
    available_cores,
    cross_lines,
    running_bands,
    simulate,
    simulate_chords,
    simulate_crossings,
    simulate_lines,
)
from analysis.quadrature import exact_moments
from analysis.sensor import SensorModel
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


def thrown_with_numpy(boundary, groups, stream):
    """The same lines from NumPy's own SFC64: (θ, p) about the boundary's centre, in the order thrown."""

    class Given(np.random.bit_generator.ISeedSequence):
        def __init__(self, words):
            self.words = words

        def generate_state(self, n_words, dtype=np.uint32):
            assert (n_words, dtype) == (3, np.uint64)
            return self.words

    words = stream.integers(0, 1 << 64, (3, LANES), dtype=np.uint64)
    lanes = [np.random.Generator(np.random.SFC64(Given(np.ascontiguousarray(words[:, i])))) for i in range(LANES)]
    for _ in range(groups):
        u = np.array([lane.random() for lane in lanes])
        v = np.array([lane.random() for lane in lanes])
        theta = np.where(u < 0.5, np.pi * (u - 0.25), np.pi * (u - 0.75) + np.pi / 2)
        yield from zip(theta, boundary.radius_cm * (2 * v - 1), strict=True)


@pytest.mark.parametrize("seed", range(3))
def test_every_line_crosses_where_shapely_says(seed):
    """Lines from NumPy's generator, cut by shapely, are those of the kernels, crossing by crossing."""
    geometry = random_polygon(seed)
    boundary = Boundary.of(geometry)
    lines = simulate_crossings(geometry, 300, np.random.default_rng(seed))
    owned = iter(np.split(lines.s_cm, np.cumsum(lines.counts)[:-1]))
    far = 3 * boundary.radius_cm
    theta_rad, p_cm, expected = [], [], []
    for theta, p in thrown_with_numpy(boundary, 12, np.random.default_rng(seed).spawn(1)[0]):
        normal, along = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
        foot = np.array(boundary.centre_cm) + p * normal
        lit = geometry.intersection(LineString([foot - far * along, foot + far * along]))
        ends = np.sort((shapely.get_coordinates(lit) - foot) @ along) if lit.length else np.empty(0)
        theta_rad.append(theta)
        p_cm.append(foot @ normal)
        expected.append((ends.size // 2, lit.length, signed_moment(ends, 3)))
        if lit.length:
            found = next(owned, None)
            if found is not None:
                assert_allclose(found, ends, atol=1e-8)
    assert next(owned, None) is None
    assert_allclose(np.column_stack(cross_lines(boundary, theta_rad, p_cm)), expected, atol=1e-6)


def test_many_words_of_vertices_and_padding():
    """Outlines of every size about the 63 edges of a word."""
    for sides in (3, 4, 62, 63, 64, 65, 126, 127, 200):
        turn = 2 * np.pi * np.arange(sides) / sides
        ring = np.column_stack([np.cos(turn), np.sin(turn)])
        disc = Polygon(10 * ring, [4 * ring[::-1]])
        boundary = Boundary.of(disc)
        theta = np.random.default_rng(sides).uniform(0, 7, 100)
        p = np.random.default_rng(sides).uniform(-9, 9, 100)
        for t, d, k, l1 in zip(theta, p, *cross_lines(boundary, theta, p)[:2], strict=True):
            n, a = np.array([np.cos(t), np.sin(t)]), np.array([-np.sin(t), np.cos(t)])
            lit = disc.intersection(LineString([d * n - 30 * a, d * n + 30 * a]))
            pieces = len(getattr(lit, "geoms", [lit])) if lit.length else 0
            assert (l1, k) == (pytest.approx(lit.length, abs=1e-9), pieces)


def test_kernels_do_what_their_python_says():
    """In NumPy's own arithmetic, word by word; only the intrinsics stay compiled."""
    outline = Boundary.of(random_polygon(1)).outline
    rooms = []
    for of in (lambda function: function, lambda function: function.py_func):
        state, work = lanes.seeded(np.random.default_rng(4)), linekernels.work_for(outline)
        with np.errstate(over="ignore"):
            of(lanes.draw)(state, work.uniform)
            of(lanes.directions)(work.uniform, work.cos, work.sin)
            work.p_cm[:] = np.linspace(-20, 20, LANES)
            of(linekernels.sign_words)(outline, work)
        _, crossings = linekernels.list_crossings(outline, work)
        of(linekernels.place_crossings)(outline, work, crossings)
        rooms.append((work, crossings))
    (one, crossings), (two, _) = rooms
    assert_array_equal(one.signs, two.signs)
    assert_allclose(one.uniform, two.uniform)
    assert_allclose(np.hypot(one.cos, one.sin), 1, rtol=1e-15)
    assert_allclose(one.t_cm[:crossings], two.t_cm[:crossings], atol=1e-12)


@pytest.mark.parametrize("size", [2, 4, 6, 8, 15, 16, 18, 300])
def test_sorting(size, rng):
    values = rng.normal(size=size + 2)
    expected = np.concatenate([values[:1], np.sort(values[1:-1]), values[-1:]])
    linekernels.sort_crossings(values, 1, size)
    assert_array_equal(values, expected)


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


def test_small_room_changes_nothing(shapes):
    boundary = Boundary.of(shapes["statue"])
    whole = montecarlo._crossings(boundary, 500, np.random.default_rng(1))
    state, work = lanes.seeded(np.random.default_rng(1)), linekernels.work_for(boundary.outline)
    parts, left = [], 500
    while left:
        s_cm, counts = np.empty(LANES * boundary.outline.x_cm.size), np.empty(left, dtype=np.int64)
        hits, filled = linekernels.fill_crossings(state, boundary.radius_cm, boundary.outline, work, (s_cm, counts))
        assert 0 < hits <= LANES
        parts.append((s_cm[:filled].copy(), counts[:hits].copy()))
        left -= hits
    assert_array_equal(np.concatenate([s for s, _ in parts]), np.concatenate([part.s_cm for part in whole]))
    assert_array_equal(np.concatenate([c for _, c in parts]), np.concatenate([part.counts for part in whole]))


def test_what_is_stopped_leaves_nothing(shapes):
    """Ctrl-C, from the callback or elsewhere, ends the threads, and the next call starts clean."""
    before = set(threading.enumerate())

    def stop(done, total):
        if done >= total // 10:
            raise KeyboardInterrupt

    for run in (
        lambda rng: simulate(shapes["tower"], lines=100_000, runs=20, rng=rng, progress=stop),
        lambda rng: simulate_lines(shapes["tower"], 2_000_000, rng, progress=stop),
        lambda rng: SensorModel(2.0).sense(shapes["tower"], 500_000, rng, progress=stop),
    ):
        with pytest.raises(KeyboardInterrupt):
            run(np.random.default_rng(1))
    assert set(threading.enumerate()) == before


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
