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

from lab.base.colours import led_rgb
from lab.base.errors import ChordlabError
from lab.bench.devices import SETTLE_S, Bench
from lab.bench.pictures import Picture
from lab.bench.rigcheck import check_bench
from lab.live.live import Live
from lab.session.ledger import Ledger, Watcher
from lab.session.levels import PlainLight, SessionLevels
from lab.session.roller import Roller, SessionError
from lab.session.run import Run
from lab.session.tally import Tally
from lab.settings.settings import Settings
from lab.store.writer import SessionWriter
from robot.device import Identity
from robot.errors import ReconnectError
from robot.turning import Leg
from tracking.recorder import Recorder

_log = logging.getLogger(__name__)

LEVEL_SAMPLES = 20
CONTACT_WINDOW_S = 0.05  # two reports of one contact, each with its latency; wider, walls met at once count too


@dataclass(frozen=True, slots=True)
class Preflight:
    """What the devices said before the first run, robot by robot."""

    identities: tuple[Identity, ...]
    levels: tuple[SessionLevels, ...]
    light: tuple[PlainLight, ...]

    def began(self, t_s: float, part: int) -> dict[str, Any]:
        """What the log's ``start`` event holds of it."""
        told = {
            "t_s": t_s,
            "levels": [asdict(levels) for levels in self.levels],
            "light": [asdict(light) for light in self.light],
        }
        return told | {"resumed": True, "part": part} if part else told


@dataclass(frozen=True, slots=True)
class Earlier:
    """What a session that is resumed has behind it.

    Attributes:
        part: the number of the part to come.
        runs: how many there were.
        next_line: a number above that of every run that ever began.
        next_film: the same of the film of several robots.
        rolling_s: how long its parts lasted.
        t_s: the last time that they tell.
    """

    part: int = 0
    runs: int = 0
    next_line: int = 0
    next_film: int = 0
    rolling_s: float = 0.0
    t_s: float = 0.0


NOTHING_EARLIER = Earlier()


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
        ledger: what it knows so far.
        tally: the sums, the same lines in them.
        rngs: one source of turns for each robot.
        watch: told where the session stands, after each run.
        say: told in words what befalls the robots.
        earlier: what it goes on from.
        live: what people ask of it meanwhile, and are shown.
    """

    def __init__(
        self,
        bench: Bench,
        settings: Settings,
        ledger: Ledger,
        tally: Tally,
        rngs: Sequence[np.random.Generator],
        *,
        watch: Watcher | None = None,
        say: Callable[[str], None] = lambda _: None,
        earlier: Earlier = NOTHING_EARLIER,
        live: Live | None = None,
    ) -> None:
        self._bench = bench
        self._settings = settings
        self._ledger = ledger
        self._tally = tally
        self._watch = watch
        self._say = say
        self._earlier = earlier
        live = live or Live()
        self._controls = live.controls
        self._rollers = [
            Roller(robot, settings, bench.cruising_cm_s, rng, led_rgb(settings.led_colour(number)), self._noted)
            for number, (robot, rng) in enumerate(zip(bench.robots, rngs, strict=True))
        ]
        if live.feed.watched:
            for roller in self._rollers:
                roller.onlooker = live.feed.sample
        self._writer: SessionWriter | None = None
        self._runs = 0
        self._film_part = earlier.next_film
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
        light = tuple(
            PlainLight(floor[i], lit[i], None if ring is None else ring[i]) for i in range(len(self._rollers))
        )
        levels = tuple(own.levels() for own in light)
        await check_bench(self._bench, self._settings)
        self._bench.show(pictures.shape)
        await asyncio.sleep(SETTLE_S)
        return Preflight(identities, levels, light)

    async def roll(self, writer: SessionWriter, preflight: Preflight) -> Outcome:
        """Roll until the session's end, each run committed to ``writer`` before the next begins.

        On every way out, cancellation included, the robots are stopped and the log says how it ended.

        Raises:
            ChordlabError: no robot is left that can go on, or a device failed.
        """
        loop = asyncio.get_running_loop()
        t_start_s = loop.time()
        self._writer = writer
        writer.append("start", **preflight.began(t_start_s, self._earlier.part))
        if self._bench.recorder is not None and self._films_all:
            await self._bench.recorder.open_segment(writer.film_path(self._film_part))
        leds = [asyncio.create_task(roller.follow_with_led()) for roller in self._rollers]
        rolling = [
            asyncio.create_task(self._keep_rolling(roller, levels), name=roller.name)
            for roller, levels in zip(self._rollers, preflight.levels, strict=True)
        ]
        try:
            with self._controls.attending(len(rolling), self._logged):
                if not await self._controls.unless_stopped(self._until_done(rolling)) and self._state == "failed":
                    self._state = "stopped"
        except asyncio.CancelledError:
            self._state = "interrupted"
            raise
        finally:
            for task in (*leds, *rolling):
                task.cancel()
            # Shielded, so that a second Ctrl-C cannot leave a robot rolling.
            await asyncio.shield(self._come_to_rest(rolling))
            earlier = self._earlier
            rolling_s = earlier.rolling_s + loop.time() - t_start_s
            outcome = Outcome(self._state, earlier.runs + self._runs, self._ledger.n, rolling_s)
            writer.append("end", t_s=loop.time(), **asdict(outcome))
            writer.finish(asdict(outcome))
        return outcome

    async def _until_done(self, rolling: list[asyncio.Task[None]]) -> None:
        """Wait until enough is rolled. A robot that is lost for good leaves the rest to the others, if any."""
        left = set(rolling)
        while self._state == "failed":
            if not left:  # no robot has runs left: a replay has come to its end
                self._state = "replayed"
                return
            done, left = await asyncio.wait(left, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                error = task.exception()
                if error is not None and (not left or not isinstance(error, ReconnectError)):
                    raise error
                if error is not None:
                    self._noted("gone", f"{error}; the others go on", robot=task.get_name())

    async def _keep_rolling(self, roller: Roller, levels: SessionLevels) -> None:
        """Roll one robot's legs until the session has enough."""
        try:
            await self._roll_legs(roller, roller.begin(levels))
        finally:
            self._controls.left()

    async def _roll_legs(self, roller: Roller, leg: Leg) -> None:
        while self._state == "failed" and not roller.used_up:
            line, self._runs = self._earlier.next_line + self._runs, self._runs + 1
            run = await self._one_run(roller, leg, line)
            self._bench.check_light()
            self._state = self._ledger.reason_to_stop() or self._state
            if self._state == "failed" and not roller.used_up:
                paused = await self._controls.between_runs()
                leg = await roller.next_leg(run, moved=paused)

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
        record = {**run.record(), **asdict(self._tally.add(run)), "video": video}
        self._ledger.enter(record, self._tally.n, self._tally.estimates)
        writer.append("line", **record)

    def _noted(self, kind: str, text: str, **data: object) -> None:
        """Put what befell a robot into the log, and say it."""
        self._say(text)
        self._logged(kind, **data)

    def _logged(self, kind: str, **data: object) -> None:
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
