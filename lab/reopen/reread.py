"""A stored session read again from its raw light, with its own thresholds or others.

The detector, the sums and the recogniser are those of a live session: with the session's own levels the tables are
those of its log, bit for bit, and with others they are what that session would have found.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from lab.base.errors import RequestError
from lab.recognise.recognisers import recogniser_for
from lab.reopen.rerun import Rerun
from lab.reopen.stored import stored_shape
from lab.session.experiment import dictionary_with
from lab.session.ledger import Ledger
from lab.session.levels import SessionLevels
from lab.session.tally import tally_for
from lab.store.reader import SessionReader
from lab.store.tables import Tables, tables_from
from robot.crossings import Levels

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Where light and dark are confirmed, as shares of the span between the session's own dark and bright levels.

    Raises:
        RequestError: they do not lie on either side of the middle, where the crossings are placed.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        if not 0 < self.low < 0.5 < self.high < 1:
            raise RequestError(
                f"thresholds at {self.low:g} and {self.high:g} of the span: the low one must lie between 0 and 0.5, "
                "the high one between 0.5 and 1"
            )

    def of(self, levels: SessionLevels) -> SessionLevels:
        """These thresholds between a session's levels. A ring of light keeps its own."""
        shape = self._between(levels.shape)
        edge = levels.edge
        return SessionLevels(shape, None if edge is None else replace(edge, shape=self._between(edge.shape)))

    def _between(self, levels: Levels) -> Levels:
        span_lux = levels.bright_lux - levels.dark_lux
        return replace(
            levels, low_lux=levels.dark_lux + self.low * span_lux, high_lux=levels.dark_lux + self.high * span_lux
        )


def reread(
    folder: Path,
    *,
    levels: Mapping[str, SessionLevels] | None = None,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
) -> Tables:
    """Make a session's tables from its raw samples. Nothing is written.

    Args:
        folder: a session folder.
        levels: other light levels, by the robot's name; none: those that the session went by, of each part its own.
        thresholds: other thresholds between the levels.
        progress: told how many runs of how many are read.

    Returns:
        The tables. What the light does not decide (bumps, stalls, where a leg was to stop) is as in the log.

    Raises:
        SessionFolderError: it is no session, it is not whole, or it holds no raw samples.
        RequestError: ``levels`` names a robot that did not roll.
    """
    session = SessionReader(folder)
    rerun = Rerun(session)
    for name in levels or {}:
        if name not in rerun.names:
            raise RequestError(f"{folder}: no robot {name} rolled in it; its robots: {', '.join(rerun.names)}")
    return tables_from(_records(rerun, levels or {}, thresholds, progress), folder)


def _records(
    rerun: Rerun, levels: Mapping[str, SessionLevels], thresholds: Thresholds | None, progress: Progress | None
) -> Generator[dict[str, Any]]:
    """The log's records of the runs, as they would be."""
    settings, shape = rerun.settings, stored_shape(rerun.session)
    recogniser = recogniser_for(dictionary_with(shape, settings), settings, called=shape.name)
    ledger, tally = Ledger(settings.stop, recogniser), tally_for(settings)
    total = sum(event["event"] == "line" for event in rerun.session.events()) if progress is not None else 0
    for done, line in enumerate(rerun.lines(), start=1):
        own = levels.get(rerun.names[line.robot], line.levels)
        own = own if thresholds is None else thresholds.of(own)
        run = rerun.roll(line, own)
        # What no sample tells of the length is the log's; the light can only move its ends.
        moved_cm = 0.0 if own == line.levels else run.length_cm - rerun.roll(line, line.levels).length_cm
        record = {
            **line.event,
            **run.record(),
            "length_cm": line.event["length_cm"] + moved_cm,
            **asdict(tally.add(run)),
        }
        record.pop("estimate", None)
        ledger.enter(record, tally.n, tally.estimates)
        yield record
        if progress is not None:
            progress(done, total)


def figures_of(tables: Tables) -> dict[str, float | int | None]:
    """What a session's tables come to: A in cm², P in cm, crossings, and lines that crossed the shape."""
    estimates = tables.estimates
    last: Any = estimates.iloc[-1] if len(estimates) else None
    return {
        "area_cm2": None if last is None else float(last["area_cm2"]),
        "perimeter_cm": None if last is None else float(last["perimeter_cm"]),
        "crossings": len(tables.crossings),
        "lines": len(estimates),
    }
