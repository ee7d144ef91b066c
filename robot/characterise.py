"""Finds out what no source states of a robot: rolls it about, flips the light over it, and watches what it says.

The steps take a ``Trial`` and callables for the world around it. What they find are ``Finding``s
(``robot.finding``), one for a key of the ``RobotProfile``. The arithmetic is in ``robot.fitting``.

The robot starts in mid-arena and need not be told where that is: a run that meets a wall is turned round and
repeated.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace

import numpy as np

from robot.crossings import LevelsError, learn_levels
from robot.device import Bump
from robot.errors import RobotError
from robot.finding import Finding
from robot.fitting import TURN, AxesFound, Figure, Hit, WallSeen, axes_of, latency_of, mean_of, onset_s, wall_through
from robot.trial import FINEST_S, GIVE_UP_S, MOVED_CM, Roll, Trial

Show = Callable[[float], None]
Say = Callable[[str], None]

INTERVALS_S = (0.1, 0.08, 0.06, 0.05, 0.04, 0.03, 0.025, 0.02, 0.015, 0.01)
WORKING_UNITS = 45  # about 27 cm/s: brisk enough to be felt at a wall, slow enough to stop within a hand's breadth
LATENCY_REPEATS = 8
FLIPS = 60
SHORTEST_RUN_CM = 25.0

_LEVEL_SAMPLES = 25
_SETTLE_S = 0.5  # a projector's latency and a light sample under way
_HOLD_FRAMES, _HOLD_S, _CONFIRM_S = 60, 2.0, 8.0
_HOLDS_SHARE = 0.9  # of the samples that should have come
_CRAWL_CM = 1.0
_HOP_CM, _HOPS_IN_ROW = 6.0, 3
_LONGEST_RUN_CM = 250.0
_LEAST_CM_S_PER_UNIT = 0.3  # for bounds on waiting only
_BACK_CM = 16.0
_OBLIQUE_RAD, _HEAD_ON = 0.6, 2
_STRAY_CM, _LEAST_RADIUS_CM = 1.0, 30.0  # beyond these it is a corner, or something that is no wall
_FARTHER = 2.2  # than where it set out from the wall: what is met there is another wall


async def least_interval(trial: Trial) -> Finding:
    """The shortest stream interval that the link holds: from long to short, then by halves to a millisecond.

    It holds when nine tenths of the samples come, evenly, and the link lives. Leaves the stream at an interval
    with some room to it.

    Raises:
        CharacteriseError: Not even the longest holds.
    """
    good_s, bad_s, n = math.inf, 0.0, 0
    for interval_s in INTERVALS_S:
        n += 1
        if not await _holds(trial, interval_s):
            bad_s = interval_s
            break
        good_s = interval_s
    if good_s == math.inf:
        raise trial.error(f"no stream holds, not even every {INTERVALS_S[0]:g} s; bring it nearer to the computer")
    while good_s - bad_s > 1.5 * FINEST_S and bad_s > 0:
        n += 1
        middle_s = round((good_s + bad_s) / 2.0, 3)
        if await _holds(trial, middle_s):
            good_s = middle_s
        else:
            bad_s = middle_s
    while not await _holds(trial, good_s, _CONFIRM_S):
        # A link may bear for a while what it does not hold.
        good_s = round(good_s + FINEST_S, 3)
        n += 1
        if good_s > INTERVALS_S[0]:
            raise trial.error("no stream holds for long; bring it nearer to the computer")
    await trial.stream(max(0.03, math.ceil(1100 * good_s) / 1000))
    how = "streams from long to short, counted and timed until one broke"
    if bad_s == 0:
        how = f"streams down to {good_s:g} s all held"
    return Finding("least_interval_s", good_s, FINEST_S / 2, n, how)


async def _holds(trial: Trial, interval_s: float, for_s: float = 0.0) -> bool:
    """Whether a stream at this interval brings its samples; a link that breaks over it is made anew."""
    for_s = max(for_s, _HOLD_S, _HOLD_FRAMES * interval_s)
    try:
        await trial.stream(interval_s)
        samples = await trial.listen(for_s)
    except RobotError as error:
        trial.lost = trial.lost or str(error)
        samples = []
    if trial.lost:
        await trial.call_back()
        return False
    spacing = np.diff([sample.t_host_s for sample in samples])
    enough = len(samples) >= _HOLDS_SHARE * for_s / interval_s
    return enough and abs(float(spacing.mean()) - interval_s) < (1 - _HOLDS_SHARE) * interval_s


async def light_levels(trial: Trial, show: Show) -> tuple[Finding, Finding]:
    """What the sensor reads under a black and a white picture.

    Raises:
        LevelsError: The two do not separate.
    """
    seen: list[list[float]] = []
    for level in (0.0, 1.0):
        show(level)
        await asyncio.sleep(_SETTLE_S)
        seen.append([(await trial.next_sample()).light_lux for _ in range(_LEVEL_SAMPLES)])
    learn_levels(*seen)
    figures = [mean_of(lux) for lux in seen]
    dark, bright = (
        Finding.of(key, figure, f"{picture} picture in mid-arena, noise {figure.scatter:.2g} lux")
        for key, figure, picture in zip(("dark_lux", "bright_lux"), figures, ("black", "white"), strict=True)
    )
    return dark, bright


async def light_latency(trial: Trial, show: Show, mid_lux: float) -> Finding:
    """From a flip of the light to the notification that shows it, the projector's own delay included.

    The flips come at evenly spread phases of the stream, so that the mean delay is known far more finely than
    its interval.

    Raises:
        LevelsError: A flip is not seen.
    """
    loop = asyncio.get_running_loop()
    phases = (trial.rng.permutation(FLIPS) + trial.rng.random(FLIPS)) / FLIPS
    arrivals: list[float] = []
    delays: list[float] = []
    level = 1.0
    for phase in phases:
        level = 1.0 - level
        sample = await trial.next_sample()
        await asyncio.sleep(float(phase) * trial.interval_s)
        flip_s = loop.time()
        show(level)
        while (sample.light_lux > mid_lux) != (level > 0.5) or sample.t_host_s < flip_s:
            if sample.t_host_s > flip_s + GIVE_UP_S:
                raise LevelsError(
                    f"{trial.robot.name}: a flip of the projector was not seen within {GIVE_UP_S:g} s; put the robot "
                    "into the projected picture and darken the room",
                    dark_lux=math.nan, bright_lux=math.nan, noise_lux=math.nan,
                )  # fmt: skip
            sample = await trial.next_sample()
            arrivals.append(sample.t_host_s)
        delays.append(sample.t_host_s - flip_s)
        # What was under way when the light changed must not be taken for the next change.
        arrivals += [(await trial.next_sample()).t_host_s for _ in range(math.ceil(0.2 / trial.interval_s))]
    spacing = np.diff(arrivals)
    interval_s = float(np.median(spacing[spacing > 0]))
    figure = _not_negative(latency_of(delays, interval_s))
    return Finding.of(
        "light_latency_s", figure, "flips of the projector at all phases of the stream, its own delay included"
    )


def _not_negative(figure: Figure) -> Figure:
    """Nothing comes before its cause: a latency that is nil may be measured a little below."""
    return replace(figure, value=max(0.0, figure.value)) if math.isfinite(figure.value) else figure


async def least_speed(trial: Trial) -> Finding:
    """The smallest speed byte that rolls: by halves between one that does and one that does not.

    Each is tried twice, and a third time where the two disagree.

    Raises:
        CharacteriseError: It does not roll at any.
    """
    most, n = 2 * WORKING_UNITS, 0

    async def rolls(units: int) -> bool:
        nonlocal n
        votes = 0
        for count in range(1, 4):
            n += 1
            # There and back: what faces a wall does not roll either.
            roll = await trial.roll(trial.heading_rad + math.pi, units, for_s=GIVE_UP_S, until_cm=_CRAWL_CM)
            votes += 1 if roll.rolled_cm > MOVED_CM else -1
            if abs(votes) == 2 or (count == 3 and votes):
                break
        return votes > 0

    if not await rolls(most):
        raise trial.error("it does not roll; put it on the floor in mid-arena, off its charger, and start again")
    least, none = most, 0
    while least - none > 1:
        middle = (least + none) // 2
        if await rolls(middle):
            least = middle
        else:
            none = middle
    return Finding("least_speed_units", least, None, n, "rolled by this speed byte and not by one less")


async def motion_latency(trial: Trial, units: int = WORKING_UNITS) -> Finding:
    """From the drive command to the onset of motion, extrapolated through the ramp of the locator's path.

    Short hops along one heading: the first, which turns, is not taken.
    """
    delays: list[float] = []
    hops = in_row = 0
    while len(delays) < LATENCY_REPEATS and hops < 5 * LATENCY_REPEATS:
        hops += 1
        roll = await trial.roll(trial.heading_rad, units, for_s=GIVE_UP_S, until_cm=_HOP_CM)
        hopped = roll.bump is None and roll.rolled_cm >= _HOP_CM
        if in_row and hopped:
            until = int(np.argmax(roll.path_cm >= _HOP_CM)) + 1
            delays.append(onset_s(roll.t_s[:until], roll.path_cm[:until]) - roll.t_command_s)
        in_row += 1
        if not hopped or in_row == _HOPS_IN_ROW:
            trial.heading_rad, in_row = trial.turned_round(), 0
    return Finding.of(
        "motion_latency_s", _not_negative(mean_of(delays)), "drive command to the onset of motion by the locator"
    )


async def roll_runs(
    trial: Trial,
    units: Sequence[int],
    *,
    begin: Callable[[int], Awaitable[None]] | None = None,
    end: Callable[[int, bool], Awaitable[None]] | None = None,
) -> dict[int, Roll]:
    """Long straight runs back and forth across the arena, one at each of ``units``; by number, the first is 0.

    A run that was cut short by a wall is turned round and repeated. ``begin`` and ``end`` are awaited around each,
    with its number, and ``end`` with whether it is kept: a camera films in between.

    Raises:
        CharacteriseError: Hardly any run is long enough.
    """
    kept: dict[int, Roll] = {}
    tries = 0
    for number, speed in enumerate(units):
        while number not in kept:
            if tries > 3 * len(units) + 10:
                raise trial.error(
                    f"hardly a run is longer than {SHORTEST_RUN_CM:g} cm; clear the arena, "
                    "or put the robot in its middle"
                )
            tries += 1
            if begin is not None:
                await begin(number)
            longest_s = 2.0 + _LONGEST_RUN_CM / (_LEAST_CM_S_PER_UNIT * speed)
            roll = await trial.roll(trial.turned_round(), speed, for_s=longest_s, until_cm=_LONGEST_RUN_CM)
            is_long = roll.rolled_cm >= SHORTEST_RUN_CM
            if is_long:
                kept[number] = roll
            elif roll.rolled_cm < SHORTEST_RUN_CM / 3:
                # In a corner, or along a wall: anywhere else will do.
                trial.heading_rad = float(trial.rng.uniform(0.0, TURN))
            if end is not None:
                await end(number, is_long)
    return kept


async def collision_axes(trial: Trial, units: int = WORKING_UNITS, *, walls: int = 2) -> Finding:
    """What the collision report's x and y point along.

    A wall is hit from one place in three directions; the three places tell by the locator how it lies, and so where
    its normal is. Then it is hit head-on. The order and signs are those that make the reports point along the normal.

    Raises:
        CharacteriseError: No wall is met.
    """
    hits: list[Hit] = []
    found: AxesFound | None = None
    done = tries = 0
    trial.heading_rad = trial.turned_round()
    while tries < 6 * walls and (done < walls or found is None or not found.certain):
        tries += 1
        at_wall = await _hit_wall(trial, units)
        if at_wall:
            done += 1
            hits += at_wall
            found = axes_of(hits)
        # On to another wall.
        trial.heading_rad += math.pi / 2 + float(trial.rng.uniform(-0.3, 0.3))
    how = "bumps head-on and oblique, against the wall as the locator has it"
    if found is None or not found.certain:
        told = "no wall could be hit thrice"
        if found is not None:
            told = f"{found.n} bumps do not tell (agreement {found.agreement:.2f}, log odds {found.lead:.1f})"
        return Finding("collision_axes", None, None, len(hits), f"{told}; give the arena firm straight walls")
    return Finding("collision_axes", found.axes, None, found.n, f"{how}, agreement {found.agreement:.3f}")


async def _hit_wall(trial: Trial, units: int) -> list[Hit]:
    """Hit the wall ahead from one place at several angles; empty where it is not one straight wall."""
    longest_s = 2.0 + _LONGEST_RUN_CM / (_LEAST_CM_S_PER_UNIT * units)
    first = await trial.roll(trial.heading_rad, units, for_s=longest_s)
    if first.rolled_cm < _BACK_CM / 2:
        return []  # it stood at a wall already
    if first.bump is None:
        raise trial.error(
            f"it reported no bump within {first.rolled_cm:.0f} cm; wall the arena in firmly, "
            "or lower the profile's collision_threshold"
        )
    ahead_rad = first.heading_rad
    back = await trial.roll(ahead_rad + math.pi, units, for_s=GIVE_UP_S, until_cm=_BACK_CM)
    inside = back.end_cm
    hits: list[tuple[Roll, Bump]] = [(first, first.bump)]
    for turn_rad in (_OBLIQUE_RAD, -_OBLIQUE_RAD):
        await _hit_once(trial, units, ahead_rad + turn_rad, inside, hits)
        if len(hits) == 1:
            return []
    wall = _wall_of(hits, inside)
    if len(hits) < 3 or wall is None:
        return []
    for _ in range(_HEAD_ON):
        await _hit_once(trial, units, wall.normal_rad(inside) + math.pi, inside, hits)
    wall = _wall_of(hits, inside)
    if wall is None:
        return []
    return [Hit(roll.heading_rad, bump.normal_heading_rad, wall.normal_rad(roll.end_cm)) for roll, bump in hits]


def _wall_of(hits: Sequence[tuple[Roll, Bump]], inside_cm: tuple[float, float]) -> WallSeen | None:
    """The wall that was hit; None for a corner, or where the places lie too close to tell."""
    wall = wall_through([roll.end_cm for roll, _ in hits], inside_cm)
    if wall is None or wall.reach_cm < _BACK_CM / 4 or wall.stray_cm > _STRAY_CM or wall.radius_cm < _LEAST_RADIUS_CM:
        return None
    return wall


async def _hit_once(
    trial: Trial, units: int, heading_rad: float, inside_cm: tuple[float, float], hits: list[tuple[Roll, Bump]]
) -> None:
    """One hit from ``inside_cm``, kept when a wall was met near by, and back there."""
    wall_cm = math.dist(inside_cm, hits[0][0].end_cm)
    roll = await trial.roll(heading_rad, units, for_s=GIVE_UP_S, until_cm=_FARTHER * wall_cm)
    if roll.bump is not None:
        hits.append((roll, roll.bump))
    right_cm, ahead_cm = inside_cm[0] - roll.end_cm[0], inside_cm[1] - roll.end_cm[1]
    # It rolls on for a few cm after it is told to stop.
    way_cm = max(1.0, math.hypot(right_cm, ahead_cm) - _HOP_CM / 2)
    await trial.roll(math.atan2(right_cm, ahead_cm), units, for_s=GIVE_UP_S, until_cm=way_cm)
