"""The error budget: how much of a session's error in A and P each cause has, adding up to what was seen.

What a robot estimates differs from the truth by a chain of causes. Each is undone in turn on the *same* lines, so
that the differences telescope, exactly, and the lines' own scatter cancels in them:

    the robot's estimate from all its lines
      speed       its chords in time × speed, against the camera's places at the times of its crossings    measured
      rest        those, against what the next four make of the camera's lines                             measured
      latency     leaving crossings found later than entering ones; jitter σ: A + 2πσ²                      fitted
      sampling    readings a step Δ apart: A + πΔ²/6, chords lost near corners                              replayed
      footprint   light averaged over a disc of radius ρ, corners rounded, chords merged                    replayed
      parallax    an image larger by ε in the sensor's plane: A (1 + ε)², P (1 + ε)                         fitted
    the image's exact chords on the camera's lines, over (1 + ε)² and 1 + ε
      anisotropy  what the lines' uneven directions and places make expected                               predicted
      counting    what is left: chance, whose exact size is σ/√N                                           measured
    the truth

*Measured* is a difference of two estimates that both come from data; *fitted* and *replayed* take ε, ρ, Δ, the jitter
and the lateness from the session's data (`analysis.edgeshift`) and work out what they do on its own lines
(`analysis.replay`); *predicted* comes from elsewhere. `rest` is what those terms leave unexplained: the budget closes
where it is none within its error and counting is as large as chance makes it. Without video only predictions remain:
what a sensor of these settings does to isotropic lines; counting is then the remainder.

Errors are by delete-a-group jackknife (Wolter 2007, ch. 4) over blocks of successive lines, which depend on each other.
All terms share the groups, fitted causes included, so that the error of any sum of them is right as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.invariants import sizes
from lab.base.errors import RequestError
from lab.base.jackknife import jackknife_sigma

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

CAUSES = ("speed", "latency", "sampling", "footprint", "parallax", "anisotropy")
"""The systematic terms, in the order of the table; `counting` and `rest` follow."""
CLOSED_SIGMAS = 3.0
FEWEST_LINES = 10
_MOST_GROUPS = 30


@dataclass(frozen=True, slots=True)
class Term:
    """One cause's part of an error.

    Attributes:
        term: one of ``CAUSES``, ``counting`` or ``rest``.
        percent: of the truth.
        sigma_percent: standard error; of ``counting`` the size that chance makes expected.
        how: in words where it comes from.
    """

    term: str
    percent: float
    sigma_percent: float
    how: str


@dataclass(frozen=True, slots=True)
class Side:
    """The budget of A or of P.

    Attributes:
        terms: they add up to ``seen_percent``, to rounding.
        seen_percent: the robot's estimate less the truth.
        sum_percent: of the terms that were found by themselves, without the one that is a remainder.
        sigma_percent: standard error of ``sum_percent`` − ``seen_percent``.
        counting_sigmas: counting in units of what chance makes expected, its expected bias taken off.
        closes: whether both are as small as they should be, within 3 σ.
    """

    terms: tuple[Term, ...]
    seen_percent: float
    sum_percent: float
    sigma_percent: float
    counting_sigmas: float
    closes: bool

    def of(self, term: str) -> Term | None:
        """A term by name; None where it was not estimated."""
        return next((found for found in self.terms if found.term == term), None)


@dataclass(frozen=True, slots=True)
class Budget:
    """Where the errors of a session come from. ``filmed``: whether a camera watched; else causes are predicted."""

    area: Side
    perimeter: Side
    lines: int
    filmed: bool

    @property
    def closes(self) -> bool:
        """Whether both sides add up to what was seen, within the errors."""
        return self.area.closes and self.perimeter.closes

    def largest(self) -> str | None:
        """The cause with the largest part in A or P among those that stand out of their errors (2 σ); None: none."""
        parts: dict[str, float] = {}
        for term in (*self.area.terms, *self.perimeter.terms):
            if term.term in CAUSES and abs(term.percent) > 2 * term.sigma_percent:
                parts[term.term] = max(parts.get(term.term, 0.0), abs(term.percent))
        return max(parts, key=parts.__getitem__) if parts else None

    def to_dict(self) -> dict[str, Any]:
        """The JSON form."""
        sides = {"area": self.area, "perimeter": self.perimeter}
        figures = ("seen_percent", "sum_percent", "sigma_percent", "counting_sigmas")
        return {
            **{
                name: [{key: getattr(term, key) for key in Term.__slots__} for term in side.terms]
                for name, side in sides.items()
            },
            **{figure: {name: getattr(side, figure) for name, side in sides.items()} for figure in figures},
            "closes": self.closes,
            "lines": self.lines,
            "filmed": self.filmed,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """What is expected of a term before the session: relative, each (2,) for A and P."""

    mean: Floats
    sigma: Floats
    how: str


def _no_slopes() -> Floats:
    return np.zeros((0, 3))


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """One link of the chain: what an observer without the causes further out finds on the lines.

    Attributes:
        term: the cause that this stage has and the one before has not.
        sums: (lines, 3) of (k, 𝓛_1, 𝓛_3) on every line, weighted; zero on lines that it does not know.
        how: of the term.
        slopes: (causes, 3) change of the summed ``sums`` by the fitted causes, of which some may be missing at the end.
    """

    term: str
    sums: Floats
    how: str
    slopes: Floats = field(default_factory=_no_slopes)


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Causes fitted to the session: ``values`` (m,), and ``replicates`` (groups, m) without each group of lines.

    The first is ε, the relative error of the image's scale.
    """

    values: Floats
    replicates: Floats


def groups_of(crossed: NDArray[np.bool_]) -> tuple[Ints, int]:
    """Group (n,) of each line, and their number: blocks of successive lines with as many that crossed in each.

    Raises:
        RequestError: fewer than ten lines crossed.
    """
    lines = int(crossed.sum())
    if lines < FEWEST_LINES:
        raise RequestError(f"{lines} crossing lines are too few for an error budget; roll at least {FEWEST_LINES}")
    groups = min(_MOST_GROUPS, lines // 2)
    before = np.cumsum(crossed) - crossed
    return np.minimum(before * groups // lines, groups - 1).astype(np.int64), groups


def budget_of(
    truth: Floats,
    stages: Sequence[Stage],
    all_lines: Floats,
    group: Ints,
    groups: int,
    fitted: Fitted,
    counting: Expected,
    anisotropy: Expected | None = None,
) -> Budget:
    """The budget of a filmed session.

    Args:
        truth: (2,) area in cm² and perimeter in cm.
        stages: from the truth outwards. The first is that of the image's exact chords on the lines that both saw, the
            last the robot's own estimate from them.
        all_lines: (lines, 3) the robot's sums on all its lines, those that the camera missed included.
        group: (lines,) of each line, from `groups_of`.
        groups: their number.
        fitted: the causes that the stages' slopes count.
        counting: the size of chance.
        anisotropy: what the lines' distribution makes expected, where it is known.
    """

    def found(sums: Floats, slopes: Floats) -> Floats:
        """(1 + groups, 2): the estimate from all lines, then without each group."""
        total = sums.sum(axis=0)
        each = np.zeros((groups, 3))
        np.add.at(each, group, sums)
        shift = (fitted.replicates - fitted.values)[:, : len(slopes)] @ slopes
        return sizes(np.concatenate([total[None], total - each + shift])) / truth

    estimates = [found(stage.sums, stage.slopes) for stage in stages]
    whole = found(all_lines, _no_slopes())
    scale = 1.0 + np.concatenate([fitted.values[:1], fitted.replicates[:, 0]])
    as_meant = estimates[0] / np.column_stack([scale**2, scale])
    # Parts of what the lines themselves give, not of the truth: so chance, common to all stages, cancels.
    parts: dict[str, tuple[Floats, str]] = {"parallax": ((estimates[0] - as_meant) / as_meant, stages[0].how)}
    for before, stage, after in zip(estimates, stages[1:], estimates[1:], strict=False):
        parts[stage.term] = ((after - before) / as_meant, stage.how)
    drawn = as_meant[0] * whole[0] / estimates[-1][0] - 1
    if anisotropy is not None:
        # known from elsewhere: all replicates have it alike, its own error is added below
        parts["anisotropy"] = (np.tile(anisotropy.mean, (1 + groups, 1)), anisotropy.how)
        drawn = drawn - anisotropy.mean
    seen = whole[0] - 1
    chance = seen - np.sum([part[0] for part, _ in parts.values()], axis=0)
    sigma = {name: jackknife_sigma(part[1:]) for name, (part, _) in parts.items()}
    expected = counting.sigma
    if anisotropy is not None:
        sigma["anisotropy"] = anisotropy.sigma
        # The unevenness is measured on these very lines, by chance as well: it is a control variate, and takes its
        # own scatter out of what is left.
        expected = np.sqrt(np.maximum(expected**2 - anisotropy.sigma**2, expected**2 / 4))
    pull = (drawn - counting.mean) / expected
    sides: list[Side] = []
    for size in range(2):
        terms = [
            Term(name, 100 * float(parts[name][0][0, size]), 100 * float(sigma[name][size]), parts[name][1])
            for name in CAUSES
            if name in parts
        ]
        terms.append(Term("counting", 100 * float(chance[size]), 100 * float(expected[size]), counting.how))
        rest, unexplained = 0.0, 0.0
        if "rest" in parts:
            rest, unexplained = 100 * float(parts["rest"][0][0, size]), 100 * float(sigma["rest"][size])
            terms.append(Term("rest", rest, unexplained, parts["rest"][1]))
        good = abs(rest) <= CLOSED_SIGMAS * unexplained and abs(float(pull[size])) <= CLOSED_SIGMAS
        percent = 100 * float(seen[size])
        sides.append(Side(tuple(terms), percent, percent - rest, unexplained, float(pull[size]), good))
    return Budget(sides[0], sides[1], int((all_lines[:, 0] > 0).sum()), filmed=True)


def predicted_budget(seen: Floats, causes: dict[str, Expected], counting: Expected, lines: int) -> Budget:
    """The budget of a session without video: ``causes`` as predicted, and counting as what they leave.

    Args:
        seen: (2,) relative deviation of A and P.
        causes: by term.
        counting: the size of chance.
        lines: that crossed the shape.
    """
    total = np.sum([cause.mean for cause in causes.values()], axis=0) if causes else np.zeros(2)
    spread = np.sqrt(counting.sigma**2 + np.sum([cause.sigma**2 for cause in causes.values()], axis=0))
    chance = seen - total
    pull = (chance - counting.mean) / spread
    sides: list[Side] = []
    for size in range(2):
        terms = [
            Term(name, 100 * float(causes[name].mean[size]), 100 * float(causes[name].sigma[size]), causes[name].how)
            for name in CAUSES
            if name in causes
        ]
        terms.append(Term("counting", 100 * float(chance[size]), 100 * float(counting.sigma[size]), counting.how))
        good = abs(float(pull[size])) <= CLOSED_SIGMAS
        percent = 100 * float(seen[size])
        side = Side(tuple(terms), percent, 100 * float(total[size]), 100 * float(spread[size]), float(pull[size]), good)
        sides.append(side)
    return Budget(sides[0], sides[1], lines, filmed=False)
