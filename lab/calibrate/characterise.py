"""Measures a robot on the floor at hand: the bench's devices put together for the steps of ``robot.characterise``."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lab.base.errors import RequestError
from lab.bench.devices import Bench, open_bench
from lab.calibrate.robot import Filmed, Progress, bolt_of, film_runs, shower, speeds_for, still_recorder
from lab.clock import run as run_on_clock
from lab.settings.load import load_settings
from lab.settings.settings import Settings
from projector.dictionary import shape_from
from robot.bolt import Bolt
from robot.characterise import (
    Say,
    collision_axes,
    least_interval,
    least_speed,
    light_latency,
    light_levels,
    motion_latency,
)
from robot.finding import Finding, applied, comments_of
from robot.profile import RobotProfile, save_profile
from robot.trial import CharacteriseError, Trial, neutral

RUNS = 20
LOWEST_BATTERY_V = 3.6  # a tired robot rolls unlike a fresh one
_NO_PROJECTOR = "needs a projector; set `projector` in the session's settings"


@dataclass(frozen=True, slots=True)
class Characterised:
    """What was found: findings in the order of the measurements, the profile with them, robot time in s."""

    robot: str
    findings: tuple[Finding, ...]
    profile: RobotProfile
    robot_s: float

    def save(self, path: Path, comments: Mapping[str, str]) -> None:
        """Write the profile, each value with how it was measured; ``comments`` for those that kept theirs.

        Raises:
            RequestError: it cannot be written.
        """
        kept = {finding.key for finding in self.findings if finding.value is None} & comments.keys()
        told = {key: text for key, text in comments_of(self.findings).items() if key not in kept}
        save_profile(self.profile, path, {**comments, **told})


@dataclass(frozen=True, slots=True)
class _Taken:
    """What the robot had to be there for."""

    findings: list[Finding]
    filmed: Filmed
    robot_s: float


def settings_for(name: str, path: Path | None) -> Settings | None:
    """The bench for a robot called ``name``: as the file has it, the virtual one for "virtual".

    None for a real robot without a file: it alone is measured, without projector and camera.

    Raises:
        RequestError: the file is no session's, or describes a bench that this robot cannot be on.
    """
    if name == "virtual":
        settings = load_settings(path)
        if not settings.is_virtual:
            return load_settings(path, {"robot": "virtual", "projector": "virtual", "camera": "virtual"})
        return settings if settings.robots == ("virtual",) else load_settings(path, {"robot": "virtual"})
    if path is None:
        return None
    return load_settings(path, {"robot": f"ble:{name}"})


def characterise_robot(
    name: str,
    settings: Settings | None,
    profile: RobotProfile,
    *,
    seed: int,
    runs: int = RUNS,
    workers: int,
    say: Say,
    progress: Progress | None = None,
) -> Characterised:
    """Measure everything that the bench at hand allows; the rest is reported as not measured and keeps its value.

    Args:
        name: the robot's, for one without settings.
        settings: the bench; None for the robot alone.
        profile: what is known of it; keeps its values where nothing is measured.
        seed: of phases and headings.
        runs: long runs for scales and drift.
        workers: processes that track the video.
        say: takes a line for each step.
        progress: of the tracking, (segments done, segments in all).

    Raises:
        RequestError: the bench cannot be opened as asked.
        LevelsError: dark and light do not separate.
        ChordlabError: a device fails, or the robot does not roll.
    """
    virtual = settings is not None and settings.is_virtual
    with TemporaryDirectory(prefix="chordlab-") as temporary:
        taken = run_on_clock(
            _measure(name, settings, profile, np.random.default_rng(seed), runs, Path(temporary), say), virtual=virtual
        )
        calibration = settings.camera_calibration() if settings is not None and taken.filmed.segments else None
        try:
            scales = taken.filmed.scales(calibration, workers, progress).findings()
        except RequestError as error:  # what was measured before is not thrown away for it
            keys = ("cm_s_per_unit", "locator_scale", "drift_rad_per_cm")
            scales = tuple(Finding(key, None, None, 0, str(error)) for key in keys)
    findings = (*taken.findings, *scales)
    return Characterised(name, findings, applied(profile, findings), taken.robot_s)


async def _measure(
    name: str,
    settings: Settings | None,
    profile: RobotProfile,
    rng: np.random.Generator,
    runs: int,
    folder: Path,
    say: Say,
) -> _Taken:
    """Go through the steps on the open bench."""
    async with _on_bench(name, settings, profile) as (robot, bench):
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        trial = Trial(robot, rng)
        await robot.connect()
        identity = await robot.identity()
        if identity.battery_v < LOWEST_BATTERY_V:
            raise CharacteriseError(
                f"{robot.name}: battery at {identity.battery_v:.2f} V, below {LOWEST_BATTERY_V} V; charge it first",
                robot=robot.name,
            )
        say(f"{robot.name}: firmware {identity.firmware}, battery {identity.battery_v:.2f} V")
        await robot.set_led(0.0)  # its own light must not be taken for the projector's
        findings = [_reply_flags(robot)]

        def found(finding: Finding) -> Finding:
            findings.append(finding)
            say(f"{finding.key}{'' if finding.value is None else f' = {finding.value}'} ({finding.comment})")
            return finding

        say("how fast a stream the link holds; it may break once or twice")
        found(await least_interval(trial))
        await robot.set_led(0.0)
        if bench is None:
            for key in ("dark_lux", "bright_lux", "light_latency_s"):
                found(Finding(key, None, None, 0, _NO_PROJECTOR))
        else:
            show = shower(bench)
            say("black and white fields")
            dark, bright = (found(level).number for level in await light_levels(trial, show))
            found(await light_latency(trial, show, (dark + bright) / 2))
            show(0.0)
        say("the smallest speed byte that rolls")
        least_units = int(found(await least_speed(trial)).number)
        say("short hops, from command to motion")
        found(await motion_latency(trial))
        say("bumps against the wall")
        found(await collision_axes(trial))
        say(f"{runs} long runs")
        filmed = await film_runs(trial, speeds_for(runs, least_units), bench, folder, say)
        return _Taken(findings, filmed, loop.time() - begun_s)


def _reply_flags(robot: Bolt) -> Finding:
    flags = robot.reply_flags
    if flags is None:
        return Finding("reply_flags", None, None, 0, "it answered no command that names its target")
    return Finding("reply_flags", flags, None, 1, f"an answer as it came, flags 0x{flags:02x}")


@asynccontextmanager
async def _on_bench(
    name: str, settings: Settings | None, profile: RobotProfile
) -> AsyncGenerator[tuple[Bolt, Bench | None]]:
    """The robot under a neutral profile, and the bench it is on, if any."""
    if settings is None:
        robot = Bolt(name, profile=neutral(profile))
        try:
            yield robot, None
        finally:
            await robot.disconnect()
        return
    async with open_bench(settings, shape_from(settings.shape, font=settings.font), settings.seeds()[0]) as bench:
        await still_recorder(bench)
        yield bolt_of(bench), bench
