"""What a session's folder tells, as it stood at any time: one model for the running session and for the stored one.

Events go in, in the order of the log; `Story.at` gives all that is shown of a moment. Nothing here knows of pages.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from analysis.estimate import Estimate
from analysis.recognition import Recogniser

Record = Mapping[str, Any]
_MOST_NAMES = 6
_BAND = 1.96  # 95 % of a normal error


@dataclass(frozen=True, slots=True)
class Standing:
    """The estimates after one more line that crossed the shape. NaN where not known yet.

    Attributes:
        n: such lines so far.
        t_s: when the line ended.
        area_cm2: with its standard error ``sigma_area_cm2``.
        perimeter_cm: with its standard error ``sigma_perimeter_cm``.
        correlation: of both errors.
        leading: the most probable entry.
        posterior: its probability.
        names: (name, probability) of the likeliest entries, the first first, given that it is one of them.
        unknown: probability that it is none of the dictionary's; NaN where nobody has worked it out.
    """

    n: int
    t_s: float
    area_cm2: float
    perimeter_cm: float
    sigma_area_cm2: float
    sigma_perimeter_cm: float
    correlation: float
    leading: str
    posterior: float
    names: tuple[tuple[str, float], ...] = ()
    unknown: float = math.nan

    def band(self, which: str) -> tuple[float, float]:
        """The 95 % band of ``area_cm2`` or ``perimeter_cm``; neither can be less than nothing."""
        value, half = getattr(self, which), _BAND * getattr(self, f"sigma_{which}")
        return max(0.0, value - half), value + half

    def estimate(self) -> Estimate:
        """The same as `analysis` writes it."""
        off = self.correlation * self.sigma_area_cm2 * self.sigma_perimeter_cm
        covariance = np.array([[self.sigma_area_cm2**2, off], [off, self.sigma_perimeter_cm**2]])
        return Estimate(self.n, self.area_cm2, self.perimeter_cm, covariance)


@dataclass(frozen=True, slots=True)
class Rolled:
    """One run: when it began and ended, how far it went, and the stretches of it in the light, cm along it."""

    line: int
    robot: str
    t_start_s: float
    t_end_s: float
    end_cm: float
    counts: bool
    lit_cm: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Remark:
    """Something that befell the session, in words: a note, a pause, a lost link."""

    t_s: float
    text: str


@dataclass(frozen=True, slots=True)
class Moment:
    """All that is known of a session at a time.

    Attributes:
        t_s: that time, s of the session's clock.
        state: ``preparing``, ``rolling``, ``paused``, ``cut`` or how it ended, as in the log.
        standings: after each crossing line so far.
        runs: so far.
        remarks: so far.
        battery_v: of each robot, the last that was read.
        rolling_s: how long it has rolled.
        left_s: how long it will take to the last line at this rate; NaN before the first.
    """

    t_s: float
    state: str
    standings: Sequence[Standing]
    runs: Sequence[Rolled]
    remarks: Sequence[Remark]
    battery_v: Mapping[str, float]
    rolling_s: float
    left_s: float

    @property
    def last(self) -> Standing | None:
        """The latest estimates."""
        return self.standings[-1] if self.standings else None


@dataclass(slots=True)
class Story:
    """A session's log so far.

    Attributes:
        lines: how many are wanted.
        standings: after each crossing line.
        runs: in the order in which they ended.
        remarks: in the order of the log.
    """

    lines: int
    standings: list[Standing] = field(default_factory=list[Standing])
    runs: list[Rolled] = field(default_factory=list[Rolled])
    remarks: list[Remark] = field(default_factory=list[Remark])
    _states: list[tuple[float, str]] = field(default_factory=list[tuple[float, str]])
    _batteries: list[tuple[float, str, float]] = field(default_factory=list[tuple[float, str, float]])
    _crossed: list[Record] = field(default_factory=list[Record])
    _recogniser: Recogniser | None = None
    _named: int = 0
    _seen: int = 0

    def begin(self, batteries: Mapping[str, float]) -> None:
        """Take what the manifest says of the robots' batteries at the start."""
        self._batteries[:0] = [(-math.inf, name, volts) for name, volts in batteries.items()]

    def take(self, events: Iterable[Record]) -> None:
        """Take the log's next events.

        Raises:
            KeyError, TypeError, ValueError: one of them is not whole.
        """
        for event in events:
            self._seen += 1
            if event["event"] == "line":
                self._take_line(event)
            elif "t_s" in event:
                self._take_other(str(event["event"]), float(event["t_s"]), event)

    @property
    def events(self) -> int:
        """How many events it has taken."""
        return self._seen

    @property
    def t_begin_s(self) -> float:
        """When it began; 0 before it did."""
        return self._states[0][0] if self._states else 0.0

    @property
    def t_end_s(self) -> float:
        """The last time that the log tells."""
        last_run = max((run.t_end_s for run in self.runs[-8:]), default=0.0)
        return max(last_run, self._states[-1][0] if self._states else 0.0)

    @property
    def has_ended(self) -> bool:
        """Whether the log tells an end, and of no part after it."""
        return bool(self._states) and self._states[-1][1] not in ("rolling", "paused")

    def name_with(self, recogniser: Recogniser) -> None:
        """Work out what the log leaves out: the probabilities of the other entries. Only new lines are looked at."""
        if recogniser is not self._recogniser:
            recogniser.reset()
            self._recogniser, self._named = recogniser, 0
        end = len(self.standings)  # more may come meanwhile
        for row in range(self._named, end):
            event = self._crossed[row]
            if event["whole"]:
                recogniser.update(event["k"], event["l1_cm"], event["l3_cm3"], event["weight"])
            names = tuple(recogniser.ranked()[:_MOST_NAMES])
            self.standings[row] = replace(self.standings[row], names=names, unknown=recogniser.unknown())
        self._named = end

    def at(self, t_s: float) -> Moment:
        """What was known at a time; at infinity, all."""
        standings = self.standings[: bisect_right(self.standings, t_s, key=lambda standing: standing.t_s)]
        runs = [run for run in self.runs if run.t_end_s <= t_s]
        state = next((state for when_s, state in reversed(self._states) if when_s <= t_s), "preparing")
        now_s = min(t_s, self.t_end_s)
        rolling_s = max(0.0, now_s - self.t_begin_s)
        n = standings[-1].n if standings else 0
        battery = {robot: volts for when_s, robot, volts in self._batteries if when_s <= t_s}
        left_s = max(0, self.lines - n) * rolling_s / n if n else math.nan
        remarks = [remark for remark in self.remarks if remark.t_s <= t_s]
        return Moment(now_s, state, standings, runs, remarks, battery, rolling_s, left_s)

    def _take_line(self, event: Record) -> None:
        told = event.get("estimate")
        t_end_s = float(event["t_end_s"])
        self.runs.append(
            Rolled(
                int(event["line"]),
                str(event["robot"]),
                float(event["t_start_s"]),
                t_end_s,
                float(event["end_cm"]),
                bool(event["counts"]),
                lit_stretches(event["crossings"], float(event["end_cm"])),
            )
        )
        if told is None:
            return
        figures = {
            name: math.nan if told[name] is None else float(told[name])
            for name in ("area_cm2", "perimeter_cm", "sigma_area_cm2", "sigma_perimeter_cm", "correlation")
        }
        leading, posterior = str(told["leading"]), float(told["posterior"])
        # several robots' runs may end at one time, and a resumed log may not go back
        t_s = max(t_end_s, self.standings[-1].t_s) if self.standings else t_end_s
        self.standings.append(
            Standing(
                int(told["n"]), t_s, **figures, leading=leading, posterior=posterior, names=((leading, posterior),)
            )
        )
        self._crossed.append(event)

    def _take_other(self, kind: str, t_s: float, event: Record) -> None:
        robot = str(event.get("robot", ""))
        if kind == "start" or (kind == "resume" and not robot):
            self._states.append((t_s, "rolling"))
        elif kind == "pause" and not robot:
            self._states.append((t_s, "paused"))
        elif kind == "end":
            self._states.append((t_s, str(event["state"])))
        if robot and "battery_v" in event:
            self._batteries.append((t_s, robot, float(event["battery_v"])))
        if text := _in_words(kind, robot, event):
            self.remarks.append(Remark(t_s, text))


def lit_stretches(crossings: Iterable[Sequence[Any]], end_cm: float) -> tuple[tuple[float, float], ...]:
    """The stretches of a run in the light, cm along it, from its crossings [t, s, entering]."""
    stretches: list[tuple[float, float]] = []
    entered: float | None = None
    for place, (_, s_cm, entering) in enumerate(crossings):
        if entering:
            entered = float(s_cm)
        elif entered is not None or place == 0:
            stretches.append((entered or 0.0, float(s_cm)))
            entered = None
    if entered is not None:
        stretches.append((entered, end_cm))
    return tuple(stretches)


def _in_words(kind: str, robot: str, event: Record) -> str:
    """What an event says to people; empty where it is told otherwise."""
    if kind == "note":
        return f"Note: {event['text']}"
    if not robot:
        return {"pause": "Paused", "resume": "Going on", "recover": "Mended after a cut"}.get(kind, "")
    text = {
        "pause": "battery low, waits to be charged",
        "resume": "goes on",
        "lost": "link lost",
        "back": "link back",
        "gone": "did not come back, the others go on",
    }.get(kind)
    return f"{robot}: {text}" if text else ""
