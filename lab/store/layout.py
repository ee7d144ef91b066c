"""What stands where in a session's folder, and how its records are spelt."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lab.base.errors import RequestError
from lab.base.given import one_line

SCHEMA_VERSION = 3
MANIFEST = "manifest.json"
EVENTS = "events.jsonl"
LINES = "lines"
LIGHT = "light.parquet"
VIDEO = "video.mkv"
FRAMES = "video.frames.parquet"
REPORT = "report.html"
CHECKSUMS = "SHA256SUMS"
LOCK = "writer.lock"


class SessionFolderError(RequestError):
    """A folder that is no session, or not a whole one. Carries ``folder``."""

    def __init__(self, folder: Path, reason: str) -> None:
        super().__init__(one_line(f"{folder}: {reason}"))
        self.folder = folder


def line_folder(folder: Path, line: int) -> Path:
    """The folder of one run."""
    return folder / LINES / f"{line:06d}"


def to_json(data: Any, *, indent: int | None = None) -> str:
    """JSON with sorted keys, so that equal data give equal bytes. NaN is refused: it is not JSON."""
    return json.dumps(data, sort_keys=True, indent=indent, allow_nan=False, ensure_ascii=False)
