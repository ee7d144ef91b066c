"""Whether the LED shone bright in each frame, from its height in the picture, and how sure that is.

The LED has two levels: bright over light, dim in the dark (or dark altogether). Their heights in the picture are learnt
from the track itself. Both change alike over the picture (vignetting, the angle at which the shell is seen), so one
smooth law is fitted to both at once. What then remains is each level's spread. A frame in whose exposure the LED
switched lies in between: it goes to the level that was held for longer, with little confidence.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr  # pyright: ignore[reportUnknownVariableType, reportMissingTypeStubs]

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_ROUNDS = 3
# Of a frame in which the LED switched: how well the share of the exposure tells what the frame's stamp met.
_SWITCH_SIGMA = 0.2
_LEAST_SWITCHES = 0.003
# Share of frames whose height strays by three times its level's spread: a glint beside the LED, an edge under it.
_STRAY = 0.02
# A dark stretch of fewer frames may be a missed sighting; the chance of missing one frame after another.
_DARK_FRAMES = 3
_MISS = 0.1


@dataclass(frozen=True, slots=True)
class LedLevels:
    """How bright the LED shines: the median amplitudes of its two levels and the threshold between (grey levels).

    ``low`` is 0 where only one level was seen: then the LED is taken as on wherever it is seen.
    """

    low: float
    high: float
    threshold: float


@dataclass(frozen=True, slots=True, eq=False)
class LedStates:
    """``on`` (n,): the brighter of two levels; ``confidence`` (n,): the probability (0..1) that this is right.

    ``levels`` is None where the state was not told by the LED's height.
    """

    levels: LedLevels | None
    on: Bools
    confidence: Floats


def led_states(amplitude: Floats, sigma: Floats, x_px: Floats, y_px: Floats) -> LedStates:
    """Tell the LED's state in each frame of a track, or of several tracks one after the other.

    Args:
        amplitude: (n,) its height, grey levels; NaN where it was not seen.
        sigma: (n,) the standard error of that.
        x_px: (n,) where it was seen.
        y_px: (n,) likewise.

    Returns:
        The states. Not seen counts as not on; how sure that is, its neighbours tell. Where the LED was seen at one
        level only and hardly ever vanished, which of the two levels that is cannot be told: it is on wherever it
        is seen, with confidence 0.5.
    """
    seen = np.isfinite(amplitude) & (amplitude > 0)
    levels = learn_levels(amplitude)
    on = seen.copy()
    chance = np.zeros(len(amplitude))
    if not seen.any():
        return LedStates(levels, on, np.full(len(amplitude), 0.5))
    logs, place = np.log(amplitude[seen]), _design(x_px[seen], y_px[seen])
    dark = _dark(seen)
    if levels.low > 0.0:
        bright = logs > math.log(levels.threshold)
        trend = np.zeros(len(logs))
        for _ in range(_ROUNDS):
            trend = _trend(logs, bright, place)
            low, high = (_middle(np.exp(logs - trend)[group]) for group in (~bright, bright))
            fresh = np.exp(logs - trend) > 0.5 * (low + high)
            if not fresh.any() or fresh.all() or (fresh == bright).all():
                break
            bright = fresh
        low, high = (_middle(np.exp(logs - trend)[group]) for group in (~bright, bright))
        levels = LedLevels(low, high, 0.5 * (low + high))
    elif dark.sum() >= max(_DARK_FRAMES, 0.01 * len(seen)):
        # The lower level is darkness.
        trend = _trend(logs, np.ones(len(logs), dtype=bool), place)
        heights = np.exp(logs - trend)
        low, high = 0.0, _middle(heights[heights > 0.5 * np.median(heights)])
        bright = heights > 0.5 * high
    else:
        return LedStates(levels, on, np.where(seen, 0.5, _unseen(seen, np.where(seen, 1.0, np.nan))))
    share = (np.exp(logs - trend) - low) / (high - low)
    error = sigma[seen] / np.exp(trend) / (high - low)
    chance[seen] = _chance(share, bright, error, float(dark.mean()))
    on[seen] = chance[seen] > 0.5
    confidence = np.where(on, chance, 1.0 - chance)
    confidence[~seen] = _unseen(seen, np.where(seen, chance, np.nan))[~seen]
    if low == 0.0:
        confidence[dark] = np.maximum(confidence[dark], 1.0 - _MISS**_DARK_FRAMES)
    return LedStates(levels, on, confidence)


def _chance(share: Floats, bright: Bools, error: Floats, dark: float) -> Floats:
    """The probability that the LED is on, from where its height lies between the levels (0 .. 1)."""
    part = float(bright.mean())
    weights = (1.0 - part, part)
    likely: list[Floats] = []
    for level, group, weight in zip((0.0, 1.0), (~bright, bright), weights, strict=True):
        spread = max(0.02, _spread(share[group] - level)) if group.sum() >= 5 else 0.1
        # A level's spread holds its frames' usual error already.
        usual = float(np.median(error[group])) if group.any() else 0.0
        width = np.sqrt(spread**2 + np.maximum(error**2 - usual**2, 0.0))
        off = (share - level) / width
        # Beyond its own level on the far side from the other one, a height is no less a sign of it.
        off = np.where((level - 0.5) * off > 0, 0.0, off)
        core = np.exp(-0.5 * off**2) + _STRAY / 3.0 * np.exp(-0.5 * (off / 3.0) ** 2)
        likely.append(weight * core / (width * math.sqrt(2.0 * math.pi)))
    switches = int(np.count_nonzero(np.diff(bright)))
    between = max(_LEAST_SWITCHES, switches / max(1, len(share))) * (1.0 + dark)
    switched = np.asarray(ndtr((share - 0.5) / _SWITCH_SIGMA), dtype=float)
    return np.clip((likely[1] + between * switched) / (likely[0] + likely[1] + between), 0.0, 1.0)


def _unseen(seen: Bools, chance: Floats) -> Floats:
    """How sure it is that an LED not seen is off: by the frames seen before and after, if they are close."""
    number = np.arange(len(seen))
    known = np.flatnonzero(seen)
    if len(known) == 0:
        return np.full(len(seen), 0.5)
    after = np.searchsorted(known, number)
    later, earlier = known[np.minimum(after, len(known) - 1)], known[np.maximum(after - 1, 0)]
    was_on = 0.5 * (chance[later] + chance[earlier])
    gap = np.minimum(np.abs(later - number), np.abs(earlier - number))
    # Seen on just before and after and missed in between: as likely on as not, and less so the longer it lasts.
    return 1.0 - was_on * (0.5 * 0.8 ** (gap - 1.0))


def _dark(seen: Bools) -> Bools:
    """Frames in stretches without the LED that are too long for missed sightings, between its sightings."""
    out = np.zeros(len(seen), dtype=bool)
    known = np.flatnonzero(seen)
    for before, after in itertools.pairwise(known.tolist()):
        if after - before > _DARK_FRAMES:
            out[before + 1 : after] = True
    return out


def _design(x_px: Floats, y_px: Floats) -> Floats:
    """Terms of a quadratic law over the picture, (n, 5), each of about unit size."""
    x, y = ((v - v.mean()) / max(1.0, float(np.ptp(v)) / 2.0) for v in (x_px, y_px))
    return np.column_stack([x, y, x * x, x * y, y * y])


def _trend(logs: Floats, bright: Bools, place: Floats) -> Floats:
    """The law by which both levels' log heights change over the picture, without their means; robust."""
    groups = [group for group in (~bright, bright) if group.sum() >= 10]
    if not groups:
        return np.zeros(len(logs))
    values = np.concatenate([logs[group] - np.median(logs[group]) for group in groups])
    terms = np.vstack([place[group] - place[group].mean(axis=0) for group in groups])
    weight = np.ones(len(values))
    law = np.zeros(place.shape[1])
    for _ in range(_ROUNDS):
        # A weak prior (a term changes the height by some 30 %) keeps places that were never visited sane.
        normal = (terms * weight[:, None]).T @ terms + np.eye(len(law)) * 0.3
        law = np.linalg.solve(normal, (terms * weight[:, None]).T @ values)
        rest = values - terms @ law
        weight = 1.0 / (1.0 + (rest / (3.0 * max(0.02, _spread(rest)))) ** 2)
    out = place @ law
    return out - float(np.median(out))


def learn_levels(amplitudes: Floats, *, apart: float = 1.6) -> LedLevels:
    """Learn the LED's two levels from all amplitudes of a track, by Otsu's threshold on their logarithms.

    The two count as two only if their medians are at least ``apart`` times each other and lie at least three of
    the larger one's standard deviations apart; each must hold 1 % of the frames.
    """
    known = amplitudes[np.isfinite(amplitudes) & (amplitudes > 0)]
    if len(known) == 0:
        return LedLevels(0.0, 0.0, 0.0)
    logs = np.sort(np.log(known))
    single = LedLevels(0.0, float(np.median(known)), 0.0)
    n = len(logs)
    fewest = max(2, math.ceil(0.01 * n))
    if n < 2 * fewest:
        return single
    cut = np.arange(fewest, n - fewest + 1)
    below = np.cumsum(logs)[cut - 1]
    total = float(logs.sum())
    # Otsu (1979): maximise the variance between the classes.
    between = (below / cut - (total - below) / (n - cut)) ** 2 * cut * (n - cut)
    split = int(cut[int(np.argmax(between))])
    dim, bright = logs[:split], logs[split:]
    gap = float(np.median(bright) - np.median(dim))
    if gap < math.log(apart) or gap < 3.0 * max(_spread(bright), _spread(dim)):
        return single
    low, high = math.exp(float(np.median(dim))), math.exp(float(np.median(bright)))
    # Half way between the levels: the frame in which it switched goes to the level it held for longer.
    return LedLevels(low, high, 0.5 * (low + high))


def _middle(values: Floats) -> float:
    return float(np.median(values))


def _spread(values: Floats) -> float:
    """Standard deviation, estimated from the median absolute deviation."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))
