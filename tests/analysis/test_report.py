"""The report says what the tables say, needs nothing from outside, and changes when they change."""

import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.compare import deviation
from analysis.figures.values import Entry, Isotropy, Measured
from analysis.report import write
from analysis.report.result import ReportError, RunCheck
from analysis.report.tables import provenance_of, tables_of
from analysis.report.verdict import decided_at, lines_to_tell_apart, verdict_of
from analysis.report.words import count, decimals_for, p_value, percent, plus_minus, probability, signed
from analysis.report.write import ReportFileError, render_report, write_report
from analysis.runlengths import arena_consistency, examine_runs, expected_bias
from tests.analysis import sample_session as sample

VOID = {"meta", "img", "br", "link", "input", "hr"}
FIGURES = {"blinks", "plane", "convergence", "posterior", "chords", "camera", "lines", "isotropy"}


@pytest.fixture(scope="module")
def result():
    return sample.session("square", runs=500, seed=4)


@pytest.fixture(scope="module")
def page(result):
    return render_report(result)


class Page(HTMLParser):
    """Collects what the tests ask for and checks that every element is closed where it should be."""

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.figures, self.elements, self.text = [], [], {}, [], []
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.elements.append((tag, attrs))
        if "id" in attrs:
            self.ids.append(attrs["id"])
        if tag == "figure":
            self.figures[attrs["id"]] = []
        if tag not in VOID:
            self.open.append(tag)
        inside = [name for name in self.figures if "figure" in self.open]
        if inside:
            self.figures[inside[-1]].append((tag, attrs))

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> without a beginning"
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    @property
    def words(self):
        return " ".join(" ".join(self.text).split())


# --- the page ---------------------------------------------------------------------------------------------------


def test_page_is_whole_and_every_figure_is_described(page):
    found = Page(page)
    assert dict(found.elements)["html"] == {"lang": "en"}
    assert set(found.figures) == {f"figure-{name}" for name in FIGURES}
    for name, parts in found.figures.items():
        tags = [tag for tag, _ in parts]
        assert "figcaption" in tags, name
        described = [attrs.get("aria-label") or attrs.get("alt") for tag, attrs in parts if tag in ("svg", "img")]
        assert len(described) == 1
        assert len(described[0]) > 40, name
    assert len(page.encode()) < 5_000_000


def test_page_needs_nothing_from_outside(page):
    found = Page(page)
    assert not re.search(r"https?:|[\"'(]//|@import|<script|<link|<iframe", page)
    for tag, attrs in found.elements:
        for name in ("src", "href"):
            if name in attrs:
                assert attrs[name].startswith(("data:image/png;base64,", "#")), (tag, attrs[name][:60])
    assert all(target.startswith("#") for target in re.findall(r"url\(([^)]*)\)", page))


def test_ids_are_unique_and_references_arrive(page):
    ids = Page(page).ids
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'(?:href="#|url\(#)([^")]+)', page)) <= set(ids)


def test_figures_follow_light_and_dark(page):
    assert "prefers-color-scheme: dark" in page
    assert "@media print" in page
    svgs = "".join(re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL))
    assert "var(--ink)" in svgs
    assert not re.search("#1b1f24|#68717d|#d9dde3|#fefefe", svgs)


def test_a_large_figure_becomes_an_image(result, monkeypatch):
    monkeypatch.setattr(write, "SVG_LIMIT", 1000)
    found = Page(render_report(replace(result, track=None, true_lines=None, isotropy=None, chord_pairs=None)))
    images = [attrs for tag, attrs in found.elements if tag == "img"]
    assert len(images) == len(found.figures) == 4
    assert all(image["src"].startswith("data:image/png;base64,iVBOR") and image["alt"] for image in images)
    assert "svg" not in [tag for tag, _ in found.elements]


def test_without_video_the_page_says_what_is_missing():
    found = Page(render_report(sample.session("square", runs=60, video=False)))
    assert set(found.figures) == {f"figure-{name}" for name in FIGURES - {"blinks", "camera", "lines", "isotropy"}}
    assert "left-out" in found.ids
    assert found.words.count("without video") == 4
    assert "no video" in found.words


def test_a_session_that_never_met_the_shape_is_reported_too():
    whole = sample.session("square", runs=20)
    empty = replace(
        whole,
        lines=whole.lines.assign(k=0, l1_cm=0.0, l3_cm3=0.0),
        crossings=whole.crossings.iloc[:0],
        estimates=whole.estimates.iloc[:0],
        ranking=[],
        chord_pairs=whole.chord_pairs.iloc[:0],
    )
    assert empty.measured is None
    assert verdict_of(empty).tone == "poor"
    found = Page(render_report(empty))
    assert "none of the 20 runs crossed the shape" in found.words
    assert {"figure-lines", "figure-blinks"} <= set(found.figures)
    assert "no line crossed the shape" in found.words


def test_names_and_values_cannot_break_the_page(result):
    nasty = '<script>alert("1")</script> & `ls`'
    wild = replace(result, title=nasty, warnings=(nasty,), provenance={nasty: {nasty: nasty}}, session=nasty)
    text = render_report(wild)
    assert "<script" not in text
    assert "<code>ls</code>" in text
    assert nasty.replace("`", "") in Page(text).words.replace("`", "")


def test_report_is_written_whole_and_the_same_each_time(result, tmp_path, page):
    path = write_report(result, tmp_path / "new" / "report.html")
    assert path.read_text(encoding="utf-8") == page
    assert list(path.parent.iterdir()) == [path]


def test_a_place_that_cannot_be_written_to_is_named(result, tmp_path, monkeypatch):
    monkeypatch.setattr(write, "render_report", lambda _: "<html>")
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(ReportFileError, match="cannot write the report") as caught:
        write_report(result, blocked / "report.html")
    assert caught.value.exit_code == 2
    assert "\n" not in str(caught.value)


def test_a_table_without_its_columns_is_refused(result):
    with pytest.raises(ReportError, match=r"'estimates' lacks area_cm2.*finalize") as caught:
        replace(result, estimates=result.estimates.drop(columns=["area_cm2"]))
    assert caught.value.missing == ("area_cm2",)


# --- numbers ----------------------------------------------------------------------------------------------------


def test_the_page_quotes_the_last_estimate(result, page):
    last = result.estimates.iloc[-1]
    words = Page(page).words
    quoted = re.search(r"A = (\d+(?:\.\d+)?) ± (\d+(?:\.\d+)?) cm²; projected 784\.0 cm²: ([+−\d.]+) %", words)
    assert float(quoted[1]) == pytest.approx(last["area_cm2"], abs=0.6)
    assert float(quoted[2]) == pytest.approx(last["sigma_area_cm2"], abs=0.6)
    assert float(quoted[3].replace("−", "-")) == pytest.approx(100 * (last["area_cm2"] / 28**2 - 1), abs=0.06)
    quoted = re.search(r"P = (\d+\.\d) ± (\d+\.\d) cm; projected 112\.0 cm", words)
    assert float(quoted[1]) == pytest.approx(last["perimeter_cm"], abs=0.06)
    assert f"{len(result.estimates)} lines of 500 arena runs" in words


def test_another_value_makes_another_text(result):
    estimates = result.estimates.copy()
    estimates.loc[estimates.index[-1], "area_cm2"] *= 1.5
    changed = replace(result, estimates=estimates)
    assert verdict_of(changed).findings[1] != verdict_of(result).findings[1]
    assert tables_of(changed)[0].rows[0] != tables_of(result)[0].rows[0]
    assert tables_of(changed)[0].rows[1] == tables_of(result)[0].rows[1]
    other = replace(result, exact=replace(result.exact, perimeter_cm=200.0))
    assert "projected 200.0 cm" in verdict_of(other).findings[2].text


def test_estimates_are_read_by_n_not_by_row(result):
    shuffled = replace(result, estimates=result.estimates.sample(frac=1, random_state=1))
    assert shuffled.measured.area_cm2 == result.estimates["area_cm2"].iloc[-1]
    assert verdict_of(shuffled) == verdict_of(result)


def test_tables_hold_the_tables(result):
    tables = {table.name: table for table in tables_of(result)}
    assert set(tables) == {"sizes", "milestones", "ranking", "isotropy", "chords"}
    reached = len(result.estimates)
    assert [row[0] for row in tables["milestones"].rows] == ["1", "3", "10", "30", "100", str(reached)]
    last = result.estimates.iloc[-1]
    assert tables["sizes"].rows[0][3] == signed(100 * (last["area_cm2"] / 28**2 - 1))
    assert tables["sizes"].rows[1][3] == signed(100 * (last["perimeter_cm"] / 112 - 1))
    tenth = result.estimates.iloc[9]
    assert tables["milestones"].rows[2][1] == str(int(tenth["line"]))
    assert tables["milestones"].rows[2][2] == plus_minus(tenth["area_cm2"], tenth["sigma_area_cm2"], "").strip()
    assert tables["ranking"].rows[0][0] == "Square"
    assert len(tables["ranking"].rows) == 4
    assert all(len(row) == len(table.heads) for table in tables.values() for row in table.rows)
    assert ("chords missed by the robot", "3") in tables["chords"].rows


def test_provenance_is_flat_and_complete(result):
    told = replace(result, provenance={"run": {"seed": 7, "arena": {"width_cm": 120.0}, "note": None}, "none": {}})
    (table,) = provenance_of(told)
    assert table.title == "run"
    assert table.rows == (("seed", "7"), ("arena.width_cm", "120"), ("note", "–"))


# --- the verdict ------------------------------------------------------------------------------------------------


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
    assert "chordlab run --lines" in verdict_of(few).problems[0].next_step
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
    assert "A = 800.0 cm²" in text
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


# --- words ------------------------------------------------------------------------------------------------------


def test_words():
    assert plus_minus(687.31, 38.4, "cm²") == "687 ± 38 cm²"
    assert plus_minus(10.126, 0.034, "cm") == "10.126 ± 0.034 cm"
    assert plus_minus(10.126, math.nan, "cm") == "10.1 cm (uncertainty unknown)"
    assert signed(-0.04) == "0.0"
    assert signed(-1.26) == "−1.3"
    assert signed(math.nan) == "unknown"
    assert probability(1.0) == "more than 99.9 %"
    assert probability(0.0) == "less than 0.1 %"
    assert percent(0.345, 0) == "34 %"
    assert count(1, "line") == "1 line"
    assert count(12345, "line") == "12\u202f345 lines"
    assert p_value(0.0004) == "< 0.001"
    assert p_value(math.nan) == "unknown"


@given(st.floats(1e-4, 1e4), st.floats(-1e5, 1e5))
def test_plus_minus_loses_less_than_a_tenth_of_the_uncertainty(sigma, value):
    shown = float(plus_minus(value, sigma, "cm").split(" ±")[0].replace("−", "-"))
    assert abs(shown - value) <= max(0.051 * sigma, 0.5 * 10.0 ** -decimals_for(sigma)) * (1 + 1e-6)


@given(st.floats(0, 1))
def test_a_probability_is_never_written_as_certain(value):
    assert not re.fullmatch(r"(100\.0|0\.0) %", probability(value))
