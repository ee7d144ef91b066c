"""What a session will need before it is rolled: crossing lines, arena runs, hours, charges, gigabytes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.planning import Need, Pace, lines_for_precision, middle_and_likely, need_of, sessions_until
from analysis.sensor import SensorModel
from lab.base.errors import RequestError
from lab.recognise.recognisers import LINE_WEIGHT, sensor_model, tables_for
from lab.recognise.separability import Separability, separability
from lab.settings.sections import BALL_RADIUS_CM
from lab.settings.settings import Settings
from projector.shape import Shape
from robot.virtual.physics import BodySettings

Progress = Callable[[int, int], None]

# Mean angle of a turn at the wall, π − E|φ − φ'|, with both angles from the normal by Lambert's law.
_MEAN_TURN_RAD = 2.355
_SESSIONS = 200  # simulated for the spread of the lines that a session needs
_LONGEST = 1500  # lines of them
_VIDEO_BYTES_S = 137e3  # 1280 × 720 at 30 frames a second on the virtual bench, H.264, quality 22: measured
_VIDEO_MOST_BYTES_S = 12e6 / 8  # the bound for a live camera


@dataclass(frozen=True, slots=True)
class Goal:
    """One thing to reach: ``name`` as the commands show it, and what it takes; None where no number of lines does."""

    name: str
    need: Need | None
    charges: int
    video_gb: float
    video_most_gb: float


@dataclass(frozen=True, slots=True)
class EntryPlan:
    """One shape's plan.

    Attributes:
        name: of the shape.
        share: of the arena runs that cross it.
        goals: by (P, A); line by line; a session with ``--until``; the precision of A, of P.
        sensor_area_rel: what the light sensor makes of A, relative, whatever the lines; more lines do not mend it.
        sensor_perimeter_rel: the same of P.
    """

    name: str
    share: float
    goals: tuple[Goal, ...]
    sensor_area_rel: float
    sensor_perimeter_rel: float


@dataclass(frozen=True, slots=True)
class Plan:
    """A session's plan: the pace of the floor, and one entry for each shape."""

    pace: Pace
    confidence: float
    precision: float
    charge_s: float
    entries: tuple[EntryPlan, ...]


def pause_s(settings: Settings) -> float:
    """What the end of a run costs: a turn on the spot, gathering speed, a command on its way.

    By the virtual robot's physics; a real one's are unknown until it has rolled.
    """
    body, profile = BodySettings(), settings.profile()
    turning_s = _MEAN_TURN_RAD / body.turn_rate_rad_s
    cruising_cm_s = profile.cruising_cm_s(settings.motion.speed_cm_s)
    return turning_s + cruising_cm_s / (2 * body.acceleration_cm_s2) + profile.command_pacing_s


def charge_s(settings: Settings) -> float:
    """How long a robot rolls from full to where a session pauses; the virtual robot's 2.5 h from full to empty."""
    body = BodySettings()
    span = (body.battery_full_v - settings.link.battery_low_v) / (body.battery_full_v - body.battery_empty_v)
    return body.battery_roll_s * span


def plan(
    shapes: Sequence[Shape],
    dictionary: Mapping[str, Shape],
    settings: Settings,
    rng: np.random.Generator,
    *,
    confidence: float = 0.95,
    precision: float = 0.05,
    table_lines: int = 100_000,
    progress: Progress = lambda _done, _total: None,
) -> Plan:
    """Plan a session over each of ``shapes``, told from the ``dictionary``'s entries (which hold them).

    Raises:
        RequestError: a shape does not fit into the arena, or confidence or precision are out of range.
    """
    reachable, model = settings.arena.lines_within, sensor_model(settings)
    robots = len(settings.robots)
    cruising_cm_s = settings.profile().cruising_cm_s(settings.motion.speed_cm_s)
    pace = Pace.on(reachable, cruising_cm_s, pause_s(settings), robots=robots, diameter_cm=2 * BALL_RADIUS_CM)
    for shape in shapes:
        if not reachable.covers(shape.geometry):
            raise RequestError(f"{shape.name} reaches out of what the robot can reach; take a larger --arena")
    judged = separability(
        dictionary, rng, confidence=confidence, model=model, table_lines=table_lines, progress=progress
    )
    until = _Until(dictionary, settings, model, confidence, rng)
    per_charge = charge_s(settings)
    entries: list[EntryPlan] = []
    for shape in shapes:
        moments = judged.moments[shape.name]
        share = min(1.0, moments.hitting_measure_cm / reachable.length)
        found = next(entry for entry in judged.entries if entry.name == shape.name)
        middle, likely = until.lines(shape.name, judged)
        area, perimeter = lines_for_precision(moments, precision)
        needs = (
            ("by (P, A)", found.plane.lines, None, False),
            ("line by line", found.line.lines, None, True),
            ("--until", middle, likely, True),
            ("precision of A", area, None, False),
            ("precision of P", perimeter, None, False),
        )
        entries.append(
            EntryPlan(
                shape.name,
                share,
                tuple(
                    _goal(
                        name,
                        None if lines is None else need_of(lines, share, pace, likely=most, whole=whole),
                        robots,
                        per_charge,
                    )
                    for name, lines, most, whole in needs
                ),
                moments.area_cm2 / shape.area_cm2 - 1,
                moments.perimeter_cm / shape.perimeter_cm - 1,
            )
        )
    return Plan(pace, confidence, precision, per_charge, tuple(entries))


def _goal(name: str, need: Need | None, robots: int, per_charge: float) -> Goal:
    if need is None:
        return Goal(name, None, 0, math.nan, math.nan)
    gigabytes = need.seconds_likely / 1e9
    charges = max(0, math.ceil(need.seconds_likely / per_charge) - 1) * robots
    return Goal(name, need, charges, _VIDEO_BYTES_S * gigabytes, _VIDEO_MOST_BYTES_S * gigabytes)


class _Until:
    """How many lines sessions that stop at a posterior need, by simulation through the session's own tables."""

    def __init__(
        self,
        dictionary: Mapping[str, Shape],
        settings: Settings,
        model: SensorModel,
        confidence: float,
        rng: np.random.Generator,
    ) -> None:
        self._dictionary, self._model, self._rng = dictionary, model, rng
        self._confidence, self._least = confidence, settings.stop.at_least
        self._tables = tables_for(dictionary, settings)

    def lines(self, name: str, judged: Separability) -> tuple[int | None, int | None]:
        """Median and 90 % quantile; never below what a session rolls at least."""
        found = next(entry for entry in judged.entries if entry.name == name)
        longest = max(2 * self._least, min(_LONGEST, 4 * (found.line.lines or _LONGEST) + 4 * self._least))
        sensed = self._model.sense(self._dictionary[name].geometry, round(1.02 * longest * _SESSIONS) + 500, self._rng)
        kinds = [column[: longest * _SESSIONS] for column in sensed.invariants()]
        sessions = kinds[0].size // longest
        # a session looks after every line; a few dozen looks, and the first one where it may stop, are as good
        n = np.unique(np.geomspace(self._least, longest, 60).round().astype(np.int64))
        if sessions == 0:
            return None, None
        logs = np.empty((sessions, n.size, len(self._tables.names)))
        for session in range(sessions):
            rows = slice(session * longest, (session + 1) * longest)
            logs[session] = np.cumsum(self._tables.look_up(*(column[rows] for column in kinds)), axis=0)[n - 1]
        own: NDArray[np.bool_] = np.array([other in {name, *found.twins} for other in self._tables.names])
        return middle_and_likely(sessions_until(LINE_WEIGHT * logs, n, own, self._confidence))
