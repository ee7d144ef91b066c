import logging

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from shapely.geometry import LineString

from analysis import kernels
from analysis.invariants import (
    AREA_PREFACTOR,
    CrossingsError,
    area_cm2,
    invariants_table,
    line_invariants,
    perimeter_cm,
    signed_moment,
)
from analysis.montecarlo import simulate_lines
from lab.base.errors import RequestError

widths = st.lists(st.floats(1e-3, 50), min_size=1, max_size=12)


def throw_with_shapely(geometry, lines, rng):
    """Lines that hit, as lists of lit (start, end): through shapely's own intersection."""
    centre, reach = np.array(geometry.envelope.centroid.coords[0]), geometry.length
    radius = max(np.hypot(*(np.array(c) - centre)) for c in geometry.envelope.exterior.coords)
    found = []
    while len(found) < lines:
        theta, p = rng.uniform(0, np.pi), rng.uniform(-radius, radius)
        normal, along = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
        start = centre + p * normal - reach * along
        lit = geometry.intersection(LineString([start, start + 2 * reach * along]))
        pieces = [piece for piece in getattr(lit, "geoms", [lit]) if piece.length > 0]
        if pieces:
            found.append(sorted(tuple(sorted(((np.array(piece.coords) - start) @ along).tolist())) for piece in pieces))
    return found


@settings(deadline=None)
@given(widths, widths, st.floats(-100, 100))
def test_recursion_equals_the_sum_over_pairs(chords, gaps, start):
    steps = [start]
    for chord, gap in zip(chords, gaps, strict=False):
        steps += [chord, gap]
    s = np.cumsum(steps[:-1] if len(steps) % 2 else steps)
    k, l1, l3 = line_invariants(s)
    assert k == s.size // 2
    # The sum over pairs cancels: it is only as good as its largest terms.
    longest = s[-1] - s[0]
    assert l1 == pytest.approx(signed_moment(s, 1), abs=1e-12 * (longest * s.size**2 + abs(start)))
    assert l3 == pytest.approx(signed_moment(s, 3), abs=1e-12 * (longest + abs(start)) ** 3 * s.size**2)


@settings(deadline=None)
@given(widths, widths)
def test_first_invariant_is_the_lit_length_and_a_line_reads_the_same_backwards(chords, gaps):
    steps = [0.0]
    for chord, gap in zip(chords, gaps, strict=False):
        steps += [chord, gap]
    s = np.cumsum(steps[:-1] if len(steps) % 2 else steps)
    k, l1, l3 = line_invariants(s)
    assert l1 == pytest.approx((s[1::2] - s[::2]).sum(), rel=1e-12)
    assert l3 >= l1**3 * (1 - 1e-12)
    assert line_invariants(s[-1] - s[::-1]) == pytest.approx((k, l1, l3), rel=1e-9)


def test_a_line_of_two_chords_by_hand():
    # In at 0 and 3, out at 1 and 5: in-out 1, 5, 2, 2; in-in 3; out-out 4.
    assert line_invariants([0, 1, 3, 5], [True, False, True, False]) == (2, 3.0, 1 + 125 + 8 + 8 - 27 - 64)
    assert signed_moment([0, 1, 3, 5], 2) == 1 + 25 + 4 + 4 - 9 - 16
    assert line_invariants([]) == (0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("s", "entering"),
    [
        ([1.0], None),
        ([2.0, 1.0], None),
        ([1.0, np.nan], None),
        ([1.0, 2.0], [False, True]),
        ([1.0, 2.0], [True]),
        ([1.0, 2.0, 3.0, 4.0], [True, True, False, False]),
    ],
)
def test_crossings_that_do_not_pair_up_are_refused(s, entering):
    with pytest.raises(CrossingsError, match="pair up") as caught:
        line_invariants(s, entering)
    assert_allclose(caught.value.crossings_cm, s)


def test_table_takes_lines_in_any_order_and_names_what_it_leaves_out(caplog):
    crossings = pd.DataFrame(
        {
            "line": [7, 7, 2, 2, 9, 2, 2],
            "order": [1, 0, 0, 1, 0, 3, 2],
            "s_cm": [4.0, 1.0, 0.0, 1.0, 5.0, 5.0, 3.0],
            "entering": [False, True, True, False, True, False, True],
        }
    )
    with caplog.at_level(logging.ERROR):
        table = invariants_table(crossings)
    assert table.columns.to_list() == ["line", "k", "l1_cm", "l3_cm3"]
    assert table.line.to_list() == [2, 7]
    assert table.k.to_list() == [2, 1]
    assert_allclose(table.l1_cm, [3, 3])
    assert_allclose(table.l3_cm3, [51, 27])
    assert table.attrs["unpaired_lines"] == [9]
    assert "1 of 3 lines" in caplog.text


def test_empty_and_incomplete_tables():
    columns = ["line", "order", "s_cm", "entering"]
    assert len(invariants_table(pd.DataFrame({c: [] for c in columns}))) == 0
    with pytest.raises(RequestError, match="entering, s_cm"):
        invariants_table(pd.DataFrame({"line": [], "order": []}))


SEVEN = ["circle", "square", "triangle", "ell", "annulus", "two discs", "tower"]


@pytest.mark.parametrize("name", SEVEN)
def test_eq_1_holds_with_pi_over_3_and_fails_as_printed(shapes, name, rng):
    geometry = shapes[name]
    k, l1, l3 = (values.mean() for values in simulate_lines(geometry, 1_000_000, rng))
    assert float(area_cm2(l1, l3)) == pytest.approx(geometry.area, rel=0.015)
    assert float(perimeter_cm(k, l1, l3)) == pytest.approx(geometry.length, rel=0.015)
    printed = 3 / np.pi * l3 / l1
    assert printed / geometry.area == pytest.approx(9 / np.pi**2, rel=0.015)
    assert abs(printed / geometry.area - 1) > 0.07
    assert pytest.approx(1.0471975512) == AREA_PREFACTOR


@pytest.mark.parametrize("name", ["ell", "annulus"])
def test_naive_third_moment_of_chords_is_wrong_off_convex_shapes(shapes, name, rng):
    found = throw_with_shapely(shapes[name], 3000, rng)
    cubes = np.mean([sum((b - a) ** 3 for a, b in line) for line in found])
    l1 = np.mean([sum(b - a for a, b in line) for line in found])
    l3 = np.mean([line_invariants(np.ravel(line))[2] for line in found])
    area = shapes[name].area
    assert np.pi / 3 * cubes / l1 < 0.75 * area
    assert np.pi / 3 * l3 / l1 == pytest.approx(area, rel=0.08)


def test_no_line_gives_nan():
    assert np.isnan(area_cm2(0.0, 0.0))
    assert np.isnan(perimeter_cm(0.0, 0.0, 0.0))
    assert_allclose(area_cm2([0.0, 1.0], [0.0, 3.0]), [np.nan, np.pi])


@settings(max_examples=30, deadline=None)
@given(st.lists(st.lists(st.floats(0.001, 9), min_size=2, max_size=10), max_size=5))
def test_compiled_kernels_do_what_their_python_says(lines):
    even = [np.cumsum(line[: len(line) // 2 * 2]) for line in lines]
    counts = np.array([line.size for line in even], dtype=np.int64)
    t = np.concatenate([*even, np.empty(0)])
    out = []
    for function in (kernels.ragged_invariants, kernels.ragged_invariants.py_func):
        k, l1, l3 = np.zeros(counts.size, np.int64), np.zeros(counts.size), np.zeros(counts.size)
        function(t, counts, k, l1, l3)
        out.append((k, l1, l3))
    assert_allclose(out[0], out[1], rtol=1e-12)
    for line, k, l1, l3 in zip(even, *out[1], strict=True):
        assert kernels.chord_invariants.py_func(line, 0, line.size) == pytest.approx((k, l1, l3))
