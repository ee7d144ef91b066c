"""The recogniser of a session: a dictionary as this robot's sensor will see it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from analysis.perline import LineModel, LineRecogniser, learn_tables
from lab.settings import Settings
from projector.shape import Shape

# A crossing is interpolated between two readings: the error of a uniform phase over the step, and of the
# footprint's ramp that is met at an angle, as measured on the virtual bench.
_JITTER_PER_STEP = 0.2
_SPEED_SCATTER = 0.02  # of the speed, from run to run
# Lines that follow each other at a wall are not independent (lag-1 correlation up to 0.24, so that n lines
# are worth (1 - 0.24)/(1 + 0.24) n = 0.6 n); counting them in full would make the posterior overconfident.
_WEIGHT = 0.6


def line_model(settings: Settings) -> LineModel:
    """What the robot of these settings makes of an ideal line."""
    step_cm = settings.motion.speed_cm_s * settings.sensor.interval_s
    return LineModel(jitter_cm=_JITTER_PER_STEP * step_cm, min_chord_cm=step_cm, scale_sigma=_SPEED_SCATTER)


def recogniser_for(dictionary: Mapping[str, Shape], settings: Settings) -> LineRecogniser:
    """Learn how each entry's lines look through the robot's sensor, by Monte Carlo.

    The same settings give the same recogniser: a stored session, read again, finds the posteriors of its log.
    """
    _, _, seed = settings.seeds()
    rng = np.random.default_rng(seed)
    outlines = {name: shape.geometry for name, shape in dictionary.items()}
    return LineRecogniser(learn_tables(outlines, rng, model=line_model(settings)), weight=_WEIGHT)
