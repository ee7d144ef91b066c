"""A stored session against simulated ones of its own shape, arena, turning and light sensor."""

from __future__ import annotations

import numpy as np

from analysis.bandcheck import MonteCarloCheck
from analysis.bandtest import (
    FEWEST_SESSIONS,
    FIRST_LINES,
    SESSIONS,
    band_test,
    checkpoints_to,
    curve_of,
    independent_curves,
    rolled_curves,
)
from analysis.compare import chord_lengths, compare_chords_by_line
from analysis.exploration import Turning
from lab.base.errors import RequestError
from lab.recognise.recognisers import sensor_model
from lab.settings.settings import Settings
from lab.store.tables import Tables
from projector.shape import Silhouette
from robot.turning import Policy

_MOST_LINES = 2_000_000  # of all simulated sessions, a second or two of work
_MOST_SENSED = 300_000  # a line through the sensor costs as much as ten


def check_against_simulation(
    tables: Tables, geometry: Silhouette, settings: Settings, rng: np.random.Generator
) -> MonteCarloCheck | None:
    """Test the session's A(N), P(N) and chord lengths against simulated sessions.

    Returns:
        None where nothing is to be compared: several robots cut each other's lines short, there are too few lines,
        or the shape reaches out of what the robot can reach.
    """
    lines = tables.crossed
    count = len(lines)
    if len(settings.robots) > 1 or count < 2 * FIRST_LINES:
        return None
    checkpoints, reachable = checkpoints_to(count), settings.arena.lines_within
    weighted = bool(lines["weight"].nunique() > 1)
    # lines turned by another law than Lambert's are held against those that should have been
    turning = Turning.INTERIOR if settings.motion.turning is Policy.INTERIOR else Turning.LAMBERT
    curve = curve_of(lines["k"], lines["l1_cm"], lines["l3_cm3"], checkpoints, weights=lines["weight"])
    runs = min(SESSIONS, max(FEWEST_SESSIONS, _MOST_LINES // count))
    sensed_runs = min(SESSIONS, max(FEWEST_SESSIONS, _MOST_SENSED // count))
    try:
        rolled = rolled_curves(geometry, reachable, checkpoints, runs, rng, turning=turning)
        sensed = rolled_curves(
            geometry, reachable, checkpoints, sensed_runs, rng, turning=turning, sensor=sensor_model(settings)
        )
    except RequestError:
        return None
    chords = chord_lengths(tables.crossings[tables.crossings["line"].isin(lines["line"])])
    return MonteCarloCheck(
        rolled=band_test(curve, rolled),
        independent=None if weighted else band_test(curve, independent_curves(geometry, checkpoints, runs, rng)),
        sensed=band_test(curve, sensed),
        chords=None if weighted or not chords.size else compare_chords_by_line(chords, count, geometry, rng),
    )
