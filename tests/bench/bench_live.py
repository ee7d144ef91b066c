"""What a page costs its session: the same run with nobody looking and with three pages open, in turns.

The run goes as fast as it can, in this process; the server and the browsers have what is left of the machine. Wall
times mean something on an idle machine of four cores or more. Elsewhere the session's own processor time tells what
the page costs it, and most exactly the share of it that was spent in what is called for the page alone: the rest of a
difference is the processor's caches and clock, shared with the browsers.

`pytest tests/bench/bench_live.py -p benchmark`.
"""

import statistics
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from lab.live.live import Live
from lab.live.server import listen, page_server
from lab.session.experiment import run_experiment
from lab.settings.load import load_settings
from tests.lab.conftest import STARTED
from tests.lab.pages import a_browser

LINES, FILMED_LINES, ROUNDS, PAGES = 30, 3, 3, 3
FOR_THE_PAGE = {"none": ("sample",), "virtual": ("sample", "frame")}


def rolled(out, camera, live):
    """One session; its wall, thread and process seconds."""
    keys = {"out": str(out), "camera": camera, "shape": "square", "seed": 5}
    keys["stop.lines"] = LINES if camera == "none" else FILMED_LINES
    settings = load_settings(None, keys)
    clocks = (time.perf_counter, time.thread_time, time.process_time)
    begin_s = [clock() for clock in clocks]
    finished = run_experiment(settings, started=STARTED, live=live)
    assert finished.outcome.state == "complete"
    return [clock() - since_s for clock, since_s in zip(clocks, begin_s, strict=True)]


def timed(live, camera):
    """``live``, and where the processor time goes that its feed takes; the share of it that the clock itself takes."""
    spent = [0.0]

    def clocked(call):
        def calling(*args, **kwargs):
            since_s = time.thread_time()
            call(*args, **kwargs)
            spent[0] += time.thread_time() - since_s

        return calling

    for name in FOR_THE_PAGE[camera]:
        setattr(live.feed, name, clocked(getattr(live.feed, name)))
    return live, spent


@pytest.mark.parametrize("camera", ["none", "virtual"])
def test_a_session_with_pages_open(benchmark, tmp_path, camera):
    rolled(tmp_path / "warm", camera, None)
    alone, watched = [], []
    with page_server(listen()) as server, a_browser() as chromium, ThreadPoolExecutor(1) as elsewhere:
        pages = [chromium.new_page() for _ in range(PAGES)]
        for page in pages:
            page.goto(server.url, timeout=120_000)
        for number in range(ROUNDS):  # in turns, so that the machine's moods fall on both
            for times, live in ((alone, None), (watched, Live(server.ends))):
                out = tmp_path / f"{number}{'w' if live else 'a'}"
                times.append(elsewhere.submit(rolled, out, camera, live).result())
        live, spent = timed(Live(server.ends), camera)
        took = benchmark.pedantic(lambda: elsewhere.submit(rolled, tmp_path / "bench", camera, live).result(), rounds=1)
        for page in pages:  # they did look
            page.wait_for_function("parseInt(document.querySelector('.facts dd').innerText) > 0", timeout=60_000)
            assert camera == "none" or page.evaluate("document.querySelector('img.camera').naturalWidth") > 0
    assert spent[0] > 0
    benchmark.extra_info["pages"] = PAGES
    benchmark.extra_info["for_the_page_of_thread_percent"] = 100 * spent[0] / took[1]
    for place, name in enumerate(("wall", "thread_cpu", "process_cpu")):
        without, with_pages = ([took[place] for took in times] for times in (alone, watched))
        benchmark.extra_info[f"{name}_s_alone"] = statistics.median(without)
        benchmark.extra_info[f"{name}_s_watched"] = statistics.median(with_pages)
        benchmark.extra_info[f"{name}_watched_to_alone"] = min(with_pages) / min(without)
