"""The page on `--json` against what the commands print."""

import json
import re

import pytest

from tests.docs.shown import HOME, type_in

PAGE = (HOME / "docs/reference/json.md").read_text(encoding="utf-8")
DIR = "sessions/2026-11-23T1042_eiffel_ab12"
RUN = {
    "run": "run --simulate --no-video --shape square --lines 10 --out others",
    "validate": f"validate {DIR} --no-report",
    "recognize": f"recognize {DIR}",
    "recover": f"recover {DIR} --dry-run",
    "finalize": f"finalize {DIR}",
    "batch": "batch sessions --out batch-json --workers 0",
    "plan": "plan square",
    "moments": "moments square",
    "simulate": "simulate square --lines 50 --runs 3",
    "shapes list": "shapes list",
    "shapes show": "shapes show square",
    "shapes import": "shapes import tower.svg --name towering --height 40",
    "shapes separability": "shapes separability square circle",
    "export": f"export {DIR} --to csv --out exported",
    "project": "project square --projector image:pictures --seconds 0.1",
    "doctor": "doctor",
    "robot info": "robot info virtual",
}
WANTS_MORE = {"classes"}  # several sessions: tests/lab/test_classes.py runs it


def told() -> dict[str, tuple[set[str], set[str]]]:
    """For each command the keys of the page: all, and those that are there at times only."""
    found = {}
    for title, section in re.findall(r"^## chordlab (.+?)\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL):
        rows = [row.split(" | ", 1) for row in section.splitlines() if row.startswith("| `")]
        keys = [(set(re.findall(r"`(\w+)`", names)), holds.startswith("where ")) for names, holds in rows]
        every = set().union(*(names for names, _ in keys))
        found[title] = every, set().union(*(names for names, at_times in keys if at_times))
    return found


def test_every_section_is_run():
    assert set(told()) == set(RUN) | WANTS_MORE


@pytest.mark.parametrize("command", RUN)
def test_a_command_prints_the_keys_that_the_page_has(command, workshop, monkeypatch, capsys):
    monkeypatch.chdir(workshop)
    assert type_in(f"chordlab {RUN[command]} --json") == 0
    every, at_times = told()[command]
    printed = set(json.loads(capsys.readouterr().out))
    assert printed <= every
    assert every - at_times <= printed
