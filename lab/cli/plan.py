"""`chordlab plan`: how many lines, how long, how many charges a session will need."""

from __future__ import annotations

import re
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lab.base.errors import RequestError
from lab.cli.choosing import CollectionOption, ConfidenceOption, FontOption, ShapeArguments, chosen_shapes
from lab.cli.output import JsonFlag, QuietFlag, emit, progress_bar, say, show_table
from projector.catalogue import PAPER

if TYPE_CHECKING:
    from lab.plan import Goal, Plan
    from lab.settings.settings import Settings


def plan(
    shapes: ShapeArguments = None,
    collection: CollectionOption = None,
    confidence: ConfidenceOption = 0.95,
    precision: Annotated[
        float, typer.Option("--precision", min=0, max=1, help="Relative error of A and of P asked for.")
    ] = 0.05,
    speed: Annotated[float | None, typer.Option("--speed", help="Cruising speed, cm/s.")] = None,
    arena: Annotated[
        str | None, typer.Option("--arena", metavar="SIZE", help="150x100 or disc:50 (the radius), cm between walls.")
    ] = None,
    robots: Annotated[int, typer.Option("--robots", min=1, max=8, help="On the floor at once.")] = 1,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random lines.")] = 1,
    font: FontOption = None,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Say how many lines, runs and hours each SHAPE will need. Lines that cross it, runs of the arena; and charges.

    The shapes are told from the entries of --collection (the paper's six by default); without SHAPE, all of them.

    Example: chordlab plan eiffel --confidence 0.95 --precision 0.05 --speed 15 --arena 150x100
    """
    import numpy as np

    from lab.plan import plan as plan_sessions
    from projector.collections import load_dictionary

    settings = _settings(speed, arena, robots)
    dictionary = load_dictionary(collection or PAPER, font=font)
    named = chosen_shapes(shapes, None, font)
    dictionary |= {shape.name: shape for shape in named if shape.name not in dictionary}
    with progress_bar("entries", quiet=quiet) as update:
        found = plan_sessions(
            named or list(dictionary.values()),
            dictionary,
            settings,
            np.random.default_rng(seed),
            confidence=confidence,
            precision=precision,
            progress=update,
        )
    if as_json:
        emit(_figures(found, settings))
    else:
        _show(found)


def _settings(speed: float | None, arena: str | None, robots: int) -> Settings:
    from lab.settings.load import load_settings

    chosen: dict[str, Any] = {"robot": ["virtual"] * robots, "camera": "none"}
    if speed is not None:
        chosen["motion.speed_cm_s"] = speed
    if arena is not None:
        rectangle = re.fullmatch(r"([\d.]+)x([\d.]+)", arena)
        disc = re.fullmatch(r"disc:([\d.]+)", arena)
        try:
            if rectangle:
                chosen |= {"arena.width_cm": float(rectangle[1]), "arena.height_cm": float(rectangle[2])}
            elif disc:
                chosen |= {"arena.kind": "disc", "arena.radius_cm": float(disc[1])}
            else:
                raise ValueError(arena)
        except ValueError as error:
            raise RequestError(f"--arena {arena} is no size; write 150x100 or disc:50, in cm") from error
    return load_settings(None, chosen)


def _figures(found: Plan, settings: Settings) -> dict[str, Any]:
    pace = found.pace
    return {
        "confidence": found.confidence,
        "precision": found.precision,
        "arena": settings.arena.model_dump(mode="json"),
        "robots": pace.robots,
        "speed_cm_s": pace.speed_cm_s,
        "mean_run_cm": pace.mean_run_cm,
        "seconds_per_run": pace.run_s,
        "seconds_per_charge": found.charge_s,
        "shapes": [asdict(entry) for entry in found.entries],
    }


def _show(found: Plan) -> None:
    from analysis.report.words import signed

    pace = found.pace
    for entry in found.entries:
        show_table(
            f"{entry.name}: {100 * entry.share:.0f} of 100 runs cross it",
            ("to reach", "lines", "arena runs", "time", "charges", "video, GB"),
            [_row(goal, found) for goal in entry.goals],
        )
        if max(abs(entry.sensor_area_rel), abs(entry.sensor_perimeter_rel)) > found.precision:
            say(
                f"{entry.name}: the light sensor alone puts {signed(100 * entry.sensor_area_rel)} % on A and "
                f"{signed(100 * entry.sensor_perimeter_rel)} % on P; more lines do not mend that"
            )
    together = f"{pace.robots} robots" if pace.robots > 1 else "one robot"
    say("in brackets: enough for 90 sessions of 100")
    say(
        f"{together} at {pace.speed_cm_s:.1f} cm/s: runs of {pace.mean_run_cm:.0f} cm on average, "
        f"{pace.run_s:.1f} s each with the turn; a charge lasts {found.charge_s / 3600:.1f} h of rolling"
    )


def _row(goal: Goal, found: Plan) -> tuple[str, ...]:
    share = f"{100 * found.confidence:g} % right"
    names = {
        "by (P, A)": f"{share}, (P, A)",
        "line by line": f"{share}, by line",
        "--until": f"--until {found.confidence:g}",
        "precision of A": f"A to {100 * found.precision:g} %",
        "precision of P": f"P to {100 * found.precision:g} %",
    }
    need = goal.need
    if need is None:
        return names[goal.name], "never", *["–"] * 4
    return (
        names[goal.name],
        f"{need.lines} ({need.lines_likely})",
        f"{need.runs} ({need.runs_likely})",
        f"{_time(need.seconds)} ({_time(need.seconds_likely)})",
        str(goal.charges),
        f"{goal.video_gb:.2f}",
    )


def _time(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds < 5940 else f"{seconds / 3600:.1f} h"
