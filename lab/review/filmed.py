"""What the camera saw of a stored session: its film tracked, its lines and crossings, the robot's held against them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from analysis.estimate import Estimate, estimate
from analysis.invariants import invariants_table
from lab.reopen.parts import part_of_runs
from lab.review.attribution import attribute, camera_estimate, lines_from_the_edge
from lab.settings.settings import Settings
from lab.store.reader import SessionReader, numbers_of
from lab.store.tables import Tables
from projector.shape import Silhouette
from robot.turning import Policy
from tracking.background import background_of
from tracking.calibration import Calibration
from tracking.identity import LedMark
from tracking.innovations import FilterHealth, filter_health
from tracking.isotropy import IsotropyReport, TooFewLinesError, examine_lines
from tracking.matching import ChordMatch, match_crossings
from tracking.runs import fit_lines
from tracking.segment import frames_table
from tracking.straightness import Straightness, straightness
from tracking.table import systematic_cm
from tracking.track import track_segments
from tracking.truth import near_chords, true_crossings

Progress = Callable[[int, int], None]

SHORTEST_RUN_CM = 5.0  # a few frames: shorter runs cannot be told from turning on the spot


@dataclass(frozen=True, slots=True)
class Filmed:
    """What the camera saw of a session. ``tested``: the lines that isotropy is judged by."""

    track: pd.DataFrame
    lines: pd.DataFrame
    crossings: pd.DataFrame
    match: ChordMatch
    estimate: Estimate | None
    isotropy: IsotropyReport | None
    tested: pd.DataFrame
    straightness: Straightness | None
    health: FilterHealth


def review_film(
    session: SessionReader,
    settings: Settings,
    geometry: Silhouette,
    tables: Tables,
    rng: np.random.Generator,
    workers: int,
    progress: Progress | None,
) -> Filmed | None:
    """Track a session's film and hold its crossings against the camera's; None where it was not filmed.

    Args:
        session: the stored session.
        settings: its settings.
        geometry: the projected shape, arena cm.
        tables: the session's.
        rng: source of the simulated sessions that isotropy is judged by.
        workers: processes that track.
        progress: told how many of the segments are done.
    """
    segments = session.segments()
    if not segments:
        return None
    calibration = Calibration.from_dict(session.manifest["calibration"]["camera"])
    several, part_of = len(settings.robots) > 1, part_of_runs(session)
    if several:
        film = _film_tracked(segments, tables.lines["line"].tolist(), part_of, settings, calibration, progress)
        names = [robot["name"] for robot in session.manifest["devices"]["robots"]]
        track = attribute(on_host_clock(film, segments), tables.lines, names)
    else:
        track = on_host_clock(track_segments(segments, calibration, workers=workers, progress=progress), segments)
    counts = tables.lines.loc[tables.lines["counts"], "line"]
    # a run's number tells its robot
    runs = track.drop(columns="robot") if several else track
    lines = fit_lines(runs, systematic_cm=systematic_cm(calibration))
    lines = lines[lines["line"].isin(counts) & (lines["reason"] == "")].reset_index(drop=True)
    crossings = true_crossings(lines, geometry, track=runs)
    if several:
        found = camera_estimate(lines, crossings, tables.lines)
        tested = lines_from_the_edge(lines, tables.lines, settings.arena.lines_within, part_of)
    else:
        found, tested = _estimate(invariants_table(crossings)), lines
    try:
        # interior stops draw lines in proportion to their length, and mean to
        isotropy = (
            None
            if settings.motion.turning is Policy.INTERIOR
            else examine_lines(
                tested["theta_rad"],
                tested["p_cm"],
                tested["length_cm"],
                settings.arena.lines_within,
                rng,
                chain=tested["line"].map(tables.lines.set_index("line")["robot"]) if several else None,
                shortest_cm=SHORTEST_RUN_CM,
            )
        )
    except TooFewLinesError:
        isotropy = None
    return Filmed(
        track,
        lines,
        crossings,
        match_crossings(
            tables.crossings,
            crossings,
            lines=_unlit_at_their_ends(lines["line"], tables.lines),
            near=near_chords(lines, geometry),
        ),
        found,
        isotropy,
        tested,
        straightness(lines),
        filter_health(track),
    )


def _film_tracked(
    segments: Mapping[int, Path],
    order: Sequence[int],
    part_of: Mapping[int, int],
    settings: Settings,
    calibration: Calibration,
    progress: Progress | None,
) -> pd.DataFrame:
    """Several robots tracked through a session's film: one film for each time that it was resumed, and one before."""
    leds = [LedMark(settings.led_colour(number)) for number in range(len(settings.robots))]
    films: dict[int, dict[int, Path]] = {}
    for line in order:  # slices follow each other as the runs ended, which is the order of the log
        if line in segments:
            films.setdefault(part_of.get(line, 0), {})[line] = segments[line]
    # A part may be too short to learn the empty floor from.
    floor = background_of(list(segments.values())) if len(films) > 1 else None
    done, tracks = 0, list[pd.DataFrame]()
    for slices in films.values():
        told = progress and partial(_further, progress, done, len(segments))
        tracks.append(track_segments(slices, calibration, robots=len(leds), leds=leds, background=floor, progress=told))
        done += len(slices)
    return pd.concat(tracks, ignore_index=True)


def _further(progress: Progress, before: int, total: int, done: int, _: int) -> None:
    progress(before + done, total)


def _unlit_at_their_ends(numbers: pd.Series[int], runs: pd.DataFrame) -> pd.Series[int]:
    """The runs whose chords all end at the shape's outline: a chord that the run itself cuts is no measured length."""
    cut = runs.loc[runs["starts_lit"] | runs["ends_lit"], "line"]
    return numbers[~numbers.isin(cut)]


def on_host_clock(track: pd.DataFrame, segments: Mapping[int, Path]) -> pd.DataFrame:
    """Move each segment's times from the camera's clock to the host's, which stamped the robot's crossings."""
    shift_s: dict[int, float] = {}
    for line, video in segments.items():
        stamps = numbers_of(frames_table(video), ("t_host_s", "t_camera_s"))
        shift_s[line] = float((stamps["t_host_s"] - stamps["t_camera_s"]).median()) if len(stamps) else 0.0
    return track.assign(t_s=track["t_s"] + track["line"].map(shift_s))


def _estimate(lines: pd.DataFrame) -> Estimate | None:
    return estimate(lines["k"], lines["l1_cm"], lines["l3_cm3"]) if len(lines) > 1 else None
