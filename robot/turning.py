"""Where the robot heads next: the policies of random lines, and what each line then weighs.

**Lambert.** Lines are uniform and isotropic over a convex arena when the angle phi from the edge's inward normal
has the density cos(phi)/2, Lambert's law, phi = asin(2u - 1) with u uniform in [0, 1): then their mean length is
Cauchy's pi A/P of the reachable polygon. The normal is local knowledge, the way the bump came from; no
compass is needed.

**Uniform.** A uniform phi favours grazing runs along the walls: they are short, and shapes in the middle of the
arena are measured too small (a tower in a 120 x 90 cm rectangle: A -14 %, P -10 %). In a *disc* of radius R, and
there alone, weights proportional to the run's length undo it. The edge looks alike from everywhere, so the ends
stay uniform along it, and a run that sets off at phi is 2R cos(phi) long: from the density 1/pi to cos(phi)/2 the
weight is (pi/2) cos(phi), which is pi/(4R) times the length. In any other arena the length depends on where the run
starts and not on phi alone, and under a uniform phi the ends do not stay uniform along the edge either: no
function of the length mends both.

**Interior.** Hit-and-run sampling needs no normal: from a point inside, roll at a uniform heading to the edge, turn
straight back, cross the arena from edge to edge, turn back once more and stop at a uniform fraction of that chord.
The stops are then uniform over the arena (R. L. Smith, Operations Research 32 (1984) 1296), the lines through them
come with a density proportional to their length in the arena, and weigh 1/length. Half of the path measures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Protocol

from numpy.random import Generator

from lab.base.errors import RequestError

# A leg no longer than this went nowhere: it set off into the wall that the robot stands at.
NOWHERE_CM = 0.5


class Policy(StrEnum):
    """How the next line is drawn."""

    LAMBERT = "lambert"
    """Cosine law at the edge: uniform isotropic lines. The one to measure with."""
    UNIFORM = "uniform"
    """Any inward angle alike: biased towards short runs. To show the bias."""
    INTERIOR = "interior"
    """Random interior stops, a fresh uniform heading at each: lines weighted by their length, no normal needed."""


class Weighting(StrEnum):
    """What a line weighs beside what its policy asks for."""

    NONE = "none"
    """Nothing more."""
    RUN_LENGTH = "run_length"
    """The length of its run: undoes uniform angles in a disc."""


class PolicyError(RequestError):
    """A turning policy that does not exist or does not serve was asked for; ``policy`` is what was asked."""

    def __init__(self, message: str, *, policy: str) -> None:
        super().__init__(message)
        self.policy = policy


@dataclass(frozen=True, slots=True)
class Leg:
    """A straight roll that a navigator asks for.

    Attributes:
        heading_rad: Where to, in the robot's clockwise frame, [0, 2 pi).
        stop_after_cm: Stop there, by the robot's own path; None to roll on to the edge.
        measures: It is a line of the statistics if it ends at the edge.
    """

    heading_rad: float
    stop_after_cm: float | None
    measures: bool


@dataclass(frozen=True, slots=True)
class LegEnd:
    """How a leg ended.

    Attributes:
        leg: The one that was asked for.
        length_cm: Path rolled.
        normal_heading_rad: Heading from the edge straight into the arena, if the edge was felt there.
        at_edge: It ended at the edge, and neither at a stop nor by a stall, a time-out or a lost link.
    """

    leg: Leg
    length_cm: float
    normal_heading_rad: float | None
    at_edge: bool


class Navigator(Protocol):
    """Draws one leg after another."""

    def first(self) -> Leg:
        """The leg to begin with, from wherever the robot was put down."""
        ...

    def next(self, ended: LegEnd) -> Leg:
        """The leg that follows the one that has ended."""
        ...


def lambert(u: float) -> float:
    """Angle from the inward normal, radians, by Lambert's law, from ``u`` uniform in [0, 1)."""
    return math.asin(2.0 * u - 1.0)


def uniform(u: float) -> float:
    """Angle from the inward normal, radians, evenly over the half circle, from ``u`` uniform in [0, 1)."""
    return math.pi * (u - 0.5)


ANGLES: Mapping[Policy, Callable[[float], float]] = MappingProxyType({Policy.LAMBERT: lambert, Policy.UNIFORM: uniform})


def turn(policy: Policy | str, normal_heading_rad: float, rng: Generator) -> float:
    """Draw the heading of the next run from the edge.

    Args:
        policy: A ``Policy`` that turns at the edge, or its name.
        normal_heading_rad: Heading, in the robot's clockwise frame, from the wall straight into the arena.
        rng: Source of the draw; one number is taken.

    Returns:
        Heading in the same frame, in [0, 2 pi).

    Raises:
        PolicyError: There is no such policy, or it draws no angle from a normal.
    """
    try:
        angle = ANGLES[Policy(policy)]
    except (ValueError, KeyError):
        raise PolicyError(
            f"no policy called {str(policy)!r} turns at the edge: choose {' or '.join(ANGLES)}", policy=str(policy)
        ) from None
    return _wrapped(normal_heading_rad + angle(rng.random()))


class WallTurner:
    """Turns at the edge by an angle drawn from its normal; edge-to-edge legs measure.

    Where nothing is felt (at the start, after a stall in mid-arena) it heads anywhere, and that leg does not
    measure; nor does one that turns away from something met in mid-arena, another robot. A leg that went nowhere
    leaves the robot at the edge whose normal it knew: it draws again.
    """

    def __init__(self, policy: Policy, rng: Generator) -> None:
        self._policy = policy
        self._rng = rng
        self._normal_rad: float | None = None
        self._at_edge = False

    def first(self) -> Leg:
        """Anywhere; does not measure, for it starts inside the arena."""
        self._normal_rad = None
        return _anywhere(self._rng)

    def next(self, ended: LegEnd) -> Leg:
        """By the policy from what was felt, or anywhere where nothing was."""
        if ended.length_cm > NOWHERE_CM or (ended.at_edge and ended.normal_heading_rad is not None):
            self._normal_rad, self._at_edge = ended.normal_heading_rad, ended.at_edge
        if self._normal_rad is None:
            return _anywhere(self._rng)
        return Leg(turn(self._policy, self._normal_rad, self._rng), None, measures=self._at_edge)


class HitAndRun:
    """Random interior stops: out to the edge, back across (this measures), and to a uniform point of that chord.

    A leg that ended elsewhere than it should leaves the robot at some inner point, from where it heads anywhere:
    hit-and-run forgets within a few stops where it began.
    """

    def __init__(self, rng: Generator) -> None:
        self._rng = rng

    def first(self) -> Leg:
        """Anywhere, to the edge; does not measure."""
        return _anywhere(self._rng)

    def next(self, ended: LegEnd) -> Leg:
        """Straight back from the edge, or anywhere from a stop inside."""
        leg = ended.leg
        if not ended.at_edge or leg.stop_after_cm is not None:
            return _anywhere(self._rng)
        back_rad = _wrapped(leg.heading_rad + math.pi)
        if not leg.measures:
            return Leg(back_rad, None, measures=True)
        return Leg(back_rad, self._rng.random() * ended.length_cm, measures=False)


def navigator_for(policy: Policy | str, rng: Generator) -> Navigator:
    """The navigator of a policy.

    Raises:
        PolicyError: There is no such policy.
    """
    try:
        policy = Policy(policy)
    except ValueError:
        raise PolicyError(
            f"no turning policy is called {policy!r}: choose {', '.join(Policy)}", policy=str(policy)
        ) from None
    return HitAndRun(rng) if policy is Policy.INTERIOR else WallTurner(policy, rng)


def line_weight(policy: Policy, weighting: Weighting, length_cm: float) -> float:
    """The weight of a line whose run was ``length_cm`` long; only the ratio of weights matters.

    Lambert's lines weigh 1, interior ones 1/length, uniform ones their length under ``RUN_LENGTH`` (right in a
    disc alone, see `check_weighting`) and else 1 (biased). Lengths are in cm; one below half a centimetre, which
    meets nothing, counts as that, so that no weight is infinite.
    """
    length_cm = max(length_cm, NOWHERE_CM)
    if policy is Policy.INTERIOR:
        return 1.0 / length_cm
    if policy is Policy.UNIFORM and weighting is Weighting.RUN_LENGTH:
        return length_cm
    return 1.0


def check_weighting(policy: Policy, weighting: Weighting, disc: bool) -> None:
    """See that the weights mend the policy's lines.

    Args:
        policy: How the lines are drawn.
        weighting: What they weigh.
        disc: The arena is a disc.

    Raises:
        PolicyError: They would bias the lines, or not mend their bias.
    """
    if weighting is Weighting.NONE or (policy is Policy.UNIFORM and disc):
        return
    if policy is Policy.UNIFORM:
        problem = "weights by run length undo uniform turning in a disc arena alone"
        cure = f"turn by {str(Policy.LAMBERT)!r}, or use a disc"
    else:
        weigh = "weigh alike" if policy is Policy.LAMBERT else "already weigh 1/length"
        problem = f"weights by run length would bias lines of the policy {str(policy)!r}, which {weigh}"
        cure = f"set the weighting to {str(Weighting.NONE)!r}"
    raise PolicyError(f"{problem}: {cure}", policy=str(policy))


def _anywhere(rng: Generator) -> Leg:
    return Leg(_wrapped(rng.uniform(0.0, math.tau)), None, measures=False)


def _wrapped(angle_rad: float) -> float:
    wrapped_rad = angle_rad % math.tau
    return wrapped_rad if wrapped_rad < math.tau else 0.0  # a negative hair modulo 2 pi rounds up to 2 pi
