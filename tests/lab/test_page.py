"""The page in a real browser: a session led from it, a stored one scrubbed, and no harm to either."""

import os
import re
import signal
import time

import psutil
import pytest

from lab.live.words import with_error
from lab.store.reader import SessionReader
from lab.store.tables import tables_of
from tests.lab.pages import a_browser, chart_data, fact, log_of, serving, until

TOKEN = "let-me-in"
HEADLINE = "document.querySelector('.headline').innerText"


@pytest.fixture(scope="module")
def browser(square_session):  # which must be rolled before: the browser's loop runs in this thread from here on
    with a_browser() as chromium:
        yield chromium


@pytest.fixture(scope="module")
def watched(browser, square_session):
    """A stored session's page, opened by a token."""
    with serving("watch", str(square_session.folder), "--token", TOKEN, url_on="stdout") as server:
        yield server


@pytest.fixture
def tab(browser, request):
    options = getattr(request, "param", {})
    context = browser.new_context(**{"viewport": {"width": 1280, "height": 900}, **options})
    context.set_default_timeout(60_000)
    page = context.new_page()
    troubles = []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("console", lambda message: troubles.append(message.text) if message.type == "error" else None)
    yield page
    context.close()
    assert troubles == []


def opened(page, server):
    page.goto(server.url)
    until(page, f"{HEADLINE} !== ''")
    return page


def scrub(page, seconds):
    page.evaluate(
        """value => {
          const slider = document.querySelector('input[type=range]');
          slider.value = value;
          slider.dispatchEvent(new Event('input', {bubbles: true}));
        }""",
        seconds,
    )


def test_a_session_is_led_from_the_page(tab, tmp_path):
    arguments = ["--simulate", "--shape", "square", "--shape", "circle", "--lines", "500", "--seed", "5", "--no-video"]
    with serving("run", *arguments, "--out", str(tmp_path), "--live", "--speed", "60", url_on="stderr") as server:
        page = opened(tab, server)
        until(page, "document.querySelector('h1').innerText === 'Square'", 60)
        (first,) = tmp_path.iterdir()

        until(page, "/^[1-9]/.test(document.querySelector('.facts dd')?.innerText)")
        before = int(fact(page, "Lines").split()[0])
        until(page, "n => parseInt(document.querySelector('.facts dd')?.innerText) > n", arg=before)

        page.get_by_role("button", name="Pause").click()
        until(page, "document.querySelector('.state').innerText === 'Paused'")
        assert [event["by"] for event in log_of(first) if event["event"] == "pause"] == ["page"]
        events = len(log_of(first))
        page.get_by_label("Note for the log").fill("somebody walked <b>by</b>")
        page.get_by_role("button", name="Keep note").click()
        until(page, "document.querySelector('.remarks')?.innerText.includes('somebody walked <b>by</b>')")
        assert [event["event"] for event in log_of(first)[events:]] == ["note"]  # nothing rolled meanwhile
        assert log_of(first)[-1]["text"] == "somebody walked <b>by</b>"
        page.get_by_role("button", name="Resume").click()
        until(page, "document.querySelector('.state').innerText === 'Rolling'")
        for scheme in ("dark", "light"):
            page.emulate_media(color_scheme=scheme)
            until(page, "dark => document.body.classList.contains('body--dark') === dark", arg=scheme == "dark")
            page.wait_for_timeout(400)  # colours fade
            assert barriers(page) == []

        page.get_by_role("button", name="Next shape: circle").click()
        until(page, "document.querySelector('h1').innerText === 'Circle'", 60)
        assert log_of(first)[-1]["state"] == "stopped"
        (second,) = (folder for folder in tmp_path.iterdir() if folder != first)
        until(page, "document.querySelector('.state').innerText === 'Rolling'")
        page.get_by_role("button", name="Stop", exact=True).click()
        page.get_by_role("button", name="Stop it").click()
        until(page, "document.querySelector('.state').innerText.startsWith('Stopped')")
        assert server.wait() == 0
        until(page, "text => document.querySelector('.after').innerText.startsWith(text)", arg=f"Report: {second}")
        page.wait_for_timeout(1500)  # a page that tried to come back would say so by now
        assert page.locator("#popup").get_attribute("aria-hidden") == "true"
        assert page.locator(".state").inner_text() == "Stopped"
        assert fact(page, "Lines").endswith("of 500")
        assert not page.get_by_role("button", name="Pause").is_visible()
    assert log_of(second)[-1]["state"] == "stopped"
    assert "resume" in [event["event"] for event in log_of(first)]
    for folder in (first, second):
        assert (folder / "report.html").is_file()
        assert SessionReader(folder).manifest["end"]["state"] == "stopped"


def test_replay_scrubs_to_what_was_known_then(tab, watched, square_session):
    page = opened(tab, watched)
    table = tables_of(SessionReader(square_session.folder)).estimates
    t_start_s = next(SessionReader(square_session.folder).events())["t_s"]
    assert fact(page, "Lines") == "150 of 150"
    for row in (table.iloc[9], table.iloc[99], table.iloc[39]):
        scrub(page, row["t_s"] - t_start_s + 0.2)
        until(page, "n => document.querySelector('.facts dd')?.innerText === `${n} of 150`", arg=int(row["n"]))
        until(page, "t => document.querySelector('.facts').innerText.includes(t)",
              arg=with_error(row["area_cm2"], row["sigma_area_cm2"], "cm²"))  # fmt: skip
        assert fact(page, "Perimeter") == with_error(row["perimeter_cm"], row["sigma_perimeter_cm"], "cm")
        until(page, """n => getElement(document.querySelector('section[aria-label="Area A(N)"] .chart').id.slice(1))
              .chart.getOption().series[2].data.length === n""", arg=int(row["n"]))  # fmt: skip
        drawn = chart_data(page, "Area A(N)", "estimate")
        assert (
            drawn
            == [[n, pytest.approx(area)] for n, area in zip(table["n"], table["area_cm2"], strict=True)][: len(drawn)]
        )
        assert row["leading"] in page.locator(".headline").inner_text() or row["posterior"] < 0.5


def test_replay_plays_by_itself(tab, watched):
    page = opened(tab, watched)
    scrub(page, 100)
    until(page, "document.querySelector('.clock').innerText.startsWith('100 ')")
    page.get_by_role("button", name="Play").click()
    until(page, "parseInt(document.querySelector('.clock').innerText) > 110")
    page.get_by_role("button", name="Halt").click()


@pytest.mark.parametrize("tab", [{"viewport": {"width": 390, "height": 844}}], indirect=True)
@pytest.mark.parametrize("large", [False, True])
def test_a_phone_needs_no_sideways_scroll(tab, watched, large):
    page = opened(tab, watched)
    if large:
        page.get_by_label("Large text").click()
        until(page, "document.querySelector('.page').classList.contains('large')")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    wide = page.evaluate(
        "[...document.querySelectorAll('.page *')].filter(e => e.getBoundingClientRect().right > 391)"
        ".map(e => e.className)"
    )
    assert wide == []


def barriers(page):
    """What keeps people from reading or using a page as it stands, by axe-core."""
    from axe_playwright_python.sync_playwright import Axe

    found = Axe().run(page).response["violations"]
    return [(fault["id"], fault["nodes"][0]["html"]) for fault in found if fault["impact"] in ("serious", "critical")]


@pytest.mark.parametrize("tab", [{"color_scheme": "light"}, {"color_scheme": "dark"}], indirect=True, ids=str)
def test_nothing_stands_in_the_way_of_anybody(tab, watched, request):
    dark = "dark" in request.node.callspec.id
    asked = []
    tab.on("request", lambda request: asked.append(request.url))
    page = opened(tab, watched)
    until(page, "dark => document.body.classList.contains('body--dark') === dark", arg=dark)  # as the system
    assert barriers(page) == []
    assert page.locator(".headline").get_attribute("aria-live") == "polite"
    assert not [url for url in asked if not re.match(r"(http|ws)://127\.0\.0\.1:|data:|blob:", url)]
    page.get_by_label("Dark page").click()  # by hand, it is the other
    until(page, "dark => document.body.classList.contains('body--dark') !== dark", arg=dark)


def test_without_the_token_nothing_is_shown(browser, watched):
    context = browser.new_context()
    page = context.new_page()
    bare = watched.url.partition("?")[0]
    assert page.goto(bare).status == 401
    assert page.goto(f"{bare}?token=wrong").status == 401
    answer = page.goto(watched.url)
    assert answer.status == 200
    assert "token" not in page.url  # it does not stay in the history
    (cookie,) = context.cookies()
    assert (cookie["sameSite"], cookie["httpOnly"]) == ("Strict", True)
    context.close()


def test_ten_pages_and_a_killed_server_leave_no_trace_in_the_log(browser, square_session, tmp_path):
    """What it wrote by then is, byte for byte, what the same session wrote without a page."""
    arguments = ["--simulate", "--shape", "square", "--lines", "150", "--seed", "5", "--no-video", "--quiet"]
    with serving("run", *arguments, "--out", str(tmp_path), "--live", "--speed", "12", url_on="stderr") as server:
        contexts = [browser.new_context() for _ in range(2)]
        pages = [context.new_page() for context in contexts for _ in range(5)]
        for page in pages:
            page.goto(server.url, wait_until="commit", timeout=90_000)  # the first waits for the server to load
        until(pages[-1], "/^[1-9]/.test(document.querySelector('.facts dd')?.innerText)", 60)
        contexts[0].close()
        (folder,) = tmp_path.iterdir()
        (page_server,) = (
            child for child in psutil.Process(server.process.pid).children()
            if child.pid != server.process.pid and "spawn_main" in " ".join(child.cmdline())
        )  # fmt: skip
        page_server.suspend()  # it hangs
        events = len(log_of(folder))
        until_s = time.monotonic() + 20
        while len(log_of(folder)) < events + 3 and time.monotonic() < until_s:
            time.sleep(0.1)
        os.kill(page_server.pid, signal.SIGKILL)
        assert log_of(folder)[-1]["event"] == "line"  # it was still rolling
        server.process.send_signal(signal.SIGINT)
        server.wait()
        contexts[1].close()
    rolled = (folder / "events.jsonl").read_bytes().splitlines()
    assert len(rolled) > events + 3
    assert rolled[:-1] == (square_session.folder / "events.jsonl").read_bytes().splitlines()[: len(rolled) - 1]
