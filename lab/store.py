"""A session's folder: an append-only log that is the truth, one folder a run, and a manifest.

Written so that a cut at any moment loses at most the run in progress: a run's files are written
aside, synced and renamed before its event is appended and synced.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Generator, Iterator
from datetime import datetime
from pathlib import Path
from typing import IO, Any, cast

import pandas as pd

from lab.base.errors import ChordlabError, RequestError
from lab.base.files import sync_folder, write_aside

SCHEMA_VERSION = 2
MANIFEST = "manifest.json"
EVENTS = "events.jsonl"
LINES = "lines"
LIGHT = "light.parquet"
VIDEO = "video.mkv"
REPORT = "report.html"
CHECKSUMS = "SHA256SUMS"


class SessionFolderError(RequestError):
    """A folder that is no session, or not a whole one. Carries ``folder``."""

    def __init__(self, folder: Path, reason: str) -> None:
        super().__init__(f"{folder}: {reason}")
        self.folder = folder


def line_folder(folder: Path, line: int) -> Path:
    """The folder of one run."""
    return folder / LINES / f"{line:06d}"


def to_json(data: Any, *, indent: int | None = None) -> str:
    """JSON with sorted keys, so that equal data give equal bytes. NaN is refused: it is not JSON."""
    return json.dumps(data, sort_keys=True, indent=indent, allow_nan=False, ensure_ascii=False)


class SessionWriter:
    """The one writer of a session folder; holds its lock until closed."""

    def __init__(self, folder: Path, events: IO[str], lock: Path) -> None:
        self.folder = folder
        self._events = events
        self._lock = lock

    @classmethod
    def create(cls, root: Path, shape: str, manifest: dict[str, Any], *, started: datetime, tag: str) -> SessionWriter:
        """Make ``root``/2026-11-23T1042_eiffel_ab12 with its manifest and an empty log.

        Raises RequestError when the folder cannot be made or is there already.
        """
        safe = "".join(char if char.isalnum() or char in "-_" else "-" for char in shape)[:40]
        folder = root / f"{started:%Y-%m-%dT%H%M}_{safe}_{tag}"
        try:
            (folder / LINES).mkdir(parents=True)
        except FileExistsError:
            raise SessionFolderError(folder, "is there already; take another --out or --seed") from None
        except OSError as error:
            raise SessionFolderError(folder, f"{error.strerror}; choose another --out") from error
        lock = folder / "writer.lock"
        lock.write_text(f"{os.getpid()}\n", encoding="ascii")
        write_aside(folder / MANIFEST, to_json({"schema_version": SCHEMA_VERSION, **manifest}, indent=2).encode())
        events = (folder / EVENTS).open("a", encoding="utf-8", newline="\n")
        sync_folder(folder)
        return cls(folder, events, lock)

    def append(self, kind: str, **data: Any) -> None:
        """Append one event and sync it to disk."""
        self._events.write(to_json({"event": kind, **data}) + "\n")
        self._events.flush()
        os.fsync(self._events.fileno())

    def video_path(self, line: int) -> Path:
        """Where the video segment of a run is recorded until the run is committed."""
        aside = self._aside(line)
        aside.mkdir(exist_ok=True)
        return aside / VIDEO

    def film_path(self, part: int) -> Path:
        """Where a part of the film of several robots is recorded until a run's end cuts it off."""
        aside = self._film_aside(part)
        aside.mkdir()
        return aside / VIDEO

    def adopt_film(self, part: int, line: int) -> None:
        """Make a part of the film, closed, that of the run that ended with it; before the run is committed."""
        self._film_aside(part).rename(self._aside(line))

    def drop_film(self, part: int) -> None:
        """Throw away the part of the film that no committed run ended with."""
        shutil.rmtree(self._film_aside(part), ignore_errors=True)

    def commit_line(self, line: int, light: pd.DataFrame) -> None:
        """Put a run's raw light samples beside its video segment and make the folder final."""
        aside = self._aside(line)
        aside.mkdir(exist_ok=True)
        path = aside / LIGHT
        light.to_parquet(path, index=False)
        with path.open("rb+") as file:
            os.fsync(file.fileno())
        sync_folder(aside)
        aside.rename(line_folder(self.folder, line))
        sync_folder(aside.parent)

    def finish(self, end_state: dict[str, Any]) -> None:
        """Write the end state into the manifest."""
        manifest = json.loads((self.folder / MANIFEST).read_text(encoding="utf-8"))
        manifest["end"] = end_state
        write_aside(self.folder / MANIFEST, to_json(manifest, indent=2).encode())

    def close(self) -> None:
        """Close the log and give the lock back. Safe to call twice."""
        if not self._events.closed:
            self._events.close()
        self._lock.unlink(missing_ok=True)

    def _film_aside(self, part: int) -> Path:
        return self.folder / LINES / f"film-{part:06d}.part"

    def _aside(self, line: int) -> Path:
        return self.folder / LINES / f"{line:06d}.part"


class SessionReader:
    """A stored session, read only."""

    def __init__(self, folder: Path) -> None:
        """Open a session. Raises SessionFolderError when it is none or is of a newer version."""
        self.folder = folder
        try:
            manifest: Any = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise SessionFolderError(folder, f"holds no {MANIFEST}, so it is no session folder") from None
        except (OSError, ValueError) as error:
            raise SessionFolderError(folder, f"{MANIFEST} cannot be read: {error}") from error
        self.manifest: dict[str, Any] = cast("dict[str, Any]", manifest) if isinstance(manifest, dict) else {}
        version = self.manifest.get("schema_version")
        if not isinstance(version, int) or version < 1:
            raise SessionFolderError(folder, f"{MANIFEST} has no schema_version")
        if version > SCHEMA_VERSION:
            raise SessionFolderError(
                folder,
                f"was written by a newer chordlab (schema {version}, this one reads up to {SCHEMA_VERSION}); "
                "update chordlab",
            )
        self.schema_version = version

    def events(self) -> Iterator[dict[str, Any]]:
        """The events in order. A torn last record is left out; a torn one before it is an error."""
        try:
            records = (self.folder / EVENTS).read_bytes().split(b"\n")
        except OSError as error:
            raise SessionFolderError(self.folder, f"{EVENTS} cannot be read: {error.strerror}") from error
        for number, record in enumerate(records[:-1], start=1):  # what follows the last newline is torn or empty
            try:
                event: Any = json.loads(record)
            except ValueError as error:
                raise SessionFolderError(
                    self.folder, f"{EVENTS} line {number} is no JSON; the file was changed"
                ) from error
            found = cast("dict[str, Any]", event) if isinstance(event, dict) else {}
            if not isinstance(found.get("event"), str):
                raise SessionFolderError(self.folder, f"{EVENTS} line {number} is no event")
            yield found

    def table(self, name: str) -> pd.DataFrame:
        """One of the derived tables (lines, crossings, estimates, track). Raises SessionFolderError when missing."""
        path = self.folder / f"{name}.parquet"
        try:
            return pd.read_parquet(path)
        except (OSError, ValueError) as error:
            raise SessionFolderError(self.folder, f"{name}.parquet cannot be read; run chordlab finalize") from error

    def segments(self) -> dict[int, Path]:
        """The video segments that were committed, by run."""
        found = sorted((self.folder / LINES).glob(f"[0-9]*/{VIDEO}"))
        return {int(path.parent.name): path for path in found if path.parent.name.isdigit()}


def write_checksums(folder: Path) -> Path:
    """Write SHA256SUMS over every file of the session, readable by ``sha256sum -c``."""
    skip = {CHECKSUMS, "writer.lock"}
    rows: list[str] = []
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name not in skip:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            rows.append(f"{digest}  {path.relative_to(folder).as_posix()}\n")
    target = folder / CHECKSUMS
    write_aside(target, "".join(rows).encode())
    return target


@contextlib.contextmanager
def disk_faults(folder: Path) -> Generator[None]:
    """Turn a full or failing disk into one clear line."""
    try:
        yield
    except (TimeoutError, ConnectionError):  # an OSError by descent, but not the disk's
        raise
    except OSError as error:
        raise ChordlabError(
            f"{folder}: {error.strerror or error}; what was synced before is safe, free some space and run again"
        ) from error
