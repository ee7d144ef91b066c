"""Lights tied to pieces of a way, frame by frame, and cut wherever two of them might as well have changed places."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from tracking.lights import Light
from tracking.motion import PixelMotion

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """How lights are tied together.

    Attributes:
        q_px2_s3: how freely a light may change its pace, spectral density of its acceleration.
        place_var_px2: variance of a light's place.
        gate: largest squared distance, in standard deviations, from where a light was expected.
        coast_s: how long a dark light is awaited before its piece ends.
        widest_rad: farthest that a light's hue may lie from its robot's.
        apart_rad: hues farther apart than this are two colours.
        mark_sigma_rad: how well a robot's hue is known.
        least_frames: shorter pieces are noise.
        doubt: a piece is cut where a change of places is as probable as this.
        pace_px_s: speed that no robot exceeds out of sight.
    """

    q_px2_s3: float = 1.2e5
    place_var_px2: float = 0.5
    gate: float = 25.0
    coast_s: float = 0.4
    widest_rad: float = 0.7
    apart_rad: float = 0.4
    mark_sigma_rad: float = 0.2
    least_frames: int = 3
    doubt: float = 0.01
    pace_px_s: float = 1000.0


@dataclass(slots=True, eq=False)
class Piece:
    """A light through some frames, and where it is going."""

    motion: PixelMotion
    frames: list[int] = field(default_factory=list[int])
    times_s: list[float] = field(default_factory=list[float])
    lights: list[Light] = field(default_factory=list[Light])
    tint: complex = 0j

    def ahead(self, t_s: float, settings: LinkSettings) -> PixelMotion:
        """Where it will be; who is out of sight for long may have turned, and is sought about where it went out."""
        motion = replace(self.motion)
        dt_s = t_s - self.times_s[-1]
        motion.predict(max(0.0, dt_s), settings.q_px2_s3)
        late_s = max(0.0, dt_s - settings.coast_s)
        motion.x -= late_s * motion.vx
        motion.y -= late_s * motion.vy
        return motion

    def take(self, frame: int, t_s: float, light: Light, settings: LinkSettings) -> None:
        """Take a frame's light for this one's."""
        if self.frames:
            self.motion.predict(max(0.0, t_s - self.times_s[-1]), settings.q_px2_s3)
            self.motion.update(light.x_px, light.y_px, settings.place_var_px2)
        self.frames.append(frame)
        self.times_s.append(t_s)
        self.lights.append(light)
        if math.isfinite(light.hue_rad):
            self.tint += cmath.rect(light.height, light.hue_rad)

    @property
    def hue_rad(self) -> float:
        """The direction atan2(V, U) of its colour, NaN where it has none."""
        return cmath.phase(self.tint) if self.tint else math.nan

    @property
    def weight(self) -> float:
        """The heights of its lights, summed: how much there is of it."""
        return sum(light.height for light in self.lights)

    def misfit(self, light: Light, t_s: float, settings: LinkSettings) -> float:
        """Minus twice the log-likelihood, but for a constant, that a light is this one; inf where it cannot be."""
        off = hues_apart(light.hue_rad, self.hue_rad)
        if off > settings.widest_rad + 2.0 * light.hue_sigma_rad:
            return math.inf
        motion = self.ahead(t_s, settings)
        farthest_px = 20.0 + settings.pace_px_s * (t_s - self.times_s[-1])
        reach = settings.place_var_px2 + min(motion.xx, farthest_px**2)
        distance = ((light.x_px - motion.x) ** 2 + (light.y_px - motion.y) ** 2) / reach
        if distance > settings.gate:
            return math.inf
        hue = (off / math.hypot(light.hue_sigma_rad, settings.mark_sigma_rad)) ** 2
        return distance + 2.0 * math.log(reach) + hue


def hues_apart(one_rad: float, other_rad: float) -> float:
    """The angle between two hues, 0 where one is not known."""
    if not (math.isfinite(one_rad) and math.isfinite(other_rad)):
        return 0.0
    return abs(math.remainder(one_rad - other_rad, math.tau))


def tie_pieces(times_s: Sequence[float], lights: Sequence[Sequence[Light]], settings: LinkSettings) -> list[Piece]:
    """Tie lights to pieces, frame by frame."""
    done: list[Piece] = []
    live: list[Piece] = []
    for frame, (t_s, found) in enumerate(zip(times_s, lights, strict=True)):
        done += [piece for piece in live if t_s - piece.times_s[-1] > settings.coast_s]
        live = [piece for piece in live if t_s - piece.times_s[-1] <= settings.coast_s]
        taken: set[int] = set()
        if live and found:
            cost = np.array([[piece.misfit(light, t_s, settings) for light in found] for piece in live])
            pairs = cheapest_pairs(cost)
            doubted = _doubted(cost, pairs, settings)
            for i, j in pairs:
                if i not in doubted:
                    live[i].take(frame, t_s, found[j], settings)
                    taken.add(j)
            # Who may have changed places begins anew; what it was before is decided later, with all there is to know.
            done += [live[i] for i in sorted(doubted)]
            live = [piece for i, piece in enumerate(live) if i not in doubted]
        for j, light in enumerate(found):
            if j not in taken:
                piece = Piece(PixelMotion(light.x_px, light.y_px, xx=settings.place_var_px2))
                piece.take(frame, t_s, light, settings)
                live.append(piece)
    return done + live


def cheapest_pairs(cost: Floats) -> list[tuple[int, int]]:
    """Pairs of least total cost (Hungarian method), none of infinite cost, as many as can be."""
    finite = cost[np.isfinite(cost)]
    if not len(finite):
        return []
    low = float(finite.min())
    never = (float(finite.max()) - low + 1.0) * (min(cost.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(np.isfinite(cost), cost - low, never))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if np.isfinite(cost[i, j])]


def swap_chance(worse: float) -> float:
    """Probability of the other of two readings that is ``worse`` in minus twice its log-likelihood."""
    return 1.0 / (1.0 + math.exp(min(max(worse, 0.0), 200.0) / 2.0))


def _doubted(cost: Floats, pairs: Sequence[tuple[int, int]], settings: LinkSettings) -> set[int]:
    """The pieces that may have changed places with another one."""
    doubted: set[int] = set()
    paired = dict(pairs)
    for i, j in pairs:
        for k in range(len(cost)):
            if k == i or not math.isfinite(cost[k, j]):
                continue
            m = paired.get(k)
            # The other piece is out of sight (and might be this light), or has a light of its own to give for it.
            swapped = cost[k, j] - cost[i, j] if m is None else cost[i, m] + cost[k, j] - cost[i, j] - cost[k, m]
            if math.isfinite(swapped) and swap_chance(float(swapped)) > settings.doubt:
                doubted |= {i, k}
    return doubted
