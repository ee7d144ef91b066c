"""From video to track: one row a frame (and robot), times from the stream's PTS.

Two ways of looking, chosen from the data. Under a camera that stands still the empty floor is learnt and each LED
followed on it, to a fraction of a pixel; several are told apart by colour, blink and motion. Under a camera that moves
the red matrices are found in each frame on their own and tied together by motion, to a pixel or two; that needs colour.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from lab.base.errors import RequestError
from tracking.background import Background, background_of, sample_scene
from tracking.calibration import Calibration
from tracking.identity import LedMark
from tracking.lights import learn_floor
from tracking.passes import Progress, RawTrack, check_still, follow_balls, follow_markers, follow_one, follow_several
from tracking.table import empty_table, interleave, led_columns, track_table
from tracking.workers import Followed, follow_each, one_thread

_log = logging.getLogger(__name__)

_SURE = 0.9  # an identity less probable than this is worth a warning


def track_video(
    path: str | Path,
    *,
    calibration: Calibration | None = None,
    robots: int = 1,
    leds: Sequence[LedMark] | None = None,
    balls: bool = False,
    background: Background | None = None,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Track the robots' LEDs through one video.

    Args:
        path: the video.
        calibration: the camera's, for positions in the arena; without it there are pixels only.
        robots: how many robots to keep apart.
        leds: what each robot's LED is known by, in the order of the robots; None: several robots' colours are
            learnt, and they are numbered in the order of their first sighting, from the top of the picture down.
        balls: the LEDs are off: follow the balls themselves, to a pixel or two, under a still camera; robots are
            then told apart by motion alone.
        background: the empty floor, where it is known already; else it is learnt from the video.
        progress: called now and then with (frames done, frames in all as far as is known).

    Returns:
        One row a frame of the video, ordered by frame (and then robot). Columns ``frame`` (from 0), ``t_s`` (PTS),
        ``x_px y_px`` (NaN where the LED was not seen), ``led_on`` (bool; the brighter of the LED's two levels, or seen
        at all where it has only one; False where not seen), ``led_confidence`` (0..1: the probability that ``led_on``
        is right; see ``ledstate.led_states``; NaN under a moving camera), ``quality`` (0..1: how well a spot explains
        the picture; 0 = not seen). With a calibration also, in the arena's frame, ``x_cm y_cm`` (NaN as above),
        ``x_smooth_cm y_smooth_cm vx_cm_s vy_cm_s sigma_x_cm sigma_y_cm`` (Kalman smoothed; gaps bridged, NaN
        only before the first and after the last sighting), ``innovation_x innovation_y`` (what the forward filter had
        not foreseen of the position, over its stated standard deviation) and ``nis`` (their squares' sum; NaN where
        there was no measurement, or only the frame before once more). With more than one robot also ``robot`` (from 0)
        after ``frame`` and ``identity`` after ``quality``: the probability that it is this robot and not another one,
        0 where not seen, NaN under a moving camera, where nothing tells.

    Raises:
        VideoError: the video cannot be read.
        CalibrationError: the calibration is for pictures of another size.
        RequestError: ``robots`` is below 1, ``leds`` are not one a robot, or a moving camera meets a video without
            colour, or balls that are to be followed.
    """
    if robots < 1:
        raise RequestError(f"cannot track {robots} robots; ask for one or more")
    with one_thread():
        if balls:
            still = True
            raws = follow_balls(Path(path), robots, calibration, background, progress)
        elif robots == 1:
            background = background or background_of([path])
            still = background.is_static
            raws = [follow_one(Path(path), background, calibration, threads=2, progress=progress)] if still else []
        else:
            floor = learn_floor(sample_scene([path]), coloured=_coloured(leds), background=background)
            still = floor.background.is_static
            raws = follow_several([Path(path)], floor, robots, leds, calibration, progress)[0] if still else []
        if not still:
            raws = follow_markers(Path(path), robots, calibration, progress)
    tables = [track_table(raw, calibration, None if balls else led_columns([raw])[0]) for raw in raws]
    for number, (raw, table) in enumerate(zip(raws, tables, strict=True)):
        _warn(str(path), number, raw)
        if robots > 1:
            table["robot"] = number
    return tables[0] if robots == 1 else interleave(tables)


def track_segments(
    paths: Sequence[str | Path] | Mapping[int, str | Path],
    calibration: Calibration | None,
    *,
    workers: int = 2,
    robots: int = 1,
    leds: Sequence[LedMark] | None = None,
    background: Background | None = None,
    progress: Progress | None = None,
) -> pd.DataFrame:
    """Track robots through many segments filmed by one static camera, as a session's are.

    The background and the LED's two levels are learnt from all segments together: a line that misses the shape shows
    one level only. A lone robot's segments are its lines, each followed by itself. With several robots the segments
    are slices of one film, in order, and followed as one: what happens in one slice tells who is who in the next.

    Args:
        paths: the segments, in the order of their lines (line = index), or a mapping from line to segment.
        calibration: the camera's, or None for pixels only.
        workers: processes to use ("spawn": a script that calls this needs the usual main guard); several robots
            are followed in this one.
        robots: how many robots to keep apart.
        leds: what each is known by; see ``track_video``.
        background: the empty floor, where it is known already.
        progress: called after each segment with (segments done, segments in all).

    Returns:
        The columns of ``track_video`` with ``line``, the segment's, before them; ``frame`` counts anew in each segment
        and ``t_s`` is its file's own. No segments give an empty table.

    Raises:
        VideoError: a segment cannot be read.
        CalibrationError: the calibration is for pictures of another size.
        RequestError: the camera moved between or within the segments, or ``leds`` are not one a robot.
    """
    jobs = list(paths.items()) if isinstance(paths, Mapping) else list(enumerate(paths))
    if not jobs:
        return empty_table(robots, calibration)
    if robots > 1:
        return _track_film(jobs, calibration, robots, leds, background, progress)
    floor = background if background is not None else background_of([path for _, path in jobs])
    check_still(floor)
    files = [Path(path) for _, path in jobs]
    done: list[Followed] = []
    for result in follow_each(files, floor, calibration, min(workers, len(jobs))):
        done.append(result)
        if progress is not None:
            progress(len(done), len(jobs))
    states = led_columns([raw for raw, _ in done])
    tables: list[pd.DataFrame] = []
    for (line, _), (_, table), state in zip(jobs, done, states, strict=True):
        table["led_on"], table["led_confidence"] = state.on, state.confidence
        table.insert(0, "line", line)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


def _track_film(
    jobs: Sequence[tuple[int, str | Path]],
    calibration: Calibration | None,
    robots: int,
    leds: Sequence[LedMark] | None,
    background: Background | None,
    progress: Progress | None,
) -> pd.DataFrame:
    """Track several robots through the slices of one film."""
    files = [Path(path) for _, path in jobs]
    with one_thread():
        floor = learn_floor(sample_scene(files), coloured=_coloured(leds), background=background)
        check_still(floor.background)
        raws, slices = follow_several(files, floor, robots, leds, calibration, progress)
    numbers = np.array([line for line, _ in jobs], dtype=np.int64)[slices.file]
    tables: list[pd.DataFrame] = []
    for number, raw in enumerate(raws):
        _warn("the film", number, raw)
        table = track_table(raw, calibration, led_columns([raw])[0])
        table["robot"] = number
        tables.append(table)
    film = interleave(tables)
    of_row = film["frame"].to_numpy()
    film.insert(0, "line", numbers[of_row])
    return film.assign(frame=slices.frame[of_row], t_s=slices.t_s[of_row])


def _coloured(leds: Sequence[LedMark] | None) -> bool:
    return leds is not None and any(led.colour is not None for led in leds)


def _warn(name: str, number: int, raw: RawTrack) -> None:
    """Say what one would else have to find in the table."""
    if not (raw.quality > 0).any():
        _log.warning("%s: robot %d was never seen; is its LED on, and of its colour?", name, number)
    elif raw.identity is not None:
        unsure = int(((raw.identity > 0) & (raw.identity < _SURE)).sum())
        if unsure:
            _log.warning("%s: robot %d may be another one in %d frames (column identity)", name, number, unsure)
