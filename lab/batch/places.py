"""Where stored sessions lie."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from lab.base.errors import RequestError
from lab.store.layout import MANIFEST


@dataclass(frozen=True, slots=True)
class Place:
    """A session's folder: ``below`` a ``root`` that was asked for."""

    root: Path
    below: str

    @property
    def folder(self) -> Path:
        """The session's folder."""
        return self.root / self.below


def places_below(roots: Sequence[Path]) -> list[Place]:
    """Every session at or below the roots, each once, root by root in order of name.

    Raises RequestError when a root is missing or holds none.
    """
    found: dict[Path, Place] = {}
    for root in roots:
        if not root.is_dir():
            raise RequestError(f"{root}: no such folder; name folders that hold sessions")
        held = [Place(root, below) for below in _sessions(root)]
        if not held:
            raise RequestError(f"no session below {root}; a session folder holds a {MANIFEST}")
        for place in held:
            found.setdefault(place.folder.resolve(), place)
    return list(found.values())


def sessions_below(roots: Sequence[Path]) -> list[Path]:
    """The folders of `places_below`."""
    return [place.folder for place in places_below(roots)]


def _sessions(root: Path) -> Iterator[str]:
    """Folders below ``root`` that hold a manifest; no links are followed, and none is looked for in a session."""
    for folder, inner, files in os.walk(root):
        if MANIFEST in files:
            inner.clear()
            yield Path(folder).relative_to(root).as_posix()
        inner.sort()
