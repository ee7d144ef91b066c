"""What befell a session, from its log: its parts, the notes that people left, pauses, lost links, mended cuts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from analysis.report.words import count
from lab.live.story import Story

Record = Mapping[str, Any]


def history_of(events: Iterable[Record]) -> list[tuple[float, str]]:
    """(s of the session's clock, what happened), in the order of the log; empty if it began and ended, and that is all.

    Args:
        events: of the session's log, all.
    """
    story = Story(lines=0)
    told: list[tuple[float, str]] = []
    parts = 0
    for event in events:
        kind = event["event"]
        if kind == "line" or "t_s" not in event:
            continue
        if kind == "start":
            parts += 1
            told.append((float(event["t_s"]), "Begun" if parts == 1 else f"Part {parts} begun"))
        elif kind == "end":
            lines, runs = count(int(event["n"]), "crossing line"), count(int(event["runs"]), "run")
            told.append((float(event["t_s"]), f"End ({event['state']}) after {lines} of {runs}"))
        else:
            story.take([event])
            told += [(remark.t_s, remark.text) for remark in story.remarks]
            story.remarks.clear()
    plain = parts == 1 and len(told) <= 2 and all(text.startswith(("Begun", "End (")) for _, text in told)
    return [] if plain else told
