"""What a cut left of a session's folder, found by looking: nothing is changed by it."""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from lab.store.layout import CHECKSUMS, EVENTS, LINES, SessionFolderError
from lab.store.reader import SessionReader
from lab.store.salvage import Event, Salvage, Torn, salvage
from lab.store.seal import verify_checksums
from lab.store.tables import Tables, tables_from
from lab.store.upgrade import upgrade_event

PART, CUT, TORN = ".part", ".cut", ".torn"
_RUN_FOLDER = re.compile(r"(\d{1,9})(\.part)?", re.ASCII)
_FILM_FOLDER = re.compile(r"film-\d+\.part", re.ASCII)
_RUN_NUMBER = re.compile(rb'"line": (\d{1,9})\b')
_RUN_ALONE = b'"crossings":'  # no other record has it
_WIDEST_GAP = 10_000  # a wider one is no gap but a number that was changed
_TORN_SEAL = f"{CHECKSUMS}: torn"


@dataclass(frozen=True, slots=True)
class Move:
    """A file or folder of the session that is to bear another name, both relative to the session's folder."""

    old: str
    new: str


@dataclass(frozen=True, slots=True)
class SetAside:
    """A torn stretch of the log, the name of the file for it, and whether that holds it already."""

    stretch: Torn
    name: str
    is_there: bool


@dataclass(frozen=True, slots=True)
class Damage:
    """What a look at a session's folder found.

    Attributes:
        session: what is left of it.
        log: its log, as it stands.
        saved: the same, sorted.
        tables: what the whole records tell.
        torn: the torn stretches of the log.
        moves: the folders below lines/ that are no runs.
        leftovers: files that were being written.
        lost: runs that are not in the log, but for those that the log says were lost before.
        changed: files that are not as SHA256SUMS says, and what is wrong with each.
    """

    session: SessionReader
    log: bytes
    saved: Salvage
    tables: Tables
    torn: Sequence[SetAside]
    moves: Sequence[Move]
    leftovers: Sequence[Move]
    lost: Sequence[int]
    changed: Sequence[str]

    @property
    def end(self) -> Event | None:
        """The event that ended the session, if it did end."""
        return _end_of(self.saved.events)

    @property
    def ending(self) -> list[Event]:
        """What the log lacks: that it was mended, and how the session ended."""
        told = set(told_before(self.saved.events, "set_aside"))
        if self.end is not None and not self.torn and {move.new for move in self.moves} <= told:
            return []
        t_s = max(_times(self.saved.events), default=0.0)
        mended = {
            "torn_bytes": self.torn_bytes,
            "torn_file": next((aside.name for aside in self.torn if aside.stretch.is_tail), None),
            "lost_lines": self.lost,
            "set_aside": self.set_aside,
            "changed": self.changed,
        }
        outcome = {
            "state": "cut" if self.end is None else self.end.get("state", "failed"),
            "runs": len(self.tables.lines),
            "n": self.lines,
            "rolling_s": _rolled_s(self.saved.events),
        }
        return [{"event": "recover", "t_s": t_s, **mended}, {"event": "end", "t_s": t_s, **outcome}]

    @property
    def lines(self) -> int:
        """Runs that count and crossed the shape."""
        return len(self.tables.crossed)

    @property
    def torn_bytes(self) -> int:
        """Bytes of the log that are no whole records."""
        return sum(len(aside.stretch.data) for aside in self.torn)

    @property
    def set_aside(self) -> list[str]:
        """What of the log and of the runs goes out of the way, by its new name."""
        return [*(aside.name for aside in self.torn), *(move.new for move in self.moves)]

    @property
    def is_seal_torn(self) -> bool:
        """Whether SHA256SUMS is there and cannot be read."""
        return _TORN_SEAL in self.changed

    def is_current(self, name: str) -> bool:
        """Whether a stored table is of the runs that the log holds."""
        try:
            stored = self.session.table(name)
        except SessionFolderError:
            return False
        return "line" in stored and stored["line"].tolist() == getattr(self.tables, name)["line"].tolist()


def look(folder: Path) -> Damage:
    """What a session's folder holds.

    Raises:
        SessionFolderError: its manifest or its log cannot be read.
    """
    session = SessionReader(folder)
    log = _log_of(session)
    saved, tables = _salvage(session, log)
    moves = _run_moves(session, saved.events)
    parts = sorted(path.name for path in folder.glob(f"*{PART}"))
    return Damage(
        session=session,
        log=log,
        saved=saved,
        tables=tables,
        torn=[_aside(folder, stretch) for stretch in saved.torn],
        moves=moves,
        leftovers=[Move(name, free_name(folder, name.removesuffix(PART) + CUT)) for name in parts],
        lost=_lost(saved, moves),
        changed=_changed(session),
    )


def told_before(events: Iterable[Event], key: str) -> list[Any]:
    """What earlier recoveries wrote into the log under a key that holds a list."""
    lists = (event.get(key) for event in events if event["event"] == "recover")
    return [item for found in lists if isinstance(found, list) for item in cast("list[Any]", found)]


def free_name(folder: Path, name: str, taken: Container[str] = ()) -> str:
    """The name, or the first numbered one, that nothing in the folder bears and that is not ``taken``."""
    return next(free for free in _numbered(name) if free not in taken and not os.path.lexists(folder / free))


def _log_of(session: SessionReader) -> bytes:
    try:
        return session.path(EVENTS).read_bytes()
    except OSError as error:
        raise SessionFolderError(
            session.folder, f"{EVENTS} cannot be read ({error.strerror}); no cut takes it away, put it back from a copy"
        ) from error


def _salvage(session: SessionReader, log: bytes) -> tuple[Salvage, Tables]:
    """What is whole in the log, and the tables of it; a record that no table can take is torn too."""
    saved = salvage(log)
    tables = _tables(session, saved.events)
    if tables is None:
        unfit = {*_unfit(session, saved.events, range(len(saved.events))), *_twice(saved.events)}
        saved = salvage(log, {saved.lines[index] for index in unfit})
        tables = _tables(session, saved.events)
    if tables is None:
        raise SessionFolderError(session.folder, f"{EVENTS} cannot be made into tables; it was changed")
    return saved, tables


def _tables(session: SessionReader, events: Sequence[Event]) -> Tables | None:
    """The tables of the events, or None where they cannot be made."""
    if any(not isinstance(event.get("line"), int) for event in events if event["event"] == "line"):
        return None
    try:
        return tables_from([upgrade_event(event, session.schema_version) for event in events], session.folder)
    except SessionFolderError:
        return None


def _twice(events: Sequence[Event]) -> Iterator[int]:
    """Events of runs that stand in the log already."""
    seen: set[int] = set()
    for index, event in enumerate(events):
        if event["event"] == "line" and isinstance(event.get("line"), int):
            if event["line"] in seen:
                yield index
            seen.add(event["line"])


def _unfit(session: SessionReader, events: Sequence[Event], among: range) -> Iterator[int]:
    """Which events the tables cannot take, found by halving."""
    if _tables(session, events[among.start : among.stop]) is not None:
        return
    if len(among) == 1:
        yield among.start
        return
    half = len(among) // 2
    yield from _unfit(session, events, among[:half])
    yield from _unfit(session, events, among[half:])


def _run_moves(session: SessionReader, events: Sequence[Event]) -> list[Move]:
    """The folders of runs that the log does not know, and after a cut those that were being written.

    A session that ended by itself keeps the film of the run that it broke off where it is.
    """
    is_cut = _end_of(events) is None
    told = set(told_before(events, "set_aside"))
    logged = _logged(events)
    try:
        names = sorted(path.name for path in session.path(LINES).iterdir())
    except OSError:
        names = []
    moves: list[Move] = []
    for name in names:
        run = _RUN_FOLDER.fullmatch(name)
        is_part = name.endswith(PART)
        if not (run or _FILM_FOLDER.fullmatch(name)) or (run and not is_part and int(run[1]) in logged):
            continue
        taken = [move.new for move in moves]
        new = free_name(session.folder, f"{LINES}/{name.removesuffix(PART)}{CUT}", taken)
        if is_cut or not is_part or new in told:
            moves.append(Move(f"{LINES}/{name}", new))
    return moves


def _lost(saved: Salvage, moves: Iterable[Move]) -> list[int]:
    """Numbers of the runs that are known of and not in the log, but for those that the log says were lost before."""
    events, logged = saved.events, _logged(saved.events)
    settled = -1
    if all(stretch.is_tail for stretch in saved.torn):  # before an end, runs broken off may leave gaps
        ends = [place for place, event in enumerate(events) if event["event"] == "end"]
        settled = max(_logged(events[: ends[-1]]) if ends else (), default=-1)
    lost: set[int] = set()
    for before, after in itertools.pairwise([settled, *sorted(line for line in logged if line > settled)]):
        if after - before <= _WIDEST_GAP:
            lost.update(range(before + 1, after))
    lost.update(int(run[1]) for move in moves if (run := _RUN_FOLDER.fullmatch(Path(move.old).name)))
    for stretch in saved.torn:
        lost.update(int(number) for number in _RUN_NUMBER.findall(stretch.data))
        last = max(logged, default=-1)
        if stretch.is_tail and _RUN_ALONE in stretch.data and max(lost, default=-1) <= last:
            lost.add(last + 1)  # cut before its number
    return sorted(lost - logged - set(told_before(events, "lost_lines")))


def _aside(folder: Path, stretch: Torn) -> SetAside:
    """Where a torn stretch is kept; in the file that holds it, if a recovery was cut after writing that."""
    lines = "" if stretch.is_tail else f".{stretch.first}"
    if not stretch.is_tail and stretch.last > stretch.first:
        lines += f"-{stretch.last}"
    names = _numbered(f"{EVENTS}{lines}{TORN}")
    name = next(name for name in names if not os.path.lexists(folder / name) or _holds(folder / name, stretch.data))
    return SetAside(stretch, name, is_there=os.path.lexists(folder / name))


def _holds(path: Path, data: bytes) -> bool:
    return path.is_file() and not path.is_symlink() and path.read_bytes() == data


def _end_of(events: Sequence[Event]) -> Event | None:
    return events[-1] if events and events[-1]["event"] == "end" else None


def _changed(session: SessionReader) -> list[str]:
    """What is not as SHA256SUMS says, where there is one."""
    if not os.path.lexists(session.folder / CHECKSUMS):
        return []
    try:
        if not session.path(CHECKSUMS).read_bytes().endswith(b"\n"):
            return [_TORN_SEAL]
        return verify_checksums(session.folder)
    except (SessionFolderError, OSError):
        return [_TORN_SEAL]


def _logged(events: Iterable[Event]) -> set[int]:
    return {event["line"] for event in events if event["event"] == "line"}


def _times(events: Iterable[Event]) -> list[float]:
    """The times in a log, s, in its order."""
    times = (event.get(name) for event in events for name in ("t_s", "t_end_s"))
    return [float(t_s) for t_s in times if isinstance(t_s, int | float) and math.isfinite(t_s)]


def _rolled_s(events: Sequence[Event]) -> float:
    """How long the parts of a session lasted together, as far as the log goes."""
    starts = [place for place, event in enumerate(events) if event["event"] == "start"]
    parts = [_times(events[one:two]) for one, two in itertools.pairwise([*starts, len(events)])]
    return sum(max(times) - times[0] for times in parts if times)


def _numbered(name: str) -> Iterator[str]:
    yield name
    for number in itertools.count(2):
        yield f"{name}.{number}"
