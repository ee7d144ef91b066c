"""What is seen of an LED in one frame, how the planes it is seen in are joined, and how far their errors are believed.

A fit knows the noise in its patch, but not what is alike in all of the patch: compression moves a spot as a whole, by
up to a quarter of a pixel, and not anew in each frame. A robot that rolls tells: over half a second its way is a
parabola, and how much the positions scatter about it beyond their stated errors is added to these.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking.ledstate import learn_levels

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Place = tuple[float, float, float, float]

# Stretches over which a robot's way is a parabola, in time and in frames, and how far it must get in one.
_STRETCH_S, _FEWEST, _MOST = 0.5, 9, 60
_LEAST_WAY_PX = 4.0
# A parabola takes some of an error that lasts for several frames with it.
_SHORT = 1.2
# Compression at constant quality 20 to 22 moves a spot by about this over its height in grey levels, px.
_COMPRESSION_PX = 4.5


@dataclass(frozen=True, slots=True)
class Sighting:
    """The LED in one frame; pixels of luma, pixel centres at whole numbers.

    ``luma`` and ``colour`` are the positions (x, y) with their variances (x, y) in the two planes, None where that
    plane does not show it. ``amplitude`` (grey levels) with its standard error is the colour plane's where the LED
    has a colour, else luma's; ``quality`` (0..1) likewise; ``flat``: no edge of the projected light is near;
    ``hidden``:
    the share of the floor's light that is missing under the spot, 0 where nothing hides the floor.
    """

    luma: Place | None
    colour: Place | None
    amplitude: float
    amplitude_sigma: float
    quality: float
    flat: bool
    hidden: float = 0.0

    @property
    def position(self) -> tuple[float, float]:
        """The joint position (x, y)."""
        x, y, _, _ = join(self.luma, self.colour, (0.0, 0.0))
        return x, y


def join(luma: Place | None, colour: Place | None, offset_px: tuple[float, float]) -> Place:
    """Join the two planes' positions by their variances: (x, y, variance of x, of y); NaN where there is neither.

    ``offset_px`` is what the colour's position has too much against luma.
    """
    if colour is None:
        return luma or (math.nan, math.nan, math.nan, math.nan)
    moved = (colour[0] - offset_px[0], colour[1] - offset_px[1], colour[2], colour[3])
    if luma is None:
        return moved
    out: list[float] = []
    variances: list[float] = []
    for axis in (0, 1):
        weight = 1.0 / luma[axis + 2], 1.0 / moved[axis + 2]
        out.append((luma[axis] * weight[0] + moved[axis] * weight[1]) / sum(weight))
        variances.append(1.0 / sum(weight))
    return out[0], out[1], variances[0], variances[1]


def places(sightings: Sequence[Sighting | None], t_s: ArrayLike | None = None) -> Floats:
    """Give (n, 4) columns x, y, var x, var y in px, NaN where not seen.

    Where colour pixels really sit against luma depends on camera and encoder (H.264's default is half a pixel to
    the left): the median difference over frames with a flat floor is taken off the colour's positions.

    Args:
        sightings: one a frame.
        t_s: (n,) the frames' times; None: they are evenly spaced.
    """
    differences = [
        (s.colour[0] - s.luma[0], s.colour[1] - s.luma[1]) for s in sightings if s and s.flat and s.colour and s.luma
    ]
    offset = (0.0, 0.0)
    if len(differences) >= 15:
        middle = np.median(np.asarray(differences, dtype=float), axis=0)
        offset = float(middle[0]), float(middle[1])
    times = np.arange(len(sightings)) / 30.0 if t_s is None else np.asarray(t_s, dtype=float)
    height = np.array([s.amplitude if s else math.nan for s in sightings])
    nowhere: Place = (math.nan, math.nan, math.nan, math.nan)
    luma = _table([s.luma or nowhere if s else nowhere for s in sightings])
    colour = _table([s.colour or nowhere if s else nowhere for s in sightings])
    if not np.isfinite(colour).any():
        return widen(times, luma, height)
    luma, colour = widen(times, luma, height), widen(times, colour, height)
    rows = [join(_place(one), _place(other), offset) for one, other in zip(luma, colour, strict=True)]
    # What moves both planes alike, as an encoder's motion vectors do, shows only now.
    return widen(times, _table(rows), height)


def widen(t_s: Floats, place: Floats, height: Floats) -> Floats:
    """Add to the variances what the positions scatter beyond them; (n, 4) in and out, ``height`` in grey levels.

    The LED's two levels are judged apart. Only stretches of some 0.5 s in which the spot moves count, and of those
    the median, so that bounces do not matter. Where there are fewer than three, the excess is that of the other level
    in inverse proportion to their heights; a track too short for either is taken for compressed video.
    """
    known = np.isfinite(place).all(axis=1) & np.isfinite(height)
    if not known.any():
        return place
    threshold = learn_levels(height[known]).threshold
    bright = height > threshold
    groups = [known & group for group in (~bright, bright)]
    levels = [float(np.median(height[group])) if group.any() else math.nan for group in groups]
    excess = [_excess(t_s, place, group) for group in groups]
    out = place.copy()
    for which, group in enumerate(groups):
        own, other = excess[which], excess[1 - which]
        if own is None:
            own = other * (levels[1 - which] / levels[which]) ** 2 if other is not None else None
        if own is None:
            own = (_COMPRESSION_PX / levels[which]) ** 2
        if math.isfinite(own):
            out[group, 2:] += own
    return out


def _excess(t_s: Floats, place: Floats, usable: Bools) -> float | None:
    """The variance (px²) that the positions have beyond their own; None where too little is seen."""
    step_s = float(np.median(np.diff(t_s))) if len(t_s) > 1 else 1.0
    length = min(max(round(_STRETCH_S / max(step_s, 1e-3)), _FEWEST), _MOST)
    scatter: list[float] = []
    for first in range(0, len(t_s) - length + 1, max(1, length // 3)):
        part = slice(first, first + length)
        times = t_s[part]
        if not usable[part].all() or times[-1] - times[0] > 1.5 * step_s * length or (np.diff(times) <= 0).any():
            continue
        if np.hypot(*(place[part][-1, :2] - place[part][0, :2])) < _LEAST_WAY_PX:
            continue
        terms = np.vander((times - times[0]) / (times[-1] - times[0]) - 0.5, 3)
        rest = place[part, :2] - terms @ np.linalg.lstsq(terms, place[part, :2], rcond=None)[0]
        scatter.append(float(np.sum(rest**2)) / (2.0 * (length - 3)) - float(np.mean(place[part, 2:])))
    return max(0.0, _SHORT * float(np.median(scatter))) if len(scatter) >= 3 else None


def _table(rows: Sequence[Place]) -> Floats:
    return np.asarray(rows, dtype=float).reshape(-1, 4)


def _place(row: Floats) -> Place | None:
    return None if math.isnan(row[0]) else (float(row[0]), float(row[1]), float(row[2]), float(row[3]))
