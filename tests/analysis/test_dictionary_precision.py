"""The dictionary's shapes keep the order of precision in which the paper found its own six."""

import itertools

import pytest

from analysis.quadrature import exact_moments
from projector.dictionary import load_dictionary

PAPER_ORDER = ["circle", "square", "triangle", "chichen_itza", "eiffel", "liberty"]
APART = 1.06  # least ratio of neighbours: the order must not hang on a nudge of the drawing


@pytest.fixture(scope="module")
def prefactors():
    moments = {name: exact_moments(shape.geometry) for name, shape in load_dictionary().items()}
    return {name: (each.sigma_area_rel, each.sigma_perimeter_rel) for name, each in moments.items()}


@pytest.mark.parametrize("which", [0, 1], ids=["area", "perimeter"])
def test_one_line_errors_rise_in_the_papers_order(prefactors, which):
    sigma = [prefactors[name][which] for name in PAPER_ORDER]
    for (lower, a), (upper, b) in itertools.pairwise(zip(PAPER_ORDER, sigma, strict=True)):
        assert b > APART * a, f"{upper} is not clearly above {lower}"


def test_area_error_rises_about_fourfold(prefactors):
    assert 3.5 < prefactors["liberty"][0] / prefactors["circle"][0] < 4.6


def test_no_two_shapes_are_alike_in_both_area_and_perimeter():
    for a, b in itertools.combinations(load_dictionary().values(), 2):
        ratios = (a.area_cm2 / b.area_cm2, a.perimeter_cm / b.perimeter_cm)
        assert any(max(ratio, 1 / ratio) > 1.15 for ratio in ratios), f"{a.name} and {b.name}"
