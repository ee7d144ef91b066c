"""`chordlab validate`, `recognize` and `finalize`: a stored session, read again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lab.base.errors import RequestError
from lab.cli.output import JsonFlag, emit, progress_bar, say, show_table
from lab.finalize import finalize as rebuild
from lab.finalize import tables_of
from lab.review import recognised, review
from lab.store import SessionReader, write_checksums

FolderArgument = Annotated[Path, typer.Argument(metavar="DIR", help="A session folder.")]


def validate(
    folder: FolderArgument,
    report: Annotated[bool, typer.Option(help="Write report.html anew.")] = True,
    as_json: JsonFlag = False,
) -> None:
    """Hold the robot's estimates against the video's ground truth.

    Example: chordlab validate sessions/2026-11-23T1042_eiffel_ab12
    """
    with progress_bar("tracking the video", quiet=as_json) as update:
        summary = review(folder, report=report, progress=update)
    if report:
        write_checksums(folder)
    if as_json:
        emit(summary)
        return
    rows = [
        (who, _with_error(summary[who], "area_cm2"), _with_error(summary[who], "perimeter_cm"))
        for who in ("robot", "camera", "truth")
        if summary[who]
    ]
    show_table(f"{summary['shape']}: {summary['lines']} lines of {summary['runs']} runs", ("", "A, cm²", "P, cm"), rows)
    chords = summary["chords"]
    if chords:
        say(
            f"chords: {chords['matched']} matched, {chords['missed']} missed, {chords['extra']} extra; "
            f"robot − camera {chords['bias_cm']:+.2f} cm, rms {chords['rms_cm']:.2f} cm"
        )
    for name in ("isotropy", "homogeneity"):
        if summary[name]:
            say(f"{name}: p = {summary[name]['p_value']:.3g}")
    say(str(summary["verdict"]))
    if summary["report"]:
        say(str(summary["report"]))


def recognize(
    folder: FolderArgument,
    steps: Annotated[int, typer.Option(min=1, help="Rows to show, spread over the session.")] = 12,
    as_json: JsonFlag = False,
) -> None:
    """The posterior over the dictionary, as lines arrive.

    Example: chordlab recognize sessions/2026-11-23T1042_eiffel_ab12
    """
    session = SessionReader(folder)
    ranking, posteriors = recognised(session, tables_of(session))
    if posteriors.empty:
        raise RequestError(f"{folder}: no line crossed the shape, so there is nothing to recognise")
    if as_json:
        columns: dict[str, Any] = {str(name): posteriors[name].to_numpy() for name in posteriors}
        emit({"n": columns.pop("n"), "posterior": columns, "ranking": ranking})
        return
    names = [name for name, _ in ranking[:6]]
    picked = posteriors.iloc[[*range(0, len(posteriors), max(1, len(posteriors) // steps)), len(posteriors) - 1]]
    rows = [
        (str(int(row["n"])), *(f"{row[name]:.3f}" for name in names))
        for _, row in picked.drop_duplicates("n").iterrows()
    ]
    show_table("posterior after n lines", ("n", *names), rows)
    say(f"{ranking[0][0]}: {ranking[0][1]:.4f}")


def finalize(folder: FolderArgument, as_json: JsonFlag = False) -> None:
    """Rebuild a session's tables from its log.

    Example: chordlab finalize sessions/2026-11-23T1042_eiffel_ab12
    """
    tables = rebuild(folder)
    write_checksums(folder)
    counts = {"lines": len(tables.lines), "crossings": len(tables.crossings), "estimates": len(tables.estimates)}
    if as_json:
        emit({"folder": folder, **counts})
    else:
        say(", ".join(f"{count} {name}" for name, count in counts.items()))


def _with_error(figures: dict[str, Any], name: str) -> str:
    sigma = figures.get(f"sigma_{name}")
    return f"{figures[name]:.1f}" + (f" ± {sigma:.1f}" if sigma is not None else "")
