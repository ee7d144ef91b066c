"""Going on with a stored session, as if it had never been cut: same folder, same sums, higher numbers, fresh seeds."""

from __future__ import annotations

import asyncio
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from lab.base.errors import RequestError
from lab.bench.devices import Bench
from lab.live.live import Live
from lab.reopen.parts import Part, Record, parts_of
from lab.reopen.recover import recover
from lab.reopen.stored import asked_settings, stored_shape
from lab.session.experiment import (
    Finished,
    calibration_of,
    conduct,
    devices_of,
    dictionary_with,
    recogniser_of,
    versions,
)
from lab.session.ledger import Ledger, Watcher
from lab.session.session import Earlier, Preflight
from lab.session.tally import Tally, invariants_of, tally_for
from lab.settings.load import parse_settings
from lab.settings.settings import Settings
from lab.store.layout import EVENTS, LINES, MANIFEST, SCHEMA_VERSION, SessionFolderError, to_json
from lab.store.reader import SessionReader
from lab.store.writer import SessionWriter
from projector.shape import Shape

_NUMBERED = re.compile(r"(film-)?(\d{1,9})(?!\d)", re.ASCII)
_TOLD = ("area_cm2", "perimeter_cm", "sigma_area_cm2", "sigma_perimeter_cm", "correlation")
_SAME = 1e-9  # of another machine's rounding


@dataclass(frozen=True, slots=True)
class Unfinished:
    """A stored session that is to go on.

    Attributes:
        folder: its own.
        settings: its own, with what is asked of the part to come.
        shape: what it projects.
        dictionary: what it chooses a name from.
        earlier: what it has behind it.
        runs: the records of its runs, in the order of the log.
        n: counted lines that crossed the shape.
        complete: in words, why there is nothing left to do; empty if there is.
    """

    folder: Path
    settings: Settings
    shape: Shape
    dictionary: dict[str, Shape]
    earlier: Earlier
    runs: Sequence[Record]
    n: int
    complete: str


def cannot_go_on(settings: Settings) -> str:
    """Why a session with these settings can never be resumed, and what to do; empty if it can."""
    match settings.robots[0].partition(":")[0]:
        case "onboard":
            return (
                "its robot adds up by itself and would begin anew, and the two sums cannot be joined; "
                "run a new session, and read both with chordlab batch"
            )
        case "replay":
            return "is a replay, which would begin anew; replay it again instead"
        case _:
            return ""


def pick_up(
    folder: Path,
    *,
    lines: int | None = None,
    until: float | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Unfinished:
    """Read a session that is to go on; mend it first, where a cut left it torn. Hold the folder's lock meanwhile.

    Args:
        folder: the session's.
        lines: how many lines it is to have in the end; None: as many as were asked of it last.
        until: posterior at which to stop; None: the one asked of it last, unless it was reached and ``lines`` asks
            for more.
        say: told what was mended.

    Raises:
        RequestError: the session cannot go on; the line says why.
    """
    mended = recover(folder)
    for what in mended.done:
        say(what)
    changed = [name for name in mended.changed if name.startswith((MANIFEST, EVENTS, f"{LINES}/"))]
    if changed:
        raise SessionFolderError(folder, f"{changed[0]} since SHA256SUMS was written; go on with an unchanged copy")
    session = SessionReader(folder)
    _check_resumable(session)
    parts = parts_of(session)
    runs = [run for part in parts for run in part.runs]
    told = next((run["estimate"] for run in reversed(runs) if "estimate" in run), {"n": 0, "posterior": 0.0})
    n, state = int(told["n"]), parts[-1].state if parts else ""
    settings, complete = _asked(session, asked_settings(session), lines, until, n, state, float(told["posterior"]))
    shape = stored_shape(session)
    dictionary = dictionary_with(shape, settings)
    earlier = _earlier(session, parts)
    settings = _to_come(settings, folder, earlier.t_s)
    if not complete:
        _check_same_bench(session, settings, shape, dictionary)
    return Unfinished(folder, settings, shape, dictionary, earlier, runs, n, complete)


def resume(
    unfinished: Unfinished,
    *,
    started: datetime,
    watch: Watcher | None = None,
    say: Callable[[str], None] = lambda _: None,
    live: Live | None = None,
) -> Finished:
    """Go on with a session, in its own folder.

    An interrupt or a failure after the folder was opened is returned, not raised.

    Raises:
        RequestError: the log does not add up to its own estimates.
        ChordlabError: nothing was recorded, since the preflight failed.
    """
    settings, earlier = unfinished.settings, unfinished.earlier
    recogniser = recogniser_of(unfinished.dictionary, settings, unfinished.shape.name, say)
    ledger, tally = Ledger(settings.stop, recogniser), tally_for(settings)
    take_up(unfinished.folder, unfinished.runs, ledger, tally)

    def reopen(bench: Bench, preflight: Preflight) -> SessionWriter:
        part = {
            "started": started.isoformat(timespec="seconds"),
            "t_s": asyncio.get_running_loop().time(),
            "devices": devices_of(settings, bench, preflight),
            "versions": versions(),
            "lines": settings.stop.lines,
            "until": settings.stop.until,
        }
        return SessionWriter.reopen(unfinished.folder, part)

    return conduct(settings, unfinished.shape, ledger, tally, reopen, earlier=earlier, watch=watch, say=say, live=live)


def take_up(folder: Path, runs: Iterable[Mapping[str, Any]], ledger: Ledger, tally: Tally) -> None:
    """Build the sums anew from the log, run by run, by the code that built them while it was rolled.

    Args:
        folder: the session's, for errors.
        runs: the records of its runs, in the order of the log.
        ledger: fresh.
        tally: fresh.

    Raises:
        SessionFolderError: a run's invariants or the estimate after it are not those of its crossings: the log was
            changed.
    """
    for run in runs:
        again = {name: value for name, value in run.items() if name != "estimate"}
        try:
            tally.take(again)
            ledger.enter(again, tally.n, tally.estimates)
            found = invariants_of((s_cm, entering) for _, s_cm, entering in run["crossings"])
            sound = found == (run["k"], run["l1_cm"], run["l3_cm3"])
            sound = sound and _alike(again.get("estimate"), run.get("estimate"))
        except (KeyError, TypeError, ValueError) as error:
            raise SessionFolderError(folder, f"the event of run {run.get('line')} is not whole ({error})") from error
        if not sound:
            raise SessionFolderError(
                folder, f"the log of run {run['line']} does not add up: it was changed; go on with an unchanged copy"
            )


def _alike(again: Mapping[str, Any] | None, stored: Mapping[str, Any] | None) -> bool:
    """Whether two estimates are the same. The name is left out: another release may recognise by better tables."""
    if again is None or stored is None:
        return again is stored
    return again["n"] == stored["n"] and all(_close(again[name], stored[name]) for name in _TOLD)


def _close(one: float | None, other: float | None) -> bool:
    if one is None or other is None:
        return one is other
    return math.isclose(one, other, rel_tol=_SAME, abs_tol=_SAME)


def _asked(
    session: SessionReader,
    settings: Settings,
    lines: int | None,
    until: float | None,
    n: int,
    state: str,
    posterior: float,
) -> tuple[Settings, str]:
    """The settings with what is asked of the part to come, and why that is there already, if it is."""
    last: Mapping[str, Any] = {"lines": settings.stop.lines, "until": settings.stop.until}
    for part in session.manifest.get("parts", []):
        last = {**last, **part}
    wanted = last["lines"] if lines is None else lines
    complete = f"complete already: {n} of {wanted} lines" if n >= wanted else ""
    if until is None:
        until = last["until"]
        if state == "recognised" and lines is not None:
            until = None  # it was reached; more lines are asked for all the same
        elif state == "recognised":
            complete = (
                f"recognised already, at {posterior:.3f} after {n} lines; ask for more --lines or a higher --until"
            )
    elif state == "recognised" and posterior >= until:
        complete = f"recognised already, at {posterior:.3f} after {n} lines"
    stop = {**settings.stop.model_dump(), "lines": wanted, "until": until}
    return parse_settings({**session.manifest["settings"], "stop": stop}, origin=str(session.folder)), complete


def _to_come(settings: Settings, folder: Path, t_s: float) -> Settings:
    """The settings of the part to come: what befell the virtual robots before ``t_s`` does not befall them again."""
    faults = tuple(
        fault.model_copy(update={"at_s": fault.at_s - t_s}) for fault in settings.virtual.faults if fault.at_s >= t_s
    )
    virtual = settings.virtual.model_copy(update={"faults": faults})
    return settings.model_copy(update={"virtual": virtual, "out": folder.parent})


def _earlier(session: SessionReader, parts: Sequence[Part]) -> Earlier:
    """What the session has behind it."""
    lines, films = [-1], [-1]
    for name in _names_seen(session):
        if (found := _NUMBERED.match(name)) is not None:
            (films if found[1] else lines).append(int(found[2]))
    lines += [int(run["line"]) for part in parts for run in part.runs]
    return Earlier(
        # A part may have been cut before its start came into the log, or after, before the manifest was written.
        part=max(1 + len(session.manifest.get("parts", [])), len(parts)),
        runs=sum(len(part.runs) for part in parts),
        next_line=max(lines) + 1,
        next_film=max(films) + 1,
        rolling_s=sum(part.rolling_s for part in parts),
        t_s=max((part.t_end_s for part in parts), default=0.0),
    )


def _names_seen(session: SessionReader) -> Iterator[str]:
    """The names of all runs and pieces of film that ever began: in the folder, or set aside when it was mended."""
    yield from (path.name for path in session.path(LINES).iterdir())
    for event in session.events():
        if event["event"] == "recover":
            yield from (str(line) for line in event.get("lost_lines", []))
            yield from (Path(name).name for name in event.get("set_aside", []))


def _check_resumable(session: SessionReader) -> None:
    """Refuse what cannot go on soundly."""
    folder, settings = session.folder, asked_settings(session)
    if session.schema_version != SCHEMA_VERSION:
        raise SessionFolderError(
            folder, f"is of the older schema {session.schema_version} and is never written to; run a new session"
        )
    if reason := cannot_go_on(settings):
        raise SessionFolderError(folder, reason)


def _check_same_bench(
    session: SessionReader, settings: Settings, shape: Shape, dictionary: Mapping[str, Shape]
) -> None:
    """Refuse a bench that the parts before would not be comparable with: files that the settings name may change."""
    manifest = session.manifest
    try:
        before = {
            "the projected shape": manifest["shape"]["digest"],
            "the dictionary or its font": manifest["dictionary"],
            "the robot profile": manifest["devices"]["profile"],
            "the calibration": manifest["calibration"],
        }
    except (KeyError, TypeError) as error:
        raise SessionFolderError(session.folder, f"its manifest is not whole ({error!r})") from error
    now = {
        "the projected shape": shape.digest,
        "the dictionary or its font": {name: entry.digest for name, entry in sorted(dictionary.items())},
        "the robot profile": asdict(settings.profile()),
        "the calibration": calibration_of(settings),
    }
    for what, then in before.items():
        if json.loads(to_json(now[what])) != then:
            raise RequestError(
                f"{session.folder}: {what} is not what the session began with; put it back, or run a new session"
            )
