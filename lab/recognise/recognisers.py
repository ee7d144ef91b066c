"""The recogniser of a session: a dictionary as this robot's sensor will see it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.congruence import congruence_classes
from analysis.perline import LineRecogniser, LineTables, tables_of
from analysis.recognition import Recogniser
from analysis.sensor import SensorModel
from analysis.tablestore import Mapper, TableStore, learn_lines
from lab.bench.pictures import span_of
from lab.settings.physics import VirtualSettings
from lab.settings.settings import Settings
from projector.shape import Shape
from robot.crossings import threshold_margin

# Lines that follow each other at a wall are not quite independent, and tables learnt from finitely many lines not
# quite exact. At this weight, over simulated sessions with bounces in a rectangle, a posterior of 95 % was right 97
# times in a hundred for the paper's six, 93 times for the letters.
LINE_WEIGHT = 0.85


@dataclass(frozen=True, slots=True, eq=False)
class Recognition:
    """What a session's lines say.

    Attributes:
        ranking: (name, probability) of each class of twins at the end, the most probable first, given that the shape
            is in the dictionary.
        posteriors: ``n`` and one column for each entry: the posterior after each crossing line.
        unknown: (lines,) probability, after each crossing line, that the shape is none of the dictionary's.
        classes: the twins, two or more names each, that no lines tell apart.
    """

    ranking: list[tuple[str, float]]
    posteriors: pd.DataFrame
    unknown: NDArray[np.float64]
    classes: tuple[tuple[str, ...], ...]

    @property
    def is_unknown(self) -> bool:
        """Whether at the end "none of these" is likelier than all entries together."""
        return bool(self.unknown.size and self.unknown[-1] > 0.5)

    @property
    def answer(self) -> tuple[str, ...]:
        """The names of the leading class; none where the shape is unknown."""
        return () if self.is_unknown else (self.ranking[0][0], *self.twins_of(self.ranking[0][0]))

    def twins_of(self, name: str) -> tuple[str, ...]:
        """The other members of a name's class."""
        return tuple(other for members in self.classes if name in members for other in members if other != name)


def recognise_lines(recogniser: Recogniser, lines: pd.DataFrame) -> Recognition:
    """Take a session's crossing lines, in order.

    Args:
        recogniser: fresh, or it is reset.
        lines: rows of the ``lines`` table with k > 0; those that are not ``whole`` count, but are not looked at.
    """
    recogniser.reset()
    rows: list[dict[str, float]] = []
    unknown: list[float] = []
    columns = lines[["whole", "k", "l1_cm", "l3_cm3", "weight"]]
    for n, (whole, k, l1_cm, l3_cm3, weight) in enumerate(columns.itertuples(index=False), start=1):
        if whole:
            recogniser.update(k, l1_cm, l3_cm3, weight)
        rows.append({"n": n, **recogniser.posterior()})
        unknown.append(recogniser.unknown())
    return Recognition(
        recogniser.ranked(),
        pd.DataFrame(rows, columns=["n", *recogniser.names]),
        np.array(unknown),
        tuple(members for members in recogniser.classes if len(members) > 1),
    )


def sensor_model(settings: Settings) -> SensorModel:
    """The light sensor of the robot of these settings; a real one is taken for what a virtual one is by default."""
    world = settings.virtual if settings.is_virtual else VirtualSettings()
    profile, optics = settings.profile(), settings.projector_optics.pinhole()
    cruising_cm_s = profile.cruising_cm_s(settings.motion.speed_cm_s)
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
    called: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    store: TableStore | None = None,
) -> LineRecogniser:
    """Learn how each entry's lines look through the robot's sensor, or read it from the user's cache.

    The same robot gives the same recogniser, whatever the session's seed: a stored session, read again, finds the
    posteriors of its log. A class of twins goes by the name ``called``, where that is one of them.
    """
    tables = tables_for(dictionary, settings, called=called, progress=progress, store=store)
    return LineRecogniser(tables, weight=LINE_WEIGHT)


def tables_for(
    dictionary: Mapping[str, Shape],
    settings: Settings,
    *,
    called: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    store: TableStore | None = None,
    mapper: Mapper | None = None,
) -> LineTables:
    """The tables of the recogniser; arguments as for `recogniser_for`, ``mapper`` as for `learn_lines`."""
    outlines = {name: shape.geometry for name, shape in dictionary.items()}
    seen = learn_lines(outlines, sensor_model(settings), store=store or TableStore(), mapper=mapper, progress=progress)
    classes = [sorted(members, key=lambda name: name != called) for members in congruence_classes(outlines)]
    return tables_of({name: lines.invariants() for name, lines in seen.items()}, classes)
