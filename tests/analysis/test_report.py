"""The report says what the tables say, needs nothing from outside, and changes when they change."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from analysis.report import write
from analysis.report.result import ReportError
from analysis.report.tables import provenance_of, tables_of
from analysis.report.verdict import verdict_of
from analysis.report.words import plus_minus, signed
from analysis.report.write import ReportFileError, render_report, write_report
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
    assert "<code><span>ls</span></code>" in text
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
