"""Monte Carlo lines a second against its peers on the same outlines, and against what its parts alone must cost.

Everywhere a line counts if it crosses the shape. Peers and limits run beside the kernel, and the best rounds are
compared, because other work on the machine only ever slows a round down. `ratio` in `extra_info` is by the wall
clock; what needs one thread, and `ratio_one_core`, goes by processor time, which a busy machine disturbs less.
"""

import time

import numpy as np
import pytest
import shapely
from shapely.geometry import Point, Polygon

from analysis.boundary import Boundary
from analysis.kernels import available_cores, kernel
from analysis.lanes import LANES, draw, seeded
from analysis.linekernels import sign_words, throw, work_for
from analysis.montecarlo import simulate
from analysis.quadrature import exact_moments
from projector.dictionary import load_dictionary

LINES = 1_000_000
SHAPELY_LINES = 5_000


def star(edges, seed=5):
    rng = np.random.default_rng(seed)
    turn = 2 * np.pi * np.arange(edges) / edges
    reach = rng.uniform(14, 18, edges)
    return Polygon(np.column_stack([reach * np.cos(turn), reach * np.sin(turn)]))


def outline_44():
    """36 corners outside and a hole of 8."""
    return star(36).difference(Point(0, 0).buffer(5, quad_segs=2))


def best_s(work, rounds=7, clock=time.perf_counter):
    work()
    taken = []
    for _ in range(rounds):
        start = clock()
        work()
        taken.append(clock() - start)
    return min(taken)


def kernel_s(outline, threads=None, lines=LINES, clock=time.perf_counter):
    def work():
        simulate(outline, lines=lines, runs=1, rng=np.random.default_rng(1), threads=threads)

    return best_s(work, clock=clock)


@pytest.fixture(scope="module", params=["triangle", "44 edges", "eiffel"])
def outline(request):
    return outline_44() if request.param == "44 edges" else load_dictionary()[request.param].geometry


def test_lines_against_vectorised_shapely(benchmark, outline):
    """The peer cuts the outline with arrays of lines and takes the lit lengths only: no 𝓛_3, no k."""
    rng = np.random.default_rng(1)
    circle = shapely.minimum_bounding_circle(outline)
    radius, centre = shapely.minimum_bounding_radius(outline), shapely.get_coordinates(circle.centroid)[0]
    shapely.prepare(outline)

    def cut():
        theta, p = rng.uniform(0, np.pi, SHAPELY_LINES), rng.uniform(-radius, radius, SHAPELY_LINES)
        normal = np.column_stack([np.cos(theta), np.sin(theta)])
        along = np.column_stack([-np.sin(theta), np.cos(theta)]) * radius
        foot = centre + p[:, None] * normal
        lines = shapely.linestrings(np.stack([foot - along, foot + along], axis=1))
        return shapely.length(shapely.intersection(lines, outline))

    peer = np.count_nonzero(cut()) / best_s(cut)
    ours = LINES / kernel_s(outline)
    cpu = time.process_time
    one_core = LINES / kernel_s(outline, 1, clock=cpu) * best_s(cut, clock=cpu) / np.count_nonzero(cut())
    benchmark.extra_info.update(
        lines_per_second=ours, shapely_lines_per_second=peer, ratio=ours / peer, ratio_one_core=one_core
    )
    benchmark(simulate, outline, lines=LINES, runs=1, rng=np.random.default_rng(1))


def test_lines_against_porespy(benchmark):
    """Chord lengths in an image of 1000² pixels along its two axes; a pixel row or column that is lit is a line."""
    filters = pytest.importorskip("porespy").filters
    outline = outline_44()
    pixels = 1000
    west, south, east, north = outline.bounds
    x, y = np.meshgrid(np.linspace(west, east, pixels), np.linspace(south, north, pixels))
    image = shapely.contains_xy(outline, x, y)
    rows = np.count_nonzero(image.any(axis=0)) + np.count_nonzero(image.any(axis=1))

    def chords():
        for axis in (0, 1):
            filters.apply_chords(image, axis=axis, spacing=1, trim_edges=False)

    peer, ours = rows / best_s(chords, 3), LINES / kernel_s(outline)
    benchmark.extra_info.update(lines_per_second=ours, porespy_lines_per_second=peer, ratio=ours / peer)
    benchmark.pedantic(chords, rounds=3)


@pytest.mark.parametrize("threads", range(1, available_cores() + 1))
def test_scaling_with_threads(benchmark, threads):
    outline = outline_44()
    ratio = kernel_s(outline, 1) / kernel_s(outline, threads)
    benchmark.extra_info.update(threads=threads, speed_up=ratio)
    benchmark(simulate, outline, lines=LINES, runs=1, rng=np.random.default_rng(1), threads=threads)


@pytest.mark.parametrize("edges", [3, 10, 30, 100, 300, 1000, 3000])
def test_scaling_with_edges(benchmark, edges):
    lines = 500_000
    outline = Point(0, 0).buffer(15, quad_segs=edges // 4) if edges > 10 else star(edges)
    used = Boundary.of(outline).edges
    taken_s = kernel_s(outline, 1, lines, time.process_time)
    benchmark.extra_info.update(edges=used, ns_per_line=1e9 * taken_s / lines, ns_per_edge=1e9 * taken_s / lines / used)
    benchmark(simulate, outline, lines=lines, runs=1, rng=np.random.default_rng(1), threads=1)


@kernel
def _numbers(state, work, batches):
    for _ in range(batches):
        draw(state, work.uniform)
        draw(state, work.uniform)


@kernel
def _edges(outline, work, batches):
    for _ in range(batches):
        sign_words(outline, work)


def test_roofline(benchmark, outline):
    """One thread: the two random numbers of a line, and two products and a comparison for each vertex, alone."""
    boundary = Boundary.of(outline)
    state, work = seeded(np.random.default_rng(1)), work_for(boundary.outline)
    throw(state, boundary.radius_cm, work)
    batches = 20_000
    numbers_s = best_s(lambda: _numbers(state, work, batches), clock=time.process_time)
    edges_s = best_s(lambda: _edges(boundary.outline, work, batches), clock=time.process_time)
    share = boundary.hull_perimeter_cm / (2 * np.pi * boundary.radius_cm)
    floor = 1e9 * (numbers_s + edges_s) / (batches * LANES * share)
    ours = 1e9 * kernel_s(outline, 1, clock=time.process_time) / LINES
    benchmark.extra_info.update(ns_per_line=ours, ns_floor=floor, ratio=ours / floor)
    benchmark(_edges, boundary.outline, work, batches)


def test_exact_moments(benchmark, outline):
    benchmark(exact_moments, outline)


@pytest.mark.parametrize("edges", [100, 300, 600])
def test_exact_moments_of_many_edges(benchmark, edges, monkeypatch):
    """On one core; the aim for 300 edges is a second."""
    monkeypatch.setattr("analysis.quadrature.available_cores", lambda: 1)
    outline = star(edges).difference(Point(0, 0).buffer(5, quad_segs=2))
    moments = benchmark.pedantic(exact_moments, (outline,), rounds=3, warmup_rounds=1)
    benchmark.extra_info.update(edges=Boundary.of(outline).edges, error=moments.error)
