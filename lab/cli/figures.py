"""`chordlab figures`: the paper's figures, from simulation and from stored sessions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lab.base.errors import RequestError
from lab.cli.choosing import FontOption, SchedulerOption, WorkersOption
from lab.cli.output import JsonFlag, QuietFlag, complain, emit, progress_bar, say

FILMED = {"1B", "1C", "1D", "1E"}
FROM_SESSIONS = FILMED | {"1F", "1G", "2A", "2B", "2C"}


def figures(
    out: Annotated[Path, typer.Option("--out", help="Folder for the figures.")] = Path("figures"),
    only: Annotated[str | None, typer.Option("--only", help="Panels, as 1G,2D; or whole figures, as 2.")] = None,
    sessions: Annotated[
        Path | None, typer.Option("--sessions", help="Stored sessions below this folder replace simulated robots.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random lines.")] = 1,
    runs: Annotated[int, typer.Option("--runs", min=3, max=100_000, help="Simulated runs over each shape.")] = 1000,
    lines: Annotated[int, typer.Option("--lines", min=20, max=100_000, help="Crossing lines of a robot.")] = 1000,
    blinks: Annotated[str, typer.Option("--blinks", help="Numbers of lines N of 1B's maps.")] = "10,40,100,200,1000",
    font: FontOption = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Draw the paper's figures. Each panel as SVG and PNG, the data behind it as CSV, and a page with captions.

    Example: chordlab figures --out figures --only 1G,2D
    """
    from analysis.figures.paper.panel import chosen_panels
    from lab.batch.places import sessions_below
    from lab.figures.draw import SHEET, as_found, draw_figures
    from lab.figures.robots import NO_SESSIONS, stored_robots
    from lab.figures.workbench import Scale
    from lab.spread.spread import spreading
    from projector.dictionary import load_dictionary
    from projector.text import find_font

    names = chosen_panels(only)
    scale = Scale(lines=lines, runs=runs, blinks=_counts(blinks))
    stored = NO_SESSIONS
    typeface = find_font(font) if any(name.startswith("3") for name in names) else None
    with progress_bar("figures", quiet=quiet) as update:
        if sessions is not None and FROM_SESSIONS & set(names):
            film = bool(FILMED & set(names))
            stored = stored_robots(sessions_below([sessions]), load_dictionary(), film=film)
        mapper = spreading(workers, scheduler)
        drawn = draw_figures(
            names, out, seed=seed, scale=scale, font=typeface, stored=stored, progress=update, mapper=mapper
        )
    for session, reason in () if quiet else drawn.left_out:
        complain(f"{session} is left out: {reason}")
    if as_json:
        emit({"out": out, "files": drawn.files, "left_out": drawn.left_out, "panels": as_found(drawn)})
        return
    say(str(out / SHEET) if quiet else f"{len(drawn.panels)} panels: {out / SHEET}")


def _counts(text: str) -> tuple[int, ...]:
    try:
        counts = sorted({int(part) for part in text.split(",")})
    except ValueError:
        counts = []
    if not counts or counts[0] < 1:
        raise RequestError(f"`--blinks {text}` is no list of numbers of lines; give for example 10,100,1000")
    return tuple(counts)
