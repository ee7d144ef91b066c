"""The batch report names the faults that were put into the table, and no others; the page needs nothing else."""

import re

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from analysis.figures.batch import Cloud, clouds_figure, errors_figure, recognition_figure, uniform_figure
from analysis.pulls import Pull, Share, Uniformity, extreme_z, outlying, uniform_band
from analysis.report.sheet import render_sheet, write_sheet
from analysis.report.sheetpanels import _shape_errors, sheet_panels
from analysis.report.sheetrows import Rows, SheetError
from analysis.report.sheettables import sessions_table, shapes_table
from analysis.report.sheetverdict import sheet_verdict
from analysis.report.words import listed
from analysis.report.write import ReportFileError
from tests.analysis import sample_batch as sample
from tests.analysis.test_report import Page

NO_SHAPES = pd.DataFrame()
FIGURES = {"clouds", "errors", "pulls", "recognition", "p-values", "health"}


def verdict(table, shapes=NO_SHAPES):
    return sheet_verdict(Rows.of(table, shapes))


def problems(table):
    return [problem.what for problem in verdict(table).problems]


@pytest.fixture(scope="module")
def honest():
    return sample.batch(120)


@pytest.fixture(scope="module")
def page(honest):
    return render_sheet(sample.broken(honest, 7, "events.jsonl: line 12 is no JSON"), NO_SHAPES)


# --- what is wrong is named, and nothing else ---------------------------------------------------------------------


def test_honest_sessions_have_no_problem(honest):
    found = verdict(honest)
    assert found.tone == "good"
    assert found.problems == ()
    assert (
        found.headline
        == "120 sessions of 4 shapes, none broken, 120 of 120 recognised; A and P are right within their errors."
    )


def test_false_alarms_are_as_rare_as_they_are_meant_to_be():
    alarms = [bool(problems(sample.batch(60, seed=seed))) for seed in range(24)]
    # three kinds of check at one in a hundred each
    assert sum(alarms) <= stats.binom.ppf(0.999, 24, 0.05)


def test_a_biased_shape_is_named_alone(honest):
    found = verdict(sample.biased(honest, "eiffel", perimeter_z=1.5))
    assert found.tone == "poor"
    assert "off for eiffel." in found.headline
    (problem,) = found.problems
    assert re.match(r"eiffel: P is \+\d+\.\d ± \d\.\d % off \(mean z \+1\.\d ± 0\.\d\) over 30 sessions", problem.what)
    assert "threshold" in problem.next_step
    topics = {finding.topic: finding.text for finding in found.findings}
    assert topics["Area"].startswith("A is right")
    assert topics["Perimeter"].startswith("P is off for eiffel")


def test_a_wrong_scale_is_told_from_other_bias(honest):
    (problem,) = verdict(sample.biased(honest, "square", area_z=2.1, perimeter_z=1.5)).problems
    assert "A is +" in problem.what
    assert "P is +" in problem.what
    assert "scale" in problem.next_step


def test_a_broken_session_is_named_and_the_others_are_judged(honest):
    table = sample.broken(honest, 7, "events.jsonl: line 12 is no JSON")
    found = verdict(table)
    assert found.tone == "fair"
    assert "1 broken, 119 of 119 recognised" in found.headline
    (problem,) = found.problems
    assert table["session"].iloc[7] in problem.what


@pytest.mark.parametrize("column", ["isotropy_p_value", "run_length_p_value", "montecarlo_p_value"])
def test_p_values_that_are_too_small_are_named(honest, column):
    table = honest.copy()
    table[column] = table[column] ** 2.5
    (problem,) = problems(table)
    title = {"isotropy": "isotropy", "run_len": "run lengths", "montecar": "Monte Carlo"}
    assert next(said for start, said in title.items() if column.startswith(start)) in problem
    assert table["session"].iloc[int(np.argmin(table[column]))] in problem


def test_p_values_that_are_too_large_are_no_fault(honest):
    assert not problems(honest.assign(isotropy_p_value=np.sqrt(honest["isotropy_p_value"])))


def test_a_session_far_from_the_others_is_named_and_spoils_nothing(honest):
    table = honest.copy()
    sigma = table["exact_sigma_area_cm2"].iloc[9]
    table.loc[9, "robot_area_cm2"] += 30 * sigma
    table.loc[9, ["area_z", "area_z_exact"]] += 30.0
    (problem,) = problems(table)
    assert problem.startswith("1 session beyond all chance")
    assert table["session"].iloc[9] in problem


def test_sessions_that_differ_by_more_than_chance(honest):
    table = honest.copy()
    own = table["shape"] == "circle"
    for column in ("area_z", "area_z_exact"):
        table.loc[own, column] *= 2.2
    (problem,) = problems(table)
    assert "A of circle (" in problem
    assert "differ by more than chance" in problem


def test_the_robots_own_errors_being_too_small_is_told_from_a_wide_scatter(honest):
    table = honest.copy()
    for column in ("area_z", "perimeter_z"):
        table[column] *= 2.0
    (problem,) = problems(table)
    assert "own errors are misjudged" in problem


def test_mistakes_are_told_from_sessions_that_are_too_short(honest):
    own = honest["shape"] == "triangle"
    wrong = honest.copy()
    wrong.loc[own, ["recognised_name", "recognised_right"]] = ["circle", False]
    found = verdict(wrong)
    assert found.tone == "poor"
    assert [problem.what for problem in found.problems] == ["Sessions were sure of a wrong name: triangle (30 of 30)."]
    short = wrong.copy()
    short.loc[own, "recognised_posterior"] = 0.6
    found = verdict(short)
    assert found.tone == "fair"
    assert ["triangle (30 of 30)" in problem.what for problem in found.problems] == [True]
    assert "Roll more lines" in found.problems[0].next_step


def test_copies_changed_files_and_dishonest_tracks_are_named(honest):
    twice = honest.copy()
    kept = [name for name in twice.columns if name not in {"session", "folder", "started"}]
    twice.loc[4, kept] = twice.loc[0, kept]
    assert [twice["session"].iloc[4] in problem for problem in problems(twice)] == [True]
    marked = honest.assign(checksums_ok=[index != 3 for index in range(len(honest))])
    marked.loc[5, "filter_honest"] = False
    changed, track = problems(marked)
    assert honest["session"].iloc[3] in changed
    assert honest["session"].iloc[5] in track


def test_outliers_of_health_are_named_in_verdict_and_figure(honest):
    table = honest.copy()
    table.loc[11, "latency_entering_s"] = 0.2
    (said,) = [finding.text for finding in verdict(table).findings if finding.topic == "Health"]
    assert f"{table['session'].iloc[11]} (200.0 ms)" in said
    health = sheet_panels(Rows.of(table, NO_SHAPES))[0][-1]
    assert "1 value marked as outlying" in health.alt
    written = {text.get_text() for axes in health.figure.axes for text in axes.texts}
    assert written - {""} == {table["session"].iloc[11]}


# --- whatever the table holds -------------------------------------------------------------------------------------


def test_a_table_without_most_columns_leaves_its_figures_out_with_reasons(honest):
    found = Page(render_sheet(honest[["session", "error", "shape"]], NO_SHAPES))
    assert not found.figures
    assert found.words.count("is left out") == 7
    assert "nothing was measured" in found.words


@settings(max_examples=12, deadline=None)
@given(gone=st.sets(st.sampled_from(sorted(set(sample.batch(1).columns) - {"session", "error"}))), empty=st.booleans())
def test_any_column_may_be_missing_or_empty(gone, empty):
    table = sample.batch(6)
    table = table.assign(**dict.fromkeys(gone)) if empty else table.drop(columns=list(gone))
    rows = Rows.of(table, NO_SHAPES)
    assert sheet_verdict(rows).headline.startswith("6 sessions")
    assert len(sessions_table(rows).rows) == 6
    shapes_table(rows)


def test_types_of_parquet_and_of_csv_read_alike(honest, tmp_path):
    table = sample.broken(honest, 2, "why").convert_dtypes()
    table.to_parquet(tmp_path / "batch.parquet")
    table.to_csv(tmp_path / "batch.csv", index=False)
    stored, text = pd.read_parquet(tmp_path / "batch.parquet"), pd.read_csv(tmp_path / "batch.csv")
    pd.testing.assert_frame_equal(Rows.of(stored, NO_SHAPES).every, Rows.of(text, NO_SHAPES).every)


def test_only_broken_sessions_or_none_at_all(honest):
    table = honest.iloc[:2]
    for index in range(2):
        table = sample.broken(table, index, f"reason {index}")
    found = Page(render_sheet(table, NO_SHAPES))
    assert "none could be analysed" in found.words
    assert "reason 1" in found.words
    assert "No session at all." in Page(render_sheet(table.iloc[:0], NO_SHAPES)).words


def test_a_table_of_something_else_is_refused_in_one_line():
    with pytest.raises(SheetError, match=r"lacks session, error: make it anew with `chordlab batch`") as refused:
        render_sheet(pd.DataFrame({"a": [1]}), NO_SHAPES)
    assert refused.value.missing == ("session", "error")


def test_what_monte_carlo_predicts_stands_beside_each_shape(honest):
    simulated = pd.DataFrame(
        {"shape": ["circle"], "simulated_sigma_area_rel": [0.0312], "simulated_sigma_perimeter_rel": [0.0187]}
    )
    table = shapes_table(Rows.of(honest, simulated))
    assert {row[0]: row[-1] for row in table.rows} == {
        "circle": "3.1, 1.9",
        "square": "–, –",
        "triangle": "–, –",
        "eiffel": "–, –",
    }


# --- the page -----------------------------------------------------------------------------------------------------


def test_page_is_whole(page):
    found = Page(page)
    assert set(found.figures) == {f"figure-{name}" for name in FIGURES}
    assert len(found.ids) == len(set(found.ids))
    for name, parts in found.figures.items():
        described = [attrs.get("aria-label") or attrs.get("alt") for tag, attrs in parts if tag in ("svg", "img")]
        assert len(described) == 1, name
        assert len(described[0]) > 40, name
    assert "events.jsonl: line 12 is no JSON" in found.words
    assert len(re.findall(r"<tr>", page[page.index('id="table-sessions"') :])) > 120


def test_page_needs_nothing_from_outside(page):
    assert not re.search(r"https?:|[\"'(]//|@import|<script|<link|<iframe|\bon\w+=", page)
    for tag, attrs in Page(page).elements:
        for name in ("src", "href"):
            if name in attrs:
                assert attrs[name].startswith(("data:image/png;base64,", "#")), tag
    assert set(re.findall(r'(?:href="#|url\(#)([^")]+)', page)) <= set(Page(page).ids)


def test_hostile_names_stay_text(honest):
    hostile = '<script>alert("x")</script>&$x^$ </td>\u202e漢\x07' + "n" * 200
    table = honest.iloc[:12].copy()
    table.loc[3, ["session", "shape", "recognised_name", "end_state", "robots"]] = hostile
    table.loc[3, "latency_entering_s"] = 0.5
    table = sample.broken(table, 5, hostile)
    text = render_sheet(table, NO_SHAPES)
    found = Page(text)
    assert "script" not in [tag for tag, _ in found.elements]
    assert "<script" not in text
    assert '<script>alert("x")</script>' in found.words


def test_the_number_of_sessions_is_no_matter(tmp_path):
    for sessions in (1, 5):
        panels, left_out = sheet_panels(Rows.of(sample.batch(sessions), NO_SHAPES))
        assert {panel.name for panel in panels} == FIGURES
        assert not left_out
    many = [f"shape {number:02d}" for number in range(15)]
    path = write_sheet(sample.batch(1000, shapes=many), NO_SHAPES, tmp_path / "new" / "report.html")
    text = path.read_text()
    assert path.stat().st_size < 5_000_000
    assert {"figure-clouds-1", "figure-clouds-2", "figure-errors-2"} <= set(Page(text).figures)
    assert "12 shapes with most sessions; 3 more are not" in Page(text).words
    assert text.count("<tr>") > 1015


def test_a_place_that_cannot_be_written_is_one_line(honest, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ReportFileError, match="cannot write the report"):
        write_sheet(honest.iloc[:1], NO_SHAPES, tmp_path / "file" / "report.html")


# --- the figures say what the table says ---------------------------------------------------------------------------


def test_ellipse_holds_its_share_of_sessions_of_any_length():
    rng = np.random.default_rng(3)
    covariance = np.array([[400.0, 60.0], [60.0, 25.0]])
    lines = rng.integers(20, 2000, 4000).astype(float)
    off = rng.multivariate_normal([0, 0], covariance, 4000) / np.sqrt(lines)[:, None]
    cloud = Cloud("circle", (700.0, 95.0), 700 + off[:, 0], 95 + off[:, 1], lines, covariance)
    assert cloud.inside().mean() == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / 4000))
    figure = clouds_figure([cloud])
    drawn = {artist.get_gid(): artist for artist in figure.findobj() if artist.get_gid()}
    assert len(drawn["inside circle"].get_offsets()) == cloud.inside().sum()
    assert len(drawn["outside circle"].get_offsets()) == (~cloud.inside()).sum()


def test_nothing_is_cut_off_and_errors_beyond_the_frame_are_marked(honest):
    table = honest.copy()
    table.loc[0, "area_error_rel"] = 9.0
    rows = Rows.of(table, NO_SHAPES)
    figure = errors_figure([_shape_errors(rows, "square")])
    first = figure.axes[0]
    marks = [collection for collection in first.collections if len(collection.get_offsets()) == 1]
    assert any(mark.get_offsets()[0][1] < first.get_ylim()[1] for mark in marks)
    assert first.get_ylim()[1] < 100
    for panel in sheet_panels(rows)[0]:
        panel.figure.draw_without_rendering()
        for axes in panel.figure.axes:
            box = axes.get_tightbbox()
            assert box.x0 > -1, panel.name
            assert box.x1 < panel.figure.bbox.x1 + 1, panel.name


def test_shares_and_answers_are_drawn():
    shares = {"a": Share.counted(8, 10), "b": Share.counted(0, 3)}
    figure = recognition_figure(shares, {"a": {"a": 8, "b": 2}, "b": {"none of these": 3}})
    words = {text.get_text() for text in figure.axes[1].texts}
    assert words == {"8", "2", "3"}
    assert [label.get_text() for label in figure.axes[1].get_xticklabels()] == ["a", "b", "none of these"]


def test_sorted_p_values_meet_their_expected_places():
    values = np.array([0.9, np.nan, 0.1, 0.5])
    (axes,) = uniform_figure({"isotropy": values}).axes
    drawn = next(part for part in axes.collections if part.get_gid() == "p isotropy").get_offsets()
    np.testing.assert_allclose(drawn, [[0.25, 0.1], [0.5, 0.5], [0.75, 0.9]])


# --- the numbers behind it ------------------------------------------------------------------------------------------


@given(st.integers(1, 400).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_by_its_formula(case):
    hits, of = case
    share, z = hits / of, 1.959963984540054
    centre = (share + z**2 / (2 * of)) / (1 + z**2 / of)
    half = z / (1 + z**2 / of) * np.sqrt(share * (1 - share) / of + z**2 / (4 * of**2))
    found = Share.counted(hits, of)
    assert (found.low, found.high) == pytest.approx((max(0, centre - half), min(1, centre + half)), abs=1e-9)


def test_pulls_of_honest_errors_are_flat_and_faults_are_seen():
    rng = np.random.default_rng(8)
    p_mean, p_spread = np.array(
        [(found.mean_p, found.spread_p) for found in (Pull.of(rng.normal(size=40)) for _ in range(1500))]
    ).T
    # never more alarms than promised; a little fewer, as the larger of two errors is taken
    for values in (p_mean, p_spread):
        assert (values < 0.01).mean() < 0.01 + 4 * np.sqrt(0.01 / 1500)
    assert Pull.of(rng.normal(1, 1, 40)).mean_p < 1e-6
    assert Pull.of(rng.normal(0, 2, 40)).spread_p < 1e-4
    single = Pull.of([1.0, np.nan])
    assert (single.count, single.mean, single.sigma) == (1, 1.0, 1.0)
    assert np.isnan(single.spread)


def test_uniformity_and_its_band():
    rng = np.random.default_rng(2)
    found = [Uniformity.of(rng.uniform(size=50)).p_value for _ in range(800)]
    assert np.mean(np.array(found) < 0.01) < 0.01 + 4 * np.sqrt(0.01 / 800)
    # a tenth of the sessions fail outright: more than the usual test of the whole curve sees
    assert Uniformity.of([*rng.uniform(0.05, 1, 180), *[1e-4] * 30]).p_value < 1e-4
    sorted_draws = np.sort(rng.uniform(size=(20000, 9)), axis=1)
    expected, low, high = uniform_band(9)
    np.testing.assert_allclose(expected, sorted_draws.mean(axis=0), atol=0.01)
    np.testing.assert_allclose(low, np.quantile(sorted_draws, 0.025, axis=0), atol=0.01)
    np.testing.assert_allclose(high, np.quantile(sorted_draws, 0.975, axis=0), atol=0.01)


def test_outliers_and_extremes():
    values = np.array([1.0, 1.1, 0.9, np.nan, 1.05, 9.0, 0.95])
    assert outlying(values).tolist() == [False] * 5 + [True, False]
    assert not outlying(values, least=3.0).any()
    assert not outlying([1.0, 50.0]).any()
    assert 1 - (1 - 2 * stats.norm.sf(extreme_z(200))) ** 200 == pytest.approx(0.01, rel=0.01)
    assert [listed(list("abcdefg"[:n]), 3) for n in (0, 1, 2, 3, 5)] == [
        "",
        "a",
        "a and b",
        "a, b and c",
        "a, b, c and 2 more",
    ]
