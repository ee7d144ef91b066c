"""Everything that the report of one session needs, as plain data.

The lab fills a :class:`SessionResult` from the session's tables; nothing here knows where they came from, so a stored
session, a simulation and a test make the same report.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from shapely.geometry.base import BaseGeometry

from analysis.bandcheck import MonteCarloCheck
from analysis.budget import Budget
from analysis.estimate import Estimate
from analysis.figures.values import Band, Entry, Isotropy
from analysis.runlengths import ArenaConsistency, ExpectedBias, RunLengths
from lab.base.errors import RequestError

_COLUMNS: Mapping[str, tuple[str, ...]] = {
    "lines": ("line", "length_cm", "k", "l1_cm", "l3_cm3", "ended"),
    "crossings": ("line", "order", "s_cm", "entering"),
    "estimates": ("n", "line", "area_cm2", "perimeter_cm", "sigma_area_cm2", "sigma_perimeter_cm", "correlation"),
    "track": ("x_cm", "y_cm", "led_on"),
    "true_lines": ("line", "x_start_cm", "y_start_cm", "x_end_cm", "y_end_cm"),
    "true_crossings": ("line", "order", "s_cm", "entering"),
    "chord_pairs": ("robot_length_cm", "true_length_cm"),
    "posteriors": ("n",),
}


ENDED_WELL = ("complete", "recognised", "replayed")
"""End states of a session that came to its own end."""


@dataclass(frozen=True, slots=True)
class RunCheck:
    """The session's own runs against what isotropic lines predict.

    Attributes:
        lengths: The lengths of the runs from edge to edge.
        consistency: The size by the known arena against Eq. 1; None with too few runs.
        bias: What the turning that fits the runs does to A and P; None where the runs are as they should be.
    """

    lengths: RunLengths
    consistency: ArenaConsistency | None
    bias: ExpectedBias | None


class ReportError(RequestError):
    """The result cannot be reported as it is. Attributes: ``table`` and the ``missing`` columns."""

    def __init__(self, table: str, missing: Sequence[str]) -> None:
        self.table = table
        self.missing = tuple(missing)
        super().__init__(
            f"table '{table}' lacks {', '.join(missing)}: rebuild the session's tables with `chordlab finalize`"
        )


@dataclass(frozen=True, slots=True, eq=False)
class SessionResult:
    """One session, ready to be reported.

    Attributes:
        name: The projected shape's dictionary name; ``title`` is how it is written for people.
        geometry: The projected shape in arena cm.
        arena: The arena's outline in arena cm.
        lines: One row a run (k = 0 for runs that missed the shape).
        crossings: The robot's crossings.
        estimates: A and P after every crossing line; ``leading`` and ``posterior`` are used where present.
        exact: The projected shape's exact A, P and covariance for one line.
        dictionary: Every entry the robot chose among, by name.
        ranking: (name, posterior), the most probable first.
        twins: Other entries that no lines tell from the leading one.
        unknown: Probability that the shape is none of the dictionary's.
        stop_at: The posterior at which the session was to stop.
        posteriors: ``n`` and one column for each entry; None where only the leader was kept.
        band: Monte Carlo spread of A(N) and P(N) for the projected shape.
        track: The camera's track, with ``line`` for the panels at given N; None without video.
        true_lines: The runs as the camera saw them; ``true_crossings`` likewise.
        camera: A and P from the camera's crossings of the same runs.
        chord_pairs: Chord by chord ``robot_length_cm`` and ``true_length_cm``.
        chords_missed: Chords that only the camera saw; ``chords_extra`` those that only the robot saw.
        isotropy: The tests of the runs' randomness.
        runs_check: What the robot's own runs say of its turning.
        budget: Where the errors of A and P come from; None with too few lines.
        montecarlo: The curves and chords against simulated sessions; None where they cannot be compared.
        session: The session folder's name.
        provenance: Section -> what -> value: seed, settings, versions, devices, host figures.
        history: (s of the session's clock, what befell it): parts, notes, pauses, lost links; empty if nothing did.
        warnings: What the session wants the reader to know, a sentence each.
    """

    name: str
    title: str
    geometry: BaseGeometry
    arena: BaseGeometry
    lines: pd.DataFrame
    crossings: pd.DataFrame
    estimates: pd.DataFrame
    exact: Entry
    dictionary: Mapping[str, Entry] = field(default_factory=dict[str, Entry])
    ranking: Sequence[tuple[str, float]] = ()
    twins: Sequence[str] = ()
    unknown: float = 0.0
    stop_at: float = 0.95
    posteriors: pd.DataFrame | None = None
    band: Band | None = None
    track: pd.DataFrame | None = None
    true_lines: pd.DataFrame | None = None
    true_crossings: pd.DataFrame | None = None
    camera: Estimate | None = None
    chord_pairs: pd.DataFrame | None = None
    chords_missed: int | None = None
    chords_extra: int | None = None
    isotropy: Isotropy | None = None
    runs_check: RunCheck | None = None
    budget: Budget | None = None
    montecarlo: MonteCarloCheck | None = None
    session: str = ""
    provenance: Mapping[str, Mapping[str, object]] = field(default_factory=dict[str, "Mapping[str, object]"])
    history: Sequence[tuple[float, str]] = ()
    warnings: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Refuse tables without the columns that the report reads.

        Raises:
            ReportError: A table lacks a column.
        """
        for table, needed in _COLUMNS.items():
            frame: pd.DataFrame | None = getattr(self, table)
            if frame is None:
                continue
            missing = [column for column in needed if column not in frame.columns]
            if missing:
                raise ReportError(table, missing)

    @property
    def runs(self) -> int:
        """Arena runs, those that missed the shape included."""
        return len(self.lines)

    @property
    def measured(self) -> Estimate | None:
        """The last estimate of the robot, or None while no line has crossed the shape."""
        if self.estimates.empty:
            return None
        last = self.estimates.sort_values("n").iloc[-1]
        s_a, s_p = float(last["sigma_area_cm2"]), float(last["sigma_perimeter_cm"])
        mixed = float(last["correlation"]) * s_a * s_p  # NaN for a single line, as are the sigmas
        return Estimate(
            n=int(last["n"]),
            area_cm2=float(last["area_cm2"]),
            perimeter_cm=float(last["perimeter_cm"]),
            covariance=np.array([[s_a**2, mixed], [mixed, s_p**2]]),
        )

    def title_of(self, name: str) -> str:
        """How an entry's name is written for people."""
        if name == self.name:
            return self.title
        entry = self.dictionary.get(name)
        return name if entry is None else entry.title
