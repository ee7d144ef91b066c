"""Many stored sessions, analysed here or on a cluster, each once: what was worked out before is not done again."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import pandas as pd

from lab.base.errors import ChordlabError
from lab.batch.cache import RowCache, key_of
from lab.batch.digests import Digests
from lab.batch.places import Place
from lab.batch.rows import COLUMNS, row_of
from lab.spread.spread import spread
from lab.spread.task import Failure, one_line
from lab.spread.versions import versions
from lab.store.layout import CHECKSUMS, SessionFolderError
from lab.store.lock import writer_of
from lab.store.seal import verify_checksums
from projector.text import find_font

Progress = Callable[[int, int], None]
Row = dict[str, Any]

# What a row depends on besides the session and the program: its form.
_SETTINGS = {"columns": COLUMNS}


@dataclass(frozen=True, slots=True, eq=False)
class Analysed:
    """A batch.

    Attributes:
        table: one row a session that was done, in the order asked for; its columns and their kinds are COLUMNS.
        computed: how many were worked out this time; the others were known, or could not be.
        stopped: what ended it before all were done; None when all are.
    """

    table: pd.DataFrame
    computed: int
    stopped: BaseException | None


def analyse(
    places: Sequence[Place],
    *,
    cache: RowCache | None = None,
    again: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Analysed:
    """Analyse sessions, each content once. Nothing is written in their folders.

    What stops it (Ctrl-C, a cluster that goes away) does not lose what is done: see `Analysed.stopped`.

    Args:
        places: from `lab.batch.places.places_below`.
        cache: rows are looked up and kept there.
        again: rows are not looked up, only kept.
        workers: as for `lab.spread.spread.spread`.
        scheduler: likewise.
        progress: told (done, total).

    Raises:
        RequestError: the scheduler or its workers cannot be used.
    """
    batch = _Batch(places, cache, again, progress)
    todo = batch.todo()
    stopped: BaseException | None = None
    try:
        # A batch of which all is known needs no workers.
        first = next(todo, None)
        if first is not None:
            found = spread(row_of, chain([first], todo), workers=workers, scheduler=scheduler, key=batch.key_of)
            with contextlib.closing(found):
                for folder, result in found:
                    batch.take(folder, result)
    except (KeyboardInterrupt, ChordlabError) as error:
        if not batch.rows and isinstance(error, ChordlabError):
            raise
        stopped = error
    rows = [batch.rows[number] for number in sorted(batch.rows)]
    return Analysed(pd.DataFrame(rows, columns=list(COLUMNS)).astype(COLUMNS), batch.computed, stopped)


class _Batch:
    """The rows of a batch as they become known."""

    def __init__(self, places: Sequence[Place], cache: RowCache | None, again: bool, progress: Progress | None) -> None:
        self.rows: dict[int, Row] = {}
        self.computed = 0
        self._places, self._cache, self._again, self._progress = places, cache, again, progress
        self._versions = {**versions(), "font": find_font().sha256}  # letters are set in it again
        self._keys: dict[Path, str] = {}  # of what is under way, by the folder that stands for its content
        self._same: dict[str, list[tuple[int, Row]]] = {}  # key → the sessions of that content

    def key_of(self, folder: Path) -> str:
        """What names a folder's content for the cache and the cluster."""
        return self._keys[folder]

    def todo(self) -> Generator[Path]:
        """The folders that have to be examined; the others' rows are known after this."""
        for number, place in enumerate(self._places):
            folder = place.folder.resolve()
            row: Row = {"session": folder.name, "root": str(place.root), "folder": place.below}
            try:
                writer = writer_of(folder)
                if writer is not None:
                    raise SessionFolderError(folder, f"is being written by {writer}; analyse it when that has ended")
                digests = self._digests(folder)
                row["content_digest"] = digests.content()
                row["checksums_ok"] = _checksums_ok(folder, digests)
                digests.keep()
            except (ChordlabError, OSError) as error:
                self._done(number, row, {"error": one_line(error)})
                continue
            key = key_of(row["content_digest"], _SETTINGS, self._versions)
            kept = self._cache.get(key) if self._cache is not None and not self._again else None
            if kept is not None:
                self._done(number, row, kept)
            elif key in self._same:
                self._same[key].append((number, row))
            else:
                self._same[key] = [(number, row)]
                self._keys[folder] = key
                yield folder

    def take(self, folder: Path, result: Row | Failure) -> None:
        """A folder was examined: keep the row, for all sessions of the same content."""
        key = self._keys.pop(folder)
        found = {"error": result.reason} if isinstance(result, Failure) else result
        self.computed += 1
        for number, row in self._same.pop(key):
            self._done(number, row, found)
        if self._cache is not None and not found["error"] and self._is_unchanged(folder, key):
            self._cache.put(key, found)

    def _done(self, number: int, row: Row, found: Row) -> None:
        self.rows[number] = row | found
        if self._progress is not None:
            self._progress(len(self.rows), len(self._places))

    def _digests(self, folder: Path) -> Digests:
        return Digests(folder) if self._cache is None else self._cache.digests(folder)

    def _is_unchanged(self, folder: Path, key: str) -> bool:
        """Whether the session is still what it was when its work was handed out."""
        try:
            return (
                writer_of(folder) is None and key_of(self._digests(folder).content(), _SETTINGS, self._versions) == key
            )
        except OSError:
            return False


def _checksums_ok(folder: Path, digests: Digests) -> bool | None:
    """Whether a session's files are those of its checksums; None where it has none."""
    if not (folder / CHECKSUMS).exists():
        return None
    return not verify_checksums(folder, digest=digests.of)
