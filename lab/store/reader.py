"""A stored session, read only, in the words of today's schema."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import pandas as pd
from pyarrow import ArrowException

from lab.base.given import json_of
from lab.store.layout import (
    EVENTS,
    FRAMES,
    LINES,
    MANIFEST,
    SCHEMA_VERSION,
    VIDEO,
    SessionFolderError,
    line_folder,
)
from lab.store.log import whole_length
from lab.store.upgrade import upgrade_event, upgrade_manifest

# What Arrow and pandas raise on tables that were changed.
_UNREADABLE = (
    *(OSError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, NotImplementedError),
    *(MemoryError, RecursionError, ArrowException),
)


def numbers_of(path: Path, columns: Sequence[str]) -> pd.DataFrame:
    """Columns of a table in a session's folder, as floats.

    Raises:
        SessionFolderError: it cannot be read, or has no such columns of numbers.
    """
    try:
        return pd.read_parquet(path, columns=list(columns))[list(columns)].astype("float64")
    except _UNREADABLE as error:
        raise SessionFolderError(path, f"cannot be read ({error}); take another copy of the session") from error


class SessionReader:
    """A stored session, read only.

    Attributes:
        folder: where it lies.
        schema_version: of the folder itself.
        manifest: upgraded to SCHEMA_VERSION, as the events are.
    """

    def __init__(self, folder: Path) -> None:
        """Open a session. Raises SessionFolderError when it is none or is of a newer version."""
        self.folder = folder
        self._root: Path | None = None
        try:
            manifest: Any = json_of(self.path(MANIFEST).read_bytes())
        except (FileNotFoundError, NotADirectoryError):
            raise SessionFolderError(folder, f"holds no {MANIFEST}, so it is no session folder") from None
        except OSError as error:
            raise SessionFolderError(folder, f"{MANIFEST} cannot be read: {error.strerror}") from error
        except ValueError as error:
            raise SessionFolderError(folder, f"{MANIFEST} cannot be read: {error}") from error
        stored = cast("dict[str, Any]", manifest) if isinstance(manifest, dict) else {}
        version = stored.get("schema_version")
        if not isinstance(version, int) or isinstance(version, bool) or version < 1:
            raise SessionFolderError(folder, f"{MANIFEST} has no schema_version")
        if version > SCHEMA_VERSION:
            raise SessionFolderError(
                folder,
                f"was written by a newer chordlab (schema {version}, this one reads up to {SCHEMA_VERSION}); "
                "update chordlab",
            )
        self.schema_version = version
        self.manifest = upgrade_manifest(stored, version)

    def path(self, relative: str | Path) -> Path:
        """A file or folder of the session, there or not.

        Raises:
            SessionFolderError: it lies or leads outside of the session's folder, or is neither (a pipe, a device).
        """
        found = self.folder / relative
        try:
            self._root = self._root or self.folder.resolve()
            inside = found.resolve().is_relative_to(self._root)
            plain = inside and (found.is_file() or found.is_dir() or not found.exists())
        except (OSError, RuntimeError, ValueError):  # names that no system takes, links that lead in a ring
            inside = plain = False
        if not inside:
            raise SessionFolderError(self.folder, f"{relative} leads outside of the session's folder; it is not read")
        if not plain:
            raise SessionFolderError(self.folder, f"{relative} is no plain file; it is not read")
        return found

    def line_path(self, line: int, name: str) -> Path:
        """A file in the folder of one run, there or not. Raises SessionFolderError as `path` does."""
        return self.path(line_folder(Path(), line) / name)

    def events(self) -> Iterator[dict[str, Any]]:
        """The events in order. A torn last record is left out; a torn one before it is an error."""
        return (event for event, _ in self.events_from(0))

    def events_from(self, byte: int, number: int = 1) -> Iterator[tuple[dict[str, Any], int]]:
        """As `events`, from a byte of the log on, where record ``number`` begins; each with the byte after it."""
        try:
            with self.path(EVENTS).open("rb") as file:
                file.seek(byte)
                log = file.read()
        except OSError as error:
            raise SessionFolderError(self.folder, f"{EVENTS} cannot be read: {error.strerror}") from error
        for line, record in enumerate(log[: whole_length(log)].split(b"\n")[:-1], start=number):
            byte += len(record) + 1
            try:
                event: Any = json_of(record)
            except ValueError as error:
                raise SessionFolderError(
                    self.folder, f"{EVENTS} line {line} is no JSON; the file was changed"
                ) from error
            found = cast("dict[str, Any]", event) if isinstance(event, dict) else {}
            if not isinstance(found.get("event"), str):
                raise SessionFolderError(self.folder, f"{EVENTS} line {line} is no event")
            yield upgrade_event(found, self.schema_version), byte

    def table(self, name: str) -> pd.DataFrame:
        """One of the derived tables (lines, crossings, estimates, track). Raises SessionFolderError when missing."""
        path = self.path(f"{name}.parquet")
        try:
            return pd.read_parquet(path)
        except _UNREADABLE as error:
            raise SessionFolderError(self.folder, f"{name}.parquet cannot be read; run chordlab finalize") from error

    def segments(self) -> dict[int, Path]:
        """The video segments that were committed, by run; the tables of their frames lie beside them.

        Raises SessionFolderError as `path` does.
        """
        try:
            names = sorted(path.name for path in self.path(LINES).iterdir() if path.name.isascii())
        except OSError:
            names = []
        lines = [int(name) for name in names if name.isdigit()]
        found = {line: (self.line_path(line, VIDEO), self.line_path(line, FRAMES)) for line in lines}
        return {line: video for line, (video, _) in found.items() if video.is_file()}
