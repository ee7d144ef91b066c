"""The verdict says what a session's tables say, and what spoils it with its cure."""

import math
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from analysis.compare import deviation
from analysis.figures.values import Entry, Isotropy, Measured
from analysis.report.problems import lines_to_tell_apart
from analysis.report.result import RunCheck
from analysis.report.tables import tables_of
from analysis.report.verdict import decided_at, verdict_of
from analysis.report.words import signed
from analysis.report.write import render_report
from analysis.runlengths import arena_consistency, examine_runs, expected_bias
from tests.analysis import sample_session as sample
from tests.analysis.test_report import Page


@pytest.fixture(scope="module")
def result():
    return sample.session("square", runs=500, seed=4)


@pytest.fixture(scope="module")
def page(result):
    return render_report(result)


def test_recognised_mistaken_undecided(result):
    assert verdict_of(result).headline.startswith("Recognised: Square")
    mistaken = verdict_of(replace(result, ranking=[("circle", 0.99), ("square", 0.01)]))
    assert mistaken.tone == "poor"
    assert "Square was projected, Circle is favoured (99.0 %)" in mistaken.headline
    undecided = verdict_of(replace(result, ranking=[("square", 0.7), ("circle", 0.3)]))
    assert undecided.tone == "fair"
    assert undecided.headline.startswith("Undecided: Square leads")
    assert "hardest rival is Circle" in undecided.problems[0].what
    wrong = verdict_of(replace(result, ranking=[("circle", 0.7), ("square", 0.3)]))
    assert "but Square was projected" in wrong.headline
    stricter = verdict_of(replace(result, ranking=[("square", 0.97), ("circle", 0.03)], stop_at=0.99))
    assert stricter.headline.startswith("Undecided")
    foreign = verdict_of(replace(result, name="text:A", ranking=[("circle", 0.97)]))
    assert "not in the dictionary" in foreign.headline
    assert "no dictionary" in verdict_of(replace(result, ranking=[])).headline


def test_undecided_for_want_of_lines_or_for_bias(result):
    few = replace(result, estimates=result.estimates[:8], ranking=[("square", 0.7), ("circle", 0.3)])
    assert f"chordlab run --resume {result.session} --lines" in verdict_of(few).problems[0].next_step
    twin = dict(result.dictionary) | {"twin": replace(result.exact, title="Twin")}
    same = replace(result, dictionary=twin, ranking=[("twin", 0.5), ("square", 0.5)])
    assert "cannot tell them apart" in verdict_of(same).problems[0].what
    far = {name: result.dictionary[name] for name in ("square", "eiffel")}
    biased = replace(result, dictionary=far, ranking=[("eiffel", 0.6), ("square", 0.4)])
    assert "biased rather than short" in verdict_of(biased).problems[0].next_step


def test_when_it_was_decided(result):
    table = pd.DataFrame(
        {
            "leading": ["circle", "square", "circle", "square", "square", "square"],
            "posterior": [0.97, 0.96, 0.99, 0.80, 0.96, 0.99],
        }
    )
    estimates = result.estimates.iloc[:6].drop(columns=["leading", "posterior"]).join(table)
    decided = replace(result, estimates=estimates, ranking=[("square", 0.99), ("circle", 0.01)])
    assert decided_at(decided) == 5
    assert "from N = 5 on" in verdict_of(decided).findings[0].text
    assert decided_at(replace(decided, ranking=[("circle", 0.99)])) is None
    assert decided_at(replace(decided, estimates=estimates.drop(columns=["leading"]))) is None
    assert decided_at(replace(decided, stop_at=0.5)) == 4


def test_chance_of_a_deviation_is_uniform_for_an_unbiased_robot():
    rng = np.random.default_rng(8)
    exact = Entry("Square", 784.0, 112.0, np.array([[9.0e4, 3.0e3], [3.0e3, 1.4e3]]))
    n = 50
    draws = rng.multivariate_normal([784.0, 112.0], exact.covariance_per_line / n, 4000)
    chances = [deviation(Measured(n, area, perimeter, np.eye(2)), exact).p_value for area, perimeter in draws]
    np.testing.assert_allclose(np.quantile(chances, [0.1, 0.5, 0.9]), [0.1, 0.5, 0.9], atol=0.03)
    off = deviation(Measured(n, 784.0 + 3 * math.sqrt(9.0e4 / n), 112.0, np.eye(2)), exact)
    assert off.z_area == pytest.approx(3.0)
    assert off.z_perimeter == 0.0
    assert math.isnan(
        deviation(Measured(n, 700.0, 100.0, np.eye(2)), replace(exact, covariance_per_line=np.zeros((2, 2)))).p_value
    )


@pytest.mark.parametrize("stop_at", [0.95, 0.99])
def test_lines_to_tell_apart_keep_their_promise(stop_at):
    covariance = np.array([[9.0e4, 3.0e3], [3.0e3, 1.4e3]])
    one, other = Entry("a", 784.0, 112.0, covariance), Entry("b", 800.0, 103.0, covariance)
    n = lines_to_tell_apart(one, other, stop_at)
    rng = np.random.default_rng(1)
    draws = rng.multivariate_normal([784.0, 112.0], covariance / n, 20_000)
    weight = np.linalg.inv(covariance / n)
    far = [draws - (784.0, 112.0), draws - (800.0, 103.0)]
    log_odds = 0.5 * (
        np.einsum("ni,ij,nj->n", far[1], weight, far[1]) - np.einsum("ni,ij,nj->n", far[0], weight, far[0])
    )
    assert (1 / (1 + np.exp(-log_odds)) >= stop_at).mean() == pytest.approx(0.95, abs=0.01)
    assert lines_to_tell_apart(one, one, stop_at) == math.inf


def test_a_wrong_speed_is_seen_and_named():
    fast = sample.session("square", runs=500, seed=4, speed_error=0.09)
    problems = verdict_of(fast).problems
    stretched = next(problem for problem in problems if "lengths are" in problem.what)
    assert 8.6 < float(re.search(r"\+([\d.]+) %", stretched.what)[1]) < 9.4
    assert "motion.cm_s_per_unit" in stretched.next_step
    assert any("wrong speed or scale" in problem.next_step for problem in problems)
    assert verdict_of(fast).tone == "fair"


def test_what_spoils_a_session_is_said(result):
    lines = result.lines.copy()
    lines.loc[:39, "ended"] = "stall"
    spoilt = replace(
        result,
        lines=lines,
        chords_missed=30,
        isotropy=Isotropy(np.zeros(9), np.zeros(9), {"Rayleigh": 1e-5}, False, "Runs favour 30°."),
    )
    said = " ".join(problem.what for problem in verdict_of(spoilt).problems)
    assert "40 runs did not end at the wall (40 by stall)" in said
    assert "missed" in said
    assert "not isotropic" in said
    assert "p-value: < 0.001 (Rayleigh)" in verdict_of(spoilt).findings[-1].text
    short = verdict_of(replace(result, estimates=result.estimates[:8]))
    assert any("Only 8 lines" in problem.what for problem in short.problems)
    unmatched = verdict_of(replace(result, chords_missed=30, chords_extra=28))
    assert any("not matched" in problem.next_step for problem in unmatched.problems)
    assert not any("lowers P" in problem.what for problem in unmatched.problems)
    few = result.chord_pairs.iloc[:3].assign(robot_length_cm=[10.0, 12.0, 10.5], true_length_cm=[10.0, 11.0, 10.9])
    assert not any("lengths are" in problem.what for problem in verdict_of(replace(result, chord_pairs=few)).problems)
    clean = verdict_of(replace(result, chords_missed=0))
    assert clean.tone == "good"
    assert clean.problems == ()
    wrong_area = result.estimates.assign(area_cm2=result.estimates["area_cm2"] * 0.7)
    biased = verdict_of(replace(result, estimates=wrong_area, chords_missed=0))
    assert any("light threshold" in problem.next_step for problem in biased.problems)


def test_camera_is_compared_with_the_robot(result):
    seen = replace(result, camera=Measured(100, 800.0, 100.0, np.diag([100.0, 4.0])))
    measured = result.measured
    text = verdict_of(seen).findings[3].text
    assert f"{signed(100 * (measured.area_cm2 / 800 - 1))} % in A" in text
    assert "A = 800 ± 10 cm²" in text
    assert tables_of(seen)[0].rows[0][-1] == "800 ± 10 cm²"
    assert "look random" in verdict_of(replace(result, isotropy=Isotropy(np.zeros(0), np.zeros(0)))).findings[-1].text
    assert "not tested" in verdict_of(replace(result, isotropy=None)).findings[-1].text


# --- the robot's own runs ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run_checks(result):
    """Of the sample's runs as they are, and of a robot that rolls the shorter half of them."""
    lengths = result.lines["length_cm"].to_numpy()
    rng = np.random.default_rng(3)
    sound = examine_runs(lengths, sample.ARENA, rng)
    agrees = arena_consistency(*(result.lines[name] for name in ("k", "l1_cm", "l3_cm3")), lengths, sample.ARENA)
    wrong = examine_runs(rng.permutation(np.sort(lengths)[:250]), sample.ARENA, rng)
    bias = expected_bias(sample.TOWER, sample.ARENA, 0.0, rng, runs=40_000)
    return RunCheck(sound, agrees, None), RunCheck(wrong, None, bias)


def test_sound_runs_are_a_finding_and_no_problem(result, run_checks):
    plain, checked = verdict_of(result), verdict_of(replace(result, runs_check=run_checks[0]))
    assert (checked.problems, checked.tone) == (plain.problems, plain.tone)
    (finding,) = set(checked.findings) - set(plain.findings)
    assert "No fault found" in finding.text
    assert f"{math.pi * 120 * 90 / (2 * (120 + 90)):.1f} cm are expected" in finding.text
    assert "The arena and Eq. 1 agree" in finding.text


def test_runs_that_are_none_of_isotropic_lines_are_a_problem_with_the_bias_they_make(result, run_checks):
    clean, wrong = replace(result, chords_missed=0), run_checks[1]
    verdict = verdict_of(replace(clean, runs_check=wrong))
    assert (verdict_of(clean).tone, verdict.tone) == ("good", "fair")
    (problem,) = verdict.problems
    assert "not those of isotropic lines (p" in problem.what
    area, perimeter = (float(found) for found in re.findall(r"by ([+-][\d.]+) ± [\d.]+ %", problem.what))
    assert [area, perimeter] == pytest.approx([100 * wrong.bias.area_rel, 100 * wrong.bias.perimeter_rel], abs=0.06)
    assert area < -3
    assert "Lambert" in problem.next_step
    assert "bias this shape" not in verdict_of(replace(clean, runs_check=replace(wrong, bias=None))).problems[0].what


def test_the_page_shows_what_the_runs_say(result, run_checks, page):
    for check in run_checks:
        words = Page(render_report(replace(result, runs_check=check))).words
        assert check.lengths.verdict.split(":")[0] in words
        assert "own runs" in words
    assert "own runs" not in Page(page).words


@pytest.mark.parametrize(("ended", "told"), [("stall", True), ("link", True), ("timeout", True), ("contact", False)])
def test_runs_that_were_cut_are_told_but_for_contacts_which_weights_make_good(result, ended, told):
    lines = result.lines.copy()
    lines.loc[:29, "ended"] = ended
    said = " ".join(problem.what for problem in verdict_of(replace(result, lines=lines)).problems)
    assert (f"30 runs did not end at the wall (30 by {ended})" in said) is told
