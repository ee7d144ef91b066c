"""What given lines show of a shape: exactly, or to a rolling light sensor.

`analysis.sensor` throws lines at random; here they are those that a robot was seen to roll, so that two readings of the
same lines differ by their cause alone and not by the lines' own scatter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.boundary import Boundary, Geometry
from analysis.kernels import chord_invariants, kernel
from analysis.sensor import SensorModel
from analysis.sensorkernels import clear_light, cross_parallel, detect, read_light, room_for

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Passes:
    """Straight passes over the floor, each array (n,).

    A pass lies on x cos θ + y sin θ = p and is the part ``low_cm`` < t < ``high_cm`` of it, where t counts along
    (−sin θ, cos θ) from the foot of the normal. Which way it was rolled makes no difference to its chords.

    A chord is closed where the pass ends in the light. Not so where ``cut`` (n, 2) says that its low or its high end is
    a cut, by another robot: that end then counts as no crossing. Passes that are cut at random, one per
    ``path_per_cut_cm`` in the light, weigh a pair of crossings the way r apart by e^(r/L) (`robot.interrupted`).
    """

    theta_rad: Floats
    p_cm: Floats
    low_cm: Floats
    high_cm: Floats
    cut: Bools
    path_per_cut_cm: float = np.inf

    @classmethod
    def whole(cls, theta_rad: Floats, p_cm: Floats) -> Passes:
        """Endless lines."""
        endless = np.full(len(theta_rad), np.inf)
        return cls(theta_rad, p_cm, -endless, endless, np.zeros((len(theta_rad), 2), dtype=np.bool_))

    @classmethod
    def thrown(cls, geometry: Geometry, lines: int, rng: np.random.Generator) -> Passes:
        """Isotropic uniform lines over the circumscribed circle of ``geometry``; some miss the shape itself."""
        outline = Boundary.of(geometry)
        theta = np.pi * rng.random(lines)
        foot = outline.centre_cm[0] * np.cos(theta) + outline.centre_cm[1] * np.sin(theta)
        return cls.whole(theta, foot + outline.radius_cm * (2 * rng.random(lines) - 1))

    def __len__(self) -> int:
        """Number of passes."""
        return len(self.theta_rad)

    def about(self, centre_cm: tuple[float, float]) -> Floats:
        """(n, 5) of (cos θ, sin θ, p, low, high) as seen from another origin."""
        cos, sin = np.cos(self.theta_rad), np.sin(self.theta_rad)
        x_cm, y_cm = centre_cm
        back_cm = y_cm * cos - x_cm * sin
        seen = [cos, sin, self.p_cm - x_cm * cos - y_cm * sin, self.low_cm - back_cm, self.high_cm - back_cm]
        return np.ascontiguousarray(np.column_stack(seen))


def true_sums(geometry: Geometry, passes: Passes) -> Floats:
    """(n, 3) of the exact (k, 𝓛_1 in cm, 𝓛_3 in cm³) of every pass; a shape that it ends in is closed there."""
    outline = Boundary.of(geometry)
    sums = np.zeros((len(passes), 3))
    _cross(passes.about(outline.centre_cm), passes.cut, float(passes.path_per_cut_cm), _arrays(outline), sums)
    return sums


def sensed_sums(
    geometry: Geometry,
    passes: Passes,
    step_cm: Floats,
    model: SensorModel,
    rng: np.random.Generator,
    *,
    late_cm: float = 0.0,
    phases: int = 8,
) -> Floats:
    """(n, 3) of (k, 𝓛_1, 𝓛_3) as a light sensor finds them, each the mean over ``phases`` random first readings.

    Args:
        geometry: the shape, cm.
        passes: the lines.
        step_cm: (n,) way between two readings on each line; that of ``model`` is not used, nor its ``speed_sigma``.
        model: footprint, thresholds, noise, and jitter of a reading's place.
        rng: of the phases, the noise and the jitter.
        late_cm: by how much later a leaving crossing is found than an entering one; it makes every chord longer.
        phases: how often each line is read.
    """
    outline = Boundary.of(geometry)
    sums = np.zeros((len(passes), 3))
    _read(
        rng,
        passes.about(outline.centre_cm),
        passes.cut,
        float(passes.path_per_cut_cm),
        _arrays(outline),
        np.ascontiguousarray(step_cm, dtype=float),
        model.footprint(),
        model.levels,
        (float(model.noise), float(model.jitter_cm), float(late_cm)),
        phases,
        sums,
    )
    return sums


def _arrays(outline: Boundary) -> tuple[Floats, Floats, Ints, Floats]:
    return outline.x_cm, outline.y_cm, outline.chunks, outline.discs


@kernel
def _invariants(
    s_cm: Floats, found: int, cut_start: bool, cut_end: bool, path_per_cut_cm: float
) -> tuple[float, float, float]:
    """(k, 𝓛_1, 𝓛_3) of one pass; an end that is a cut counts for its lit length only."""
    if path_per_cut_cm == np.inf and not cut_start and not cut_end:
        k, l1_cm, l3_cm3 = chord_invariants(s_cm, 0, found)
        return float(k), l1_cm, l3_cm3
    first = 1 if cut_start else 0
    last = found - 1 if cut_end else found
    l1_cm = 0.0
    l3_cm3 = 0.0
    for j in range(0, found, 2):
        l1_cm += s_cm[j + 1] - s_cm[j]
    for j in range(first, last):
        for i in range(first, j):
            r_cm = s_cm[j] - s_cm[i]
            pair = r_cm * r_cm * r_cm * np.exp(r_cm / path_per_cut_cm)
            l3_cm3 += pair if (i + j) % 2 else -pair
    return 0.5 * max(0, last - first), l1_cm, l3_cm3


@kernel
def _cross(
    passes: Floats, cut: Bools, path_cm: float, boundary: tuple[Floats, Floats, Ints, Floats], sums: Floats
) -> None:
    own = np.zeros(1)
    t_cm = np.empty((1, boundary[0].size))
    counts = np.zeros(1, np.int64)
    for line in range(passes.shape[0]):
        cos, sin, p, low, high = passes[line]
        cross_parallel((cos, sin, p), own, boundary, t_cm, counts)
        kept = 0
        # Entry and exit by turns: a pair that lies partly outside is cut, one that lies outside is left out.
        for j in range(0, counts[0] - 1, 2):
            begin = max(t_cm[0, j], low)
            end = min(t_cm[0, j + 1], high)
            if end > begin:
                t_cm[0, kept] = begin
                t_cm[0, kept + 1] = end
                kept += 2
        begun_cut = kept > 0 and cut[line, 0] and t_cm[0, 0] == low
        ended_cut = kept > 0 and cut[line, 1] and t_cm[0, kept - 1] == high
        found = _invariants(t_cm[0], kept, begun_cut, ended_cut, path_cm)
        sums[line, 0], sums[line, 1], sums[line, 2] = found


@kernel
def _read(
    rng: np.random.Generator,
    passes: Floats,
    cut: Bools,
    path_cm: float,
    boundary: tuple[Floats, Floats, Ints, Floats],
    steps_cm: Floats,
    footprint: tuple[Floats, Floats, Floats],
    levels: tuple[float, float, float],
    spread: tuple[float, float, float],
    phases: int,
    sums: Floats,
) -> None:
    offsets_cm, half_cm, weight = footprint
    noise, jitter_cm, late_cm = spread
    widest_cm = 0.0
    for i in range(boundary[0].size):
        widest_cm = max(widest_cm, np.hypot(boundary[0][i], boundary[1][i]))
    most = 2.0 * (widest_cm + 2.0 * half_cm.max()) / steps_cm.min()
    t_cm, counts, s_cm, light, found_cm = room_for(offsets_cm.size, boundary[0].size, most)
    clear = clear_light(levels, noise)
    for line in range(passes.shape[0]):
        cos, sin, p, low, high = passes[line]
        if cross_parallel((cos, sin, p), offsets_cm, boundary, t_cm, counts) == 0:
            continue
        for _ in range(phases):
            readings = read_light((t_cm, counts), (half_cm, weight), steps_cm[line], rng.random(), clear, s_cm, light)
            kept = 0
            last = -np.inf
            before_s = s_cm[0]
            before_light = light[0]
            for i in range(readings):
                # The light between two readings is even where some were left out, so the ends lie on a straight line.
                at = s_cm[i]
                seen = light[i]
                share = (high - before_s) / (at - before_s) if at > high and i > 0 else 1.0
                if before_s < low <= at and low <= high:
                    s_cm[0] = low
                    light[0] = before_light + (low - before_s) / (at - before_s) * (seen - before_light)
                    last = low
                    kept = 1
                ended = at > high
                place = high if ended else at
                value = before_light + share * (seen - before_light)
                before_s = at
                before_light = seen
                if at < low or share < 0.0:
                    continue
                if jitter_cm > 0.0:
                    place = max(last, place + jitter_cm * rng.standard_normal())
                last = place
                s_cm[kept] = place
                light[kept] = value + (noise * rng.standard_normal() if noise > 0.0 else 0.0)
                kept += 1
                if ended:
                    break
            if kept == 0:
                continue
            found = detect(s_cm, light, kept, levels, found_cm)
            begun_cut = found > 0 and cut[line, 0] and found_cm[0] == s_cm[0]
            ended_cut = found > 0 and cut[line, 1] and found_cm[found - 1] == s_cm[kept - 1]
            if late_cm != 0.0:
                for j in range(found):
                    found_cm[j] += 0.5 * late_cm if j % 2 else -0.5 * late_cm
                for j in range(1, found):
                    found_cm[j] = max(found_cm[j], found_cm[j - 1])
            k, l1_cm, l3_cm3 = _invariants(found_cm, found, begun_cut, ended_cut, path_cm)
            sums[line, 0] += k / phases
            sums[line, 1] += l1_cm / phases
            sums[line, 2] += l3_cm3 / phases
