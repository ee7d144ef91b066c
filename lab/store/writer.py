"""The one writer of a session's folder: an append-only log that is the truth, one folder a run, and a manifest.

Written so that a cut at any moment loses at most the run in progress: a run's files are written
aside, synced and renamed before its event is appended and synced.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Generator
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import Any

import pandas as pd

from lab.base.errors import ChordlabError
from lab.base.files import make_folder, open_new, sync_file, sync_folder, write_all, write_aside
from lab.store.layout import (
    CHECKSUMS,
    EVENTS,
    LIGHT,
    LINES,
    MANIFEST,
    SCHEMA_VERSION,
    VIDEO,
    SessionFolderError,
    line_folder,
    to_json,
)
from lab.store.lock import writing
from lab.store.log import EventLog
from lab.store.reader import SessionReader


class SessionWriter:
    """The one writer of a session folder; holds its lock until closed."""

    def __init__(self, folder: Path, log: EventLog, held: ExitStack) -> None:
        self.folder = folder
        self._log = log
        self._held = held

    @classmethod
    def create(cls, root: Path, shape: str, manifest: dict[str, Any], *, started: datetime, tag: str) -> SessionWriter:
        """Make ``root``/2026-11-23T1042_eiffel_ab12 with its manifest and an empty log.

        Raises RequestError when the folder cannot be made or is there already.
        """
        safe = "".join(char if char.isalnum() or char in "-_" else "-" for char in shape)[:40]
        folder = root / f"{started:%Y-%m-%dT%H%M}_{safe}_{tag}"
        try:
            make_folder(folder)
        except FileExistsError:
            raise SessionFolderError(folder, "is there already; take another --out or --seed") from None
        except OSError as error:
            raise SessionFolderError(folder, f"{error.strerror}; choose another --out") from error
        try:
            with ExitStack() as held:
                held.enter_context(writing(folder))
                (folder / LINES).mkdir()
                log = EventLog(folder / EVENTS, new=True)
                held.callback(log.close)
                sync_folder(folder)
                # The manifest makes a folder a session's, so it comes when the rest is there to stay.
                _write_manifest(folder, {"schema_version": SCHEMA_VERSION, **manifest})
                return cls(folder, log, held.pop_all())
        except (OSError, SessionFolderError) as error:
            shutil.rmtree(folder, ignore_errors=True)
            if isinstance(error, SessionFolderError):
                raise
            raise SessionFolderError(folder, f"{error.strerror}; choose another --out") from error

    @classmethod
    def reopen(cls, folder: Path, part: dict[str, Any]) -> SessionWriter:
        """Open a session's folder to go on with it: no longer ended, with one more of its ``parts``.

        Raises SessionFolderError: another process writes in it, it is of another schema, or it is not mended.
        """
        with ExitStack() as held:
            held.enter_context(writing(folder))
            session = SessionReader(folder)
            if session.schema_version != SCHEMA_VERSION:
                raise SessionFolderError(
                    folder, f"is of the older schema {session.schema_version} and is never written to; start a new one"
                )
            _check_plain_folder(folder, LINES)
            try:
                log = EventLog(session.path(EVENTS), new=False)
                held.callback(log.close)
                if not log.is_whole:
                    raise SessionFolderError(folder, f"{EVENTS} ends in a torn record; run chordlab recover on it")
                # Its sums are those of a session that had ended.
                (folder / CHECKSUMS).unlink(missing_ok=True)
                manifest = {key: value for key, value in session.manifest.items() if key != "end"}
                _write_manifest(folder, {**manifest, "parts": [*manifest.get("parts", []), part]})
            except OSError as error:
                raise SessionFolderError(folder, f"{error.strerror}; it cannot be written to") from error
            return cls(folder, log, held.pop_all())

    def append(self, kind: str, **data: Any) -> None:
        """Append one event and sync it to disk. Raises OSError; the log then ends with the event before."""
        self._log.append(f"{to_json({'event': kind, **data})}\n".encode())

    def video_path(self, line: int) -> Path:
        """Where the video segment of a run is recorded until the run is committed."""
        return self._make_aside(line) / VIDEO

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
        aside = self._make_aside(line)
        with open_new(aside / LIGHT) as file:
            write_all(file.fileno(), light.to_parquet(index=False))
        for path in sorted(aside.iterdir()):
            sync_file(path)
        sync_folder(aside)
        aside.rename(line_folder(self.folder, line))
        sync_folder(aside.parent)

    def finish(self, end_state: dict[str, Any]) -> None:
        """Write the end state into the manifest."""
        _write_manifest(self.folder, {**SessionReader(self.folder).manifest, "end": end_state})

    def close(self) -> None:
        """Close the log and give the lock back. Safe to call twice."""
        self._held.close()

    def _make_aside(self, line: int) -> Path:
        """Where a run's files lie until it is committed; a planted link there is taken away, not followed."""
        aside = self._aside(line)
        if aside.is_symlink():
            aside.unlink()
        aside.mkdir(exist_ok=True)
        return aside

    def _film_aside(self, part: int) -> Path:
        return self.folder / LINES / f"film-{part:06d}.part"

    def _aside(self, line: int) -> Path:
        return self.folder / LINES / f"{line:06d}.part"


def _write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    write_aside(folder / MANIFEST, to_json(manifest, indent=2).encode())


def _check_plain_folder(folder: Path, name: str) -> None:
    """Refuse to write below what is no folder of the session's own."""
    path = folder / name
    if path.is_symlink() or not path.is_dir():
        raise SessionFolderError(folder, f"{name} is no plain folder; the session cannot go on")


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
