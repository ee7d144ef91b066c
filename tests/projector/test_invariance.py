"""What a robot can find out does not depend on where a shape lies, how it is turned, or a mirror."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.affinity import affine_transform
from shapely.geometry import MultiPolygon, Point, Polygon, box

from analysis.congruence import are_congruent, congruence_classes
from analysis.quadrature import exact_moments
from projector.collections import load_dictionary
from projector.dictionary import shape_from
from projector.fill import fill
from projector.importers import import_shape

# corner polygons, whose moments are exact to 1e-12: connected, with a hole, and in two pieces
CORNERED = (
    shape_from("triangle").geometry,
    Polygon([(0, 0), (30, 0), (30, 10), (12, 10), (12, 40), (0, 40)]),
    box(0, 0, 40, 30).difference(box(5, 5, 20, 12)),
    MultiPolygon([box(0, 0, 10, 30), Polygon([(20, 0), (45, 3), (25, 21)])]),
)


def moved(geometry, turn, mirror, dx, dy):
    cosine, sine = np.cos(turn), np.sin(turn)
    return affine_transform(geometry, [cosine, -sine * mirror, sine, cosine * mirror, dx, dy])


motions = st.tuples(st.floats(-7, 7), st.sampled_from([1.0, -1.0]), st.floats(-80, 80), st.floats(-80, 80))


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(CORNERED), motions)
def test_motions_leave_size_and_moments_alone(geometry, motion):
    there = moved(geometry, *motion)
    before, after = exact_moments(geometry), exact_moments(there)
    assert there.area == pytest.approx(geometry.area, rel=1e-9)
    assert there.length == pytest.approx(geometry.length, rel=1e-9)
    assert after.mean == pytest.approx(before.mean, rel=1e-9)
    assert np.abs((after.covariance - before.covariance) / np.outer(before.mean, before.mean)).max() < 1e-9
    assert np.abs(after.relative - before.relative).max() < 1e-9


@settings(max_examples=25, deadline=None)
@given(motions)
def test_motions_before_an_import_leave_the_import_alone(tmp_path_factory, motion):
    eiffel = shape_from("eiffel")
    path = tmp_path_factory.mktemp("moved") / "moved.geojson"
    path.write_text(shapely.to_geojson(moved(eiffel.geometry, *motion)))
    again = import_shape(str(path), "moved", area_cm2=eiffel.area_cm2).shape
    assert again.perimeter_cm == pytest.approx(eiffel.perimeter_cm, rel=1e-9)
    assert are_congruent(again.geometry, eiffel.geometry)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 30)), min_size=4, max_size=9), motions)
def test_filling_and_moving_commute(points, motion):
    ring = np.array(points, dtype=float)
    there = shapely.get_coordinates(moved(shapely.LineString([*points, points[0]]), *motion))
    for rule in ("nonzero", "evenodd"):
        assert fill([there], rule).area == pytest.approx(fill([ring], rule).area, rel=1e-9, abs=1e-9)


def test_mirror_twins_make_one_class_and_lookalikes_do_not():
    pear = Polygon([(0, 0), (30, 0), (30, 10), (12, 14), (12, 40), (0, 40)])
    taller = affine_transform(pear, [1, 0, 0, 1.01, 0, 0])
    disc = Point(0, 0).buffer(20, quad_segs=64)
    shapes = {
        "pear": pear,
        "mirrored": moved(pear, 0.7, -1.0, 5, -9),
        "disc": disc,
        "turned": moved(pear, -2.1, 1.0, 50, 3),
        "taller": taller,
        "disc again": moved(disc, 0.3, 1.0, 9, 9),
    }
    assert congruence_classes(shapes) == [("pear", "mirrored", "turned"), ("disc", "disc again"), ("taller",)]


def test_equal_area_and_perimeter_are_not_enough_for_a_class():
    # two arms, on the same side or on opposite sides: the same area, the same perimeter
    one = box(0, 0, 40, 10).union(box(5, 10, 10, 25)).union(box(25, 10, 30, 25))
    other = box(0, 0, 40, 10).union(box(5, 10, 10, 25)).union(box(25, -15, 30, 0))
    assert (one.area, one.length) == pytest.approx((other.area, other.length))
    assert not are_congruent(one, other)


def test_the_dictionary_holds_no_twins():
    drawn = load_dictionary() | load_dictionary("monuments")
    classes = congruence_classes({name: shape.geometry for name, shape in drawn.items()})
    assert all(len(members) == 1 for members in classes)
