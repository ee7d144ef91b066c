"""Contacts told from walls: a wall is met alone, another robot by two at nearly the same time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

_ROUNDS = 30


def contacts_among(
    bumps_by_robot: Mapping[str, Sequence[float]], window_s: float
) -> tuple[dict[str, list[bool]], dict[str, float]]:
    """Tell contacts between robots from walls: two robots bump at nearly the same time.

    Pairs are made of the nearest in time first, and each bump is in one pair at most.

    Args:
        bumps_by_robot: Times of each robot's bumps, s, on one clock, rising.
        window_s: Bumps of two robots no further apart than this are one contact.

    Returns:
        For each robot, whether each bump was a contact; and for each robot, how many of its flags are expected
        to be walls that chance brought together, from the rates of the bumps that no other came near.

    Raises:
        ValueError: The window is below 0 s.
    """
    if not window_s >= 0.0:
        raise ValueError("the window must be 0 s or more")
    flags = {robot: [False] * len(times) for robot, times in bumps_by_robot.items()}
    every = sorted((t_s, robot, at) for robot, times in bumps_by_robot.items() for at, t_s in enumerate(times))
    pairs: list[tuple[float, int, int]] = []
    for i, (t_s, robot, _) in enumerate(every):
        j = i + 1
        while j < len(every) and every[j][0] - t_s <= window_s:
            if every[j][1] != robot:
                pairs.append((every[j][0] - t_s, i, j))
            j += 1
    for _, i, j in sorted(pairs):
        (_, one, at_one), (_, two, at_two) = every[i], every[j]
        if not flags[one][at_one] and not flags[two][at_two]:
            flags[one][at_one] = flags[two][at_two] = True
    return flags, _by_chance(flags, window_s, every[-1][0] - every[0][0] if every else 0.0)


def _by_chance(flags: dict[str, list[bool]], window_s: float, span_s: float) -> dict[str, float]:
    """Expected number of walls among each robot's flags: the fixed point of walls = left alone + by chance."""
    chance = dict.fromkeys(flags, 0.0)
    if span_s <= 0.0:
        return chance
    for _ in range(_ROUNDS):
        walls = {robot: len(flags[robot]) - sum(flags[robot]) + chance[robot] for robot in flags}
        everyone = sum(walls.values())
        for robot, flagged in flags.items():
            share = 1.0 - math.exp(-2.0 * window_s * (everyone - walls[robot]) / span_s)
            chance[robot] = min(float(sum(flagged)), walls[robot] * share)
    return chance
