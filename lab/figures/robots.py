# pyright: reportUnknownMemberType=false
# (shapely's stubs leave every **kwargs untyped)
"""Who explored each shape: a simulated robot, or the best stored session of that shape."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from analysis.billiard import roll
from analysis.compare import chord_lengths
from analysis.estimate import running_estimates
from analysis.figures.paper.explored import Explored
from analysis.montecarlo import Lines
from lab.base.errors import ChordlabError, RequestError
from lab.reopen.stored import stored_settings, stored_shape
from lab.review.filmed import SHORTEST_RUN_CM
from lab.review.review import examine, keep
from lab.settings.settings import Settings
from lab.store.lock import is_being_written
from lab.store.reader import SessionReader
from lab.store.tables import Tables, tables_of
from projector.shape import Shape
from tracking.isotropy import TooFewLinesError, examine_lines

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_SIMULATED = "a simulated robot"
_TRACK = ("line", "x_cm", "y_cm", "led_on")
_FEWEST_LINES = 10  # a session with fewer replaces nothing


def simulated_robot(shape: Shape, settings: Settings, *, lines: int, rng: np.random.Generator) -> Explored:
    """Roll a robot with an ideal light sensor from edge to edge of the arena until ``lines`` lines crossed the shape.

    It turns by Lambert's law. Its LED blinks once a camera frame, at the settings' speed.
    """
    within = settings.arena.lines_within
    share = min(1.0, shape.geometry.convex_hull.length / within.length)
    theta, p, length = np.empty(0), np.empty(0), np.empty(0)
    chords = _chords(theta, p, shape)
    while (left := lines - np.unique(chords.line).size) > 0:
        # between two stretches a robot is put down anew on the edge
        rolls = roll(within, 1, math.ceil(left / share + 4 * math.sqrt(left / share)) + 8, rng)
        theta, p = np.append(theta, rolls.theta_rad[0]), np.append(p, rolls.p_cm[0])
        length = np.append(length, rolls.length_cm[0])
        chords = _chords(theta, p, shape)
    crossing = np.unique(chords.line)[:lines]
    runs = int(crossing[-1]) + 1
    chords = chords.of_runs(runs)
    counts = 2 * np.bincount(np.searchsorted(crossing, chords.line), minlength=lines)
    s_cm = np.column_stack([chords.in_cm, chords.out_cm]).ravel()
    running = running_estimates(*Lines(s_cm, counts).invariants())
    estimates = pd.DataFrame(
        {"n": running.n, "line": crossing, "area_cm2": running.area_cm2, "perimeter_cm": running.perimeter_cm}
    )
    return Explored(
        name=shape.name,
        title=shape.title,
        geometry=shape.geometry,
        arena=settings.arena.polygon,
        source=_SIMULATED,
        estimates=estimates,
        chords_cm=chords.out_cm - chords.in_cm,
        runs=runs,
        track=_blinks(chords, theta, p, settings.motion.speed_cm_s / settings.virtual.camera_rate_hz, rng),
        random=partial(_random, theta[:runs], p[:runs], length[:runs], settings, rng.spawn(1)[0]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Chords:
    """Where runs lie in the shape, each array (chords,), run by run: t counts along (−sin θ, cos θ)."""

    line: Ints
    in_cm: Floats
    out_cm: Floats

    def of_runs(self, runs: int) -> _Chords:
        """Those of the first ``runs`` runs."""
        kept = self.line < runs
        return _Chords(self.line[kept], self.in_cm[kept], self.out_cm[kept])


def _chords(theta: Floats, p: Floats, shape: Shape) -> _Chords:
    reach = 2 * float(np.abs(shapely.get_coordinates(shape.geometry)).max())
    foot = p[:, None] * np.column_stack([np.cos(theta), np.sin(theta)])
    along = np.column_stack([-np.sin(theta), np.cos(theta)])
    ends = np.stack([foot - reach * along, foot + reach * along], axis=1)
    parts, line = shapely.get_parts(shapely.intersection(shapely.linestrings(ends), shape.geometry), return_index=True)
    whole = (shapely.get_type_id(parts) == shapely.GeometryType.LINESTRING) & (shapely.length(parts) > 0)
    parts, line = parts[whole], line[whole]
    first, last = shapely.get_point(parts, 0), shapely.get_point(parts, -1)
    cos, sin = np.cos(theta[line]), np.sin(theta[line])
    t = np.sort([shapely.get_y(point) * cos - shapely.get_x(point) * sin for point in (first, last)], axis=0)
    order = np.lexsort([t[0], line])
    return _Chords(line[order].astype(np.int64), t[0][order], t[1][order])


def _blinks(chords: _Chords, theta: Floats, p: Floats, step_cm: float, rng: np.random.Generator) -> pd.DataFrame:
    """Where a camera sees the LED lit: every ``step_cm`` along each run, from a random first frame on."""
    line = chords.line
    phase = rng.random(theta.size)[line]
    first = np.ceil(chords.in_cm / step_cm - phase)
    count = np.maximum(np.floor(chords.out_cm / step_cm - phase) - first + 1, 0).astype(np.int64)
    of = np.repeat(np.arange(line.size), count)
    number = np.arange(of.size) - np.repeat(np.cumsum(count) - count, count)
    t = (first[of] + number + phase[of]) * step_cm
    cos, sin = np.cos(theta[line[of]]), np.sin(theta[line[of]])
    distance = p[line[of]]
    return pd.DataFrame(
        {"line": line[of], "x_cm": distance * cos - t * sin, "y_cm": distance * sin + t * cos, "led_on": True}
    )


def _random(theta: Floats, p: Floats, length: Floats, settings: Settings, rng: np.random.Generator) -> str:
    try:
        return examine_lines(theta, p, length, settings.arena.lines_within, rng, shortest_cm=SHORTEST_RUN_CM).verdict
    except TooFewLinesError:
        return ""


@dataclass(frozen=True, slots=True)
class Stored:
    """Stored sessions that may stand for a simulated robot.

    Attributes:
        by_shape: for each shape, the session with the most crossing lines.
        filmed: the same among those that a camera saw.
        left_out: (folder, why not) of the others.
    """

    by_shape: Mapping[str, Explored]
    filmed: Mapping[str, Explored]
    left_out: tuple[tuple[str, str], ...]


NO_SESSIONS = Stored({}, {}, ())


def stored_robots(folders: Sequence[Path], dictionary: Mapping[str, Shape], *, film: bool) -> Stored:
    """Read sessions of the ``dictionary``'s shapes, at their own size.

    Nothing in the folders is changed but for films that were never tracked: with ``film`` they are, and the track is
    kept.
    """
    by_shape: dict[str, Explored] = {}
    filmed: dict[str, Explored] = {}
    left_out: list[tuple[str, str]] = []
    for folder in folders:
        try:
            session = SessionReader(folder)
            shape, tables = stored_shape(session), tables_of(session)
            reason = _unfit(shape, tables, dictionary)
            if reason:
                left_out.append((folder.name, reason))
                continue
            found = _explored(session, shape, tables, film=film)
        except (ChordlabError, OSError, ValueError, KeyError) as error:
            left_out.append((folder.name, " ".join(str(error).split()) or repr(error)))
            continue
        name = shape.name
        if name not in by_shape or by_shape[name].lines < found.lines:
            by_shape[name] = found
        if found.track is not None and (name not in filmed or filmed[name].lines < found.lines):
            filmed[name] = found
    return Stored(by_shape, filmed, tuple(left_out))


def _unfit(shape: Shape, tables: Tables, dictionary: Mapping[str, Shape]) -> str:
    if shape.name not in dictionary:
        return f"{shape.name} is none of the paper's shapes"
    if shape.digest != dictionary[shape.name].digest:
        return f"its {shape.name} is of another size or outline than the dictionary's"
    if len(tables.estimates) < _FEWEST_LINES:
        return f"only {len(tables.estimates)} lines crossed the shape"
    return ""


def _explored(session: SessionReader, shape: Shape, tables: Tables, *, film: bool) -> Explored:
    counted = tables.lines.loc[tables.lines["counts"], "line"]
    chords = tables.crossings[tables.crossings["line"].isin(counted)]
    track: pd.DataFrame | None = None
    tracked = (session.folder / "track.parquet").is_file()
    # a folder that another process may be writing to is left as it is: it serves, but not for what a camera saw
    if film and session.segments() and (tracked or not is_being_written(session.folder)):
        if not tracked:
            keep(examine(session.folder))
        track = session.table("track")
        if not set(_TRACK) <= set(track.columns):
            raise RequestError(f"{session.folder}: its track is of an older chordlab; run chordlab validate on it")
        track = track.loc[:, list(_TRACK)]
    return Explored(
        name=shape.name,
        title=shape.title,
        geometry=shape.geometry,
        arena=stored_settings(session).arena.polygon,
        source=f"session {session.folder.name}",
        estimates=tables.estimates[["n", "line", "area_cm2", "perimeter_cm"]],
        chords_cm=chord_lengths(chords),
        runs=len(tables.lines),
        track=track,
    )
