"""How well a dictionary tells its entries apart: six shapes in the paper's order, letters by a matched dictionary."""

import itertools
import string
from pathlib import Path

import matplotlib
import numpy as np
import pytest

from analysis.perline import LineRecogniser, learn_tables, tables_of
from analysis.quadrature import exact_moments
from analysis.sensor import SensorModel
from analysis.tablestore import learn_lines
from projector.dictionary import load_dictionary, shape_from
from tests.analysis.blind_robot import BlindRobot

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


# Capitals 20 cm high, a reading every 2 cm: coarse enough that the strokes' ends and gaps are often missed.
STEP_CM = 2.0
LINES = 80
RUNS = 12


@pytest.fixture(scope="module")
def letters():
    font = Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"  # the same on every machine
    return {letter: shape_from(f"text:{letter}", font=font, height_cm=20).geometry for letter in string.ascii_uppercase}


def share_right(recogniser, measured):
    """Share of right names over all letters, each recognised from `LINES` lines at a time."""
    right = []
    for letter, lines in measured.items():
        for run in np.split(lines, len(lines) // LINES):
            recogniser.reset()
            recogniser.update_many(*run.T)
            right.append(recogniser.ranked()[0][0] == letter)
    return np.mean(right)


@pytest.mark.slow
@pytest.mark.parametrize(("footprint_cm", "ideal_right"), [(0.1, 0.45), (0.3, 0.6)])
def test_letters_are_told_by_a_matched_dictionary_and_not_by_an_ideal_one(letters, footprint_cm, ideal_right, rng):
    """The robot is simulated by points of the footprint and the robot's own detector, not by the sensor model."""
    robot = BlindRobot(STEP_CM, footprint_cm)
    measured = {letter: robot.roll(outline, RUNS * LINES, rng) for letter, outline in letters.items()}
    sensor = SensorModel(STEP_CM, footprint_cm, margin=robot.margin, noise=robot.noise, speed_sigma=robot.speed_sigma)
    seen = learn_lines(letters, sensor)
    matched = LineRecogniser(tables_of({name: lines.invariants() for name, lines in seen.items()}))
    ideal = LineRecogniser(learn_tables(letters, rng))
    assert share_right(matched, measured) >= 0.95
    assert share_right(ideal, measured) < ideal_right
