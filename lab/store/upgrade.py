"""Older sessions in today's words: one step for each version of the schema. Folders are never rewritten.

1 → 2: sessions of several robots. A line says whose it is, whether it is whole, where it ended, what it counts and
when it was up to speed (unknown in the first sessions of all); light levels are a list, one entry a robot, and may
have those of a lit edge.
2 → 3: sessions that are resumed. A start holds the light samples that its levels were learnt from (unknown: none were
kept); the manifest lists the parts after the first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast

from lab.store.layout import SCHEMA_VERSION

Record = dict[str, Any]


def upgrade_manifest(manifest: Mapping[str, Any], version: int) -> Record:
    """A manifest of schema ``version`` in the words of SCHEMA_VERSION; what it does not have stays absent."""
    found = dict(manifest)
    for step in range(version, SCHEMA_VERSION):
        found = _STEPS[step][0](found)
    return {**found, "schema_version": SCHEMA_VERSION}


def upgrade_event(event: Mapping[str, Any], version: int) -> Record:
    """An event of schema ``version`` in the words of SCHEMA_VERSION."""
    found = dict(event)
    for step in range(version, SCHEMA_VERSION):
        found = _STEPS[step][1](found)
    return found


def _manifest_1_to_2(manifest: Record) -> Record:
    devices: Any = manifest.get("devices")
    robot: Any = cast("Record", devices).get("robot") if isinstance(devices, dict) else None
    if not isinstance(robot, dict):
        return manifest
    only = {**cast("Record", robot), "levels": _of_one_robot(manifest.get("levels")), "led": None}
    return {**manifest, "devices": {"robots": [only], **cast("Record", devices)}}


def _event_1_to_2(event: Record) -> Record:
    match event.get("event"):
        case "start" if "levels" in event:
            return {**event, "levels": [_of_one_robot(event["levels"])]}
        case "line":
            missing = {"robot": "", "weight": 1.0, "starts_lit": False, "ends_lit": False, "t_rolling_s": None}
            named = {"whole": "counts", "end_cm": "length_cm"}
            return {**missing, **{new: event[old] for new, old in named.items() if old in event}, **event}
        case _:
            return event


def _manifest_2_to_3(manifest: Record) -> Record:
    return {"parts": [], **manifest}


def _event_2_to_3(event: Record) -> Record:
    levels = event.get("levels")
    if event.get("event") != "start" or not isinstance(levels, list):
        return event
    return {"light": [None] * len(cast("list[Any]", levels)), **event}


def _of_one_robot(levels: Any) -> Record | None:
    return None if levels is None else {"shape": levels, "edge": None}


_Step = Callable[[Record], Record]
_STEPS: Mapping[int, tuple[_Step, _Step]] = {
    1: (_manifest_1_to_2, _event_1_to_2),
    2: (_manifest_2_to_3, _event_2_to_3),
}
