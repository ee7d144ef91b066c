"""`chordlab validate` and `finalize`: a stored session, read again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from analysis.figures.budget import name_of
from analysis.report.words import signed, signed_with
from lab.cli.output import JsonFlag, emit, progress_bar, say, show_table
from lab.finalize import finalize as rebuild
from lab.review import review
from lab.store import write_checksums

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
    for name in ("straightness", "filter"):
        if summary[name]:
            say(str(summary[name]["verdict"]))
    for name in ("isotropy", "homogeneity"):
        if summary[name]:
            say(f"{name}: p = {summary[name]['p_value']:.3g}")
    if summary["isotropy"]:
        say(str(summary["isotropy"]["verdict"]))
    if summary["budget"]:
        _show_budget(summary["budget"])
    if summary["montecarlo"]:
        say(f"Monte Carlo: {summary['montecarlo']['sentence']}")
    say(str(summary["verdict"]))
    if summary["report"]:
        say(str(summary["report"]))


def _show_budget(budget: dict[str, Any]) -> None:
    rows = [
        (name_of(area["term"]), _percent(area), _percent(perimeter))
        for area, perimeter in zip(budget["area"], budget["perimeter"], strict=True)
    ]
    seen = budget["seen_percent"]
    rows.append(("robot − truth", signed(seen["area"]), signed(seen["perimeter"])))
    show_table("error budget", ("", "A, %", "P, %"), rows)
    source = "" if budget["filmed"] else "predicted, for want of a video; "
    say(f"budget: {source}{'adds up' if budget['closes'] else 'does NOT add up'} to what was seen within its errors")


def _percent(term: dict[str, Any]) -> str:
    return signed_with(term["percent"], term["sigma_percent"])


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
