"""Are the robot's lines isotropic and homogeneous? Tests of true lines, with effect sizes.

Only then do the means over its lines stand for the integrals over all lines, and so for area and
perimeter. Lines are mapped to (U, V), uniform on the unit square if they are right (`tracking.linespace`).

Successive runs share an end point on the wall, so they are dependent even when each is perfect: tests for
independent lines at 5 % condemn 7 to 34 % of perfect sessions. Here what shared ends make alike is
taken out (`tracking.nulltable`), and every p-value comes from a table of whole sessions simulated with perfect
turns in the same region, with as many runs, broken where the session's chain of runs is broken. Nothing is
thinned away.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from shapely import Polygon

from lab.base.errors import RequestError
from tracking.anisotropy import Effect, Evidence, effects_of
from tracking.linespace import LineSpace, Wall
from tracking.nulltable import FAMILY, LEVEL, NullTable, Sums, tabulate
from tracking.uniformity import holm

__all__ = ["IsotropyReport", "LineTest", "NullTable", "TooFewLinesError", "examine_lines", "tabulate"]

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_FEWEST_LINES = 10
# two runs whose nearest ends lie within this share of the perimeter share an end: room for the camera's error at
# grazing angles and for a robot that backs off before it turns
_SAME_END = 0.02


class TooFewLinesError(RequestError):
    """Too few usable lines to test; carries ``lines`` and ``needed``."""

    def __init__(self, lines: int, needed: int) -> None:
        super().__init__(f"{lines} usable lines are too few to test isotropy; roll at least {needed}")
        self.lines = lines
        self.needed = needed


@dataclass(frozen=True, slots=True)
class LineTest:
    """One test: its statistic, raw p-value, and p-value after Holm's correction over the four."""

    name: str
    looks_for: str
    statistic: float
    p_value: float
    holm_p_value: float


@dataclass(frozen=True, slots=True)
class IsotropyReport:
    """What the lines' statistics say.

    ``isotropy_p`` is Holm's over Rayleigh and Hermans-Rasson (directions), ``homogeneity_p`` Holm's over
    Cramer-von Mises (places) and Neyman (joint), ``joint_p`` Neyman's own. ``family_p`` is the share of perfect
    sessions in which the smallest of the four is as small, and ``passed`` that it is no less than 5 %: Holm's
    correction bounds the same chance from above, since the tests share much.

    ``effects`` are the sizes of ``one_axis``, ``four_arms`` and ``centre_pull`` (`tracking.anisotropy.effects_of`);
    ``bias``, ``bias_low``, ``bias_high`` and ``smallest_bias`` are the first one's: the amplitude of the excess along
    one axis (density 1 + bias cos), its 95 % interval, and what this many lines show in 8 sessions of 10.
    ``favoured_rad`` is the direction of travel, in [0, pi), of that excess. Mean run lengths in cm: predicted is
    pi A/P of the region (Cauchy), for runs of at least ``shortest_cm`` their simulated mean. ``linked`` counts the
    lines that share an end with the line before.
    """

    lines: int
    skipped: int
    outside: int
    linked: int
    tests: tuple[LineTest, ...]
    isotropy_p: float
    homogeneity_p: float
    joint_p: float
    family_p: float
    effects: tuple[Effect, ...]
    favoured_rad: float
    mean_run_cm: float
    predicted_run_cm: float
    run_length_p: float
    passed: bool
    verdict: str
    evidence: Evidence = field(repr=False, compare=False)

    @property
    def bias(self) -> float:
        """The excess along one axis."""
        return self.effects[0].value

    @property
    def bias_low(self) -> float:
        """Lower end of its 95 % interval."""
        return self.effects[0].low

    @property
    def bias_high(self) -> float:
        """Upper end of its 95 % interval."""
        return self.effects[0].high

    @property
    def smallest_bias(self) -> float:
        """The excess along one axis that shows in 8 sessions of 10."""
        return self.effects[0].least_seen

    def effect_dict(self) -> dict[str, dict[str, float]]:
        """The JSON form of the effects: value, low, high of each."""
        return {one.name: {"value": one.value, "low": one.low, "high": one.high} for one in self.effects}

    def least_seen_dict(self) -> dict[str, float]:
        """The least size of each effect that shows in 8 sessions of 10."""
        return {one.name: one.least_seen for one in self.effects}

    def to_dict(self) -> dict[str, Any]:
        """The JSON form: numbers, one dict a test, one an effect; without the lines."""
        apart = ("tests", "effects", "evidence")
        fields: dict[str, Any] = {name: getattr(self, name) for name in self.__slots__ if name not in apart}
        fields |= {name: getattr(self, name) for name in ("bias", "bias_low", "bias_high", "smallest_bias")}
        fields["tests"] = [{name: getattr(test, name) for name in test.__slots__} for test in self.tests]
        return fields | {"effect": self.effect_dict(), "least_seen": self.least_seen_dict()}


_LOOKS_FOR = dict(
    zip(
        FAMILY,
        (
            "one favoured direction",
            "several favoured directions",
            "favoured places across the arena",
            "directions and places that go together",
        ),
        strict=True,
    )
)


def _shared_ends(theta: Floats, p: Floats, region: Polygon, chain: NDArray[Any]) -> tuple[Floats, Bools]:
    """Places (n - 1,) along the wall where each line's end is nearest to the next line's, and whether it is one end."""
    wall = Wall.of(region)
    ends = wall.ends_cm(theta, p)
    gap = ends[1:, None, :] - ends[:-1, :, None]
    gap -= wall.perimeter_cm * np.round(gap / wall.perimeter_cm)
    nearest = np.abs(gap).reshape(len(gap), 4).argmin(axis=1)
    row = np.arange(len(gap))
    between = gap.reshape(len(gap), 4)[row, nearest]
    shared = (np.abs(between) < _SAME_END * wall.perimeter_cm) & (chain[1:] == chain[:-1])
    return np.mod(ends[row, nearest // 2] + between / 2.0, wall.perimeter_cm), shared


def examine_lines(
    theta_rad: ArrayLike,
    p_cm: ArrayLike,
    run_length_cm: ArrayLike,
    reachable: Polygon,
    rng: np.random.Generator,
    *,
    chain: ArrayLike | None = None,
    shortest_cm: float = 0.0,
    successive: bool = True,
    null: NullTable | None = None,
) -> IsotropyReport:
    """Test whether lines are isotropic and homogeneous in the region that the ball's centre can reach.

    Args:
        theta_rad: direction of each line's normal, (n,), in the order rolled; lines with NaN are skipped.
        p_cm: signed distance of each line, (n,).
        run_length_cm: length of each run, (n,).
        reachable: convex polygon in which the ball's centre moves.
        rng: source of the simulated sessions.
        chain: which robot rolled each line, (n,), of any type; without it, one robot rolled them all.
        shortest_cm: runs shorter than this are left out, here and in the simulated sessions; set it where
            the camera cannot see short runs, for else their absence counts as a fault.
        successive: a robot's runs follow each other, each from where the last one ended.
        null: a table from `tabulate`, to be shared between sessions of equal length.

    Raises:
        TooFewLinesError: fewer than 10 lines are left.
        RegionError: the region is not convex.
        RequestError: the arrays differ in length, or the table is for another number of lines.
    """
    theta, p, length = (np.asarray(a, dtype=float).ravel() for a in (theta_rad, p_cm, run_length_cm))
    _, robot = np.unique(np.zeros(len(theta)) if chain is None else np.asarray(chain).ravel(), return_inverse=True)
    if not len(theta) == len(p) == len(length) == len(robot):
        raise RequestError("theta, p, run length and chain must be one value each a line; they differ in length")
    usable = np.isfinite(theta) & np.isfinite(p) & np.isfinite(length)
    skipped = int(len(theta) - usable.sum())
    usable &= ~(length < shortest_cm)
    order = np.flatnonzero(usable)[np.argsort(robot[usable], kind="stable")]
    theta, p, length, robot = theta[order], p[order], length[order], robot[order]
    if len(theta) < _FEWEST_LINES:
        raise TooFewLinesError(len(theta), _FEWEST_LINES)
    place, shared = _shared_ends(theta, p, reachable, robot)
    shared &= successive
    if null is None:
        begins = np.concatenate([[True], ~shared])
        null = tabulate(reachable, len(theta), rng, shortest_cm=shortest_cm, begins=begins)
    if null.lines != len(theta) or null.shortest_cm != shortest_cm or not null.reachable.equals(reachable):
        raise RequestError(
            f"the table is for {null.lines} runs of at least {null.shortest_cm:g} cm, the session has {len(theta)} "
            f"of at least {shortest_cm:g} cm, or it is for another region; tabulate again"
        )
    space = LineSpace.of(reachable)
    u, v_raw = space.uniforms(theta, p)
    v = np.clip(v_raw, 0.0, 1.0)
    sums = Sums.of(u[None], v[None], length[None], null.ends.total(place[None], shared[None]))
    seen = {name: float(values[0]) for name, values in null.statistics_of(sums).items()}
    raw = {name: float(null.p_values(name, np.array([value]))[0]) for name, value in seen.items()}
    corrected = holm([raw[name] for name in FAMILY])
    tests = tuple(
        LineTest(name, _LOOKS_FOR[name], seen[name], raw[name], p_holm)
        for name, p_holm in zip(FAMILY, corrected, strict=True)
    )
    family_p = float(null.family_p(np.array([min(raw[name] for name in FAMILY)]))[0])
    effects, angle = effects_of(u, v, null)
    # the normal's direction, turned by a quarter into the direction of travel
    favoured = float(np.mod(space.direction(float(np.mod(angle / (2 * np.pi), 1.0))) + np.pi / 2, np.pi))
    verdict = _verdict(tests, family_p, len(u), effects, favoured)
    if raw["run_length"] < LEVEL:
        verdict += (
            f" Runs are {length.mean():.1f} cm long on average where {null.mean_run_cm:.1f} cm are expected "
            f"(p = {raw['run_length']:.2g}): are they cut short, or is the region not the one rolled in?"
        )
    return IsotropyReport(
        lines=len(u),
        skipped=skipped,
        outside=int(((v_raw < 0) | (v_raw > 1)).sum()),
        linked=int(shared.sum()),
        tests=tests,
        isotropy_p=min(holm([raw["rayleigh"], raw["hermans_rasson"]])),
        homogeneity_p=min(holm([raw["cramer_von_mises"], raw["neyman"]])),
        joint_p=raw["neyman"],
        family_p=family_p,
        effects=effects,
        favoured_rad=favoured,
        mean_run_cm=float(length.mean()),
        predicted_run_cm=null.mean_run_cm,
        run_length_p=raw["run_length"],
        passed=family_p >= LEVEL,
        verdict=verdict,
        evidence=Evidence(theta, p, null.information(), null.least_seen["any"] ** 2),
    )


def _verdict(
    tests: tuple[LineTest, ...], family_p: float, lines: int, effects: tuple[Effect, ...], favoured_rad: float
) -> str:
    """What a teacher should know: whether a fault was found, which, and what could have been missed."""
    size = {one.name: one for one in effects}
    if family_p >= LEVEL:
        return (
            f"No fault found in {lines} lines: they look isotropic and homogeneous (p = {family_p:.2g}). "
            f"An excess along one axis of {100 * min(size['one_axis'].least_seen, 1):.0f} % or more "
            "would show in 8 sessions of 10."
        )
    least = min(tests, key=lambda test: test.p_value)
    found = [test for test in tests if test is least or test.holm_p_value < LEVEL]
    faults = "; ".join(test.looks_for for test in found)
    said = (
        f"The {lines} lines are not isotropic and homogeneous ({faults}; p = {family_p:.2g}); "
        "area and perimeter will be biased."
    )
    if "rayleigh" in {test.name for test in found}:
        share = 100 * size["one_axis"].value
        said += f" Travel near {np.degrees(favoured_rad):.0f} deg is {share:.0f} % too frequent."
    elif size["centre_pull"].low > 0:
        said += " Lines through the middle of the arena are too frequent."
    elif size["centre_pull"].high < 0:
        said += " Lines along the walls are too frequent."
    return said
