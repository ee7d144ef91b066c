"""`chordlab classes`: which stored sessions were over the same shape, without a dictionary."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lab.cli.choosing import leaving, picture_path
from lab.cli.output import JsonFlag, QuietFlag, emit, say, show_table

if TYPE_CHECKING:
    from lab.recognise.classes import Sorted


def classes(
    roots: Annotated[list[Path], typer.Argument(metavar="ROOT...", help="Folders that hold sessions.")],
    number: Annotated[
        int | None, typer.Option("--classes", min=1, help="How many; default: as many as it finds.")
    ] = None,
    method: Annotated[str, typer.Option("--method", help="errors, mixture or kmeans.")] = "errors",
    lines: Annotated[
        int | None, typer.Option("--lines", min=10, help="Cut each session into runs of so many crossing lines.")
    ] = None,
    by: Annotated[str, typer.Option("--by", help="size (A and P) or lines (five means of the lines).")] = "size",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random starts.")] = 1,
    out: Annotated[Path | None, typer.Option("--out", help="Picture of the (P, A) plane, .svg, .png or .pdf.")] = None,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Sort sessions by their lines, as if no shape had a name.

    Example: chordlab classes sessions --out classes.svg
    """
    import numpy as np

    from analysis.figures.classes import classes_figure
    from analysis.figures.style import save_figure
    from lab.batch.places import sessions_below
    from lab.recognise.classes import sort_sessions

    target = picture_path(out) if out else None
    found = sort_sessions(
        sessions_below(roots), np.random.default_rng(seed), number=number, method=method, lines=lines, kind=by
    )
    if target is not None:
        with leaving(target):
            save_figure(classes_figure(found.points), target)
    if as_json:
        emit({**_figures(found), "picture": target})
        return
    if quiet and target is not None:
        say(str(target))
        return
    show_table(
        f"{found.classes.number} classes of {len(found.points)} runs ({found.classes.criterion})",
        ("run", "lines", "class", "sure", "A, cm²", "P, cm", "nearest other"),
        [
            (
                point.name,
                str(point.lines),
                str(point.label + 1),
                f"{100 * sure:.0f} %",
                f"{point.area_cm2:.0f}",
                f"{point.perimeter_cm:.0f}",
                f"{found.points[near[0][0]].name} ({near[0][1]:.1f} σ)",
            )
            for point, sure, near in zip(found.points, found.classes.probability, found.nearest, strict=True)
        ],
    )
    for name, reason in found.left_out:
        say(f"{name}: {reason}")
    if found.score is not None:
        say(
            f"against the shapes that were projected: adjusted Rand index {found.score.rand:.2f}, "
            f"V-measure {found.score.v_measure:.2f}"
        )
    if target is not None:
        say(str(target))


def _figures(found: Sorted) -> dict[str, Any]:
    chosen = found.classes
    return {
        "classes": chosen.number,
        "method": chosen.method,
        "criterion": chosen.criterion,
        "scores": chosen.scores,
        "runs": [
            {
                "session": point.name,
                "lines": point.lines,
                "class": point.label + 1,
                "probability": float(sure),
                "area_cm2": point.area_cm2,
                "perimeter_cm": point.perimeter_cm,
                "nearest": [{"session": found.points[other].name, "sigmas": away} for other, away in near],
            }
            for point, sure, near in zip(found.points, chosen.probability, found.nearest, strict=True)
        ],
        "left_out": [{"session": name, "reason": reason} for name, reason in found.left_out],
        "truth": None
        if found.score is None
        else {"adjusted_rand": found.score.rand, "v_measure": found.score.v_measure},
    }
