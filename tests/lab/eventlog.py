"""A session's log and manifest as they stand on disk, read with no code of the lab."""

from __future__ import annotations

import json
from pathlib import Path


class EventLog:
    """Whatever has a ``folder``: the events in it."""

    folder: Path

    @property
    def events(self) -> list[dict]:
        return [json.loads(line) for line in (self.folder / "events.jsonl").read_text().splitlines()]

    def told(self, kind: str) -> list[dict]:
        return [event for event in self.events if event["event"] == kind]

    @property
    def runs(self) -> list[dict]:
        return self.told("line")

    @property
    def manifest(self) -> dict:
        return json.loads((self.folder / "manifest.json").read_text())
