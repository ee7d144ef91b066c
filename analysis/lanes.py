"""Random numbers and directions for 64 lines at once, compiled.

Random numbers are those of `numpy.random.SFC64` (C. Doty-Humphrey), one generator for each of the 64 lines, inlined
because a call costs more than the number. No fast-math anywhere: equal seeds give equal bits on every machine.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.kernels import kernel

Floats = NDArray[np.float64]
Words = NDArray[np.uint64]

LANES = 64
_WARM_UP = 12  # rounds after seeding, as NumPy does

_ONE = np.uint64(1)
_S11, _S3, _S24, _S40 = np.uint64(11), np.uint64(3), np.uint64(24), np.uint64(40)
_TO_UNIT = 2.0**-53


def seeded(stream: np.random.Generator) -> Words:
    """State (4, 64) of one SFC64 for each of the 64 lines: three words drawn from ``stream`` each, and the counter."""
    state = np.ones((4, LANES), dtype=np.uint64)
    state[:3] = stream.integers(0, 1 << 64, (3, LANES), dtype=np.uint64)
    drop = np.empty(LANES)
    for _ in range(_WARM_UP):
        draw(state, drop)
    return state


@kernel
def draw(state: Words, uniform: Floats) -> None:
    """Draw the next number in [0, 1) of every lane's SFC64, with 53 bits, as NumPy's ``random()`` does."""
    a, b, c, counter = state[0], state[1], state[2], state[3]
    for i in range(LANES):
        new = a[i] + b[i] + counter[i]
        counter[i] += _ONE
        a[i] = b[i] ^ (b[i] >> _S11)
        b[i] = c[i] + (c[i] << _S3)
        c[i] = ((c[i] << _S24) | (c[i] >> _S40)) + new
        uniform[i] = np.float64(np.int64(new >> _S11)) * _TO_UNIT


@kernel
def directions(uniform: Floats, cos: Floats, sin: Floats) -> None:
    """Turn uniform numbers into normals: θ from −π/4 to π/4, and for the upper half of them a quarter turn on.

    The Taylor series are complete to double precision within ±π/4, and have no branches.
    """
    for i in range(LANES):
        twice = 2.0 * uniform[i]
        upper = twice >= 1.0
        x = (np.pi / 2) * ((twice - 1.0 if upper else twice) - 0.5)
        q = x * x
        s = 1.0 / 6227020800 - q * (1.0 / 1307674368000)
        s = 1.0 / 362880 - q * (1.0 / 39916800 - q * s)
        s = x * (1.0 - q * (1.0 / 6 - q * (1.0 / 120 - q * (1.0 / 5040 - q * s))))
        c = 1.0 / 479001600 - q * (1.0 / 87178291200 - q * (1.0 / 20922789888000))
        c = 1.0 / 720 - q * (1.0 / 40320 - q * (1.0 / 3628800 - q * c))
        c = 1.0 - q * (0.5 - q * (1.0 / 24 - q * c))
        cos[i] = -s if upper else c
        sin[i] = c if upper else s
