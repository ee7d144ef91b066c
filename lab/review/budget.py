"""The error budget of a stored session: its own light, crossings and video, given to `analysis.budget`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from shapely import affinity

from analysis.billiard import roll
from analysis.budget import (
    FEWEST_LINES,
    Budget,
    Expected,
    Fitted,
    Stage,
    budget_of,
    groups_of,
    predicted_budget,
)
from analysis.edgeshift import EdgeShift
from analysis.estimate import ratio_bias
from analysis.invariants import invariants_table, sizes
from analysis.quadrature import Moments
from analysis.replay import Passes, sensed_sums, true_sums
from analysis.sensor import SensorModel
from lab.base.jackknife import jackknife_sigma
from lab.recognise.recognisers import sensor_model
from lab.reopen.parts import LearntLevels
from lab.review.filmed import Filmed
from lab.review.reviewed import Reviewed
from lab.review.watched import Edges, Readings, Watched, readings_of, watch
from lab.session.tally import stored_cut_lines
from lab.settings.settings import Settings
from projector.shape import Silhouette
from robot.cutlines import estimate_interrupted
from robot.interrupted import InterruptedEstimator
from robot.turning import Policy
from tracking.anisotropy import TooFewHitsError, bias_from

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Sums = Callable[[Floats], Floats]

_FINE_CM = 0.05  # steps as good as none: π (0.05 cm)²/6 is 0.001 cm²
_RANDOM_LINES, _RANDOM_GROUPS = 20_000, 30
_FEWEST_PHASES, _MOST_PHASES, _ALL_PHASES = 4, 64, 6000
_SESSIONS, _LONGEST_SESSION = 400, 300  # simulated, to see how much successive lines depend on each other
_STEPS = np.array([0.01, 0.15, 0.1, 0.01])  # of ε, ρ in cm, lateness in cm, jitter² in cm², for the slopes


def session_budget(found: Reviewed, rng: np.random.Generator) -> Budget | None:
    """The error budget of a reviewed session; None with fewer than ten crossing lines.

    With a video the causes are measured; without one, or where it shows too few edges, they are predicted.
    """
    lines = found.tables.lines
    counted = lines[lines["counts"]].sort_values("line").reset_index(drop=True)
    if found.robot is None or int((counted["k"] > 0).sum()) < FEWEST_LINES:
        return None
    rolled = _Rolled.of(found, counted)
    chance = _chance(found, counted, rng)
    measured = None if found.filmed is None else _measured(rolled, found, found.filmed, chance, rng)
    if measured is not None:
        return measured
    seen = np.array([found.robot.area_cm2, found.robot.perimeter_cm]) / rolled.truth - 1
    return predicted_budget(seen, _causes(rolled, rng), chance, int((counted["k"] > 0).sum()))


@dataclass(frozen=True, slots=True, eq=False)
class _Rolled:
    """What the robot did: its counted ``lines``, their ``crossings``, and what counts for how much."""

    geometry: Silhouette
    lines: pd.DataFrame
    crossings: pd.DataFrame
    weight: Floats
    path_per_cut_cm: float
    model: SensorModel
    readings: Callable[[int, str], Readings]
    settings: Settings

    @classmethod
    def of(cls, found: Reviewed, counted: pd.DataFrame) -> _Rolled:
        crossings = found.tables.crossings
        crossings = crossings[crossings["line"].isin(counted["line"])].sort_values(["line", "order"])
        path_cm = math.inf
        if counted["robot"].nunique() > 1:
            path_cm = estimate_interrupted(stored_cut_lines(counted, crossings)).path_per_cut_cm
        levels = LearntLevels.of(found.session)
        model = sensor_model(found.settings)
        first = next(iter(levels.by_part[0].values()), None)
        if first is not None:
            span_lux = first["bright_lux"] - first["dark_lux"]
            model = replace(model, margin=(first["high_lux"] - first["mid_lux"]) / span_lux)

        def readings(line: int, robot: str) -> Readings:
            return readings_of(found.session, line, levels.get(line, robot))

        weight = np.asarray(counted["weight"] / counted["weight"].mean(), dtype=float)
        return cls(found.shape.geometry, counted, crossings, weight, path_cm, model, readings, found.settings)

    @property
    def truth(self) -> Floats:
        """(2,) area in cm² and perimeter in cm."""
        return np.array([self.geometry.area, self.geometry.length])

    def sums(self, lines: pd.DataFrame, crossings: pd.DataFrame) -> Floats:
        """(n, 3) of the weighted (k, 𝓛_1, 𝓛_3) of counted lines, zero on those that are not in ``lines``."""
        made = np.zeros((len(self.lines), 3))
        rows = pd.Index(self.lines["line"]).get_indexer(pd.Index(lines["line"]))
        if self.lines["robot"].nunique() <= 1:
            table = invariants_table(crossings).set_index("line").reindex(lines["line"]).fillna(0.0)
            made[rows] = table[["k", "l1_cm", "l3_cm3"]].to_numpy(dtype=float) * self.weight[rows, None]
            return made
        for row, line in zip(rows, stored_cut_lines(lines, crossings), strict=True):
            one = InterruptedEstimator(self.path_per_cut_cm)
            line.into(one)
            if one.lit_cm > 0:
                made[row] = one.crossings / 2, one.lit_cm, one.area() * 3 / math.pi * one.lit_cm
        return made


def _chance(found: Reviewed, counted: pd.DataFrame, rng: np.random.Generator) -> Expected:
    """How large the error by counting statistics is expected to be."""
    moments, robot = found.moments[found.shape.name], found.robot
    crossed = int((counted["k"] > 0).sum())
    if robot is not None and (counted["weight"].nunique() > 1 or counted["robot"].nunique() > 1):
        sigma = np.sqrt(np.diag(robot.covariance)) / [robot.area_cm2, robot.perimeter_cm]
        return Expected(np.zeros(2), sigma, f"chance; ± is the scatter of the {crossed} lines themselves")
    sigma = np.sqrt(np.diag(moments.relative) / crossed)
    how = f"chance; ± is the exact σ/√N of {crossed} lines"
    if found.settings.motion.turning is Policy.LAMBERT:
        worse = _dependence(found.shape.geometry, found.settings, len(counted), moments, rng)
        how += f", {worse[0]:.2f}-fold as one line begins where the last one ended"
        sigma = sigma * worse
    return Expected(ratio_bias(moments.mean, moments.covariance) / crossed, sigma, how)


def _dependence(
    geometry: Silhouette, settings: Settings, runs: int, moments: Moments, rng: np.random.Generator
) -> Floats:
    """(2,) by how much A and P of successive runs scatter more than those of independent ones, by simulation."""
    runs = min(runs, _LONGEST_SESSION)
    rolls = roll(settings.arena.lines_within, _SESSIONS, runs, rng)
    k, l1, l3 = (true_sums(geometry, Passes.whole(rolls.theta_rad.ravel(), rolls.p_cm.ravel())) / moments.mean).T
    pull = np.stack([l3 - l1, k + l3 - 2 * l1], axis=1).reshape(_SESSIONS, runs, 2)
    return np.sqrt(pull.sum(axis=1).var(axis=0) / (runs * pull.reshape(-1, 2).var(axis=0)))


def _measured(
    rolled: _Rolled, found: Reviewed, filmed: Filmed, chance: Expected, rng: np.random.Generator
) -> Budget | None:
    """The budget by the camera; None where too few crossings of robot and camera belong together."""
    settings, lines = found.settings, rolled.lines
    watched = watch(found.session, settings, rolled.geometry, lines, rolled.crossings, filmed, rolled.path_per_cut_cm)
    crossed = np.asarray(lines["k"] > 0, dtype=np.bool_)
    if int((crossed & watched.seen).sum()) < FEWEST_LINES:
        return None
    group, groups = groups_of(crossed)
    edges = Edges.between(watched, filmed, rolled.geometry)
    nadir_cm = np.asarray(settings.projector_optics.pinhole().centre_cm[:2], dtype=float)
    shift = edges.shift(nadir_cm, group, groups)
    if shift is None:
        return None
    ramps = edges.ramps(watched)
    radius = None if ramps is None else ramps.radius_cm(group, groups)
    said = "by the light's ramps"
    if radius is None:
        radius = rolled.model.footprint_cm, np.full(groups, rolled.model.footprint_cm)
        said = "by the settings, as no edge was clean"
    jitter = _mean_and_left(watched.jitter_cm2, group, groups)
    fitted = Fitted(
        np.array([shift.values[0], radius[0], shift.values[3], jitter[0]]),
        np.column_stack([shift.replicates[:, 0], radius[1], shift.replicates[:, 3], jitter[1]]),
    )
    stages = _replayed(rolled, watched, shift, fitted.values, nadir_cm, said, int(rng.integers(2**63)))
    seen_lines = lines[watched.seen]
    by_camera = rolled.sums(watched.lines[watched.seen], watched.crossings)
    own = rolled.sums(lines, rolled.crossings)
    of_seen = np.where(watched.seen[:, None], own, 0.0)
    ratio = of_seen[:, 1].sum() / by_camera[:, 1].sum()
    both = (of_seen[:, 1] > 0) & (by_camera[:, 1] > 0)
    spread = float(np.std(of_seen[both, 1] / by_camera[both, 1] / ratio, ddof=1))
    lengths = f"chords {ratio:.4f} times the camera's, {100 * spread:.1f} % apart from line to line"
    stages += [
        Stage("rest", by_camera, f"of robot against camera on {len(seen_lines)} lines, unexplained by the other terms"),
        Stage("speed", of_seen, lengths),
    ]
    return budget_of(
        rolled.truth, stages, own, group, groups, fitted, chance, _anisotropy(filmed, settings, rolled.geometry)
    )


def _mean_and_left(values: Floats, group: Ints, groups: int) -> tuple[float, Floats]:
    """Mean of the known values, and (groups,) the same without each group; 0 where none is known."""
    known = np.isfinite(values)
    total, number = (
        np.bincount(group[known], weights=weights, minlength=groups)
        for weights in (values[known], np.ones(int(known.sum())))
    )
    left = (total.sum() - total) / np.maximum(number.sum() - number, 1.0)
    return float(total.sum() / max(number.sum(), 1.0)), left


def _replayed(
    rolled: _Rolled, watched: Watched, shift: EdgeShift, causes: Floats, nadir_cm: Floats, said: str, seed: int
) -> list[Stage]:
    """The image's exact chords on the camera's lines, and what the sensor makes of them, a cause at a time."""
    weight = np.where(watched.seen, rolled.weight, 0.0)[:, None]
    steps_cm, fine_cm = watched.step_cm, np.full(len(weight), _FINE_CM)
    phases = int(np.clip(_ALL_PHASES // len(weight), _FEWEST_PHASES, _MOST_PHASES))

    def image(eps: float) -> Silhouette:
        grown = affinity.scale(rolled.geometry, 1 + eps, 1 + eps, origin=(float(nadir_cm[0]), float(nadir_cm[1])))
        return affinity.translate(grown, float(shift.values[1]), float(shift.values[2]))

    def exact(values: Floats) -> Floats:
        return weight * true_sums(image(float(values[0])), watched.passes)

    def sensed(steps_cm: Floats, noise: float) -> Sums:
        def of(values: Floats) -> Floats:
            eps, rho_cm, late_cm, jitter_cm2 = (*values.tolist(), 0.0, 0.0)[:4]
            sensor = replace(
                rolled.model, footprint_cm=max(rho_cm, 0.0), noise=noise, jitter_cm=math.sqrt(max(jitter_cm2, 0.0))
            )
            # the same phases for all: what differs is due to the causes
            same = np.random.default_rng(seed)
            return weight * sensed_sums(
                image(eps), watched.passes, steps_cm, sensor, same, late_cm=late_cm, phases=phases
            )

        return of

    scale, rho_cm, late_cm, jitter_cm2 = causes.tolist()
    step_cm = float(np.median(steps_cm[watched.seen]))
    at_steps = sensed(steps_cm, rolled.model.noise)
    makers: tuple[tuple[str, int, Sums, str], ...] = (
        (
            "image",
            1,
            exact,
            f"the image in the sensor's plane is {1 + scale:.4f} times as large as meant, by its edges",
        ),
        ("footprint", 2, sensed(fine_cm, 0.0), f"radius {rho_cm:.2f} cm, {said}; replayed on the camera's lines"),
        ("sampling", 2, at_steps, f"a reading every {step_cm:.2f} cm; replayed on the camera's lines"),
        (
            "latency",
            4,
            at_steps,
            f"the light's end is found {10 * late_cm:.1f} mm later than its beginning; jitter "
            f"{10 * math.sqrt(jitter_cm2):.1f} mm",
        ),
    )
    stages: list[Stage] = []
    for term, known, make, how in makers:
        values = causes[:known]
        here = make(values)
        slopes = np.stack([(make(values + aside) - here).sum(axis=0) for aside in np.diag(_STEPS[:known])])
        stages.append(Stage(term, here, how, slopes / _STEPS[:known, None]))
    return stages


def _anisotropy(filmed: Filmed, settings: Settings, geometry: Silhouette) -> Expected | None:
    """What the lines' distribution does to the shape at hand; None where it was not tested."""
    if filmed.isotropy is None:
        return None
    try:
        bias = bias_from(filmed.isotropy.evidence, settings.arena.lines_within, geometry)
    except TooFewHitsError:
        return None
    return Expected(
        np.array([bias.area_rel, bias.perimeter_rel]),
        np.array([bias.area_rel_sigma, bias.perimeter_rel_sigma]),
        "by the lines' directions and places, as the camera saw them",
    )


def _causes(rolled: _Rolled, rng: np.random.Generator) -> dict[str, Expected]:
    """What the sensor should do to isotropic lines of this shape, and the robot's clock and speed to its lengths."""
    passes = Passes.thrown(rolled.geometry, _RANDOM_LINES, rng)
    group = np.arange(_RANDOM_LINES) % _RANDOM_GROUPS
    seed = int(rng.integers(2**63))
    model = rolled.model
    jitter_cm2 = _stamp_jitter_cm2(rolled)

    def relative(sums: Floats) -> Floats:
        each = np.stack([np.bincount(group, weights=column, minlength=_RANDOM_GROUPS) for column in sums.T], axis=1)
        return sizes(np.concatenate([sums.sum(axis=0)[None], sums.sum(axis=0) - each])) / rolled.truth

    def sensed(step_cm: float, sensor: SensorModel) -> Floats:
        steps_cm = np.full(_RANDOM_LINES, step_cm)
        return relative(sensed_sums(rolled.geometry, passes, steps_cm, sensor, np.random.default_rng(seed), phases=1))

    still = replace(model, noise=0.0, jitter_cm=0.0)
    exact = relative(true_sums(rolled.geometry, passes))
    blurred = sensed(_FINE_CM, still)
    stepped = sensed(model.step_cm, replace(model, jitter_cm=0.0))
    shaken = sensed(model.step_cm, replace(model, jitter_cm=math.sqrt(jitter_cm2)))

    def cause(change: Floats, how: str) -> Expected:
        change = change / exact
        return Expected(change[0], jackknife_sigma(change[1:]), how)

    spread = model.speed_sigma
    return {
        "speed": Expected(
            np.full(2, 3 * spread**2),
            np.zeros(2),
            f"predicted: 3 s² of a speed {100 * spread:.1f} % apart from run to run",
        ),
        "footprint": cause(blurred - exact, f"predicted: radius {model.footprint_cm:.2f} cm, by the settings"),
        "sampling": cause(stepped - blurred, f"predicted: a reading every {model.step_cm:.2f} cm"),
        "latency": cause(shaken - stepped, f"predicted: jitter of the stamps, {10 * math.sqrt(jitter_cm2):.1f} mm"),
    }


def _stamp_jitter_cm2(rolled: _Rolled) -> float:
    """Variance of the places of readings by the jitter of their time stamps; 0 where it cannot be told."""
    interval_s = rolled.settings.sensor.interval_s
    found = [
        rolled.readings(line, robot).stamp_variance_s2()
        for line, robot in rolled.lines[["line", "robot"]].itertuples(index=False)
    ]
    known = [variance for variance in found if math.isfinite(variance)]
    if not known or rolled.settings.motion.length_from != "time":
        return 0.0
    return float(np.mean(known)) * (rolled.model.step_cm / interval_s) ** 2
