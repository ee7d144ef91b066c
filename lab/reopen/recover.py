"""Mending what a cut left of a session's folder: a kill, a power cut, a full disk. Nothing is ever deleted.

A folder is looked at first, which changes nothing, and what is to be done comes out as a list of steps. After
each step, and in the midst of one, the folder can be looked at again, so recovery may itself be cut at any
moment: what is set aside is on the disk before the log is cut, and the log is replaced whole, together with the
record of its own mending.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from analysis.estimate import Estimate
from lab.base.files import sync_folder, write_aside
from lab.session.tally import stored_estimate
from lab.store.damage import CUT, PART, Damage, Move, SetAside, free_name, look, told_before
from lab.store.layout import CHECKSUMS, EVENTS, MANIFEST, SessionFolderError, to_json
from lab.store.lock import writing
from lab.store.seal import write_checksums
from lab.store.tables import Tables, finalize

_OUTCOME = ("state", "runs", "n", "rolling_s")


@dataclass(frozen=True, slots=True)
class Recovery:
    """What a session's folder holds, and what was done to mend it.

    Attributes:
        folder: the session's.
        done: one sentence for each step; empty when there was nothing to mend. After a dry run: what is to be done.
        state: how the session ended, ``cut`` when it was cut; empty where the log could not be looked at yet.
        runs: runs that are whole, of all robots.
        lines: those that count and crossed the shape.
        estimate: area and perimeter from them, with errors; None with fewer than two.
        lost_lines: numbers of the runs that are known of and are not in the log, whenever they were lost.
        torn_bytes: bytes of the log that were no whole records.
        set_aside: what was moved out of the way, by its new name in the folder.
        changed: files that are not as SHA256SUMS says, and what is wrong with each. They are named, not mended.
    """

    folder: Path
    done: tuple[str, ...]
    state: str = ""
    runs: int = 0
    lines: int = 0
    estimate: Estimate | None = None
    lost_lines: tuple[int, ...] = ()
    torn_bytes: int = 0
    set_aside: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Step:
    """One thing to do, in words that serve before and after it, and its doing."""

    what: str
    do: Callable[[], object]


def recover(folder: Path, *, dry_run: bool = False) -> Recovery:
    """Mend a session's folder after a cut; one that is whole is left as it is, byte by byte.

    Args:
        folder: the session's.
        dry_run: say what is to be done, and leave it.

    Raises:
        SessionFolderError: it is being written, or holds nothing that a session could be made of again.
        OSError: the disk is full or failing. Nothing is lost by it; recover again.
    """
    placing = _manifest_steps(folder)
    if not placing:
        damage = look(folder)
        if not _steps(damage):
            return _report(damage, [])
    with writing(folder):
        placing = _manifest_steps(folder)
        if dry_run and placing:
            return Recovery(folder, tuple(step.what for step in placing))
        _take(placing)
        damage = look(folder)
        steps = _steps(damage)
        if not dry_run:
            _take(steps)
        return _report(damage, [*placing, *steps])


def _take(steps: Sequence[_Step]) -> None:
    for step in steps:
        step.do()


def _manifest_steps(folder: Path) -> list[_Step]:
    """What puts a manifest in its place, where it has none. Raises SessionFolderError when there is none to be had."""
    if not folder.is_dir():
        raise SessionFolderError(folder, "is no folder; name a session's")
    if _is_manifest(folder / MANIFEST):
        return []
    aside = MANIFEST + PART
    if _is_manifest(folder / aside):
        placed = [Move(aside, MANIFEST)]
        if os.path.lexists(folder / MANIFEST):
            placed.insert(0, Move(MANIFEST, free_name(folder, MANIFEST + CUT)))
        return [_renaming(folder, move) for move in placed]
    if not _has_bytes(folder / EVENTS):
        raise SessionFolderError(folder, "is no session, or was cut before its session began; run it anew")
    raise SessionFolderError(
        folder,
        f"its {MANIFEST} is missing or torn, and there is no whole {aside}; "
        "put that of a session with the same settings in its place and recover again",
    )


def _is_manifest(path: Path) -> bool:
    """Whether a file of the folder reads as JSON of a manifest; of which version is judged by who reads it."""
    try:
        return path.is_file() and "schema_version" in json.loads(path.read_bytes())
    except (OSError, ValueError, TypeError, RecursionError):
        return False


def _has_bytes(path: Path) -> bool:
    try:
        return path.stat().st_size > 0
    except OSError:
        return False


def _steps(damage: Damage) -> list[_Step]:
    """What mends a folder, in order."""
    folder, ending = damage.session.folder, damage.ending
    steps = [_renaming(folder, move) for move in damage.leftovers]
    steps += [_keeping(folder, aside) for aside in damage.torn if not aside.is_there]
    mended = damage.saved.kept + "".join(f"{to_json(event)}\n" for event in ending).encode()
    if mended != damage.log:
        what = "what was mended and how the session ended" if ending else "where its last line ends"
        steps.append(_Step(f"{EVENTS} is told {what}", lambda: write_aside(folder / EVENTS, mended)))
    steps += [_renaming(folder, move) for move in damage.moves]
    steps += _end_steps(damage)
    if not all(damage.is_current(name) for name in Tables.__slots__):
        steps.append(_Step("the tables are rebuilt", lambda: finalize(folder)))
    seal = folder / CHECKSUMS
    is_sealed = os.path.lexists(seal)
    if is_sealed and (steps or damage.is_seal_torn):
        # First of all: it is of the folder as it was, and what is mended from here on would be named as changed.
        steps.insert(0, _renaming(folder, Move(CHECKSUMS, free_name(folder, CHECKSUMS + CUT))))
    if steps or not is_sealed:
        steps.append(_Step(f"{CHECKSUMS} is written", lambda: write_checksums(folder)))
    return steps


def _renaming(folder: Path, move: Move) -> _Step:
    def rename() -> None:
        (folder / move.old).rename(folder / move.new)
        sync_folder((folder / move.new).parent)

    return _Step(f"{move.old} is renamed to {move.new}", rename)


def _keeping(folder: Path, aside: SetAside) -> _Step:
    """Keeps a torn stretch of the log."""
    stretch = aside.stretch
    where = f"line {stretch.first}" if stretch.first == stretch.last else f"lines {stretch.first} to {stretch.last}"
    what = f"{len(stretch.data)} bytes of {EVENTS} that are no record ({where}) are moved to {aside.name}"
    return _Step(what, lambda: write_aside(folder / aside.name, stretch.data))


def _end_steps(damage: Damage) -> list[_Step]:
    """What gives the manifest the end of the log; it keeps its own schema."""
    path = damage.session.path(MANIFEST)
    manifest = cast("dict[str, Any]", json.loads(path.read_bytes()))
    outcome, end = _outcome(damage), manifest.get("end")
    if isinstance(end, dict) and all(cast("dict[str, Any]", end).get(name) == outcome[name] for name in outcome):
        return []
    data = to_json({**manifest, "end": outcome}, indent=2).encode()
    return [_Step(f"{MANIFEST} is told how the session ended", lambda: write_aside(path, data))]


def _outcome(damage: Damage) -> dict[str, Any]:
    """How the session ended, as the manifest has it."""
    last = (damage.ending or [damage.end or {}])[-1]
    return {name: last[name] for name in _OUTCOME if name in last}


def _report(damage: Damage, steps: Sequence[_Step]) -> Recovery:
    return Recovery(
        folder=damage.session.folder,
        done=tuple(step.what for step in steps),
        state=str(_outcome(damage).get("state", "")),
        runs=len(damage.tables.lines),
        lines=damage.lines,
        estimate=stored_estimate(damage.tables.lines, damage.tables.crossings),
        lost_lines=(*told_before(damage.saved.events, "lost_lines"), *damage.lost),
        torn_bytes=damage.torn_bytes,
        set_aside=(*damage.set_aside, *(move.new for move in damage.leftovers)),
        changed=tuple(damage.changed),
    )
