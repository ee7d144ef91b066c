"""What a page costs its session: the same run with nobody looking and with three pages open.

The run goes as fast as it can, in this process; the server and the browsers have what is left of the machine, so that
the figure means something on two cores or more. `pytest tests/bench/bench_live.py -p benchmark`.
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
from tests.lab.pages import CHROMIUM, need_chromium

LINES, FILMED_LINES, ROUNDS, PAGES = 60, 4, 3, 3


def rolled(out, camera, live):
    keys = {"out": str(out), "camera": camera, "shape": "square", "seed": 5}
    keys["stop.lines"] = LINES if camera == "none" else FILMED_LINES
    settings = load_settings(None, keys)
    begin_s, begin_cpu_s = time.perf_counter(), time.thread_time()
    finished = run_experiment(settings, started=STARTED, live=live)
    took_s, took_cpu_s = time.perf_counter() - begin_s, time.thread_time() - begin_cpu_s
    assert finished.outcome.state == "complete"
    return took_s, took_cpu_s


@pytest.mark.parametrize("camera", ["none", "virtual"])
def test_a_session_with_pages_open(benchmark, tmp_path, camera):
    need_chromium()
    from playwright.sync_api import sync_playwright

    rolled(tmp_path / "warm", camera, None)
    alone, watched = [], []
    with page_server(listen()) as server, sync_playwright() as playwright, ThreadPoolExecutor(1) as elsewhere:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        pages = [chromium.new_page() for _ in range(PAGES)]
        for page in pages:
            page.goto(server.url)
        for number in range(ROUNDS):  # in turns, so that the machine's moods fall on both
            for times, live in ((alone, None), (watched, Live(server.ends))):
                out = tmp_path / f"{number}{'w' if live else 'a'}"
                times.append(elsewhere.submit(rolled, out, camera, live).result())
                for page in pages:
                    page.wait_for_selector("h1")
        benchmark.pedantic(
            lambda: elsewhere.submit(rolled, tmp_path / "bench", camera, Live(server.ends)).result(), rounds=1
        )
        chromium.close()
    benchmark.extra_info["pages"] = PAGES
    # The session's own work tells what the page costs it, even where others keep the machine busy.
    for place, name in enumerate(("seconds", "cpu_seconds")):
        without, with_pages = ([took[place] for took in times] for times in (alone, watched))
        benchmark.extra_info[f"{name}_alone"] = statistics.median(without)
        benchmark.extra_info[f"{name}_watched"] = statistics.median(with_pages)
        benchmark.extra_info[f"{name}_watched_to_alone"] = min(with_pages) / min(without)
