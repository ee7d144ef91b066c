"""`chordlab track`: from a video to a table of positions."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from lab.cli.output import JsonFlag, QuietFlag, emit, progress_bar, say


def track(
    videos: Annotated[
        list[Path],
        typer.Argument(metavar="VIDEO...", help="A video of rolling robots, or segments of one still camera."),
    ],
    calibration: Annotated[
        Path | None, typer.Option(help="calibration.json of the camera; without one, pixels only.")
    ] = None,
    robots: Annotated[int, typer.Option(min=1, max=32, help="How many robots to follow.")] = 1,
    balls: Annotated[bool, typer.Option("--balls", help="LEDs are off: follow the balls themselves.")] = False,
    workers: Annotated[int, typer.Option(min=1, help="Processes that share several segments.")] = 2,
    out: Annotated[Path, typer.Option(help="The table: .parquet, or .csv.")] = Path("track.parquet"),
    preview: Annotated[Path | None, typer.Option(help="Also draw track and LED over the video: .mkv, or .mp4.")] = None,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Follow the LEDs through a video: one row a frame (and robot).

    Example: chordlab track video.mkv --calibration calibration.json --out track.parquet
    """
    from lab.filmtrack import check_outputs, preview_films, save_table, summary_of, track_films
    from tracking.calibration import load_calibration
    from tracking.innovations import filter_health

    check_outputs(out, preview)
    optics = load_calibration(calibration) if calibration else None
    with progress_bar("frames" if len(videos) == 1 else "tracking", quiet=quiet) as update:
        table, figures = track_films(videos, optics, robots=robots, balls=balls, workers=workers, progress=update)
    save_table(table, out)
    if preview is not None:
        with progress_bar("preview", quiet=quiet) as update:
            preview_films(videos, table, preview, update)
    summary = summary_of(figures)
    health = filter_health(table) if optics is not None else None
    if as_json:
        emit(
            {
                **summary,
                "robots": robots,
                "filter": None if health is None else health.to_dict(),
                "out": out,
                "preview": preview,
                "videos": [asdict(film) for film in figures],
            }
        )
        return
    if not quiet:
        say(_line(summary, robots))
    if health is not None and not quiet:
        say(health.verdict)
    for written in (out, preview):
        if written is not None:
            say(str(written))


def _line(summary: dict[str, Any], robots: int) -> str:
    """The result in one line; what did not happen is not mentioned."""
    from analysis.report.words import percent

    text = (
        f"{summary['frames']} frames at {summary['rate_hz']:.1f} Hz, {robots} robot{'s' if robots > 1 else ''}: "
        f"seen in {percent(summary['seen_share'])}, lit in {percent(summary['lit_share'])} of rows; "
        f"{summary['dropped']} dropped"
    )
    for key, name in (("duplicated", "stamped twice"), ("frozen", "frozen")):
        if summary[key]:
            text += f", {summary[key]} {name}"
    if summary["truncated"]:
        lost = summary["frames_lost"]
        text += "; cut short" if lost is None else f"; cut short, {lost} lost"
    return text
