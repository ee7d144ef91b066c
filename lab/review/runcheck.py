"""What a session's own runs say of the robot's turning: no camera is needed for it."""

from __future__ import annotations

import numpy as np
import pandas as pd

from analysis.report.result import RunCheck
from analysis.runlengths import FEWEST_RUNS, arena_consistency, examine_runs, expected_bias
from lab.base.errors import RequestError
from lab.settings.settings import Settings
from projector.shape import Silhouette
from robot.turning import Policy, Weighting


def check_runs(
    lines: pd.DataFrame, geometry: Silhouette, settings: Settings, rng: np.random.Generator
) -> RunCheck | None:
    """Compare run lengths and chord statistics with those of isotropic lines, and say what bias a difference makes.

    Args:
        lines: the session's ``lines`` table.
        geometry: the projected shape, arena cm.
        settings: the session's.
        rng: source of the simulated sessions.

    Returns:
        None where the question does not arise: several robots cut each other's lines short, lines that are weighted
        by their length are not meant to be isotropic, and after feeling an edge of light a robot sets off a little
        inside, so that the shortest lines are missing; or too few lines.
    """
    motion, reachable = settings.motion, settings.arena.lines_within
    whole = lines[lines["whole"]]
    felt = settings.arena.edge != "bump" and motion.turning is not Policy.INTERIOR
    if felt or len(settings.robots) > 1 or motion.weighting is not Weighting.NONE or len(whole) < FEWEST_RUNS:
        return None
    lengths = examine_runs(whole["length_cm"], reachable, rng, length_weighted=motion.turning is Policy.INTERIOR)
    try:
        consistency = arena_consistency(
            whole["k"], whole["l1_cm"], whole["l3_cm3"], whole["length_cm"], reachable, weights=whole["weight"]
        )
    except RequestError:  # too few runs or crossings to say
        consistency = None
    bias = None
    if not lengths.passed and np.isfinite(lengths.exponent):
        bias = expected_bias(geometry, reachable, lengths.exponent, rng)
    return RunCheck(lengths, consistency, bias)
