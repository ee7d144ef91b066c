"""A session: preflight, then run after run (drive, collect, estimate, sync to disk) until it is time to stop.

The same code runs on hardware and on the virtual bench; only the devices and the loop's clock differ.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np

from analysis.recognition import Recogniser
from lab.base.errors import ChordlabError
from lab.bench import Bench
from lab.run import STALL_CM, Run
from lab.settings import Settings
from lab.store import SessionWriter
from robot.crossings import CrossingDetector, Levels, learn_levels
from robot.device import Bump, Identity, Sample
from robot.onboard import Estimator
from robot.turning import turn

_log = logging.getLogger(__name__)

LEVEL_SAMPLES = 20
LOWEST_BATTERY_V = 3.5
_SETTLE_S = 0.3  # a projector's latency and a light sample under way, after the picture changes
_GIVE_UP_S = 15.0  # for what takes a second when all is well
_BATTERY_EVERY_S = 60.0


class SessionError(ChordlabError):
    """The session cannot begin or go on."""


@dataclass(frozen=True, slots=True)
class Preflight:
    """What the devices said before the first run."""

    identity: Identity
    levels: Levels


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a session stands, after a run. NaN where nothing is known yet."""

    line: int
    n: int
    t_s: float
    area_cm2: float
    sigma_area_cm2: float
    perimeter_cm: float
    sigma_perimeter_cm: float
    leading: str
    posterior: float
    battery_v: float


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a session ended."""

    state: str
    runs: int
    n: int
    rolling_s: float


class Watcher(Protocol):
    """What follows a session while it runs."""

    def __call__(self, progress: Progress, /) -> None:
        """Take note of where the session stands; called on the loop, must return quickly."""
        ...


class Session:
    """One session on an open bench."""

    def __init__(
        self,
        bench: Bench,
        settings: Settings,
        recogniser: Recogniser,
        rng: np.random.Generator,
        *,
        watch: Watcher | None = None,
    ) -> None:
        self._bench = bench
        self._settings = settings
        self._recogniser = recogniser
        self._rng = rng
        self._watch = watch
        self._estimator = Estimator()
        self._run: Run | None = None
        self._run_over = asyncio.Event()
        self._bump: Bump | None = None
        self._normal_rad: float | None = None
        self._lost = ""
        self._waiting: list[Sample] | None = None
        self._enough = asyncio.Event()
        self._led_wanted = asyncio.Event()
        self._battery_v = math.nan
        self._battery_read_s = 0.0

    async def preflight(self) -> Preflight:
        """Connect, check the battery, learn the two light levels from a black and a white picture.

        Raises:
            SessionError: the battery is low or no light samples come.
            LevelsError: dark and light do not separate.
        """
        bench, settings = self._bench, self._settings
        robot = bench.robot
        robot.on_sample, robot.on_bump, robot.on_lost = self._on_sample, self._on_bump, self._on_lost
        await robot.connect()
        identity = await robot.identity()
        self._battery_v, self._battery_read_s = identity.battery_v, asyncio.get_running_loop().time()
        _check_battery(robot.name, identity.battery_v)
        await robot.set_led(settings.led.dark_level)
        await robot.start_stream(settings.sensor.interval_s)
        dark = await self._light_of(bench.pictures.black)
        bright = await self._light_of(bench.pictures.white)
        levels = learn_levels(dark, bright)
        bench.show(bench.pictures.shape)
        await asyncio.sleep(_SETTLE_S)
        return Preflight(identity, levels)

    async def roll(self, writer: SessionWriter, levels: Levels) -> Outcome:
        """Roll until the session's end, each run committed to ``writer`` before the next begins.

        On every way out, cancellation included, the robot is stopped and the log says how it ended.
        """
        loop = asyncio.get_running_loop()
        t_start_s = loop.time()
        writer.append("start", t_s=t_start_s, levels=asdict(levels))
        led = asyncio.create_task(self._follow_with_led())
        line, state = 0, "failed"
        try:
            heading_rad = self._rng.uniform(0, math.tau)
            while state == "failed":
                run = await self._one_run(writer, levels, line, heading_rad)
                line += 1
                await self._mind_the_battery()
                heading_rad = self._next_heading(run)
                state = self._reason_to_stop() or state
        except asyncio.CancelledError:
            state = "interrupted"
            raise
        finally:
            led.cancel()
            # Shielded, so that a second Ctrl-C cannot leave the robot rolling.
            await asyncio.shield(self._come_to_rest())
            outcome = Outcome(state, line, self._estimator.lines, loop.time() - t_start_s)
            writer.append("end", t_s=loop.time(), **asdict(outcome))
            writer.finish(asdict(outcome))
        return outcome

    def _next_heading(self, run: Run) -> float:
        """Turn at the wall, by the policy; where no wall is known, anywhere."""
        if self._bump is not None:
            self._normal_rad = self._bump.normal_heading_rad
        elif run.rolled_cm > STALL_CM:
            self._normal_rad = None  # given up in mid-arena
        # else: it set off into the wall that it stands at (the bump's direction is felt with an error), and draws again
        if self._normal_rad is None:
            return self._rng.uniform(0, math.tau)
        return turn(self._settings.motion.turning, self._normal_rad, self._rng)

    async def _one_run(self, writer: SessionWriter, levels: Levels, line: int, heading_rad: float) -> Run:
        """Roll from wall to wall once and commit it."""
        settings, robot = self._settings, self._bench.robot
        recorder = self._bench.recorder
        self._bump, self._lost = None, ""
        self._run_over.clear()
        if recorder is not None:
            await recorder.open_segment(writer.video_path(line))
        loop = asyncio.get_running_loop()
        run = Run(
            line,
            loop.time(),
            self._bench.cruising_cm_s,
            settings.motion.length_from == "odometry",
            CrossingDetector(levels),
        )
        self._run = run  # before it drives: on a short run the bump can come before the command's reply
        self._led_wanted.set()  # a run that ended in the light left the LED lit
        try:
            async with asyncio.timeout(_GIVE_UP_S):
                await robot.drive(heading_rad, run.speed_cm_s)
        except TimeoutError:
            raise SessionError(f"{robot.name}: no answer for {_GIVE_UP_S:g} s; bring it nearer and run again") from None
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(settings.motion.run_timeout_s):
                await self._run_over.wait()
        t_end_s = self._bump.t_host_s if self._bump else loop.time()
        self._run = None
        run.finish(t_end_s)
        await robot.stop()
        video = None
        if recorder is not None:
            segment = await recorder.close_segment()
            video = {"frames": segment.frames, "dropped": segment.dropped}
        writer.commit_line(line, run.light())
        self._conclude(writer, run, t_end_s, video)
        if self._lost:
            raise SessionError(f"{robot.name}: the link was lost ({self._lost}); bring it nearer and run again")
        return run

    async def _mind_the_battery(self) -> None:
        """Read the battery now and then. Raises SessionError once it is too low to roll straight."""
        now_s = asyncio.get_running_loop().time()
        if now_s - self._battery_read_s < _BATTERY_EVERY_S:
            return
        self._battery_v, self._battery_read_s = await self._bench.robot.battery_v(), now_s
        _check_battery(self._bench.robot.name, self._battery_v)

    def _conclude(self, writer: SessionWriter, run: Run, t_end_s: float, video: dict[str, int] | None) -> None:
        """Estimate from a finished run and put it into the log.

        Only runs from wall to wall are lines of the statistics: the first starts inside the arena, and one
        that stalled or timed out did not reach the wall.
        """
        ended = "bump" if self._bump else "link" if self._lost else "stall" if run.stalled else "timeout"
        counts = run.line > 0 and ended == "bump"
        k, l1_cm, l3_cm3 = self._invariants(run, counts)
        record: dict[str, Any] = {
            "line": run.line,
            "t_start_s": run.t_start_s,
            "t_rolling_s": run.t_rolling_s,
            "t_end_s": t_end_s,
            "length_cm": run.rolled_cm,
            "speed_cm_s": run.rolled_cm / (t_end_s - run.t_start_s) if t_end_s > run.t_start_s else 0.0,
            "ended": ended,
            "counts": counts,
            "k": k,
            "l1_cm": l1_cm,
            "l3_cm3": l3_cm3,
            "video": video,
            "crossings": [[crossing.t_s, crossing.s_cm, crossing.entering] for crossing in run.crossings],
        }
        estimator = self._estimator
        if counts and k:
            self._recogniser.update(k, l1_cm, l3_cm3)
            leading, posterior = self._recogniser.ranked()[0]
            record["estimate"] = {
                "n": estimator.lines,
                "area_cm2": estimator.area(),
                "perimeter_cm": estimator.perimeter(),
                "sigma_area_cm2": _or_none(estimator.sigma_area()),
                "sigma_perimeter_cm": _or_none(estimator.sigma_perimeter()),
                "correlation": _or_none(estimator.correlation()),
                "leading": leading,
                "posterior": posterior,
            }
        writer.append("line", **record)
        if self._watch is not None:
            self._watch(self._progress(run.line, t_end_s))

    def _invariants(self, run: Run, counts: bool) -> tuple[int, float, float]:
        """Take a run's crossings through the on-board estimator: (k, L1, L3); into the means if it counts."""
        estimator = self._estimator if counts else Estimator(covariance=False)
        estimator.start_line()
        for crossing in run.crossings:
            estimator.crossing(crossing.s_cm, crossing.entering)
        return estimator.end_line()

    def _reason_to_stop(self) -> str | None:
        stop, n = self._settings.stop, self._estimator.lines
        if stop.until is not None and n >= stop.at_least and self._recogniser.ranked()[0][1] >= stop.until:
            return "recognised"
        return "complete" if n >= stop.lines else None

    def _progress(self, line: int, t_s: float) -> Progress:
        estimator = self._estimator
        leading, posterior = self._recogniser.ranked()[0] if estimator.lines else ("", math.nan)
        return Progress(
            line,
            estimator.lines,
            t_s,
            estimator.area(),
            estimator.sigma_area(),
            estimator.perimeter(),
            estimator.sigma_perimeter(),
            leading,
            posterior,
            self._battery_v,
        )

    def _on_sample(self, sample: Sample) -> None:
        if self._waiting is not None:
            self._waiting.append(sample)
            if len(self._waiting) >= LEVEL_SAMPLES:
                self._enough.set()
        run = self._run
        if run is not None and not self._run_over.is_set():
            lit = run.detector.lit
            run.feed(sample)
            if run.detector.lit != lit:
                self._led_wanted.set()
            if run.stalled:
                self._run_over.set()

    def _on_bump(self, bump: Bump) -> None:
        if self._run is not None and not self._run_over.is_set():
            self._bump = bump
            self._run_over.set()

    def _on_lost(self, reason: str) -> None:
        self._lost = reason
        self._run_over.set()

    async def _follow_with_led(self) -> None:
        """Keep the LED as the last crossing left it: a blink faster than the link can follow is skipped."""
        led = self._settings.led
        shown = led.dark_level
        while True:
            await self._led_wanted.wait()
            self._led_wanted.clear()
            run = self._run
            wanted = led.lit_level if run is not None and run.detector.lit else led.dark_level
            if wanted != shown:
                try:
                    await self._bench.robot.set_led(wanted)
                except ChordlabError as error:  # a missed blink costs the camera a label, not the session a line
                    _log.warning("LED not set: %s", error)
                else:
                    shown = wanted

    async def _light_of(self, picture: np.ndarray[Any, np.dtype[np.uint8]]) -> list[float]:
        """Light samples, in lux, under a picture that fills the arena."""
        self._bench.show(picture)
        await asyncio.sleep(_SETTLE_S)
        samples: list[Sample] = []
        self._waiting, self._enough = samples, asyncio.Event()
        try:
            async with asyncio.timeout(_GIVE_UP_S):
                await self._enough.wait()
        except TimeoutError:
            raise SessionError(
                f"{self._bench.robot.name}: only {len(samples)} light samples in {_GIVE_UP_S:g} s; "
                "bring the robot nearer to the computer and try again"
            ) from None
        finally:
            self._waiting = None
        return [sample.light_lux for sample in samples]

    async def _come_to_rest(self) -> None:
        """Stop the robot and close the camera's segment, whatever state they are in."""
        self._run = None
        with contextlib.suppress(ChordlabError, TimeoutError):
            async with asyncio.timeout(_GIVE_UP_S):
                await self._bench.robot.stop()
        recorder = self._bench.recorder
        if recorder is not None and recorder.segment is not None:
            try:
                await recorder.close_segment()
            except ChordlabError as error:  # the log must still say how the session ended
                _log.error("the last video segment is lost: %s", error)


def _check_battery(robot: str, battery_v: float) -> None:
    if battery_v < LOWEST_BATTERY_V:
        raise SessionError(
            f"{robot}: battery at {battery_v:.2f} V, below {LOWEST_BATTERY_V} V; what was rolled is kept, charge it"
        )


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
