"""The recogniser of a session: a dictionary as this robot's sensor will see it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from analysis.perline import LineRecogniser, tables_of
from analysis.sensor import SensorModel
from analysis.tablestore import TableStore, learn_lines
from lab.pictures import span_of
from lab.settings import Settings, VirtualSettings
from projector.shape import Shape
from robot.crossings import threshold_margin

# Lines that follow each other at a wall are not independent (lag-1 correlation up to 0.24, so that n lines
# are worth (1 - 0.24)/(1 + 0.24) n = 0.6 n); counting them in full would make the posterior overconfident.
_WEIGHT = 0.6


def sensor_model(settings: Settings) -> SensorModel:
    """The light sensor of the robot of these settings; a real one is taken for what a virtual one is by default."""
    world = settings.virtual if settings.is_virtual else VirtualSettings()
    profile, optics = settings.profile(), settings.projector_optics.pinhole()
    # as the driver will: the speed's command comes in whole units
    cruising_cm_s = profile.speed_units(settings.motion.speed_cm_s) * profile.cm_s_per_unit
    throw_cm = float(optics.centre_cm[2]) - settings.sensor.height_cm
    blur_cm = world.blur_px * throw_cm / float(optics.camera_matrix[0, 0])
    span_lux = span_of(settings.arena) * (world.white_lux - world.black_lux)
    by_time = settings.motion.length_from == "time"
    return SensorModel(
        step_cm=cruising_cm_s * settings.sensor.interval_s,
        footprint_cm=math.hypot(world.footprint_cm, 2.0 * blur_cm),
        margin=threshold_margin(world.light_noise_lux, span_lux) / span_lux,
        noise=world.light_noise_lux / span_lux,
        speed_sigma=world.speed_error_sigma if by_time else 0.0,
        # a packet's further delay is uniform
        jitter_cm=cruising_cm_s * world.link_jitter_s / math.sqrt(12.0) if by_time else 0.0,
    )


def recogniser_for(
    dictionary: Mapping[str, Shape],
    settings: Settings,
    *,
    progress: Callable[[int, int], None] | None = None,
    store: TableStore | None = None,
) -> LineRecogniser:
    """Learn how each entry's lines look through the robot's sensor, or read it from the user's cache.

    The same robot gives the same recogniser, whatever the session's seed: a stored session, read again, finds the
    posteriors of its log.
    """
    outlines = {name: shape.geometry for name, shape in dictionary.items()}
    seen = learn_lines(outlines, sensor_model(settings), store=store or TableStore(), progress=progress)
    return LineRecogniser(tables_of({name: lines.invariants() for name, lines in seen.items()}), weight=_WEIGHT)
