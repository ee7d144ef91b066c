"""A session: preflight, then run after run (drive, collect, estimate, sync to disk) until it is time to stop.

The same code runs on hardware and on the virtual bench; only the devices and the loop's clock differ.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from analysis.recognition import Recogniser
from lab.base.colours import led_rgb
from lab.base.errors import ChordlabError
from lab.bench import SETTLE_S, Bench
from lab.ledger import Ledger, Watcher
from lab.pictures import Picture
from lab.rigcheck import check_bench
from lab.roller import Roller, SessionError, SessionLevels
from lab.run import Run
from lab.settings import Settings
from lab.store import SessionWriter
from lab.tally import tally_for
from robot.crossings import learn_levels
from robot.device import Identity
from robot.edge import learn_edge_levels
from robot.errors import ReconnectError
from robot.turning import Leg
from tracking.recorder import Recorder

_log = logging.getLogger(__name__)

LEVEL_SAMPLES = 20
CONTACT_WINDOW_S = 0.05  # two reports of one contact, each with its latency; wider, walls met at once count too


@dataclass(frozen=True, slots=True)
class Preflight:
    """What the devices said before the first run; a robot that estimates by itself keeps its levels to itself."""

    identities: tuple[Identity, ...]
    levels: tuple[SessionLevels | None, ...]


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a session ended."""

    state: str
    runs: int
    n: int
    rolling_s: float


class Session:
    """One session on an open bench, with one robot or several.

    Args:
        bench: the devices.
        settings: the session's.
        recogniser: fed with each line.
        rngs: one source of turns for each robot.
        watch: told where the session stands, after each run.
        say: told in words what befalls the robots.
    """

    def __init__(
        self,
        bench: Bench,
        settings: Settings,
        recogniser: Recogniser,
        rngs: Sequence[np.random.Generator],
        *,
        watch: Watcher | None = None,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._bench = bench
        self._settings = settings
        self._ledger = Ledger(settings.stop, recogniser)
        self._watch = watch
        self._say = say
        self._tally = tally_for(settings)
        self._rollers = [
            Roller(robot, settings, bench.cruising_cm_s, rng, led_rgb(settings.led_colour(number)), self._noted)
            for number, (robot, rng) in enumerate(zip(bench.robots, rngs, strict=True))
        ]
        self._writer: SessionWriter | None = None
        self._runs = 0
        self._film_part = 0
        self._committing_run = asyncio.Lock()
        self._state = "failed"

    async def preflight(self) -> Preflight:
        """Connect, check the batteries, learn the light levels from plain fields of light.

        Raises:
            RobotError: a robot is not to be had.
            SessionError: a battery is low or no light samples come.
            LevelsError: the levels do not separate.
        """
        identities = tuple([await roller.connect() for roller in self._rollers])
        pictures = self._bench.pictures
        floor = await self._light_of(pictures.floor)
        lit = await self._light_of(pictures.lit)
        ring = None if pictures.ring is None else await self._light_of(pictures.ring)
        levels = tuple(
            SessionLevels(
                learn_levels(floor[i], lit[i]), None if ring is None else learn_edge_levels(floor[i], lit[i], ring[i])
            )
            for i in range(len(self._rollers))
        )
        await check_bench(self._bench, self._settings)
        self._bench.show(pictures.shape)
        await asyncio.sleep(SETTLE_S)
        return Preflight(identities, levels)

    async def roll(self, writer: SessionWriter, preflight: Preflight) -> Outcome:
        """Roll until the session's end, each run committed to ``writer`` before the next begins.

        On every way out, cancellation included, the robots are stopped and the log says how it ended.

        Raises:
            ChordlabError: no robot is left that can go on, or a device failed.
        """
        loop = asyncio.get_running_loop()
        t_start_s = loop.time()
        self._writer = writer
        writer.append("start", t_s=t_start_s, levels=[levels and asdict(levels) for levels in preflight.levels])
        if self._bench.recorder is not None and self._films_all:
            await self._bench.recorder.open_segment(writer.film_path(self._film_part))
        leds = [asyncio.create_task(roller.follow_with_led()) for roller in self._rollers]
        rolling = [
            asyncio.create_task(self._keep_rolling(roller, levels), name=roller.name)
            for roller, levels in zip(self._rollers, preflight.levels, strict=True)
            if levels is not None
        ]
        try:
            await self._until_done(rolling)
        except asyncio.CancelledError:
            self._state = "interrupted"
            raise
        finally:
            for task in (*leds, *rolling):
                task.cancel()
            # Shielded, so that a second Ctrl-C cannot leave a robot rolling.
            await asyncio.shield(self._come_to_rest(rolling))
            outcome = Outcome(self._state, self._runs, self._ledger.n, loop.time() - t_start_s)
            writer.append("end", t_s=loop.time(), **asdict(outcome))
            writer.finish(asdict(outcome))
        return outcome

    async def _until_done(self, rolling: list[asyncio.Task[None]]) -> None:
        """Wait until enough is rolled. A robot that is lost for good leaves the rest to the others, if any."""
        left = set(rolling)
        while self._state == "failed":
            done, left = await asyncio.wait(left, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                error = task.exception()
                if error is not None and (not left or not isinstance(error, ReconnectError)):
                    raise error
                if error is not None:
                    self._noted("gone", f"{error}; the others go on", robot=task.get_name())

    async def _keep_rolling(self, roller: Roller, levels: SessionLevels) -> None:
        """Roll one robot's legs until the session has enough."""
        leg = roller.begin(levels)
        while self._state == "failed":
            line, self._runs = self._runs, self._runs + 1
            run = await self._one_run(roller, leg, line)
            self._bench.check_light()
            self._state = self._ledger.reason_to_stop() or self._state
            if self._state == "failed":
                leg = await roller.next_leg(run)

    async def _one_run(self, roller: Roller, leg: Leg, line: int) -> Run:
        """Roll one leg, filmed where there is a camera, and commit it."""
        recorder, writer = self._bench.recorder, self._committing
        if recorder is not None and not self._films_all:
            await recorder.open_segment(writer.video_path(line))
        run = await roller.roll_leg(leg, line)
        if run.ended == "bump" and self._met_another(roller, run.t_end_s):
            run.ended = "contact"
        async with self._committing_run:
            video = None if recorder is None else await self._cut_film(recorder, writer, line)
            writer.commit_line(line, run.light())
            self._conclude(writer, run, video)
        if self._watch is not None:
            self._watch(self._ledger.progress(self._tally.estimates, run.line, run.t_end_s, roller.battery_v))
        return run

    @property
    def _films_all(self) -> bool:
        """Whether the film runs on from run to run, since the runs of several robots overlap."""
        return len(self._rollers) > 1

    async def _cut_film(self, recorder: Recorder, writer: SessionWriter, line: int) -> dict[str, int] | None:
        """Close the video of the run that has ended; of several robots' film, what was filmed since the last cut."""
        if self._films_all:
            segment = await recorder.open_segment(writer.film_path(self._film_part + 1))
            writer.adopt_film(self._film_part, line)
            self._film_part += 1
        else:
            segment = await recorder.close_segment()
        return None if segment is None else {
            "frames": segment.frames, "dropped": segment.dropped, "late": segment.late
        }  # fmt: skip

    @property
    def _committing(self) -> SessionWriter:
        if self._writer is None:
            raise SessionError("the session has no folder yet; call roll with one")
        return self._writer

    def _met_another(self, roller: Roller, t_s: float) -> bool:
        """Two robots that bump at the same time have met each other; a wall is hit alone."""
        return any(abs(other.bumped_s - t_s) < CONTACT_WINDOW_S for other in self._rollers if other is not roller)

    def _conclude(self, writer: SessionWriter, run: Run, video: dict[str, int] | None) -> None:
        """Estimate from a finished run and put it into the log."""
        line = self._tally.add(run)
        record: dict[str, Any] = {
            "line": run.line,
            "robot": run.robot,
            "t_start_s": run.t_start_s,
            "t_rolling_s": run.t_rolling_s,
            "t_end_s": run.t_end_s,
            "length_cm": run.length_cm,
            "end_cm": run.path_cm(run.t_end_s),
            "speed_cm_s": run.rolled_cm / (run.t_end_s - run.t_start_s) if run.t_end_s > run.t_start_s else 0.0,
            "heading_rad": run.leg.heading_rad,
            "normal_heading_rad": run.normal_heading_rad,
            "ended": run.ended,
            "starts_lit": run.starts_lit,
            "ends_lit": run.ends_lit,
            "whole": run.is_line,
            **asdict(line),
            "video": video,
            "crossings": [[crossing.t_s, crossing.s_cm, crossing.entering] for crossing in run.crossings],
        }
        if line.counts and line.k:
            self._ledger.n = self._tally.n
            if run.is_line:  # a line cut short would look like another shape's
                self._ledger.recogniser.update(line.k, line.l1_cm, line.l3_cm3, line.weight)
            record["estimate"] = self._ledger.estimate(self._tally.estimates)
        writer.append("line", **record)

    def _noted(self, kind: str, text: str, **data: object) -> None:
        """Put what befell a robot into the log, and say it."""
        self._say(text)
        self._committing.append(kind, t_s=asyncio.get_running_loop().time(), **data)

    async def _light_of(self, picture: Picture) -> list[list[float]]:
        """Each robot's light samples, in lux, under a picture that fills the arena."""
        self._bench.show(picture)
        await asyncio.sleep(SETTLE_S)
        return await asyncio.gather(*(roller.light(LEVEL_SAMPLES) for roller in self._rollers))

    async def _come_to_rest(self, rolling: list[asyncio.Task[None]]) -> None:
        """Stop the robots and close the camera's segment, whatever state they are in."""
        await asyncio.gather(*rolling, return_exceptions=True)
        await asyncio.gather(*(roller.halt() for roller in self._rollers))
        recorder = self._bench.recorder
        if recorder is not None and recorder.segment is not None:
            try:
                await recorder.close_segment()
            except ChordlabError as error:  # the log must still say how the session ended
                _log.error("the last video segment is lost: %s", error)
        if recorder is not None and self._films_all:
            self._committing.drop_film(self._film_part)
