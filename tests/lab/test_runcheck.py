"""A session's own runs, examined: wrong turns are caught without a camera, right ones are not; so says the report."""

import math
import shutil

import numpy as np
import pandas as pd
import pytest
from shapely import Point, box

from analysis.report.verdict import verdict_of
from lab.review.findings import summarise, to_result
from lab.review.review import examine, review
from lab.review.runcheck import check_runs
from lab.settings.load import load_settings
from lab.store.reader import SessionReader
from lab.store.tables import tables_of
from tests.lab.conftest import roll

REACH = box(-56.35, -41.35, 56.35, 41.35)
SQUARE = box(-22, -22, 22, 22)


@pytest.fixture(scope="session")
def caught(uniform_session):
    """The review of the session that turned by a uniform angle: what was found, the report's data, the figures."""
    found = examine(uniform_session.folder)
    result = to_result(found)
    return found, result, summarise(found, result)


@pytest.fixture(scope="session")
def sound(square_session):
    found = examine(square_session.folder)
    result = to_result(found)
    return found, result, summarise(found, result)


@pytest.fixture(scope="session")
def interior_session(tmp_path_factory):
    return roll(tmp_path_factory.mktemp("interior"), shape="square", motion__turning="interior", stop__lines=40, seed=6)


def whole_lengths(session):
    lines = tables_of(SessionReader(session.folder)).lines
    return lines.loc[lines["whole"], "length_cm"]


def test_uniform_turns_are_caught(caught, uniform_session):
    _, _, summary = caught
    lengths = whole_lengths(uniform_session)
    cauchy_cm = math.pi * REACH.area / REACH.length
    found = summary["run_lengths"]
    assert found["mean_cm"] == pytest.approx(lengths.mean())
    assert found["expected_cm"] == pytest.approx(cauchy_cm)
    assert found["p_value"] < 0.05
    assert found["exponent"] < 0.7  # 0 is the uniform angle, 1 Lambert's


def test_the_bias_that_follows_has_the_sign_that_uniform_turns_give_a_tower(caught):
    """Lines along the walls are too many, those through the middle too few and too short: both come out low."""
    _, _, summary = caught
    bias = summary["run_lengths"]["bias"]
    assert -0.3 < bias["area_rel"] < -0.01
    assert -0.25 < bias["perimeter_rel"] < -0.005


def test_the_verdict_names_the_problem_and_the_cure(caught):
    _, result, _ = caught
    verdict = verdict_of(result)
    (problem,) = [problem for problem in verdict.problems if "isotropic lines" in problem.what]
    assert "%" in problem.what
    assert "motion.turning" in problem.next_step
    assert verdict.tone != "good"
    (finding,) = [finding for finding in verdict.findings if finding.topic == "The robot's own runs"]
    assert "m = " in finding.text


def test_lamberts_turns_are_not_caught(sound, square_session):
    _, result, summary = sound
    assert summary["run_lengths"]["p_value"] > 0.05
    assert summary["run_lengths"]["bias"] is None
    assert summary["run_lengths"]["mean_cm"] == pytest.approx(whole_lengths(square_session).mean())
    verdict = verdict_of(result)
    assert not [problem for problem in verdict.problems if "isotropic lines" in problem.what]
    assert [finding.topic for finding in verdict.findings].count("The robot's own runs") == 1


def test_interior_stops_are_held_against_lines_drawn_by_their_length(interior_session):
    """Their mean is that of L² over that of L, of uniform lines: by chords thrown here."""
    found = summarised(interior_session)["run_lengths"]
    rng = np.random.default_rng(5)
    theta, p = rng.uniform(0, math.pi, 400_000), rng.uniform(-70, 70, 400_000)
    along, across = np.array([-np.sin(theta), np.cos(theta)]), np.array([np.cos(theta), np.sin(theta)])
    low, high = np.full(theta.size, -np.inf), np.full(theta.size, np.inf)
    for axis, half in ((0, 56.35), (1, 41.35)):
        one, two = (np.array([-half, half])[:, None] - p * across[axis]) / along[axis]
        low, high = np.maximum(low, np.minimum(one, two)), np.minimum(high, np.maximum(one, two))
    length = np.clip(high - low, 0, None)
    weighted_cm = (length**2).sum() / length.sum()
    assert found["expected_cm"] == pytest.approx(weighted_cm, rel=0.01)
    assert found["expected_cm"] > 1.15 * math.pi * REACH.area / REACH.length
    assert found["mean_cm"] == pytest.approx(whole_lengths(interior_session).mean())
    assert found["p_value"] > 0.05
    assert found["exponent"] is None


def summarised(session):
    return review(session.folder, report=False)


def lines_table(lengths, **more):
    return pd.DataFrame(
        {"length_cm": lengths, "k": 0, "l1_cm": 0.0, "l3_cm3": 0.0, "whole": True, "weight": 1.0, **more}
    )


@pytest.mark.parametrize(
    "keys",
    [
        {"robot": ["virtual"] * 2, "camera": "none"},
        {"motion.turning": "uniform", "motion.weighting": "run_length", "arena.kind": "disc"},
        {"arena.edge": "dark_ring"},
    ],
    ids=["several robots", "weighted lines", "felt edge"],
)
def test_where_the_question_does_not_arise_there_is_no_answer(keys):
    lengths = np.full(60, 70.0)
    assert check_runs(lines_table(lengths), SQUARE, load_settings(None, keys), np.random.default_rng(1)) is None
    assert check_runs(lines_table(lengths), SQUARE, load_settings(None), np.random.default_rng(1)) is not None


def test_too_few_lines_and_lines_that_never_met_the_shape():
    settings = load_settings(None)
    few = lines_table(np.full(9, 70.0))
    assert check_runs(few, SQUARE, settings, np.random.default_rng(1)) is None
    missed = check_runs(lines_table(np.full(60, 75.0)), SQUARE, settings, np.random.default_rng(1))
    assert missed.consistency is None
    assert missed.lengths.runs == 60


def test_runs_that_are_no_lines_are_left_out():
    """Stalls and the way to the first wall are short: they would look like wrong turns."""
    rng = np.random.default_rng(8)
    settings = load_settings(None, {"arena.kind": "disc", "arena.radius_cm": 53.65})
    right = 100 * np.sqrt(1 - rng.uniform(-1, 1, 150) ** 2)  # chords of the disc of 50 cm that the centre can reach
    table = lines_table(np.concatenate([right, np.full(50, 0.2)]))
    table["whole"] = table["length_cm"] > 0.5
    disc = Point(0, 0).buffer(20)
    with_stalls = check_runs(table, disc, settings, np.random.default_rng(1))
    alone = check_runs(table[:150], disc, settings, np.random.default_rng(1))
    assert with_stalls.lengths == alone.lengths
    assert with_stalls.lengths.passed


def test_the_report_shows_what_the_runs_say(uniform_session, square_session, tmp_path):
    for session, wrong in ((uniform_session, True), (square_session, False)):
        folder = shutil.copytree(session.folder, tmp_path / str(wrong))
        text = review(folder, report=True)["report"].read_text(encoding="utf-8")
        assert ("own runs" in text) is True
        assert ("These are not the runs of uniform isotropic lines" in text) is wrong
        assert ("The runs are not those of isotropic lines" in text) is wrong
        assert ("No fault found" in text) is not wrong
