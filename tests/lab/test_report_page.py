"""The reports in a real browser: whole without the net, readable by all, on a phone, in the dark and on paper."""

import re
from pathlib import Path

import pandas as pd
import pytest

from analysis.report import problems, sheethealth, sheetverdict
from analysis.report.sheet import write_sheet
from lab.cli.main import main
from lab.review import findings
from lab.review.history import history_of
from lab.review.review import review
from lab.settings.settings import Settings
from tests.analysis import sample_batch
from tests.lab.pages import a_browser

SAMPLES = Path(__file__).parents[2] / "data" / "sessions"
MOST_BYTES = 5_000_000
A4_PX = {"width": 698, "height": 1000}  # 18.5 cm between the margins, at 96 dots an inch


@pytest.fixture(scope="module")
def reports(square_session, uniform_session, tmp_path_factory):
    """The page of a session with film, of one without, of one that turned wrongly, and of a batch of many."""
    folder = tmp_path_factory.mktemp("reports")
    made = {}
    stored = {"filmed": SAMPLES / "square-filmed", "blind": square_session.folder, "wrong": uniform_session.folder}
    for name, session in stored.items():
        made[name] = review(session, report=True, out=folder / name)["report"]
    for name, sessions in (("batch", 40), ("many", 400)):
        made[name] = write_sheet(sample_batch.batch(sessions), pd.DataFrame(), folder / f"{name}.html")
    return made


@pytest.fixture(scope="module")
def browser(reports):  # which must be made before: the browser's loop runs in this thread from here on
    with a_browser() as chromium:
        yield chromium


@pytest.fixture
def look(browser, reports):
    """Open a report: the page, and the addresses that it asked for."""
    contexts = []

    def opened(name, **options):
        context = browser.new_context(**{"viewport": {"width": 1280, "height": 900}, **options})
        contexts.append(context)
        page = context.new_page()
        asked = []
        page.on("request", lambda request: asked.append(request.url))
        page.goto(reports[name].as_uri())
        return page, asked

    yield opened
    for context in contexts:
        context.close()


NAMES = ("filmed", "blind", "wrong", "batch")


@pytest.mark.parametrize("name", [*NAMES, "many"])
def test_a_report_is_one_file_of_less_than_5_mb(look, reports, name):
    page, asked = look(name)
    assert [url for url in asked if not url.startswith("data:")] == [reports[name].as_uri()]
    assert reports[name].stat().st_size < MOST_BYTES
    loaded = page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
    assert loaded


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_stands_in_the_way_of_anybody(look, name, scheme):
    from axe_playwright_python.sync_playwright import Axe

    page, _ = look(name, color_scheme=scheme)
    found = Axe().run(page).response["violations"]
    serious = [
        (fault["id"], fault["nodes"][0]["html"][:200]) for fault in found if fault["impact"] in ("serious", "critical")
    ]
    assert serious == []
    assert page.locator("main, header, h1").count() >= 3
    levels = page.evaluate("[...document.querySelectorAll('h1,h2,h3')].map(head => +head.tagName[1])")
    assert levels[:2] == [1, 2]
    paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
    ink = page.evaluate("getComputedStyle(document.querySelector('figure svg text, figure svg path, h1')).color")
    light, dark = (sum(map(int, re.findall(r"\d+", colour)[:3])) for colour in (paper, ink))
    assert (light > dark) is (scheme == "light")


@pytest.mark.parametrize("name", NAMES)
def test_a_phone_needs_no_sideways_scroll(look, name):
    page, _ = look(name, viewport={"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    beyond = page.evaluate(
        "[...document.querySelectorAll('main *')].filter(e => !e.closest('.scroll') && "
        "e.getBoundingClientRect().right > 391).map(e => e.outerHTML.slice(0, 80))"
    )
    assert beyond == []


@pytest.mark.parametrize("name", ["filmed", "blind", "wrong"])
def test_on_paper_nothing_is_cut_off(look, name):
    """What scrolls on a screen cannot on paper; a figure with its caption fits on a page."""
    page, _ = look(name, viewport=A4_PX)
    page.emulate_media(media="print", color_scheme="dark")
    cut = page.evaluate(
        "[...document.querySelectorAll('main *')].filter(e => e.getBoundingClientRect().right > innerWidth + 1)"
        ".map(e => e.outerHTML.slice(0, 80))"
    )
    assert cut == []
    tall = page.evaluate("Math.max(...[...document.querySelectorAll('figure')].map(e => e.offsetHeight))")
    assert tall < A4_PX["height"]
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"


@pytest.mark.parametrize("name", NAMES)
def test_the_verdict_comes_first_and_every_table_names_its_columns(look, name):
    page, _ = look(name)
    sections = page.evaluate(
        "[...document.querySelectorAll('main > section')].map(e => e.id || e.getAttribute('aria-label'))"
    )
    assert sections[0] == "Verdict"
    assert sections.index("figures") < sections.index("tables") < sections.index("provenance")
    nameless = page.evaluate(
        "[...document.querySelectorAll('table:not(.facts)')].filter(table => "
        "[...table.tHead.rows[0].cells].slice(1).some(cell => !cell.innerText.trim())).map(table => table.id)"
    )
    assert nameless == []
    heads = page.evaluate(  # the words of a command stand one behind the other
        "[...document.querySelectorAll('code span:first-child')].map(word => getComputedStyle(word).display)"
    )
    assert set(heads) <= {"inline"}
    words = page.locator("main").inner_text()
    record = page.evaluate("[...document.querySelectorAll('.record, #provenance, code')].map(e => e.innerText).join()")
    assert [found for found in re.findall(r"(?<![\w−-])-\d\S*", words) if found not in record] == []
    assert re.findall(r"\d(?:nan|inf)\b|\bnan\b|\be-\d\d", words) == []


def test_a_wrong_session_says_so_and_what_to_do(look):
    page, _ = look("wrong")
    assert "below, each with what to do" in page.locator(".verdict").inner_text()
    assert "motion.turning" in page.locator("#todo").inner_text()


# --- what is said


def told(kind, t_s, **more):
    return {"event": kind, "t_s": t_s, **more}


def test_parts_notes_pauses_and_lost_links_are_told():
    log = [
        told("start", 4.0),
        {"event": "line", "line": 0},
        told("note", 9.5, text="lamp moved"),
        told("pause", 12.0, robot="", by="page"),
        told("resume", 15.0, robot="", by="page"),
        told("lost", 20.0, robot="SB-1"),
        told("back", 22.0, robot="SB-1"),
        told("end", 30.0, state="stopped", n=3, runs=7),
        told("start", 40.0),
        told("end", 90.0, state="complete", n=10, runs=21),
    ]
    assert history_of(log) == [
        (4.0, "Begun"),
        (9.5, "Note: lamp moved"),
        (12.0, "Paused"),
        (15.0, "Going on"),
        (20.0, "SB-1: link lost"),
        (22.0, "SB-1: link back"),
        (30.0, "End (stopped) after 3 crossing lines of 7 runs"),
        (40.0, "Part 2 begun"),
        (90.0, "End (complete) after 10 crossing lines of 21 runs"),
    ]
    assert history_of([log[0], log[-1]]) == []


CURES = "\n".join(
    re.sub(r'"\n\s*f?"', "", Path(module.__file__).read_text(encoding="utf-8"))
    for module in (problems, sheetverdict, sheethealth, findings)
)


@pytest.mark.parametrize("command", sorted(set(re.findall(r"chordlab ((?:[a-z]+ ?)+)(?=[`{ A-Z-])", CURES))))
def test_every_command_that_a_report_advises_exists(command, capsys):
    assert main([*command.split(), "--help"]) == 0
    assert f"chordlab {command.strip()}" in capsys.readouterr().out


def test_every_setting_that_a_report_advises_exists():
    advised = set(re.findall(r"`(\w+)\.(\w+)[` =]", CURES)) - {("manifest", "json")}
    assert len(advised) > 4
    for section, key in advised:
        assert key in type(getattr(Settings(), section)).model_fields, f"{section}.{key}"
