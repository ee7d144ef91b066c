"""What the tests of resumed sessions cut with, and read by: sums by their definitions, no code of the lab."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from lab.reopen.resume import pick_up, resume
from lab.session.experiment import Finished
from robot.onboard import Estimator
from tests.lab.eventlog import EventLog

RESUMED = datetime(2026, 11, 24, 9, 0)


@dataclass(frozen=True)
class Log(EventLog):
    """The events of a session, as they stand."""

    folder: Path


def cut_after(folder: Path, runs: int, copy: Path) -> Path:
    """A copy of a session as a kill after its ``runs``-th run would have left it, with the next one half written."""
    copy.mkdir(parents=True)
    kept, seen = [], 0
    for line in (folder / "events.jsonl").read_bytes().splitlines(keepends=True):
        kind = json.loads(line)["event"]
        if seen == runs and kind in ("line", "end"):
            break
        seen += kind == "line"
        kept.append(line)
    (copy / "events.jsonl").write_bytes(b"".join(kept))
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest.pop("end")
    (copy / "manifest.json").write_text(json.dumps(manifest))
    (copy / "lines").mkdir()
    half = 0
    for line in kept:
        event = json.loads(line)
        if event["event"] == "line":
            name, half = f"lines/{event['line']:06d}", event["line"] + 1
            if (folder / name).exists():
                shutil.copytree(folder / name, copy / name)
    (copy / f"lines/{half:06d}.part").mkdir()
    return copy


def go_on(folder: Path, lines: int | None = None, **more) -> Finished:
    """Resume a session, whatever state it is in."""
    unfinished = pick_up(folder, lines=lines)
    assert not unfinished.complete
    return resume(unfinished, started=RESUMED, **more)


def estimates_of_one_robot(runs: list[dict]) -> list[tuple]:
    """What one on-board estimator says after each crossing line, fed with all the lines without a break."""
    estimator, told = Estimator(), []
    for run in runs:
        if not run["counts"]:
            continue
        estimator.start_line()
        for _, s_cm, entering in run["crossings"]:
            estimator.crossing(s_cm, entering)
        k, _, _ = estimator.end_line(weight=run["weight"])
        if k:
            figures = estimator.area(), estimator.perimeter(), estimator.sigma_area(), estimator.sigma_perimeter()
            told.append((estimator.lines, *(None if math.isnan(value) else value for value in figures)))
    return told


def estimates_told(runs: list[dict]) -> list[tuple]:
    """The same, as the log tells it."""
    names = ("n", "area_cm2", "perimeter_cm", "sigma_area_cm2", "sigma_perimeter_cm")
    return [tuple(run["estimate"][name] for name in names) for run in runs if "estimate" in run]
