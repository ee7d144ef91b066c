"""The runs of a stored session, made again from their raw samples by the code that made them live."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import pandas as pd

from lab.base.errors import ChordlabError
from lab.reopen.stored import stored_settings
from lab.session.levels import SessionLevels
from lab.session.run import Run
from lab.settings.settings import Settings
from lab.store.layout import LIGHT, SessionFolderError
from lab.store.reader import SessionReader, numbers_of
from robot.crossings import CrossingDetector, Levels
from robot.device import Sample
from robot.edge import EdgeLevels, RingedDetector
from robot.turning import Leg

BUMPS = ("bump", "contact")


@dataclass(frozen=True, slots=True, eq=False)
class StoredLine:
    """A run as it lies in the folder.

    Attributes:
        event: its record in the log.
        light: its raw samples, the columns of `Sample`.
        robot: which of the session's robots rolled it, from 0.
        part: of which part of the session it is, from 0.
        levels: the light levels that it was read with.
    """

    event: dict[str, Any]
    light: pd.DataFrame
    robot: int
    part: int
    levels: SessionLevels

    def samples(self) -> list[Sample]:
        """The raw samples as they came."""
        columns = (self.light[name].tolist() for name in Sample.__slots__)
        return [Sample(*row) for row in zip(*columns, strict=True)]


class Rerun:
    """Makes the runs of one stored session again.

    Raises:
        SessionFolderError: its robot estimated by itself and left no raw samples, or the manifest is not whole.
    """

    def __init__(self, session: SessionReader) -> None:
        self.session = session
        self.settings: Settings = stored_settings(session)
        if self.settings.robots[0].startswith("onboard:"):
            raise SessionFolderError(
                session.folder,
                "its robot estimated by itself and left no raw samples; read its lines with chordlab validate",
            )
        try:
            devices: Any = session.manifest["devices"]
            self.names = [str(robot["name"]) for robot in devices["robots"]]
            if "cruising_cm_s" in devices:
                self.cruising_cm_s = float(devices["cruising_cm_s"])
            else:  # an old folder
                self.cruising_cm_s = self.settings.profile().cruising_cm_s(self.settings.motion.speed_cm_s)
            self._light_latency_s = float(devices["profile"]["light_latency_s"]) if "profile" in devices else 0.0
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise SessionFolderError(session.folder, f"the manifest's devices are not whole ({error!r})") from error

    def lines(self) -> Iterator[StoredLine]:
        """The runs in the log's order.

        Raises:
            SessionFolderError: raw samples or an event are missing or not whole.
        """
        levels: list[SessionLevels | None] = []
        part = -1
        for event in self.session.events():
            try:
                if event["event"] == "start":
                    levels = [None if own is None else session_levels(own) for own in event["levels"]]
                    part += 1
                elif event["event"] == "line":
                    robot = self.names.index(event["robot"]) if event["robot"] else 0
                    own = levels[robot]
                    if own is None:
                        raise ValueError("its light levels are not known")
                    yield StoredLine(event, self._light(int(event["line"])), robot, part, own)
            except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
                what = f"of line {event.get('line')}" if event["event"] == "line" else f"'{event['event']}'"
                raise SessionFolderError(self.session.folder, f"the event {what} is not whole ({error})") from error

    def roll(self, line: StoredLine, levels: SessionLevels) -> Run:
        """Make a run again as a live one would have been with these levels.

        What the light does not decide stays as it was: bumps, stops, stalls and their times. The way by the odometer
        beyond what samples tell (a rest after a bump, the run-up from an edge of light) is taken from the log.

        Raises:
            SessionFolderError: the event is not whole.
        """
        stored_cm = line.event.get("length_cm")
        if not isinstance(stored_cm, (int, float)):
            raise SessionFolderError(self.session.folder, f"the event of line {line.event.get('line')} has no length")
        samples = line.samples()
        if line.event["ended"] in BUMPS:
            return self._fed(line, levels, samples, 0.0, float(stored_cm))
        seen_cm = self._fed(line, line.levels, samples, 0.0).length_cm
        return self._fed(line, levels, samples, max(0.0, float(stored_cm) - seen_cm))

    def _fed(
        self,
        line: StoredLine,
        levels: SessionLevels,
        samples: list[Sample],
        run_up_cm: float,
        length_cm: float | None = None,
    ) -> Run:
        event, settings = line.event, self.settings
        normal: Any = event.get("normal_heading_rad")
        run = Run(
            event["line"],
            event["robot"],
            # whether a leg measures is known of those that came to the edge; others are no lines anyhow
            Leg(event.get("heading_rad", 0.0), None, measures=bool(event["whole"])),
            event["t_start_s"],
            self.cruising_cm_s,
            settings.motion.length_from == "odometry",
            CrossingDetector(levels.shape)
            if levels.edge is None
            else RingedDetector(levels.edge, light_latency_s=self._light_latency_s),
            run_up_cm,
            settings.arena.longest_line_cm,
            normal_heading_rad=normal,
        )
        for sample in samples:
            run.feed(sample)
            if run.entered is not None:
                run.finish(run.entered.t_s, "edge")
                break
        else:
            run.finish(event["t_end_s"], event["ended"])
        if length_cm is not None and samples:
            origin = run.left or samples[0]
            run.at_rest = Sample(run.t_end_s, samples[-1].light_lux, origin.x_cm + length_cm, origin.y_cm, 0.0)
        return run

    def _light(self, number: int) -> pd.DataFrame:
        return numbers_of(self.session.line_path(number, LIGHT), tuple(Sample.__slots__))


def session_levels(stored: Any) -> SessionLevels:
    """Light levels as the log keeps them. Raises KeyError, TypeError or ValueError where they are not whole."""
    try:
        found = cast("dict[str, Any]", stored)
        edge = found.get("edge")
        return SessionLevels(
            Levels(**found["shape"]),
            None
            if edge is None
            else EdgeLevels(shape=Levels(**edge["shape"]), ring=Levels(**edge["ring"]), bright=bool(edge["bright"])),
        )
    except ChordlabError as error:  # levels that do not rise
        raise ValueError(str(error)) from error
