"""Commands that serve pages, as a user starts them, and a browser that looks at them."""

import asyncio
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
_FIRST_WORD_S = 60


@contextmanager
def a_browser():
    """Chromium without a window; while it is open, this thread's event loop is the browser's.

    Skipped where there is none; in CI there is one, and its lack a failure.
    """
    if CHROMIUM is None and os.environ.get("CI") != "true":
        pytest.skip("no chromium in the path; install Debian's package to test the page")
    assert CHROMIUM is not None, "CI needs the package chromium"
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-background-networking"]
        )
        yield chromium
        chromium.close()
    asyncio.set_event_loop(None)


@dataclass
class Serving:
    process: subprocess.Popen
    url: str
    said: list[str] = field(default_factory=list)

    def wait(self, timeout_s=60):
        return self.process.wait(timeout_s)


@contextmanager
def serving(*arguments: str, url_on: str):
    """A chordlab command; its first line on ``url_on`` (stdout, stderr) that is an address is where it serves."""
    command = [sys.executable, "-c", "from lab.cli.main import entry; entry()", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    said: queue.Queue[tuple[str, str]] = queue.Queue()
    heard: list[str] = []

    def read(name):
        for line in getattr(process, name):
            heard.append(line.rstrip())
            said.put((name, line.rstrip()))

    readers = [threading.Thread(target=read, args=(name,), daemon=True) for name in ("stdout", "stderr")]
    for reader in readers:
        reader.start()
    try:
        until_s = time.monotonic() + _FIRST_WORD_S
        while True:
            name, line = said.get(timeout=max(0.1, until_s - time.monotonic()))
            if name == url_on and line.startswith("http://"):
                break
        yield Serving(process, line, heard)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(10)
        for reader in readers:
            reader.join(10)
        process.stdout.close()
        process.stderr.close()


def log_of(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()]


def fact(page, name: str) -> str:
    """One of the page's small figures."""
    return page.evaluate(
        "name => [...document.querySelectorAll('.facts div')].find(d => d.querySelector('dt').innerText === name)"
        ".querySelector('dd').innerText",
        name,
    )


def chart_data(page, title: str, series: str) -> list:
    """The points of a chart's series, from the chart itself."""
    return page.evaluate(
        """([title, series]) => {
          const chart = document.querySelector(`section[aria-label="${title}"] .chart`);
          return getElement(chart.id.slice(1)).chart.getOption().series.find(s => s.name === series).data;
        }""",
        [title, series],
    )


def until(page, expression: str, timeout_s: float = 30, arg=None):
    page.wait_for_function(expression, arg=arg, timeout=1000 * timeout_s)
