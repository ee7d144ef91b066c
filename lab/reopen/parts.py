"""The parts of a stored session: one from its beginning, and one more for each time that it was resumed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lab.store.layout import SessionFolderError
from lab.store.reader import SessionReader

Record = dict[str, Any]


@dataclass(slots=True)
class Part:
    """What the log tells between a ``start`` and the next one.

    Attributes:
        number: from 0.
        levels: of its ``start`` event: for each robot the light levels that were learnt for this part.
        t_start_s: when it began, s of the session's clock.
        t_end_s: the last time that the log tells of it.
        state: how it ended; empty where the log does not say, since it was cut.
        runs: its runs' records, in the order of the log.
    """

    number: int
    levels: list[dict[str, Any] | None]
    t_start_s: float
    t_end_s: float
    state: str = ""
    runs: list[Record] = field(default_factory=list[Record])

    @property
    def rolling_s(self) -> float:
        """How long it lasted, s."""
        return self.t_end_s - self.t_start_s


def parts_of(session: SessionReader) -> list[Part]:
    """The parts of a session, from its log; none where it was cut before its first run began.

    Raises:
        SessionFolderError: the log tells of a run before any start, or an event lacks its time.
    """
    parts: list[Part] = []
    for event in session.events():
        try:
            if event["event"] == "start":
                t_s = float(event["t_s"])
                parts.append(Part(len(parts), list(event["levels"]), t_s, t_s))
            elif event["event"] == "line":
                parts[-1].runs.append(event)
                parts[-1].t_end_s = max(parts[-1].t_end_s, float(event["t_end_s"]))
            elif parts and "t_s" in event:
                parts[-1].t_end_s = max(parts[-1].t_end_s, float(event["t_s"]))
            if parts and event["event"] == "end":
                parts[-1].state = str(event["state"])
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise SessionFolderError(
                session.folder, f"the log's event {event['event']!r} is not whole ({error!r}); the file was changed"
            ) from error
    return parts


def part_of_runs(session: SessionReader) -> dict[int, int]:
    """The number of the part that each run was rolled in; empty for a session that was never resumed."""
    if not session.manifest.get("parts"):
        return {}
    return {int(run["line"]): part.number for part in parts_of(session) for run in part.runs}


@dataclass(frozen=True, slots=True)
class LearntLevels:
    """The light levels of a session's shape, as each of its parts learnt them.

    Attributes:
        by_part: for each part by robot; those of the first robot also under the empty name.
        part_of: the part of each run; empty in a session of one part.
    """

    by_part: tuple[Mapping[str, Mapping[str, float]], ...]
    part_of: Mapping[int, int]

    @classmethod
    def of(cls, session: SessionReader) -> LearntLevels:
        """What a session's manifest and, where it was resumed, its log say."""
        manifest = session.manifest
        robots = manifest.get("devices", {}).get("robots", [])
        first = {robot["name"]: robot["levels"]["shape"] for robot in robots if robot.get("levels")}
        if manifest.get("levels"):
            first[""] = manifest["levels"]
        part_of = part_of_runs(session)
        if not part_of:
            return cls((first,), {})
        names = [*(robot["name"] for robot in robots), ""]
        later = [
            {
                name: levels["shape"]
                for name, levels in zip(names, [*part.levels, *part.levels[:1]], strict=False)
                if levels is not None
            }
            for part in parts_of(session)[1:]
        ]
        return cls((first, *later), part_of)

    def get(self, line: int, robot: str) -> Mapping[str, float] | None:
        """The levels that a run's crossings were found with; None where they are not known."""
        levels = self.by_part[self.part_of.get(line, 0)]
        return levels.get(robot, levels.get(""))
