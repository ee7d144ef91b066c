"""Rows that were worked out before, kept under the digest of all that went into them."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from lab.base.files import write_aside
from lab.batch.digests import Digests


def key_of(content: str, settings: Mapping[str, Any], versions: Mapping[str, str]) -> str:
    """What a row is kept under: content of the session, settings of the analysis, program and packages."""
    parts = {"content": content, "settings": dict(settings), "versions": dict(versions)}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


class RowCache:
    """A folder of rows that may be lost at any time: whatever is missing or damaged is made anew.

    Nothing here raises OSError: a folder that cannot be written keeps nothing.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, key: str) -> dict[str, Any] | None:
        """The row kept under ``key``; None where there is none, or it is damaged."""
        try:
            digest, _, body = self._path(key).read_bytes().partition(b"\n")
            if hashlib.sha256(body).hexdigest().encode() != digest:
                return None
            row: Any = json.loads(body)
        except (OSError, ValueError):
            return None
        return cast("dict[str, Any]", row) if isinstance(row, dict) else None

    def put(self, key: str, row: Mapping[str, Any]) -> None:
        """Keep a row of plain JSON values under ``key``, whole or not at all."""
        body = json.dumps(dict(row), sort_keys=True, allow_nan=False).encode()
        path = self._path(key)
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_aside(path, hashlib.sha256(body).hexdigest().encode() + b"\n" + body)

    def digests(self, folder: Path) -> Digests:
        """The digests of a session's files, remembered here."""
        name = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()
        return Digests(folder, self._folder / "digests" / name[:2] / f"{name}.json")

    def _path(self, key: str) -> Path:
        return self._folder / "rows" / key[:2] / f"{key}.json"
