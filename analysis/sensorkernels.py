"""Compiled loops of the light sensor: a line over a shape, the light along it, and what a detector makes of it.

The sensor averages over a disc of floor. Gauss–Chebyshev quadrature of the second kind slices the disc into a few
parallel chords. Each slice travels a line parallel to the sensor's own, and the share of it that is lit is a sum of
linear ramps, one for each crossing of that line: the light is piecewise linear along the run, and only the readings
near its knots need be taken.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.kernels import chord_invariants, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_TRAILING = 2  # readings in the dark after the last ramp: they confirm the last exit
_SLOWEST = 0.2  # a run's speed, relative to what it should be; keeps its readings countable
_SPARE_READINGS = 8  # rounding, and those before the first ramp
_DEEPEST_NOISE = 6.0  # noise widths


@kernel
def cross_parallel(
    direction: tuple[float, float, float],
    offsets_cm: Floats,
    boundary: tuple[Floats, Floats, Ints, Floats],
    t_cm: Floats,
    counts: Ints,
) -> int:
    """Find the sorted crossings of lines parallel to a line; returns how many there are on all of them.

    ``direction`` is the line's (cos θ, sin θ, p); line i has p + ``offsets_cm[i]`` and fills ``t_cm[i]`` (lines,
    edges) and ``counts[i]``. ``boundary`` is (x_cm, y_cm, chunks, discs) of an
    `analysis.boundary.Boundary`: circles round stretches of edges, so that a whole stretch away from the line is
    skipped at once.
    """
    cos, sin, p = direction
    x_cm, y_cm, chunks, discs = boundary
    reach = np.abs(offsets_cm).max()
    counts[:] = 0
    total = 0
    for chunk in range(chunks.shape[0]):
        if abs(discs[chunk, 0] * cos + discs[chunk, 1] * sin - p) > discs[chunk, 2] + reach:
            continue
        start = chunks[chunk, 0]
        before = x_cm[start] * cos + y_cm[start] * sin - p
        for i in range(start + 1, chunks[chunk, 1] + 1):
            after = x_cm[i] * cos + y_cm[i] * sin - p
            if max(before, after) >= -reach and min(before, after) <= reach:
                along = y_cm[i - 1] * cos - x_cm[i - 1] * sin
                rise = y_cm[i] * cos - x_cm[i] * sin - along
                for line in range(offsets_cm.size):
                    first = before - offsets_cm[line]
                    if (first >= 0.0) == (after - offsets_cm[line] >= 0.0):
                        continue
                    t = along + first / (before - after) * rise
                    j = counts[line] - 1
                    while j >= 0 and t_cm[line, j] > t:
                        t_cm[line, j + 1] = t_cm[line, j]
                        j -= 1
                    t_cm[line, j + 1] = t
                    counts[line] += 1
                    total += 1
            before = after
    return total


@kernel
def read_light(
    crossings: tuple[Floats, Ints],
    slices: tuple[Floats, Floats],
    step_cm: float,
    phase: float,
    clear: tuple[float, float],
    s_cm: Floats,
    light: Floats,
) -> int:
    """Read the light every ``step_cm`` along a line; returns the number of readings.

    ``crossings`` are (t_cm, counts) of the slices' lines, ``slices`` their (half length in cm, weight). The light
    is 0 in the dark and 1 in the shape. The first reading lies ``phase`` + 1 steps, 0 ≤ phase < 1, before the first
    ramp. Of readings that see the same light, at or below ``clear[0]`` or at or above ``clear[1]``, only the first and
    the last are given. ``s_cm`` and ``light`` must hold them all.
    """
    t_cm, counts = crossings
    half_cm, weight = slices
    lines = counts.size
    # Two sorted sequences of knots for each slice: where its ramps begin and where they end.
    index = np.zeros(2 * lines, np.int64)
    head = np.full(2 * lines, np.inf)
    for line in range(lines):
        if counts[line] > 0:
            head[2 * line] = t_cm[line, 0] - half_cm[line]
            head[2 * line + 1] = t_cm[line, 0] + half_cm[line]
    sequence = np.argmin(head)
    at = head[sequence] - (1.0 + phase) * step_cm
    origin = at
    value = 0.0
    slope = 0.0
    ramps = 0
    readings = 0
    trailing = 0
    step = 0
    while True:
        s = origin + step * step_cm
        knot = head[sequence]
        while knot <= s:
            value += slope * (knot - at)
            at = knot
            line = sequence // 2
            entering = 1.0 if index[sequence] % 2 == 0 else -1.0
            change = entering * weight[line] / (2.0 * half_cm[line])
            if sequence % 2 == 0:
                slope += change
                ramps += 1
            else:
                slope -= change
                ramps -= 1
                if ramps == 0:
                    slope = 0.0
            index[sequence] += 1
            if index[sequence] < counts[line]:
                to_end = half_cm[line] if sequence % 2 else -half_cm[line]
                head[sequence] = t_cm[line, index[sequence]] + to_end
            else:
                head[sequence] = np.inf
            sequence = np.argmin(head)
            knot = head[sequence]
        seen = value + slope * (s - at)
        s_cm[readings] = s
        light[readings] = seen
        readings += 1
        if knot == np.inf:
            trailing += 1
            if trailing == _TRAILING:
                return readings
            step += 1
        elif ramps == 0 and (seen <= clear[0] or seen >= clear[1]):
            step += max(1, int((knot - s) / step_cm))
        else:
            step += 1


@kernel
def detect(s_cm: Floats, light: Floats, readings: int, levels: tuple[float, float, float], found_cm: Floats) -> int:
    """Turn the light of a run into crossings in ``found_cm``, entry, exit, entry, exit; returns their number.

    The detector of `robot.crossings`, path alone: ``levels`` (low, middle, high). A crossing is confirmed at the
    far level and placed at the mean of the passages through the middle since the near one, linearly between
    readings. A run that starts or ends in the light has a crossing there. Light that is not finite is passed over.
    """
    low, mid, high = levels
    found = 0
    begun = False
    lit = False
    last_s = 0.0
    last_light = 0.0
    passages = 0
    sum_s = 0.0
    for i in range(readings):
        s = s_cm[i]
        now = light[i]
        if not np.isfinite(now):
            continue
        if not begun:
            begun = True
            lit = now >= mid
            if lit:
                found_cm[found] = s
                found += 1
            last_s, last_light = s, now
            continue
        if (last_light >= mid) != (now >= mid):
            passages += 1
            sum_s += last_s + (mid - last_light) / (now - last_light) * (s - last_s)
        last_s, last_light = s, now
        confirmed = now <= low if lit else now >= high
        refuted = now >= high if lit else now <= low
        if confirmed:
            lit = not lit
            found_cm[found] = sum_s / passages
            found += 1
        if confirmed or refuted:
            passages = 0
            sum_s = 0.0
    if lit:
        found_cm[found] = s_cm[readings - 1]
        found += 1
    return found


@kernel
def clear_light(levels: tuple[float, float, float], noise: float) -> tuple[float, float]:
    """The light below and above which nothing can happen that the next reading would not undo."""
    return levels[0] - _DEEPEST_NOISE * noise, levels[2] + _DEEPEST_NOISE * noise


@kernel
def room_for(slices: int, vertices: int, readings: float) -> tuple[Floats, Ints, Floats, Floats, Floats]:
    """Room for one line: (t_cm, counts) of `cross_parallel`, (s_cm, light) of `read_light`, found_cm of `detect`.

    ``readings`` is the most that a line's length holds.
    """
    size = int(readings) + _SPARE_READINGS
    return (
        np.empty((slices, vertices)),
        np.zeros(slices, np.int64),
        np.empty(size),
        np.empty(size),
        np.empty(size + 1),
    )


@kernel
def sense_line(
    rng: np.random.Generator,
    crossings: tuple[Floats, Ints],
    slices: tuple[Floats, Floats],
    motion: tuple[float, float, float],
    levels: tuple[float, float, float],
    noise: float,
    room: tuple[float, Floats, Floats, Floats],
) -> tuple[int, float, float]:
    """Roll along one line; returns the (k, 𝓛_1, 𝓛_3) that are measured.

    Arguments as for `read_light` and `sense_lines`; ``room`` is (phase, s_cm, light, found_cm).
    """
    step_cm, jitter_cm, speed_sigma = motion
    phase, s_cm, light, found_cm = room
    clear = clear_light(levels, noise)
    speed = max(_SLOWEST, 1.0 + speed_sigma * rng.standard_normal()) if speed_sigma > 0.0 else 1.0
    readings = read_light(crossings, slices, speed * step_cm, phase, clear, s_cm, light)
    last = -np.inf
    for i in range(readings):
        # The robot takes its speed for what it should be.
        place = s_cm[i] / speed
        if jitter_cm > 0.0:
            place = max(last, place + jitter_cm * rng.standard_normal())
        s_cm[i] = place
        last = place
        if noise > 0.0:
            light[i] += noise * rng.standard_normal()
    found = detect(s_cm, light, readings, levels, found_cm)
    return chord_invariants(found_cm, 0, found)


@kernel
def sense_lines(
    rng: np.random.Generator,
    extent_cm: float,
    boundary: tuple[Floats, Floats, Ints, Floats],
    footprint: tuple[Floats, Floats, Floats],
    motion: tuple[float, float, float],
    levels: tuple[float, float, float],
    noise: float,
    seen: tuple[Ints, Floats, Floats],
) -> Floats:
    """Roll along random lines and fill ``seen`` with the (k, 𝓛_1, 𝓛_3) that are measured on each; k may be 0.

    Lines have |p| < ``extent_cm`` about the boundary's origin. ``footprint`` is (offset, half length, weight) of the
    slices, an odd number of them with the sensor's own line in the middle; ``motion`` the (step in cm, standard
    deviation of a reading's place in cm, of a run's relative speed); ``noise`` the standard deviation of a reading.
    Returns (2, 3): the sums over the lines of what was measured less the true (k, 𝓛_1, 𝓛_3), and of the squares.
    """
    offsets_cm, half_cm, weight = footprint
    k, l1_cm, l3_cm3 = seen
    slices = offsets_cm.size
    longest_cm = 2.0 * (extent_cm + half_cm.max())
    t_cm, counts, s_cm, light, found_cm = room_for(slices, boundary[0].size, longest_cm / (_SLOWEST * motion[0]))
    excess = np.zeros((2, 3))
    difference = np.empty(3)
    for line in range(k.size):
        k[line] = 0
        l1_cm[line] = 0.0
        l3_cm3[line] = 0.0
        theta = np.pi * rng.random()
        p = extent_cm * (2.0 * rng.random() - 1.0)
        phase = rng.random()
        if cross_parallel((np.cos(theta), np.sin(theta), p), offsets_cm, boundary, t_cm, counts) == 0:
            continue
        middle = slices // 2
        true_k, true_1, true_3 = chord_invariants(t_cm[middle], 0, counts[middle])
        room = (phase, s_cm, light, found_cm)
        k[line], l1_cm[line], l3_cm3[line] = sense_line(
            rng, (t_cm, counts), (half_cm, weight), motion, levels, noise, room
        )
        difference[0] = k[line] - true_k
        difference[1] = l1_cm[line] - true_1
        difference[2] = l3_cm3[line] - true_3
        excess[0] += difference
        excess[1] += difference * difference
    return excess


@kernel
def sense_given(
    rng: np.random.Generator,
    lines: tuple[Floats, Floats, Floats],
    extent_cm: float,
    boundary: tuple[Floats, Floats, Ints, Floats],
    footprint: tuple[Floats, Floats, Floats],
    motion: tuple[float, float, float],
    levels: tuple[float, float, float],
    noise: float,
    seen: tuple[Ints, Floats, Floats],
) -> None:
    """As `sense_lines`, along given ``lines`` (cos θ, sin θ, p in cm); ``extent_cm`` bounds the shape and footprint."""
    cos, sin, p_cm = lines
    offsets_cm, half_cm, weight = footprint
    k, l1_cm, l3_cm3 = seen
    longest_cm = 2.0 * (extent_cm + half_cm.max())
    most = longest_cm / (_SLOWEST * motion[0])
    t_cm, counts, s_cm, light, found_cm = room_for(offsets_cm.size, boundary[0].size, most)
    for line in range(k.size):
        k[line] = 0
        l1_cm[line] = 0.0
        l3_cm3[line] = 0.0
        direction = (cos[line], sin[line], p_cm[line])
        if abs(p_cm[line]) > extent_cm or cross_parallel(direction, offsets_cm, boundary, t_cm, counts) == 0:
            continue
        room = (rng.random(), s_cm, light, found_cm)
        k[line], l1_cm[line], l3_cm3[line] = sense_line(
            rng, (t_cm, counts), (half_cm, weight), motion, levels, noise, room
        )
