# pyright: reportPrivateImportUsage=false, reportUnknownMemberType=false, reportMissingTypeStubs=false
# numba's intrinsics are untyped; `_trailing_zeros` and `_ones` below are the only ones.
"""Compiled lines across a shape, 64 at a time: crossings, 𝓛_1 and 𝓛_3.

A line n·v = p meets an edge when the sign of n·v − p changes between its ends. The signs at 64 successive vertices
make one machine word for each line: the loop over vertices is the outer one, that over lines the inner one, which
the compiler turns into vector instructions. A word XORed with itself, shifted by one, has a bit for every edge that
is met, and only those few edges are looked at again. No crossing is ever dropped: there is room for all edges.

The lines are those of `analysis.lanes`. No fast-math anywhere: equal seeds give equal bits on every machine.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numba
import numpy as np
from llvmlite import ir
from numpy.typing import NDArray

from analysis.kernels import chord_invariants, kernel
from analysis.lanes import LANES, directions, draw

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Words = NDArray[np.uint64]

WORD_EDGES = 63  # 64 vertices to a word, the last of which opens the next
_INTERLEAVED = 16  # up to so many crossings are sorted without branches

_ZERO, _ONE = np.uint64(0), np.uint64(1)
_BIT1, _BIT2, _BIT3 = np.uint64(2), np.uint64(4), np.uint64(8)


class Outline(NamedTuple):
    """A shape's vertices in the order of the sign words; see `outline_of`.

    Attributes:
        x_cm: (vertices + padding,) all rings end to end, each closed by its first vertex.
        y_cm: the same.
        edges: (words,) bit i of word w is set if vertices 63 w + i and the next are the ends of an edge.
        fours: (words,) groups of four vertices in each word.
    """

    x_cm: Floats
    y_cm: Floats
    edges: Words
    fours: Ints


class Work(NamedTuple):
    """Room for the crossings of 64 lines; see `work_for`.

    Attributes:
        cos, sin, p_cm: (64,) the lines.
        uniform: (64,) random numbers.
        signs: (words, 64).
        edge, line: (crossings,) whose crossing it is.
        t_cm: (crossings,) places along the lines: line after line, sorted within each by `sort_crossings`.
        first, number: (65,) of each line that hits: its first crossing and how many.
        l1_cm, l3_cm3: (64,) of each line that hits.
        bucket: (65,) scratch.
    """

    cos: Floats
    sin: Floats
    p_cm: Floats
    uniform: Floats
    signs: Words
    edge: Words
    line: Words
    t_cm: Floats
    first: Ints
    number: Ints
    l1_cm: Floats
    l3_cm3: Floats
    bucket: Ints


def outline_of(x_cm: Floats, y_cm: Floats, rings: Ints) -> Outline:
    """Arrange closed rings, laid end to end with first and last index in ``rings`` (r, 2), for the kernels."""
    vertices = x_cm.size
    joined = np.ones(vertices - 1, dtype=bool)
    joined[rings[:-1, 1]] = False
    words = -(-joined.size // WORD_EDGES)
    bits = np.zeros((words, 64), dtype=np.uint64)
    bits[:, :WORD_EDGES].flat[: joined.size] = joined
    edges = (bits << np.arange(64, dtype=np.uint64)).sum(axis=1, dtype=np.uint64)
    fours = np.full(words, 16, dtype=np.int64)
    fours[-1] = -(-(vertices - WORD_EDGES * (words - 1)) // 4)
    padding = WORD_EDGES * (words - 1) + 4 * int(fours[-1]) - vertices
    # The last vertex again: no change of sign.
    return Outline(
        np.concatenate([x_cm, np.full(padding, x_cm[-1])]),
        np.concatenate([y_cm, np.full(padding, y_cm[-1])]),
        edges,
        fours,
    )


def work_for(outline: Outline) -> Work:
    """Room for 64 lines, each of which may cross every edge."""
    crossings = LANES * outline.x_cm.size + 2  # listing writes up to two ahead
    floats = [np.empty(LANES) for _ in range(4)]
    return Work(
        floats[0],
        floats[1],
        floats[2],
        floats[3],
        np.empty((outline.edges.size, LANES), dtype=np.uint64),
        np.empty(crossings, dtype=np.uint64),
        np.empty(crossings, dtype=np.uint64),
        np.empty(crossings),
        np.empty(LANES + 1, dtype=np.int64),
        np.empty(LANES + 1, dtype=np.int64),
        np.empty(LANES),
        np.empty(LANES),
        np.empty(LANES + 1, dtype=np.int64),
    )


@cast(Any, numba).extending.intrinsic
def _trailing_zeros(_context: Any, word: Any) -> Any:
    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 0))

    return word(word), generate


@cast(Any, numba).extending.intrinsic
def _ones(_context: Any, word: Any) -> Any:
    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return word(word), generate


@kernel
def throw(state: Words, radius_cm: float, work: Work) -> None:
    """Draw 64 lines that cross a circle about the origin, uniform and isotropic: direction, then p."""
    draw(state, work.uniform)
    directions(work.uniform, work.cos, work.sin)
    draw(state, work.uniform)
    for i in range(LANES):
        work.p_cm[i] = radius_cm * (2.0 * work.uniform[i] - 1.0)


@kernel
def sign_words(outline: Outline, work: Work) -> None:
    """On which side of each line every vertex lies: one bit each."""
    x_cm, y_cm = outline.x_cm, outline.y_cm
    cos, sin, p_cm = work.cos, work.sin, work.p_cm
    for word in range(outline.edges.size):
        signs = work.signs[word]
        for i in range(LANES):
            signs[i] = _ZERO
        for four in range(outline.fours[word]):
            v = WORD_EDGES * word + 4 * four
            x0, x1, x2, x3 = x_cm[v], x_cm[v + 1], x_cm[v + 2], x_cm[v + 3]
            y0, y1, y2, y3 = y_cm[v], y_cm[v + 1], y_cm[v + 2], y_cm[v + 3]
            shift = np.uint64(4 * four)
            b0, b1, b2, b3 = _ONE << shift, _BIT1 << shift, _BIT2 << shift, _BIT3 << shift
            for i in range(LANES):
                c = cos[i]
                s = sin[i]
                p = p_cm[i]
                low = (b0 if x0 * c + y0 * s >= p else _ZERO) | (b1 if x1 * c + y1 * s >= p else _ZERO)
                high = (b2 if x2 * c + y2 * s >= p else _ZERO) | (b3 if x3 * c + y3 * s >= p else _ZERO)
                signs[i] |= low | high


@kernel
def list_crossings(outline: Outline, work: Work) -> tuple[int, int]:
    """List the edges that each line meets, line after line; returns (lines that hit, crossings)."""
    edge, line, first, number = work.edge, work.line, work.first, work.number
    filled = 0
    hits = 0
    for i in range(LANES):
        begun = filled
        for word in range(outline.edges.size):
            signs = work.signs[word, i]
            met = (signs ^ (signs >> _ONE)) & outline.edges[word]
            here = int(_ones(met))
            # Two at once, whether there are any or not: most lines have none or two, and a wrong guess costs more.
            base = np.uint64(WORD_EDGES * word)
            edge[filled] = base + _trailing_zeros(met)
            line[filled] = np.uint64(i)
            met &= met - _ONE
            edge[filled + 1] = base + _trailing_zeros(met)
            line[filled + 1] = np.uint64(i)
            for j in range(filled + 2, filled + here):
                met &= met - _ONE
                edge[j] = base + _trailing_zeros(met)
                line[j] = np.uint64(i)
            filled += here
        first[hits] = begun
        number[hits] = filled - begun
        hits += 1 if filled > begun else 0
    return hits, filled


@kernel
def place_crossings(outline: Outline, work: Work, crossings: int) -> None:
    """Compute where along its line each listed crossing lies, by linear interpolation between the edge's ends."""
    x_cm, y_cm = outline.x_cm, outline.y_cm
    for j in range(crossings):
        e = work.edge[j]
        i = work.line[j]
        c = work.cos[i]
        s = work.sin[i]
        before = x_cm[e] * c + y_cm[e] * s - work.p_cm[i]
        after = x_cm[e + _ONE] * c + y_cm[e + _ONE] * s - work.p_cm[i]
        along = y_cm[e] * c - x_cm[e] * s
        work.t_cm[j] = along + before / (before - after) * (y_cm[e + _ONE] * c - x_cm[e + _ONE] * s - along)


@kernel
def sort_crossings(t_cm: Floats, first: int, count: int) -> None:
    """Sort ``t_cm[first : first + count]``; few of them by exchanges without branches."""
    if count == 4:
        t0, t1, t2, t3 = t_cm[first], t_cm[first + 1], t_cm[first + 2], t_cm[first + 3]
        t0, t1 = (t0, t1) if t0 < t1 else (t1, t0)
        t2, t3 = (t2, t3) if t2 < t3 else (t3, t2)
        t0, t2 = (t0, t2) if t0 < t2 else (t2, t0)
        t1, t3 = (t1, t3) if t1 < t3 else (t3, t1)
        t1, t2 = (t1, t2) if t1 < t2 else (t2, t1)
        t_cm[first], t_cm[first + 1], t_cm[first + 2], t_cm[first + 3] = t0, t1, t2, t3
        return
    if count > _INTERLEAVED:
        t_cm[first : first + count].sort()
        return
    for a in range(first + 1, first + count):
        value = t_cm[a]
        for b in range(first, a):
            other = t_cm[b]
            t_cm[b] = value if value < other else other
            value = other if value < other else value
        t_cm[a] = value


@kernel
def cross(outline: Outline, work: Work) -> int:
    """Find the crossings of 64 lines, line after line in ``work``, not yet sorted; returns how many lines hit."""
    sign_words(outline, work)
    hits, crossings = list_crossings(outline, work)
    place_crossings(outline, work, crossings)
    return hits


@kernel
def measure(work: Work, hits: int) -> None:
    """Sort the crossings of every line that hits and fill ``l1_cm`` and ``l3_cm3``.

    Lines of one chord are done first and those of two, three and four each together, so that the processor can
    foresee its branches.
    """
    t_cm, first, number, bucket = work.t_cm, work.first, work.number, work.bucket
    for crossings in range(2, 12, 2):
        chosen = 0
        for i in range(hits):
            bucket[chosen] = i
            chosen += 1 if number[i] == crossings or (crossings == 10 and number[i] > 8) else 0
        for row in range(chosen):
            i = int(bucket[row])
            begin = int(first[i])
            if crossings == 2:
                one, other = t_cm[begin], t_cm[begin + 1]
                t_cm[begin] = min(one, other)
                t_cm[begin + 1] = max(one, other)
                chord = abs(other - one)
                work.l1_cm[i] = chord
                work.l3_cm3[i] = chord * chord * chord
            else:
                size = crossings if crossings < 10 else int(number[i])
                sort_crossings(t_cm, begin, size)
                _, work.l1_cm[i], work.l3_cm3[i] = chord_invariants(t_cm, begin, begin + size)
        if crossings == 2 and chosen == hits:
            return


@kernel
def sum_lines(state: Words, ends: Ints, radius_cm: float, outline: Outline, work: Work, sums: Floats) -> int:
    """Throw lines until ``ends[-1]`` have hit, and add (k, 𝓛_1, 𝓛_3) to the ``sums`` (stretches, 3).

    Stretch i holds the lines that hit from number ``ends[i − 1]`` up to ``ends[i]``. Returns the lines thrown.
    """
    stretch = 0
    done = 0
    thrown = 0
    while stretch < ends.size:
        throw(state, radius_cm, work)
        thrown += LANES
        hits = cross(outline, work)
        measure(work, hits)
        i = 0
        while i < hits and stretch < ends.size:
            stop = min(hits, i + ends[stretch] - done)
            done += stop - i
            crossings = 0
            l1_cm = 0.0
            l3_cm3 = 0.0
            for j in range(i, stop):
                crossings += work.number[j]
                l1_cm += work.l1_cm[j]
                l3_cm3 += work.l3_cm3[j]
            sums[stretch, 0] += crossings // 2
            sums[stretch, 1] += l1_cm
            sums[stretch, 2] += l3_cm3
            i = stop
            while stretch < ends.size and ends[stretch] == done:
                stretch += 1
    return thrown


@kernel
def fill_lines(
    state: Words, radius_cm: float, outline: Outline, work: Work, columns: tuple[Ints, Floats, Floats]
) -> None:
    """Throw lines until the ``columns`` k, 𝓛_1, 𝓛_3 are full of those that hit."""
    k, l1_cm, l3_cm3 = columns
    done = 0
    while done < k.size:
        throw(state, radius_cm, work)
        hits = min(cross(outline, work), k.size - done)
        measure(work, hits)
        for i in range(hits):
            k[done + i] = work.number[i] // 2
            l1_cm[done + i] = work.l1_cm[i]
            l3_cm3[done + i] = work.l3_cm3[i]
        done += hits


@kernel
def fill_crossings(
    state: Words, radius_cm: float, outline: Outline, work: Work, found: tuple[Floats, Ints]
) -> tuple[int, int]:
    """Throw lines and store the sorted crossings of those that hit, until either array of ``found`` is full.

    ``found`` is (t_cm, counts); ``t_cm`` must have room for 64 lines that cross every edge, or nothing is
    thrown. Returns (lines, crossings) stored.
    """
    t_cm, counts = found
    lines = 0
    filled = 0
    while lines < counts.size and filled + LANES * outline.x_cm.size <= t_cm.size:
        throw(state, radius_cm, work)
        hits = min(cross(outline, work), counts.size - lines)
        for i in range(hits):
            sort_crossings(work.t_cm, work.first[i], work.number[i])
            counts[lines + i] = work.number[i]
            for j in range(work.first[i], work.first[i] + work.number[i]):
                t_cm[filled] = work.t_cm[j]
                filled += 1
        lines += hits
    return lines, filled


@kernel
def cross_given(
    cos: Floats, sin: Floats, p_cm: Floats, outline: Outline, work: Work, columns: tuple[Ints, Floats, Floats]
) -> None:
    """Fill the ``columns`` k, 𝓛_1, 𝓛_3 of given lines; 0 for those that miss."""
    k, l1_cm, l3_cm3 = columns
    for begin in range(0, k.size, LANES):
        size = min(LANES, k.size - begin)
        for i in range(LANES):
            source = begin + min(i, size - 1)
            work.cos[i] = cos[source]
            work.sin[i] = sin[source]
            work.p_cm[i] = p_cm[source]
        for i in range(begin, begin + size):
            k[i] = 0
            l1_cm[i] = 0.0
            l3_cm3[i] = 0.0
        hits = cross(outline, work)
        measure(work, hits)
        for i in range(hits):
            line = np.int64(work.line[work.first[i]])
            if line < size:
                k[begin + line] = work.number[i] // 2
                l1_cm[begin + line] = work.l1_cm[i]
                l3_cm3[begin + line] = work.l3_cm3[i]
