"""The robot's scales from the camera against its odometry: what a run was, and what the robot made of it.

Only steady stretches of runs are compared, as slopes against time, so that neither the ramps at their ends nor an
even difference of the two clocks matter. Works on runs rolled for it and on the runs of a stored session alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
import pandas as pd

from lab.base.errors import RequestError
from lab.bench.devices import Bench, open_bench
from lab.clock import run as run_on_clock
from lab.reopen.stored import stored_settings
from lab.review.filmed import on_host_clock
from lab.settings.settings import Settings
from lab.store.layout import LIGHT
from lab.store.reader import SessionReader, numbers_of
from projector.dictionary import shape_from
from robot.bolt import Bolt
from robot.characterise import Say, Show, roll_runs
from robot.finding import Finding
from robot.fitting import Figure, Floats, combine, fit_path, path_of, slope, steady_window
from robot.profile import RobotProfile, load_profile
from robot.trial import Roll, Trial, neutral
from tracking.calibration import Calibration
from tracking.recorder import Recorder
from tracking.segment import frames_table
from tracking.track import track_segments

Progress = Callable[[int, int], None]

RUN_COLUMNS = (
    "line", "units", "seconds", "length_cm", "odometer_cm", "speed_cm_s", "speed_error", "odometer_cm_s",
    "odometer_error", "curvature_rad_per_cm", "curvature_error",
)  # fmt: skip
FEWEST_RUNS = 3
_SPEEDS = 4
_SLOWEST_UNITS, _FASTEST_UNITS = 32, 56  # about 19 and 33 cm/s: a run then has some seconds of steady rolling
_MARGIN_S = 0.25  # what two clocks may differ by, at both ends of a steady stretch
_SHORTEST_S = 0.4
_FINEST = 1e-4  # no odometer is better, relatively: keeps the weights finite on a noiseless one
_INTERVAL_S = 0.05
_TELL_EVERY = 5


@dataclass(frozen=True, slots=True, eq=False)
class Wheels:
    """What the robot said of one run: times (n,) on the host's clock, path and speed by its odometer as it is."""

    units: float
    t_s: Floats
    path_cm: Floats
    speed_cm_s: Floats

    @classmethod
    def of(cls, roll: Roll) -> Wheels:
        """From a roll under a neutral profile."""
        return cls(float(roll.units), roll.t_s, roll.path_cm, roll.speed_cm_s)


@dataclass(frozen=True, slots=True, eq=False)
class Scales:
    """What runs say together.

    Attributes:
        runs: one row a run, columns ``RUN_COLUMNS``; what the camera did not see is NaN.
        cm_s_per_unit: speed of one unit of the speed byte; by the odometer where there was no camera.
        locator_scale: true cm per cm of the odometer.
        drift_rad_per_cm: curvature, clockwise +.
        filmed: whether a camera saw the runs; else the last two are NaN.
    """

    runs: pd.DataFrame
    cm_s_per_unit: Figure
    locator_scale: Figure
    drift_rad_per_cm: Figure
    filmed: bool

    def findings(self) -> tuple[Finding, Finding, Finding]:
        """The three as values of a profile, each with how it was measured."""
        if not self.filmed:
            unseen = "needs a camera that films the runs; set `camera` in the session's settings"
            return (
                Finding.of("cm_s_per_unit", self.cm_s_per_unit, "odometer against speed byte, no camera"),
                Finding("locator_scale", None, None, 0, unseen),
                Finding("drift_rad_per_cm", None, None, 0, unseen),
            )
        each = "scatter {:.2g} from run to run"
        speed, locator, drift = self.cm_s_per_unit, self.locator_scale, self.drift_rad_per_cm
        return (
            Finding.of("cm_s_per_unit", speed, f"camera against speed byte, {each.format(speed.scatter)}"),
            Finding.of("locator_scale", locator, f"camera against odometer, {each.format(locator.scatter)}"),
            Finding.of("drift_rad_per_cm", drift, f"curvature of runs by the camera, {each.format(drift.scatter)}"),
        )


def speeds_for(runs: int, least_units: int) -> list[int]:
    """Speed bytes for so many runs: several different ones, again and again, that all roll."""
    slowest = max(_SLOWEST_UNITS, math.ceil(1.1 * least_units))
    choice = np.linspace(slowest, max(_FASTEST_UNITS, 2 * slowest - _SLOWEST_UNITS), _SPEEDS).round().astype(int)
    return [int(choice[number % _SPEEDS]) for number in range(runs)]


def fit_runs(wheels: Mapping[int, Wheels], track: pd.DataFrame | None) -> pd.DataFrame:
    """Fit the steady stretch of each run, by the odometer and by the camera.

    Args:
        wheels: what the robot said, by line.
        track: ``line t_s x_cm y_cm`` of the same lines on the host's clock, or None without a camera.

    Returns:
        One row for each run with a steady stretch that both saw, columns ``RUN_COLUMNS``. ``seconds`` is the
        stretch's duration, ``length_cm`` and ``odometer_cm`` what was rolled in it.
    """
    seen = None if track is None else dict(list(track.groupby("line")))
    rows: list[dict[str, float]] = []
    for line, said in wheels.items():
        window = steady_window(said.t_s, said.speed_cm_s, _MARGIN_S)
        if window is None or window[1] - window[0] < _SHORTEST_S:
            continue
        seconds = window[1] - window[0]
        steady = (said.t_s >= window[0]) & (said.t_s <= window[1])
        odometer = slope(said.t_s[steady], said.path_cm[steady])
        if not odometer.n:
            continue
        row = dict.fromkeys(RUN_COLUMNS, math.nan) | {
            "line": float(line),
            "units": said.units,
            "seconds": seconds,
            "odometer_cm": odometer.value * seconds,
            "odometer_cm_s": odometer.value,
            "odometer_error": math.hypot(odometer.error, _FINEST * odometer.value),
        }
        if seen is not None:
            frames = seen.get(line)
            if frames is None:
                continue
            frames = frames[frames["t_s"].between(*window)]
            path = fit_path(frames["t_s"], frames["x_cm"], frames["y_cm"])
            if path is None:
                continue
            row |= {
                "length_cm": path.speed_cm_s.value * seconds,
                "speed_cm_s": path.speed_cm_s.value,
                "speed_error": path.speed_cm_s.error,
                "curvature_rad_per_cm": path.curvature_rad_per_cm.value,
                "curvature_error": path.curvature_rad_per_cm.error,
            }
        rows.append(row)
    return pd.DataFrame(rows, columns=list(RUN_COLUMNS)).astype({"line": "int64"})


def scales_of(runs: pd.DataFrame) -> Scales:
    """Regress through the origin: true speed on the speed byte, true on reported path; each run weighs as it is exact.

    Raises:
        RequestError: fewer than three runs can be used.
    """
    if len(runs) < FEWEST_RUNS:
        raise RequestError(
            f"only {len(runs)} runs have a steady stretch that robot and camera saw, and {FEWEST_RUNS} are needed: "
            "roll more and longer runs, and let the camera see the whole arena"
        )
    value = {name: np.asarray(runs[name], dtype=float) for name in RUN_COLUMNS}
    units, odometer, speed = value["units"], value["odometer_cm_s"], value["speed_cm_s"]
    if bool(np.isnan(speed).all()):
        unknown = Figure(math.nan, math.nan, 0)
        by_odometer = combine(odometer / units, value["odometer_error"] / units)
        return Scales(runs, by_odometer, unknown, unknown, filmed=False)
    ratio = speed / odometer
    ratio_error = ratio * np.hypot(value["speed_error"] / speed, value["odometer_error"] / odometer)
    return Scales(
        runs,
        combine(speed / units, value["speed_error"] / units),
        combine(ratio, ratio_error),
        combine(value["curvature_rad_per_cm"], value["curvature_error"]),
        filmed=True,
    )


class Film:
    """Films runs, a segment for each that is kept.

    Args:
        recorder: running.
        folder: where the segments go.
    """

    def __init__(self, recorder: Recorder, folder: Path) -> None:
        self.segments: dict[int, Path] = {}
        self._recorder = recorder
        self._folder = folder

    async def begin(self, number: int) -> None:
        """Open the segment of a run."""
        await self._recorder.open_segment(self._folder / f"{number:06d}.mkv")

    async def end(self, number: int, kept: bool) -> None:
        """Close it; a run that is not kept leaves none."""
        segment = await self._recorder.close_segment()
        if kept and segment.frames:
            self.segments[number] = segment.path
        else:
            segment.path.unlink(missing_ok=True)
            frames_table(segment.path).unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class Filmed:
    """Runs as rolled, with the segments that show them (none without a camera)."""

    rolls: dict[int, Roll]
    segments: dict[int, Path]

    def scales(self, calibration: Calibration | None, workers: int, progress: Progress | None) -> Scales:
        """Track the segments and work out the scales. Raises RequestError where too few runs can be used."""
        wheels = {number: Wheels.of(roll) for number, roll in self.rolls.items()}
        track = None
        if self.segments and calibration is not None:
            track = track_segments(self.segments, calibration, workers=workers, progress=progress)
            track = on_host_clock(track, self.segments)
        return scales_of(fit_runs(wheels, track))


async def film_runs(trial: Trial, units: Sequence[int], bench: Bench | None, folder: Path, say: Say) -> Filmed:
    """Roll runs over a dark floor, filmed where the bench has a camera. The robot streams already."""
    told = 0

    def report(number: int) -> None:
        nonlocal told
        if number >= told + _TELL_EVERY:
            told = number
            say(f"run {number} of {len(units)}")

    async def begin(number: int) -> None:
        report(number)

    if bench is None or bench.camera is None:
        return Filmed(await roll_runs(trial, units, begin=begin), {})
    shower(bench)(0.0)
    await trial.robot.set_led(1.0)
    async with Recorder(bench.camera) as recorder:
        film = Film(recorder, folder)

        async def begin_filmed(number: int) -> None:
            report(number)
            await film.begin(number)

        rolls = await roll_runs(trial, units, begin=begin_filmed, end=film.end)
    return Filmed(rolls, film.segments)


def shower(bench: Bench) -> Show:
    """A callable that fills the projector's picture: 0 black, 1 white."""
    width_px, height_px = bench.projector.image_size
    pictures = {level: np.full((height_px, width_px), level, dtype=np.uint8) for level in (0, 255)}

    def show(level: float) -> None:
        bench.show(pictures[round(255 * level)])

    return show


def bolt_of(bench: Bench) -> Bolt:
    """The bench's first robot, from now on driven by a neutral profile.

    Raises:
        RequestError: there is no BOLT on it.
    """
    for robot in bench.robots:
        if isinstance(robot, Bolt):
            robot.profile = neutral(robot.profile)
            return robot
    raise RequestError('there is no BOLT on this bench; set robot = "ble:SB-1234" or "virtual"')


def calibrate_robot(
    settings: Settings,
    profile: RobotProfile,
    runs: int,
    *,
    workers: int,
    say: Say,
    progress: Progress | None = None,
) -> Scales:
    """Roll runs on the settings' bench, filmed, and work out the scales.

    Args:
        settings: the bench; it must have a camera.
        profile: what is known of the robot: the least speed byte that rolls.
        runs: how many.
        workers: processes that track the video.
        say: takes a line now and then.
        progress: of the tracking, (segments done, segments in all).

    Raises:
        RequestError: no camera, or too few runs that could be used.
        ChordlabError: a device fails.
    """
    if settings.camera == "none":
        raise RequestError(
            'the scales need a camera: set camera = "usb:0" in the settings, or give --from a filmed one'
        )
    if runs < FEWEST_RUNS:
        raise RequestError(f"{runs} runs tell too little: ask for --runs {FEWEST_RUNS} or more")

    async def on_the_bench(folder: Path) -> Filmed:
        async with open_bench(settings, shape_from(settings.shape, font=settings.font), settings.seeds()[0]) as bench:
            await still_recorder(bench)
            robot = bolt_of(bench)
            trial = Trial(robot, np.random.default_rng(settings.seeds()[1]))
            await robot.connect()
            await trial.stream(max(_INTERVAL_S, profile.least_interval_s))
            return await film_runs(trial, speeds_for(runs, profile.least_speed_units), bench, folder, say)

    with TemporaryDirectory(prefix="chordlab-") as temporary:
        filmed = run_on_clock(on_the_bench(Path(temporary)), virtual=settings.is_virtual)
        return filmed.scales(settings.camera_calibration(), workers, progress)


async def still_recorder(bench: Bench) -> None:
    """Stop the bench's own recorder: a camera that nobody needs yet only takes time."""
    if bench.recorder is not None:
        await bench.recorder.stop()


def scales_of_session(folder: Path, *, workers: int, progress: Progress | None = None) -> Scales:
    """The scales from a stored session that was filmed.

    Raises:
        RequestError: it is no session, was not filmed, or too few of its runs can be used.
    """
    session = SessionReader(folder)
    settings = stored_settings(session)
    segments = session.segments()
    if not segments:
        raise RequestError(f"{folder}: this session was not filmed; give --from one with video, or roll new runs")
    if len(settings.robots) > 1:
        raise RequestError(f"{folder}: {len(settings.robots)} robots roll in it; give a session of one robot")
    profile = profile_then(session, settings)
    try:
        cruising_cm_s = float(session.manifest["devices"]["cruising_cm_s"])
        calibration = Calibration.from_dict(session.manifest["calibration"]["camera"])
    except (KeyError, TypeError, ValueError) as error:
        raise RequestError(f"{folder}: the manifest lacks {error}; give another session") from error
    units = round(cruising_cm_s / profile.cm_s_per_unit)
    wheels: dict[int, Wheels] = {}
    for line in segments:
        light = numbers_of(session.line_path(line, LIGHT), ("t_host_s", "x_cm", "y_cm", "speed_cm_s"))
        raw = light.to_numpy()
        # What the driver made of the odometer is undone: the robot's own figures count.
        path, speed = path_of(raw[:, 1], raw[:, 2]) / profile.locator_scale, raw[:, 3] / profile.locator_scale
        wheels[line] = Wheels(float(units), raw[:, 0], path, speed)
    track = track_segments(segments, calibration, workers=workers, progress=progress)
    return scales_of(fit_runs(wheels, on_host_clock(track, segments)))


def profile_then(session: SessionReader, settings: Settings) -> RobotProfile:
    """What the driver of a stored session took its robot for: the manifest's, where it has one."""
    devices: dict[str, Any] = session.manifest.get("devices", {})
    stored = devices.get("profile")
    if not isinstance(stored, dict):
        scale = settings.motion.cm_s_per_unit
        return RobotProfile() if scale is None else RobotProfile(cm_s_per_unit=scale)
    values = cast("dict[str, Any]", stored)
    scales = {key: float(values[key]) for key in ("cm_s_per_unit", "locator_scale") if key in values}
    return replace(RobotProfile(), **scales)


def profile_to_update(path: Path, otherwise: RobotProfile) -> tuple[RobotProfile, dict[str, str]]:
    """The profile that a file holds with its comments, so that what is not measured anew keeps both.

    Where there is no file yet, ``otherwise`` and no comments.

    Raises:
        RequestError: the file is no robot profile, or cannot be written beside.
    """
    if not path.parent.is_dir():
        raise RequestError(f"{path}: there is no folder {path.parent}; make it, or choose another --out")
    if not path.exists():
        return otherwise, {}
    profile = load_profile(path)
    comments: dict[str, str] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        key, equals, _ = line.partition(" = ")
        _, hash_, comment = line.partition("  # ")
        if equals and hash_ and not key.startswith("#"):
            comments[key] = comment
    return profile, comments
