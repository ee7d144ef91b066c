"""`chordlab run`: a full session, ending in a report."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from lab.base.errors import RequestError
from lab.cli.completing import collections, robots, sessions, settings_files, shapes
from lab.cli.output import JsonFlag, QuietFlag, complain, emit, fail, progress_bar, say
from lab.cli.paging import HostOption, LiveFlag, Paging, PortOption, SpeedOption, TokenOption, paging
from lab.cli.recognize import read_letters
from lab.live.server import LOOPBACK

if TYPE_CHECKING:
    from lab.session.experiment import Finished
    from lab.session.ledger import Progress as Step
    from lab.session.ledger import Watcher
    from lab.settings.settings import Settings


def run(
    session: Annotated[
        Path | None,
        typer.Argument(metavar="[SESSION.toml]", help="Settings; none: defaults.", autocompletion=settings_files),
    ] = None,
    simulate: Annotated[bool, typer.Option("--simulate", help="On the virtual bench, whatever the file says.")] = False,
    robot: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROBOT", help="ble:SB-1234, onboard:CL-1234 or virtual; once for each robot.", autocompletion=robots
        ),
    ] = None,
    shape: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SHAPE",
            help="A dictionary name, text:WORD, or a shape file; several: a session for each.",
            autocompletion=shapes,
        ),
    ] = None,
    dictionary: Annotated[
        str | None,
        typer.Option(
            help="What to choose the name from: paper, monuments, letters, words or all.", autocompletion=collections
        ),
    ] = None,
    lines: Annotated[int | None, typer.Option(help="Stop after this many lines that cross the shape.")] = None,
    until: Annotated[float | None, typer.Option(help="Stop once the leading posterior reaches this.")] = None,
    seed: Annotated[int | None, typer.Option(help="Everything random follows from it.")] = None,
    out: Annotated[Path | None, typer.Option(help="Where the session folder goes.")] = None,
    letters: Annotated[
        bool, typer.Option("--letters", help="Letter by letter: a session for each letter of text:WORD, then the word.")
    ] = False,
    no_video: Annotated[bool, typer.Option("--no-video", help="Without a camera.")] = False,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Go on with a stored session, in its folder, to --lines; as it was begun.",
            autocompletion=sessions,
        ),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Play a stored session back, as it was set or with other options.",
            autocompletion=sessions,
        ),
    ] = None,
    live: LiveFlag = False,
    host: HostOption = LOOPBACK,
    port: PortOption = 0,
    token: TokenOption = None,
    speed: SpeedOption = None,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Run a full lab session and report on it. The report's path is printed last.

    Example: chordlab run --simulate --shape eiffel --lines 150 --seed 1
    """
    from lab.bench.replayed import replay_devices

    begun = {
        "robot": robot or None,
        "shape": shape[0] if shape else None,
        "dictionary": dictionary,
        "seed": seed,
        "out": out,
    }
    if resume is not None:
        begun |= {
            "SESSION.toml": session,
            "simulate": simulate or None,
            "letters": letters or None,
            "no-video": no_video or None,
            "replay": replay,
        }
        _refuse_with_resume(resume, [name for name, value in begun.items() if value is not None])
        settings_of_each: list[Settings] = []
    else:
        if letters:
            begun["dictionary"] = dictionary or "letters"
        flags = {**begun, "stop.lines": lines, "stop.until": until}
        if replay is not None:
            _refuse_with_replay(session, robot, simulate=simulate, letters=letters)
        base = None if replay is None else replay_devices(replay)
        settings_of_each = [
            _settings(session, simulate, no_video, {**flags, "shape": each}, base) for each in shape or [None]
        ]
        if letters and len(settings_of_each) > 1:
            raise RequestError("--letters is for one word: give --shape once")
    with paging(live=live, host=host, port=port, token=token, speed=speed, tell=complain) as page:
        if resume is not None:
            _report(_go_on(resume, lines, until, page, quiet=quiet or as_json), quiet=quiet, as_json=as_json)
        elif letters:
            _run_letters(settings_of_each[0], page, quiet=quiet, as_json=as_json)
        elif len(settings_of_each) == 1:
            _report(_run_one(settings_of_each[0], page, quiet=quiet or as_json), quiet=quiet, as_json=as_json)
        else:
            _run_several(settings_of_each, page, quiet=quiet, as_json=as_json)


Told: TypeAlias = "tuple[Finished, dict[str, Any], dict[str, float]]"
"""A session that is over: how it ended, its figures, and how fast the virtual bench was."""


def _report(told: Told, *, quiet: bool, as_json: bool) -> None:
    """Say what came of a session. Raises typer.Exit after one that failed."""
    finished, summary, ratios = told
    if as_json:
        emit({**summary, **ratios, "folder": finished.folder})
    else:
        _tell(summary, ratios, quiet=quiet)
    if finished.failure is not None:
        raise typer.Exit(1)


def _run_several(settings_of_each: list[Settings], page: Paging, *, quiet: bool, as_json: bool) -> None:
    """A session for each shape, one after the other, until one fails or is stopped by hand."""
    names = [settings.shape for settings in settings_of_each]
    sessions: list[dict[str, Any]] = []
    failed = False
    for settings, next_shape in zip(settings_of_each, [*names[1:], ""], strict=True):
        finished, summary, ratios = _run_one(settings, page, quiet=quiet or as_json, next_shape=next_shape)
        sessions.append({**summary, **ratios, "folder": finished.folder})
        failed = finished.failure is not None
        if not as_json:
            _tell(summary, ratios, quiet=quiet)
        if failed or page.stopped:
            break
    if as_json:
        emit({"sessions": sessions})
    if failed:
        raise typer.Exit(1)


def _refuse_with_replay(session: Path | None, robot: list[str] | None, *, simulate: bool, letters: bool) -> None:
    """A replay has its devices, and its settings, from the stored session."""
    given = {"SESSION.toml": session, "--robot": robot, "--simulate": simulate, "--letters": letters}
    for option, value in given.items():
        if value:
            raise RequestError(
                f"{option} is not for --replay: settings and devices are those of the stored session; take --shape, "
                "--dictionary, --lines, --until, --seed, --out or --no-video"
            )


def _refuse_with_resume(folder: Path, given: list[str]) -> None:
    """A session goes on as it was begun."""
    if given:
        option = given[0] if "." in given[0] else f"--{given[0]}"
        raise RequestError(
            f"{option} is not for --resume: {folder} goes on as it was begun; take --lines, --until, --quiet or --json"
        )


def _run_one(settings: Settings, page: Paging, *, quiet: bool, next_shape: str = "") -> Told:
    """One session and its review; ``next_shape`` comes after it."""
    from lab.session.experiment import run_experiment

    began_s = time.perf_counter()
    with _session_bar(settings, quiet=quiet) as (watch, tell):
        live = page.live(settings, tell, next_shape=next_shape)
        finished = run_experiment(settings, started=datetime.now(), watch=watch, say=live.telling(tell), live=live)
    return _concluded(finished, settings, began_s, quiet=quiet)


def _go_on(folder: Path, lines: int | None, until: float | None, page: Paging, *, quiet: bool) -> Told:
    """Go on with a session and review the whole of it; one that is complete is reviewed again."""
    from lab.reopen.resume import pick_up
    from lab.reopen.resume import resume as resume_session
    from lab.session.experiment import Finished
    from lab.store.lock import writing

    began_s = time.perf_counter()
    with writing(folder):
        unfinished = pick_up(folder, lines=lines, until=until, say=complain)
        settings, earlier = unfinished.settings, unfinished.earlier
        if unfinished.complete:
            complain(f"{folder}: {unfinished.complete}")
            return _concluded(Finished(folder, None, False, None), settings, began_s, quiet=quiet)
        with _session_bar(settings, quiet=quiet, done=unfinished.n) as (watch, tell):
            live = page.live(settings, tell)
            say_all = live.telling(tell)
            finished = resume_session(unfinished, started=datetime.now(), watch=watch, say=say_all, live=live)
        return _concluded(finished, settings, began_s, quiet=quiet, earlier_s=earlier.rolling_s)


def _concluded(finished: Finished, settings: Settings, began_s: float, *, quiet: bool, earlier_s: float = 0.0) -> Told:
    """What comes after the rolling: say how it went, track, report, seal."""
    rolled_s = time.perf_counter() - began_s
    from lab.reopen.resume import cannot_go_on
    from lab.review.review import review
    from lab.store.seal import write_checksums
    from lab.store.tables import finalize

    if finished.failure is not None:
        fail(str(finished.failure))
    if finished.interrupted:
        tables = finalize(finished.folder)
        further = "read them: chordlab validate" if cannot_go_on(settings) else "go on: chordlab run --resume"
        complain(f"interrupted after {len(tables.estimates)} crossing lines; {further} {finished.folder}")
        raise typer.Exit(1)
    ratios = _ratios(finished, settings, rolled_s, earlier_s)
    with progress_bar("tracking the video", quiet=quiet) as update:
        summary = review(finished.folder, report=True, host=ratios, progress=update)
    write_checksums(finished.folder)
    summary["seconds"] = time.perf_counter() - began_s
    summary["peak_memory_mb"] = _peak_memory_mb()
    return finished, summary, ratios


def _run_letters(settings: Settings, page: Paging, *, quiet: bool, as_json: bool) -> None:
    """A session for each letter of the word, in a folder of the word's name; then what they spell."""
    from projector.collections import charter_words
    from projector.text import TEXT_PREFIX

    word = settings.shape.removeprefix(TEXT_PREFIX)
    if word == settings.shape or len(word) < 2:
        raise RequestError(f"--letters is for a word: give --shape {TEXT_PREFIX}WORD")
    folders: list[Path] = []
    for place, letter in enumerate(word):
        own = settings.model_copy(
            update={"shape": TEXT_PREFIX + letter, "seed": settings.seed + place, "out": settings.out / word}
        )
        finished, summary, ratios = _run_one(own, page, quiet=quiet or as_json)
        folders.append(finished.folder)
        if not as_json:
            _tell(summary, ratios, quiet=quiet)
        if finished.failure is not None:
            raise typer.Exit(1)
        if page.stopped:
            break
    read_letters(folders, charter_words(), settings.dictionary, quiet=quiet, as_json=as_json)


def _tell(summary: dict[str, Any], ratios: dict[str, float], *, quiet: bool) -> None:
    if not quiet:
        say(str(summary["verdict"]))
        for name, value in ratios.items():
            say(f"{name.replace('_', ' ')}: {value:.1f}")
    say(str(summary["report"]))


def _settings(
    session: Path | None, simulate: bool, no_video: bool, flags: dict[str, Any], base: dict[str, Any] | None
) -> Settings:
    from lab.settings.load import load_settings

    overrides = {
        key: str(value) if isinstance(value, Path) else value for key, value in flags.items() if value is not None
    }
    if no_video:
        overrides["camera"] = "none"
    return load_settings(session, overrides, simulate=simulate, base=base)


def _ratios(finished: Finished, settings: Settings, rolled_s: float, earlier_s: float) -> dict[str, float]:
    """How much faster than the robot the virtual bench rolled; nothing of the kind on a real one."""
    if not settings.is_virtual or finished.outcome is None:
        return {}
    kind = "without_video" if settings.camera == "none" else "with_video"
    robot_s = finished.outcome.rolling_s - earlier_s
    return {"robot_seconds": robot_s, "wall_seconds": rolled_s, f"times_real_time_{kind}": robot_s / rolled_s}


def _peak_memory_mb() -> float:
    """Largest resident memory of this process so far, MB."""
    import psutil

    info = psutil.Process().memory_info()
    peak: int | None = getattr(info, "peak_wset", None)  # Windows
    if peak is not None:
        return peak / 1e6
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


@contextmanager
def _session_bar(settings: Settings, *, quiet: bool, done: int = 0) -> Generator[tuple[Watcher, Callable[[str], None]]]:
    """Progress on stderr: lines, A ± , P ±, the leading name and its posterior, battery, time left; and what to say."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True, quiet=quiet)
    columns = (
        TextColumn("line {task.completed}/{task.total}"),
        BarColumn(bar_width=20),
        TextColumn("{task.description}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task("setting out", total=settings.stop.lines, completed=done)
        told = 10 * done // settings.stop.lines

        def watch(step: Step) -> None:
            nonlocal told
            text = "no line has crossed the shape yet"
            if step.n:
                text = (
                    f"A {_with_error(step.area_cm2, step.sigma_area_cm2)} cm²  "
                    f"P {_with_error(step.perimeter_cm, step.sigma_perimeter_cm)} cm  "
                    f"{_leading(step)}  battery {step.battery_v:.2f} V"
                )
            bar.update(task, completed=step.n, description=text)
            tenth = 10 * step.n // settings.stop.lines
            if bar.disable and not quiet and tenth > told:  # into a log file: a line for each tenth of the way
                told = tenth
                complain(f"line {step.n}/{settings.stop.lines}  {text}")

        def tell(text: str) -> None:
            console.print(text, markup=False, highlight=False, soft_wrap=True)

        yield watch, tell


def _leading(step: Step) -> str:
    if step.unknown > 0.5:
        return f"none of these {step.unknown:.2f}"
    return f"{step.leading} {step.posterior:.2f}"


def _with_error(value: float, sigma: float) -> str:
    return f"{value:.0f} ± {sigma:.0f}" if math.isfinite(sigma) else f"{value:.0f}"
