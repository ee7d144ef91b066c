"""The recursion for one line, compiled, and how anything here is compiled.

Every kernel is sequential and releases the GIL: parallelism comes from threads that own their blocks,
because numba's own parallel loops may not be entered from two Python threads at once.
"""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from lab.base.compiled import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


CORES = "CHORDLAB_CORES"  # how many of the machine's cores a process may use, where it is one of several


def available_cores() -> int:
    """Number of cores this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    told = os.environ.get(CORES, "")
    return max(1, min(cores, int(told))) if told.isdecimal() else cores


# Every kernel releases the GIL.
kernel = compiled(nogil=True)


@kernel
def chord_invariants(t_cm: Floats, first: int, last: int) -> tuple[int, float, float]:
    """Give (k, 𝓛_1, 𝓛_3) of the sorted crossings ``t_cm[first:last]``, which alternate in, out, in, out.

    Constant memory and no cancellation: with C_n = Σ_{i<now} ∓(now − t_i)ⁿ, both C_1 and C_2 stay ≥ 0.
    """
    k = 0
    c1 = 0.0
    c2 = 0.0
    l3 = 0.0
    for j in range(first, last - 1, 2):
        if k > 0:
            c2 += 2.0 * (t_cm[j] - t_cm[j - 1]) * c1
        chord = t_cm[j + 1] - t_cm[j]
        l3 += 3.0 * c2 * chord + 3.0 * c1 * chord * chord + chord * chord * chord
        c2 += 2.0 * c1 * chord + chord * chord
        c1 += chord
        k += 1
    return k, c1, l3


@kernel
def ragged_invariants(t_cm: Floats, counts: Ints, k: Ints, l1_cm: Floats, l3_cm3: Floats) -> None:
    """Fill (k, 𝓛_1, 𝓛_3) of every line; line i owns the next ``counts[i]`` sorted crossings of ``t_cm``."""
    first = 0
    for line in range(counts.size):
        last = first + counts[line]
        k[line], l1_cm[line], l3_cm3[line] = chord_invariants(t_cm, first, last)
        first = last


@kernel
def chord_moments(t_cm: Floats, first: int, last: int) -> tuple[int, float, float, float, float]:
    """Give (k, 𝓛_1, 𝓛_3, 𝓛_4, 𝓛_5) of the sorted crossings ``t_cm[first:last]``: the same recursion with C_3, C_4.

    By the binomial theorem C_n grows by Σ_m C(n, m) C_m gⁿ⁻ᵐ over a way g, with C_0 = 1 in the light and 0 in the
    dark; 𝓛_n is what C_n gains in the light.
    """
    k = 0
    c1 = 0.0
    c2 = 0.0
    c3 = 0.0
    c4 = 0.0
    l3 = 0.0
    l4 = 0.0
    l5 = 0.0
    for j in range(first, last - 1, 2):
        if k > 0:
            gap = t_cm[j] - t_cm[j - 1]
            c4 += gap * (4.0 * c3 + gap * (6.0 * c2 + 4.0 * gap * c1))
            c3 += gap * (3.0 * c2 + 3.0 * gap * c1)
            c2 += 2.0 * gap * c1
        c = t_cm[j + 1] - t_cm[j]
        l5 += c * (5.0 * c4 + c * (10.0 * c3 + c * (10.0 * c2 + c * (5.0 * c1 + c))))
        gain4 = c * (4.0 * c3 + c * (6.0 * c2 + c * (4.0 * c1 + c)))
        gain3 = c * (3.0 * c2 + c * (3.0 * c1 + c))
        l4 += gain4
        c4 += gain4
        l3 += gain3
        c3 += gain3
        c2 += c * (2.0 * c1 + c)
        c1 += c
        k += 1
    return k, c1, l3, l4, l5


@kernel
def ragged_moments(t_cm: Floats, counts: Ints, found: Floats) -> None:
    """Fill ``found`` (lines, 5) with (k, 𝓛_1, 𝓛_3, 𝓛_4, 𝓛_5) of every line, as `ragged_invariants`."""
    first = 0
    for line in range(counts.size):
        last = first + counts[line]
        k, l1, l3, l4, l5 = chord_moments(t_cm, first, last)
        found[line, 0] = k
        found[line, 1] = l1
        found[line, 2] = l3
        found[line, 3] = l4
        found[line, 4] = l5
        first = last
