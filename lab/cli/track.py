"""`chordlab track`: from a video to a table of positions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lab.base.errors import RequestError
from lab.cli.output import JsonFlag, emit, progress_bar, say
from tracking.calibration import load_calibration
from tracking.overlay import write_preview
from tracking.track import track_video


def track(
    video: Annotated[Path, typer.Argument(metavar="VIDEO", help="Any video of rolling robots.")],
    calibration: Annotated[
        Path | None, typer.Option(help="calibration.json of the camera; without one, pixels only.")
    ] = None,
    robots: Annotated[int, typer.Option(min=1, max=32, help="How many robots to follow.")] = 1,
    out: Annotated[Path, typer.Option(help="The table: .parquet, or .csv.")] = Path("track.parquet"),
    preview: Annotated[Path | None, typer.Option(help="Also draw track and LED over the video (.mkv).")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Follow the LEDs through a video: one row a frame (and robot).

    Example: chordlab track video.mkv --calibration calibration.json --out track.parquet
    """
    if out.suffix not in (".parquet", ".csv"):
        raise RequestError(f"{out}: the table is written as .parquet or .csv; name it so")
    optics = load_calibration(calibration) if calibration else None
    with progress_bar("frames", quiet=as_json) as update:
        table = track_video(video, calibration=optics, robots=robots, progress=update)
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix == ".csv":
        table.to_csv(out, index=False)
    else:
        table.to_parquet(out, index=False)
    if preview is not None:
        write_preview(video, table, preview)
    seen = table[["x_px", "y_px"]].notna().all(axis=1)
    summary = {
        "frames": int(table["frame"].nunique()),
        "robots": robots,
        "seen_share": float(seen.mean()) if len(table) else 0.0,
        "lit_share": float(table["led_on"].mean()) if len(table) else 0.0,
        "out": out,
        "preview": preview,
    }
    if as_json:
        emit(summary)
        return
    say(
        f"{summary['frames']} frames, {robots} robot{'s' if robots > 1 else ''}: "
        f"seen in {summary['seen_share']:.1%}, lit in {summary['lit_share']:.1%} of rows"
    )
    for written in (out, preview):
        if written is not None:
            say(str(written))
