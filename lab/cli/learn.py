"""`chordlab shapes learn`: what a dictionary looks like to a robot's sensor, worked out before it is needed."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from lab.cli.choosing import (
    CollectionOption,
    FontOption,
    SchedulerOption,
    ShapeArguments,
    WorkersOption,
    chosen_shapes,
)
from lab.cli.output import JsonFlag, QuietFlag, emit, progress_bar, say
from projector.catalogue import PAPER


def learn(
    shapes: ShapeArguments = None,
    collection: CollectionOption = None,
    session: Annotated[
        Path | None, typer.Option("--settings", help="Session's TOML file: its robot and arena. Default: the virtual.")
    ] = None,
    font: FontOption = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Learn how entries look through the robot's sensor. It is kept for the sessions to come.

    A session learns what it lacks by itself; a large collection is learnt sooner by many.

    Example: chordlab shapes learn --collection letters --workers 2
    """
    from analysis.tablestore import TableStore
    from lab.recognise.recognisers import tables_for
    from lab.settings.load import load_settings
    from lab.spread.spread import spreading

    chosen = chosen_shapes(shapes, collection or (None if shapes else PAPER), font)
    store, began_s = TableStore(), time.perf_counter()
    with progress_bar("entries", quiet=quiet) as update:
        tables_for(
            {shape.name: shape for shape in chosen},
            load_settings(session, {}),
            progress=update,
            store=store,
            mapper=spreading(workers, scheduler),
        )
    seconds = time.perf_counter() - began_s
    if as_json:
        emit({"entries": [shape.name for shape in chosen], "seconds": seconds, "kept": store.folder})
        return
    say(f"{len(chosen)} entries are known, after {seconds:.1f} s: {store.folder}")
