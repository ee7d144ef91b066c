"""`chordlab track`: one video, or the segments of one film, to a table, a preview and a few figures."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lab.base.errors import RequestError
from lab.base.files import write_aside
from tracking.calibration import Calibration, CalibrationError
from tracking.overlay import write_preview
from tracking.stamps import frozen, timing_of
from tracking.track import track_segments, track_video
from tracking.video import VideoInfo, ending_of, probe

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class FilmFigures:
    """What came out of one video.

    Attributes:
        video: the file.
        frames: pictures in it, which is the number of the table's rows for each robot.
        seen_share: share of the rows (0..1) in which the robot's LED was seen.
        lit_share: share of the rows in which it was bright.
        rate_hz: frames a second, from the usual interval of the time stamps; NaN with fewer than two frames.
        dropped: frames missing, from gaps in the time stamps.
        duplicated: frames under a stamp that is no later than the one before.
        frozen: frames that show the picture before them again under a stamp of their own.
        truncated: the end of the file is missing.
        frames_lost: frames that are missing with it; None where the file does not say.
    """

    video: Path
    frames: int
    seen_share: float
    lit_share: float
    rate_hz: float
    dropped: int
    duplicated: int
    frozen: int
    truncated: bool
    frames_lost: int | None


def track_films(
    videos: Sequence[Path],
    calibration: Calibration | None,
    *,
    robots: int = 1,
    balls: bool = False,
    workers: int = 2,
    progress: Progress | None = None,
) -> tuple[pd.DataFrame, list[FilmFigures]]:
    """Track one video, or several that one camera took of one scene without being moved.

    Several are learnt from together (floor, levels of the LED); those of one robot are tracked on several cores, those
    of several robots are slices of one film, in the order given. With ``balls`` the LEDs are off and the balls
    themselves are followed, through each video by itself: nothing says which robot of one is which of the next.

    Returns:
        The table of ``tracking.track.track_video``; of several videos with their names before it (``video``). And each
        video's figures.

    Raises:
        VideoError: a video cannot be read.
        CalibrationError: the calibration is for pictures of another size.
        RequestError: no LED is seen in any of the videos, a video is given twice, or several do not show one scene.
    """
    if len(set(videos)) < len(videos):
        raise RequestError("a video is given twice; name each once")
    infos = [probe(video) for video in videos]
    for info in infos:
        _check_size(info, calibration)
    with _remarks() as speak:
        parts: list[pd.DataFrame]
        if len(videos) == 1:
            table = track_video(videos[0], calibration=calibration, robots=robots, balls=balls, progress=progress)
            parts = [table]
        else:
            if balls:
                table = _one_by_one(videos, calibration, robots, progress)
            else:
                table = track_segments(videos, calibration, robots=robots, workers=workers, progress=progress)
            numbers = table.pop("line").to_numpy()
            parts = [table.loc[numbers == number] for number in range(len(videos))]
            table.insert(0, "video", np.array([str(video) for video in videos], dtype=object)[numbers])
        figures = [_figures(info, part) for info, part in zip(infos, parts, strict=True)]
        if not (table["quality"] > 0).any():
            where = str(videos[0]) if len(videos) == 1 else f"{len(videos)} videos"
            raise RequestError(
                f"{where}: no {'ball' if balls else 'LED'} in any of {sum(film.frames for film in figures)} frames; "
                f"{'' if balls else 'switch it on, darken the room, and '}let the camera see the robot move"
            )
        speak()
    return table, figures


def _one_by_one(
    videos: Sequence[Path], calibration: Calibration | None, robots: int, progress: Progress | None
) -> pd.DataFrame:
    """Follow balls through videos, each by itself; ``line`` is the video's number."""
    tables: list[pd.DataFrame] = []
    for number, video in enumerate(videos):
        table = track_video(video, calibration=calibration, robots=robots, balls=True)
        table.insert(0, "line", number)
        tables.append(table)
        if progress is not None:
            progress(len(tables), len(videos))
    return pd.concat(tables, ignore_index=True)


def save_table(table: pd.DataFrame, out: Path) -> None:
    """Write a table whole or not at all, .parquet or .csv.

    Raises:
        RequestError: it cannot be written there.
    """
    if out.suffix == ".csv":
        data = table.to_csv(index=False).encode()
    else:
        buffer = io.BytesIO()
        table.to_parquet(buffer, index=False)
        data = buffer.getvalue()
    try:
        write_aside(out, data)
    except OSError as error:
        raise RequestError(f"{out}: cannot be written ({error.strerror}); choose another --out") from error


def check_outputs(out: Path, preview: Path | None) -> None:
    """Find out before hours of work whether the results can be written. Makes the folders.

    Raises:
        RequestError: a name's ending is not known, or a folder cannot be made.
    """
    if out.suffix not in (".parquet", ".csv"):
        raise RequestError(f"{out}: the table is written as .parquet or .csv; name it so")
    if preview is not None and preview.suffix.lower() not in (".mkv", ".mp4"):
        raise RequestError(f"{preview}: the preview is written as .mkv or .mp4; name it so")
    for file in (out, preview):
        if file is not None:
            try:
                file.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise RequestError(f"{file.parent}: no folder can be made there ({error.strerror})") from error


def preview_films(videos: Sequence[Path], table: pd.DataFrame, out: Path, progress: Progress | None) -> None:
    """Draw the track over its videos, one after the other in one preview; errors as ``write_preview``."""
    of_video = table["video"] if "video" in table.columns else pd.Series(str(videos[0]), index=table.index)
    tracks = [table.loc[np.asarray(of_video == str(video))] for video in videos]
    write_preview(videos, tracks, out, progress=progress)


def summary_of(figures: Sequence[FilmFigures]) -> dict[str, Any]:
    """The figures of all videos together; each is weighted by its frames.

    ``frames_lost`` is None where one of the videos does not know it.
    """
    frames = sum(film.frames for film in figures)
    lost = [film.frames_lost for film in figures]
    rates = [film.rate_hz for film in figures if np.isfinite(film.rate_hz)]
    return {
        "frames": frames,
        "seen_share": sum(film.seen_share * film.frames for film in figures) / max(frames, 1),
        "lit_share": sum(film.lit_share * film.frames for film in figures) / max(frames, 1),
        "rate_hz": float(np.median(rates)) if rates else float("nan"),
        "dropped": sum(film.dropped for film in figures),
        "duplicated": sum(film.duplicated for film in figures),
        "frozen": sum(film.frozen for film in figures),
        "truncated": any(film.truncated for film in figures),
        "frames_lost": None if None in lost else sum(number or 0 for number in lost),
    }


def _check_size(info: VideoInfo, calibration: Calibration | None) -> None:
    if calibration is not None:
        try:
            calibration.check_size(info.size)
        except CalibrationError as error:
            raise CalibrationError(f"{info.path}: {error}") from error


def _figures(info: VideoInfo, table: pd.DataFrame) -> FilmFigures:
    first = table.loc[np.asarray(table["robot"] == 0)] if "robot" in table.columns else table
    timing = timing_of(first["t_s"])
    ending = ending_of(info, len(first), float(first["t_s"].max()))
    return FilmFigures(
        video=info.path,
        frames=len(first),
        seen_share=float(table["x_px"].notna().mean()),
        lit_share=float(table["led_on"].mean()),
        rate_hz=timing.rate_hz,
        dropped=timing.dropped,
        duplicated=timing.duplicated,
        frozen=int(frozen(first["t_s"], first["x_px"], first["y_px"]).sum()),
        truncated=ending.truncated,
        frames_lost=ending.frames_lost,
    )


class _HeldBack(logging.Filter):
    """Keeps what is said, each remark once, until it is known whether an error says it better."""

    def __init__(self) -> None:
        super().__init__()
        self.records: dict[str, logging.LogRecord] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        self.records.setdefault(record.getMessage(), record)
        return False


@contextmanager
def _remarks() -> Generator[Callable[[], None]]:
    """Hold back the tracker's remarks; yields what lets them go."""
    held = _HeldBack()
    loggers = [logging.getLogger(name) for name in ("tracking.video", "tracking.track")]

    def quieten() -> None:
        for logger in loggers:
            logger.removeFilter(held)

    def speak() -> None:
        quieten()
        for record in held.records.values():
            logging.getLogger(record.name).handle(record)

    for logger in loggers:
        logger.addFilter(held)
    try:
        yield speak
    finally:
        quieten()
