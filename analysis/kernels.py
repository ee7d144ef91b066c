# pyright: reportPrivateImportUsage=false
# numba's decorators erase signatures; `kernel` below is the one place that meets them.
"""Compiled inner loops of the Monte Carlo and the quadrature, and the recursion for one line.

Every kernel is sequential and releases the GIL: parallelism comes from threads that own their blocks,
because numba's own parallel loops may not be entered from two Python threads at once.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_Function = TypeVar("_Function", bound=Callable[..., Any])

_njit = cast(Any, numba).njit

# Gauss–Legendre on [0, 1], four points: exact to degree 7, and 𝓛_3² is of degree 6 in p.
_NODES_P = np.array([0.06943184420297371, 0.33000947820757187, 0.6699905217924281, 0.9305681557970262])
_WEIGHTS_P = np.array([0.17392742256872692, 0.32607257743127307, 0.32607257743127307, 0.17392742256872692])
N_INTEGRALS = 10


def available_cores() -> int:
    """Number of cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def kernel(function: _Function) -> _Function:
    """Compile ``function`` with numba, GIL released, keeping its Python signature.

    The compiled code is cached beside the module, or in the user's cache directory, or (where neither
    can be written) not at all.
    """
    try:
        return cast(_Function, _njit(nogil=True, cache=True)(function))
    except RuntimeError:
        return cast(_Function, _njit(nogil=True)(function))


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
def trace_lines(
    uniforms: Floats,
    quota: int,
    radius_cm: float,
    boundary: tuple[Floats, Floats, Ints, Floats],
    found: tuple[Floats, Ints],
) -> tuple[int, int, int]:
    """Throw lines at the boundary and store the sorted crossings of those that hit.

    ``uniforms`` (n, 2) in [0, 1) gives each line (θ, p) with θ = πu and p = R(2v − 1) about the centre of
    the shape's circumscribed circle. ``boundary`` is (x_cm, y_cm, chunks, discs): closed rings end to end;
    (c, 2) stretches of consecutive edges and (c, 3) the circles (x, y, r) round them, so that a whole stretch
    away from the line is skipped at once. ``found`` is (t_cm, counts), to be filled with the crossings and with
    their number on each line that hits. Stops at ``quota`` hits, at the end of ``uniforms``, or when ``t_cm``
    might not hold the next line. Returns (hits, uniforms used, crossings stored).
    """
    x_cm, y_cm, chunks, discs = boundary
    t_cm, counts = found
    hits = 0
    used = 0
    filled = 0
    for row in range(uniforms.shape[0]):
        if hits == quota or t_cm.size - filled < x_cm.size:
            break
        used = row + 1
        theta = np.pi * uniforms[row, 0]
        p = radius_cm * (2.0 * uniforms[row, 1] - 1.0)
        cos = np.cos(theta)
        sin = np.sin(theta)
        end = filled
        for chunk in range(chunks.shape[0]):
            if abs(discs[chunk, 0] * cos + discs[chunk, 1] * sin - p) > discs[chunk, 2]:
                continue
            start = chunks[chunk, 0]
            before = x_cm[start] * cos + y_cm[start] * sin - p
            for i in range(start + 1, chunks[chunk, 1] + 1):
                after = x_cm[i] * cos + y_cm[i] * sin - p
                if (before >= 0.0) != (after >= 0.0):
                    along = y_cm[i - 1] * cos - x_cm[i - 1] * sin
                    t = along + before / (before - after) * (y_cm[i] * cos - x_cm[i] * sin - along)
                    j = end - 1
                    while j >= filled and t_cm[j] > t:
                        t_cm[j + 1] = t_cm[j]
                        j -= 1
                    t_cm[j + 1] = t
                    end += 1
                before = after
        if end > filled:
            counts[hits] = end - filled
            hits += 1
            filled = end
    return hits, used, filled


@kernel
def direction_integrals(theta_rad: Floats, x_cm: Floats, y_cm: Floats, previous: Ints, following: Ints) -> Floats:
    """Integrate over p, exactly, for every direction: returns (n, 10).

    Columns: ∫[hit], ∫k, ∫𝓛_1, ∫𝓛_3, ∫k², ∫k𝓛_1, ∫k𝓛_3, ∫𝓛_1², ∫𝓛_1𝓛_3, ∫𝓛_3² dp. The vertices' projections cut
    the p axis into strips in which the same edges are crossed and every crossing is linear in p.
    ``previous`` and ``following`` are each vertex' neighbours in its ring; edge i runs from vertex i to
    ``following[i]``.
    """
    n = x_cm.size
    out = np.zeros((theta_rad.size, 10))
    order = np.arange(n)
    p = np.empty(n)
    t = np.empty(n)
    active = np.empty(n, np.int64)
    middle = np.empty(n)
    low = np.empty(n)
    rise = np.empty(n)
    crossings = np.empty(n)
    is_active = np.zeros(n, np.bool_)
    for row in range(theta_rad.size):
        cos = np.cos(theta_rad[row])
        sin = np.sin(theta_rad[row])
        for i in range(n):
            p[i] = x_cm[i] * cos + y_cm[i] * sin
            t[i] = y_cm[i] * cos - x_cm[i] * sin
        if row == 0:
            order[:] = np.argsort(p)
        else:  # neighbouring directions keep almost the same order
            for i in range(1, n):
                vertex = order[i]
                j = i - 1
                while j >= 0 and p[order[j]] > p[vertex]:
                    order[j + 1] = order[j]
                    j -= 1
                order[j + 1] = vertex
        is_active[:] = False
        m = 0
        for rank in range(n - 1):
            vertex = order[rank]
            for side in range(2):
                edge = vertex if side == 0 else previous[vertex]
                if is_active[edge]:
                    is_active[edge] = False
                    j = 0
                    while active[j] != edge:
                        j += 1
                    m -= 1
                    for i in range(j, m):
                        active[i] = active[i + 1]
                else:
                    is_active[edge] = True
                    active[m] = edge
                    m += 1
            p_low = p[vertex]
            width = p[order[rank + 1]] - p_low
            if width <= 0.0 or m < 2:
                continue
            for i in range(m):
                edge = active[i]
                end = following[edge]
                slope = (t[end] - t[edge]) / (p[end] - p[edge])
                at_low = t[edge] + (p_low - p[edge]) * slope
                at_middle = at_low + 0.5 * width * slope
                j = i - 1
                while j >= 0 and middle[j] > at_middle:
                    active[j + 1] = active[j]
                    middle[j + 1] = middle[j]
                    low[j + 1] = low[j]
                    rise[j + 1] = rise[j]
                    j -= 1
                active[j + 1] = edge
                middle[j + 1] = at_middle
                low[j + 1] = at_low
                rise[j + 1] = width * slope
            out[row, 0] += width
            for node in range(4):
                for i in range(m):
                    crossings[i] = low[i] + _NODES_P[node] * rise[i]
                k, l1, l3 = chord_invariants(crossings, 0, m)
                weight = width * _WEIGHTS_P[node]
                out[row, 1] += weight * k
                out[row, 2] += weight * l1
                out[row, 3] += weight * l3
                out[row, 4] += weight * k * k
                out[row, 5] += weight * k * l1
                out[row, 6] += weight * k * l3
                out[row, 7] += weight * l1 * l1
                out[row, 8] += weight * l1 * l3
                out[row, 9] += weight * l3 * l3
    return out
