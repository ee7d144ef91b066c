"""Which light is which robot's, through a whole film: by colour, by blink, and where neither tells by motion.

First the frames' lights are tied to pieces, by the assignment of least total cost to where each was going; a piece is
cut wherever two robots might as well have changed places. Then every piece is given to the robots whose mark it
bears, and the pieces of those that bear the same mark are tied to chains, again by the assignment of least cost. How
sure all this is goes along, as a probability.
"""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lab.base.colours import led_hue
from lab.base.errors import RequestError
from tracking.lights import Light
from tracking.pieces import LinkSettings, Piece, cheapest_pairs, hues_apart, swap_chance, tie_pieces

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LedMark:
    """What one robot's LED is known by.

    Attributes:
        colour: a name of ``lab.base.colours.LED_COLOURS``; None where colour says nothing.
        blink_s: the period of an identifying blink, s; None where it has none.
    """

    colour: str | None = None
    blink_s: float | None = None

    def __post_init__(self) -> None:
        if self.colour is not None:
            led_hue(self.colour)
        if self.blink_s is not None and not self.blink_s > 0:
            raise RequestError(f"an LED cannot blink every {self.blink_s:g} s; give a period above 0")


@dataclass(slots=True)
class Identity:
    """One robot through a film, by frame number: its lights, and how surely (0..1) they are its own."""

    lights: dict[int, Light] = field(default_factory=dict[int, Light])
    certainty: dict[int, float] = field(default_factory=dict[int, float])
    hue_rad: float = math.nan


def identify(
    times_s: Sequence[float],
    lights: Sequence[Sequence[Light]],
    robots: int,
    marks: Sequence[LedMark] | None = None,
    settings: LinkSettings | None = None,
) -> list[Identity]:
    """Say which lights are which robot's.

    Args:
        times_s: one a frame, not falling.
        lights: the lights found in each frame.
        robots: how many there are.
        marks: what each is known by, in their order; None: colours are learnt, and the robots come in the order of
            their first sighting, those of one frame from the top of the picture down.
        settings: how lights are tied together.

    Returns:
        One identity a robot. Robots of one mark are numbered by motion alone: their first pieces are theirs by
        definition.

    Raises:
        RequestError: the marks are not one a robot.
    """
    settings = settings or LinkSettings()
    if marks is not None and len(marks) != robots:
        raise RequestError(f"{len(marks)} LED marks for {robots} robots; give one for each")
    blinks = [mark.blink_s for mark in marks or () if mark.blink_s is not None]
    if blinks:
        settings = replace(settings, coast_s=max(settings.coast_s, 0.7 * max(blinks)))
    pieces = [piece for piece in tie_pieces(times_s, lights, settings) if len(piece.frames) >= settings.least_frames]
    if marks is None:
        groups = [(cluster, None, 1.0) for cluster in _by_hue(pieces, settings)]
        made = _heaviest([_chains(cluster, settings) for cluster, _, _ in groups], robots)
        chosen = [_identity(chain, others, [1.0] * len(chain), settings) for chain, others in made]
        chosen.sort(key=_reading_order)
        return chosen + [Identity() for _ in range(robots - len(chosen))]
    return _marked(pieces, marks, settings)


def _by_hue(pieces: Sequence[Piece], settings: LinkSettings) -> list[list[Piece]]:
    """Part the pieces by colour: where their hues leave a gap around the circle."""
    coloured = sorted((piece for piece in pieces if math.isfinite(piece.hue_rad)), key=lambda piece: piece.hue_rad)
    grey = [piece for piece in pieces if not math.isfinite(piece.hue_rad)]
    if not coloured:
        return [grey] if grey else []
    hues = [piece.hue_rad for piece in coloured]
    gaps = [(hues[(n + 1) % len(hues)] - hues[n]) % math.tau for n in range(len(hues))]
    cuts = [n + 1 for n, gap in enumerate(gaps) if gap > settings.apart_rad]
    if not cuts:
        return [coloured]
    turned = coloured[cuts[0] :] + coloured[: cuts[0]]
    bounds = [0, *(cut - cuts[0] for cut in cuts[1:]), len(turned)]
    return [turned[first:last] for first, last in itertools.pairwise(bounds) if last > first] + ([grey] if grey else [])


def _join_cost(before: Piece, after: Piece, settings: LinkSettings) -> float:
    """Misfit of one piece as the continuation of another; inf where it cannot be."""
    if after.times_s[0] <= before.times_s[-1]:
        return math.inf
    return before.misfit(after.lights[0], after.times_s[0], settings)


def _chains(pieces: Sequence[Piece], settings: LinkSettings) -> list[list[Piece]]:
    """Tie the pieces of one colour to chains: the joins of least total cost, as many as motion allows."""
    if not pieces:
        return []
    cost = np.array([[_join_cost(a, b, settings) for b in pieces] for a in pieces])
    after = dict(cheapest_pairs(cost))
    heads = set(range(len(pieces))) - set(after.values())
    chains: list[list[Piece]] = []
    for head in sorted(heads, key=lambda n: pieces[n].times_s[0]):
        chain, place = [pieces[head]], head
        while place in after:
            place = after[place]
            chain.append(pieces[place])
        chains.append(chain)
    return chains


def _heaviest(clusters: Sequence[list[list[Piece]]], count: int) -> list[tuple[list[Piece], list[list[Piece]]]]:
    """The ``count`` heaviest chains, each with the others of its colour; broken ones of one colour are put together.

    Chains that never shine at the same time may be one robot's that was out of sight for long, or was carried.
    """
    left = [(chain, which) for which, cluster in enumerate(clusters) for chain in cluster]
    total = max((sum(piece.weight for piece in chain) for chain, _ in left), default=0.0)
    left = [(chain, which) for chain, which in left if sum(piece.weight for piece in chain) > 0.002 * total]
    left.sort(key=lambda item: -sum(piece.weight for piece in item[0]))
    chosen, rest = left[:count], left[count:]
    for chain, which in rest:
        for place, (own, mine) in enumerate(chosen):
            if mine == which and not _overlap(own, chain):
                chosen[place] = (sorted([*own, *chain], key=lambda piece: piece.times_s[0]), mine)
                break
    return [(own, [other for other, which in chosen if which == mine and other is not own]) for own, mine in chosen]


def _overlap(one: Sequence[Piece], other: Sequence[Piece]) -> bool:
    return any(a.times_s[0] <= b.times_s[-1] and b.times_s[0] <= a.times_s[-1] for a in one for b in other)


def _identity(
    chain: Sequence[Piece], others: Sequence[Sequence[Piece]], by_mark: Sequence[float], settings: LinkSettings
) -> Identity:
    """Write a chain out frame by frame; each join that may have been another's makes it less sure."""
    found = Identity()
    continuous = 1.0
    tint = 0j
    for place, piece in enumerate(chain):
        if place and others:
            chance = _join_chance(chain[place - 1], piece, others, settings)
            continuous = continuous * (1.0 - chance) + (1.0 - continuous) * chance
        for frame, light in zip(piece.frames, piece.lights, strict=True):
            found.lights[frame] = light
            found.certainty[frame] = continuous * by_mark[place]
        tint += piece.tint
    found.hue_rad = cmath.phase(tint) if tint else math.nan
    return found


def _join_chance(before: Piece, after: Piece, others: Sequence[Sequence[Piece]], settings: LinkSettings) -> float:
    """The chance that a piece continues one of the other robots of its mark instead."""
    own = _join_cost(before, after, settings)
    worst = 0.0 if math.isfinite(own) else 0.5
    for other in others:
        for last, following in itertools.zip_longest(other, other[1:]):
            if last is None or last.times_s[-1] >= after.times_s[0]:
                continue
            if following is not None and following.times_s[0] <= before.times_s[-1]:
                continue  # it was in sight elsewhere all the while
            theirs = _join_cost(last, after, settings)
            if following is not None:
                theirs += _join_cost(before, following, settings) - _join_cost(last, following, settings)
            if math.isfinite(theirs) and math.isfinite(own):
                worst = max(worst, swap_chance(theirs - own))
    return worst


def _reading_order(identity: Identity) -> tuple[int, float, float]:
    frame = min(identity.lights)
    return frame, identity.lights[frame].y_px, identity.lights[frame].x_px


def _marked(pieces: Sequence[Piece], marks: Sequence[LedMark], settings: LinkSettings) -> list[Identity]:
    """Give each piece to the robots whose mark it bears, then tie the pieces of each mark."""
    kinds = list(dict.fromkeys(marks))
    hues = _fitted_hues(pieces, kinds, settings)
    own: dict[LedMark, list[Piece]] = {kind: [] for kind in kinds}
    sure: dict[int, float] = {}
    for piece in pieces:
        told = np.array([_log_likelihood(piece, kind, hue, settings) for kind, hue in zip(kinds, hues, strict=True)])
        if not np.isfinite(told).any():
            continue  # a light of no robot's colour
        share = np.exp(told - told.max())
        best = int(np.argmax(told))
        own[kinds[best]].append(piece)
        sure[id(piece)] = float(share[best] / share.sum())
    found: dict[LedMark, list[Identity]] = {}
    for kind in kinds:
        made = _heaviest([_chains(own[kind], settings)], marks.count(kind))
        found[kind] = [
            _identity(chain, others, [sure[id(piece)] for piece in chain], settings) for chain, others in made
        ]
        found[kind].sort(key=_reading_order)
    return [found[mark].pop(0) if found[mark] else Identity() for mark in marks]


def _fitted_hues(pieces: Sequence[Piece], kinds: Sequence[LedMark], settings: LinkSettings) -> list[float]:
    """Where each mark's hue lies in this film: the palette's, moved to the lights nearest to it."""
    named = [math.nan if kind.colour is None else led_hue(kind.colour) for kind in kinds]
    tints = [0j] * len(kinds)
    for piece in pieces:
        off = [hues_apart(piece.hue_rad, hue) if math.isfinite(hue) else math.inf for hue in named]
        nearest = int(np.argmin(off))
        if off[nearest] <= settings.widest_rad:
            tints[nearest] += piece.tint
    told = dict[str, complex]()
    for kind, tint in zip(kinds, tints, strict=True):
        if kind.colour is not None:
            told[kind.colour] = told.get(kind.colour, 0j) + tint
    return [
        math.nan if kind.colour is None else cmath.phase(told[kind.colour]) if told[kind.colour] else hue
        for kind, hue in zip(kinds, named, strict=True)
    ]


def _log_likelihood(piece: Piece, kind: LedMark, hue_rad: float, settings: LinkSettings) -> float:
    """How well a piece bears a mark; -inf where its colour is another one."""
    total = 0.0
    if kind.colour is not None:
        off = hues_apart(piece.hue_rad, hue_rad)
        if off > settings.widest_rad:
            return -math.inf
        total -= 0.5 * (off / settings.mark_sigma_rad) ** 2
    if kind.blink_s is not None:
        total += _blink_evidence(piece, kind.blink_s)
    return total


def _blink_evidence(piece: Piece, blink_s: float) -> float:
    """Log-likelihood gained by a wave of this period in the light's height (unseen is dark), over none.

    A sine wave fitted to white noise's n independent values, of which it explains the share R, gains -n/2 ln(1 - R);
    of a light that keeps its level over half periods there are two such values a period.
    """
    span_s = piece.times_s[-1] - piece.times_s[0]
    if span_s < 1.5 * blink_s or len(piece.frames) < 8:
        return 0.0
    frames = np.arange(piece.frames[0], piece.frames[-1] + 1)
    times = np.interp(frames, piece.frames, piece.times_s)
    level = np.zeros(len(frames))
    level[np.asarray(piece.frames) - frames[0]] = [light.height for light in piece.lights]
    level = level - level.mean()
    power = float(level @ level)
    if power <= 0.0:
        return 0.0
    wave = np.exp(-2j * np.pi * times / blink_s)
    share = min(2.0 * abs(complex(level @ wave)) ** 2 / (len(level) * power), 0.99)
    return -(span_s / blink_s) * math.log(1.0 - share)
