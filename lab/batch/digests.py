"""What a session's files hold, as SHA-256, read again only where size, time or inode have changed."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import stat
import time
from pathlib import Path
from typing import Any

from lab.base.files import PLAIN, write_aside
from lab.store.layout import EVENTS, LINES, MANIFEST

# A file that changed within the same tick of its file system's clock would look unchanged: the youngest are not kept.
_YOUNG_NS = 2_000_000_000


class Digests:
    """The digests of one session's files.

    Args:
        folder: the session's; only read.
        memory: a file that keeps them from one time to the next; made anew where it is missing or damaged, None keeps
            nothing.
    """

    def __init__(self, folder: Path, memory: Path | None = None) -> None:
        self._folder, self._memory = folder, memory
        self._known: dict[str, Any] = {}
        if memory is not None:
            with contextlib.suppress(OSError, ValueError, AttributeError):
                self._known = dict(json.loads(memory.read_bytes()).items())
        self._used: dict[str, list[Any]] = {}

    def of(self, path: Path) -> str:
        """SHA-256 of a file of the session. Raises OSError, for a link too."""
        name = path.relative_to(self._folder).as_posix()
        descriptor = os.open(path, os.O_RDONLY | PLAIN | getattr(os, "O_NONBLOCK", 0))
        with os.fdopen(descriptor, "rb") as file:
            now = os.fstat(descriptor)
            if not stat.S_ISREG(now.st_mode):
                raise OSError(f"{path}: no plain file")
            signature = [now.st_size, now.st_mtime_ns, now.st_ino]
            kept = self._known.get(name)
            if isinstance(kept, list) and kept[:-1] == signature:  # pyright: ignore[reportUnknownMemberType]: from JSON
                self._used[name] = kept
                return str(kept[-1])  # pyright: ignore[reportUnknownArgumentType]
            read_ns = time.time_ns()
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            if now.st_mtime_ns < read_ns - _YOUNG_NS:
                self._used[name] = [*signature, digest]
            return digest

    def content(self) -> str:
        """SHA-256 of what the session recorded: names and bytes of manifest, log and lines. Raises OSError."""
        found = hashlib.sha256()
        names = [name for name in (MANIFEST, EVENTS) if (self._folder / name).exists()]
        for folder, inner, files in os.walk(self._folder / LINES):
            inner.sort()
            names += [(Path(folder) / name).relative_to(self._folder).as_posix() for name in sorted(files)]
        for name in names:
            path = self._folder / name
            said = f"-> {path.readlink()}" if path.is_symlink() else self.of(path)
            found.update(f"{said} {name}\n".encode())
        return found.hexdigest()

    def keep(self) -> None:
        """Keep what was looked up or worked out for the next time; where it cannot be, that is all that is lost."""
        if self._memory is None or self._used == self._known:
            return
        with contextlib.suppress(OSError):
            self._memory.parent.mkdir(parents=True, exist_ok=True)
            write_aside(self._memory, json.dumps(self._used).encode())
