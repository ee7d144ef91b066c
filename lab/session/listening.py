"""A session with a robot that estimates by itself: it rolls alone, and what it tells after each line is kept."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd

from lab.base.errors import ChordlabError
from lab.bench.devices import SETTLE_S, Bench
from lab.bench.pictures import Picture
from lab.bench.rigcheck import check_bench
from lab.live.live import Live
from lab.session.ledger import Ledger, Watcher
from lab.session.levels import PlainLight
from lab.session.roller import SessionError
from lab.session.session import LEVEL_SAMPLES, Outcome, Preflight
from lab.settings.settings import Settings
from lab.store.writer import SessionWriter
from robot.backoff import persist
from robot.device import Sample
from robot.errors import RobotError
from robot.onboard import Estimator
from robot.selfguided import OnboardLine, SelfGuided


@dataclass(slots=True)
class _Own:
    """The robot's own area and perimeter, with errors from the same lines added up here."""

    sums: Estimator
    area_cm2: float = math.nan
    perimeter_cm: float = math.nan

    def area(self) -> float:
        return self.area_cm2

    def perimeter(self) -> float:
        return self.perimeter_cm

    def sigma_area(self) -> float:
        return self.sums.sigma_area()

    def sigma_perimeter(self) -> float:
        return self.sums.sigma_perimeter()

    def correlation(self) -> float:
        return self.sums.correlation()


class Listening:
    """One session on an open bench whose robot needs no host to drive.

    Args:
        bench: the devices.
        guest: the robot.
        settings: the session's.
        ledger: what it knows so far.
        seed: of the robot's turns.
        watch: told where the session stands, after each line.
        say: told in words what befalls the robot.
        live: what people ask of it meanwhile, and are shown. A robot that rolls alone cannot be paused.
    """

    def __init__(
        self,
        bench: Bench,
        guest: SelfGuided,
        settings: Settings,
        ledger: Ledger,
        seed: np.random.SeedSequence,
        *,
        watch: Watcher | None = None,
        say: Callable[[str], None] = lambda _: None,
        live: Live | None = None,
    ) -> None:
        self._bench = bench
        self._guest = guest
        self._settings = settings
        self._seed = seed
        self._watch = watch
        self._say = say
        self._ledger = ledger
        self._controls = (live or Live()).controls
        self._state, self._runs = "failed", 0
        self._own = _Own(Estimator())
        self._battery_v = math.nan
        self._heard: asyncio.Queue[OnboardLine | str] = asyncio.Queue()

    async def preflight(self) -> Preflight:
        """Connect, and learn the light levels, in the robot's own unit, from plain fields of light.

        Raises:
            RobotError: the robot is not to be had.
            LevelsError: the levels do not separate.
        """
        guest, pictures = self._guest, self._bench.pictures
        guest.on_line, guest.on_lost = self._heard.put_nowait, self._heard.put_nowait
        await guest.connect()
        identity = await guest.identity()
        self._battery_v = identity.battery_v
        light = PlainLight(await self._light_of(pictures.floor), await self._light_of(pictures.lit), None)
        levels = light.levels()
        await check_bench(self._bench, self._settings)
        self._bench.show(pictures.shape)
        await asyncio.sleep(SETTLE_S)
        return Preflight((identity,), (levels,), (light,))

    async def roll(self, writer: SessionWriter, preflight: Preflight) -> Outcome:
        """Listen until the session's end. On every way out the robot is told to stop, and the log says how it ended.

        Raises:
            ChordlabError: the robot was lost and did not come back, or a device failed.
        """
        loop = asyncio.get_running_loop()
        t_start_s = loop.time()
        writer.append("start", **preflight.began(t_start_s, 0))

        def log(kind: str, **data: object) -> None:
            writer.append(kind, t_s=loop.time(), **data)

        try:
            seed = int(self._seed.generate_state(1, np.uint32)[0])
            await self._guest.start(self._settings.motion.speed_cm_s, seed, preflight.levels[0].shape)
            with self._controls.attending(1, log):
                if not await self._controls.unless_stopped(self._until_done(writer)) and self._state == "failed":
                    self._state = "stopped"
        except asyncio.CancelledError:
            self._state = "interrupted"
            raise
        finally:
            await asyncio.shield(self._let_rest())
            outcome = Outcome(self._state, self._runs, self._ledger.n, loop.time() - t_start_s)
            writer.append("end", t_s=loop.time(), lost_lines=self._guest.lost_lines, **asdict(outcome))
            writer.finish(asdict(outcome))
        return outcome

    async def _until_done(self, writer: SessionWriter) -> None:
        """Take line after line until the session has enough."""
        while self._state == "failed":
            await self._film(writer, self._runs)
            line = await self._next(writer)
            await self._keep(writer, line, self._runs)
            self._bench.check_light()
            self._runs += 1
            self._state = self._ledger.reason_to_stop() or self._state

    async def _next(self, writer: SessionWriter) -> OnboardLine:
        """The next line; a lost robot is called back meanwhile, and rolls on whether it is heard or not."""
        while True:
            try:
                async with asyncio.timeout(self._settings.motion.run_timeout_s + self._guest.profile.silence_s):
                    heard = await self._heard.get()
            except TimeoutError:
                raise SessionError(
                    f"{self._guest.name}: no line for {self._settings.motion.run_timeout_s:g} s; is it stuck?"
                ) from None
            if isinstance(heard, OnboardLine):
                return heard
            await self._call_back(writer, heard)

    async def _call_back(self, writer: SessionWriter, reason: str) -> None:
        """Connect again, with growing pauses, to the session that the robot still rolls."""
        name, limit_s = self._guest.name, self._settings.link.reconnect_s
        if limit_s == 0:
            raise SessionError(f"{name}: the link was lost ({reason}); bring it nearer and run again")
        self._say(f"{name}: the link was lost ({reason}); calling it back for up to {limit_s:g} s")
        loop = asyncio.get_running_loop()
        writer.append("lost", t_s=loop.time(), robot=name, reason=reason)
        attempts = await persist(name, self._guest.connect, limit_s, lambda: True)
        writer.append("back", t_s=loop.time(), robot=name, attempts=attempts)

    async def _film(self, writer: SessionWriter, line: int) -> None:
        if self._bench.recorder is not None:
            await self._bench.recorder.open_segment(writer.video_path(line))

    async def _keep(self, writer: SessionWriter, told: OnboardLine, line: int) -> None:
        """Put a line into the sums, the log and, where it was filmed, its folder."""
        video = None
        if self._bench.recorder is not None:
            segment = await self._bench.recorder.close_segment()
            video = {"frames": segment.frames, "dropped": segment.dropped, "late": segment.late}
            writer.commit_line(line, pd.DataFrame(columns=list(Sample.__slots__), dtype=float))
        speed_cm_s = self._settings.motion.speed_cm_s
        t_start_s = told.t_host_s - told.length_cm / speed_cm_s
        record: dict[str, Any] = {
            "line": line,
            "robot": self._guest.name,
            "told": told.line,
            "t_robot_s": told.t_robot_s,
            "t_start_s": t_start_s,
            "t_rolling_s": t_start_s,
            "t_end_s": told.t_host_s,
            "length_cm": told.length_cm,
            "end_cm": told.length_cm,
            "speed_cm_s": speed_cm_s,
            "ended": "bump",
            "starts_lit": False,
            "ends_lit": False,
            "counts": True,
            "whole": True,
            "weight": 1.0,
            "k": told.k,
            "l1_cm": told.l1_cm,
            "l3_cm3": told.l3_cm3,
            "video": video,
            "crossings": [],
        }
        self._own.area_cm2, self._own.perimeter_cm = told.area_cm2, told.perimeter_cm
        self._own.sums.add_line(told.k, told.l1_cm, told.l3_cm3)
        self._ledger.enter(record, self._own.sums.lines, self._own)
        writer.append("line", **record)
        if self._watch is not None:
            self._watch(self._ledger.progress(self._own, line, told.t_host_s, self._battery_v))

    async def _light_of(self, picture: Picture) -> list[float]:
        """Light samples, in the robot's unit, under a picture that fills the arena."""
        self._bench.show(picture)
        await asyncio.sleep(SETTLE_S)
        return [await self._guest.light() for _ in range(LEVEL_SAMPLES)]

    async def _let_rest(self) -> None:
        """Tell the robot to stop and close the camera's segment, whatever state they are in."""
        try:
            await self._guest.stop()
        except RobotError as error:  # alone for a while, it stops by itself
            self._say(f"{error}")
        recorder = self._bench.recorder
        if recorder is not None and recorder.segment is not None:
            try:
                await recorder.close_segment()
            except ChordlabError as error:
                self._say(f"the last video segment is lost: {error}")
