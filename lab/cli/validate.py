"""`chordlab validate` and `finalize`: a stored session, read again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lab.base.errors import RequestError
from lab.cli.completing import sessions
from lab.cli.output import JsonFlag, QuietFlag, emit, progress_bar, say, show_table

if TYPE_CHECKING:
    from lab.store.tables import Tables


FolderArgument = Annotated[Path, typer.Argument(metavar="DIR", help="A session folder.", autocompletion=sessions)]


def validate(
    folder: FolderArgument,
    report: Annotated[bool, typer.Option(help="Write report.html anew.")] = True,
    out: Annotated[
        Path | None, typer.Option("--out", help="Where report and tables go; the session is then left as it is.")
    ] = None,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Hold the robot's estimates against the video's ground truth.

    Example: chordlab validate sessions/2026-11-23T1042_eiffel_ab12
    """
    from lab.review.review import review
    from lab.store.seal import write_checksums

    _check_apart(folder, out)
    with progress_bar("tracking the video", quiet=quiet) as update:
        summary = review(folder, report=report, out=out, progress=update)
    if out is None:
        write_checksums(folder)
    if as_json:
        emit(summary)
        return
    if not quiet:
        _show(summary)
    say(str(summary["verdict"]))
    if summary["report"]:
        say(str(summary["report"]))


def _show(summary: dict[str, Any]) -> None:
    from analysis.report.words import signed

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
            f"robot − camera {signed(chords['bias_cm'], 2)} cm, rms {chords['rms_cm']:.2f} cm"
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


def _show_budget(budget: dict[str, Any]) -> None:
    from analysis.figures.budget import name_of
    from analysis.report.words import signed

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
    from analysis.report.words import signed_with

    return signed_with(term["percent"], term["sigma_percent"])


def finalize(
    folder: FolderArgument,
    from_light: Annotated[
        bool, typer.Option("--from-light", help="From the raw light samples, with these thresholds; see --out.")
    ] = False,
    low: Annotated[float | None, typer.Option(help="Confirms the dark: a share of the span, below 0.5.")] = None,
    high: Annotated[float | None, typer.Option(help="Confirms the light: a share of the span, above 0.5.")] = None,
    out: Annotated[Path | None, typer.Option(help="Where the tables from the light go.")] = None,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Rebuild a session's tables. From its log, or from its raw light with other thresholds.

    Example: chordlab finalize sessions/2026-11-23T1042_eiffel_ab12 --from-light --low 0.35 --high 0.65 --out reread
    """
    from lab.store.seal import write_checksums
    from lab.store.tables import finalize as rebuild

    if from_light:
        _from_light(folder, low, high, out, quiet=quiet, as_json=as_json)
        return
    if (low, high, out) != (None, None, None):
        raise RequestError("--low, --high and --out are for the raw light: give --from-light too")
    tables = rebuild(folder)
    write_checksums(folder)
    counts = {"lines": len(tables.lines), "crossings": len(tables.crossings), "estimates": len(tables.estimates)}
    if as_json:
        emit({"folder": folder, **counts})
    elif not quiet:
        say(", ".join(f"{count} {name}" for name, count in counts.items()))


def _from_light(
    folder: Path, low: float | None, high: float | None, out: Path | None, *, quiet: bool, as_json: bool
) -> None:
    """Tables from the raw light, beside those of the log, which is the truth and is left alone."""
    from lab.reopen.reread import Thresholds, figures_of, reread
    from lab.store.reader import SessionReader
    from lab.store.tables import tables_of

    if (low is None) != (high is None):
        raise RequestError("thresholds come in pairs: give both --low and --high, or neither")
    _check_apart(folder, out)
    thresholds = None if low is None or high is None else Thresholds(low, high)
    with progress_bar("reading the light again", quiet=quiet) as update:
        again = reread(folder, thresholds=thresholds, progress=update)
    logged, found = (figures_of(tables) for tables in (tables_of(SessionReader(folder)), again))
    if out is not None:
        _keep(again, out)
    if as_json:
        emit({"folder": folder, "out": out, "log": logged, "light": found})
        return
    if quiet and out is not None:
        say(str(out))
        return
    names = {"area_cm2": "A, cm²", "perimeter_cm": "P, cm", "crossings": "crossings", "lines": "crossing lines"}
    rows = [
        (text, _plain(logged[name]), _plain(found[name]), _change(logged, found, name)) for name, text in names.items()
    ]
    show_table(f"{folder.name}: the light read again", ("", "log", "light", "change"), rows)
    if out is not None:
        say(str(out))


def _check_apart(folder: Path, out: Path | None) -> None:
    if out is not None and out.resolve().is_relative_to(folder.resolve()):
        raise RequestError(f"{out}: lies in the session, which holds what its log says; choose another --out")


def _keep(tables: Tables, out: Path) -> None:
    from lab.store.tables import Tables, write_table

    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in Tables.__slots__:
            write_table(out, name, getattr(tables, name))
    except OSError as error:
        raise RequestError(f"{out}: {error.strerror or error}; choose another --out") from error


def _plain(figure: float | None) -> str:
    return "–" if figure is None else f"{figure:.1f}" if isinstance(figure, float) else str(figure)


def _change(logged: Mapping[str, float | None], found: Mapping[str, float | None], name: str) -> str:
    from analysis.report.words import signed

    before, after = logged[name], found[name]
    if before is None or after is None:
        return "–"
    if isinstance(before, float):
        return f"{signed(100 * (after / before - 1), 2)} %" if before else "–"
    return signed(after - before, 0)


def _with_error(figures: dict[str, Any], name: str) -> str:
    sigma = figures.get(f"sigma_{name}")
    return f"{figures[name]:.1f}" + (f" ± {sigma:.1f}" if sigma is not None else "")
