"""The constant-velocity filter of one axis, written out as 2x2 recursions for numba.

Model: state (x, v), x' = x + v dt, white acceleration of spectral density q, so the process noise of a step is
q [[dt³/3, dt²/2], [dt²/2, dt]] (Bar-Shalom, Li & Kirubarajan 2001, Eq. 6.2.2-12). A kick is a jump of the velocity
somewhere in a step, of variance w: it adds w [[dt²/3, dt/2], [dt/2, 1]]. Measurements see x alone, variance r.
The smoother is that of Rauch, Tung & Striebel (1965). ``tracking.kalman`` holds the same filter on filterpy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lab.base.compiled import compiled

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_LATEST_SHOWN = 8  # measurements, at most, from a turn to that in which it shows
_LEAST_CHANCE = 0.01  # of a step to have held a turn, over the likeliest one's: below, it gets no kick


@compiled()
def process_noise(dt_s: float, q: float, kick_var: float) -> tuple[float, float, float]:
    """Give the process noise (xx, xv, vv) of a step of ``dt_s`` with a kick of variance ``kick_var`` (0 = none)."""
    xx = q * dt_s**3 / 3.0 + kick_var * dt_s**2 / 3.0
    xv = q * dt_s**2 / 2.0 + kick_var * dt_s / 2.0
    return xx, xv, q * dt_s + kick_var


@compiled()
def smooth_axis(
    t_s: Floats, z: Floats, r: Floats, use: Flags, kick_var: Floats, q: float, start_var_v: float
) -> tuple[Floats, Floats, Floats]:
    """Filter forward and smooth backward one axis.

    Args:
        t_s: (n,) times, rising.
        z: (n,) measured positions; the first must be used.
        r: (n,) their variances.
        use: (n,) which of them to take.
        kick_var: (n,) variance of the velocity jump in the step that ends at each sample.
        q: spectral density of the acceleration.
        start_var_v: variance of the velocity at the start.

    Returns:
        Positions (n,), velocities (n,), covariances (n, 3) as xx, xv, vv.
    """
    n = len(t_s)
    xs = np.empty(n)
    vs = np.empty(n)
    cov = np.empty((n, 3))
    x, v = z[0], 0.0
    pxx, pxv, pvv = r[0], 0.0, start_var_v
    for k in range(n):
        if k > 0:
            dt = t_s[k] - t_s[k - 1]
            qxx, qxv, qvv = process_noise(dt, q, kick_var[k])
            x += dt * v
            pxx += 2.0 * dt * pxv + dt * dt * pvv + qxx
            pxv += dt * pvv + qxv
            pvv += qvv
            if use[k]:
                s = pxx + r[k]
                gain_x, gain_v = pxx / s, pxv / s
                innovation = z[k] - x
                x += gain_x * innovation
                v += gain_v * innovation
                # Symmetric form of (I - K H) P: no cancellation below zero where r << pxx.
                pvv -= gain_v * pxv
                pxx, pxv = pxx * r[k] / s, pxv * r[k] / s
        xs[k], vs[k] = x, v
        cov[k, 0], cov[k, 1], cov[k, 2] = pxx, pxv, pvv
    for k in range(n - 2, -1, -1):
        dt = t_s[k + 1] - t_s[k]
        qxx, qxv, qvv = process_noise(dt, q, kick_var[k + 1])
        axx, axv, avv = cov[k, 0], cov[k, 1], cov[k, 2]
        mxx = axx + 2.0 * dt * axv + dt * dt * avv + qxx
        mxv = axv + dt * avv + qxv
        mvv = avv + qvv
        det = mxx * mvv - mxv * mxv
        # Smoother gain C = P Fᵀ M⁻¹.
        fxx, fxv = axx + dt * axv, axv
        fvx, fvv = axv + dt * avv, avv
        cxx = (fxx * mvv - fxv * mxv) / det
        cxv = (fxv * mxx - fxx * mxv) / det
        cvx = (fvx * mvv - fvv * mxv) / det
        cvv = (fvv * mxx - fvx * mxv) / det
        dx = xs[k + 1] - xs[k] - dt * vs[k]
        dv = vs[k + 1] - vs[k]
        xs[k] += cxx * dx + cxv * dv
        vs[k] += cvx * dx + cvv * dv
        exx, exv, evv = cov[k + 1, 0] - mxx, cov[k + 1, 1] - mxv, cov[k + 1, 2] - mvv
        hxx, hxv = cxx * exx + cxv * exv, cxx * exv + cxv * evv
        hvx, hvv = cvx * exx + cvv * exv, cvx * exv + cvv * evv
        cov[k, 0] = axx + hxx * cxx + hxv * cxv
        cov[k, 1] = axv + hxx * cvx + hxv * cvv
        cov[k, 2] = avv + hvx * cvx + hvv * cvv
    return xs, vs, cov


@compiled()
def plan(
    t_s: Floats,
    x: Floats,
    y: Floats,
    rx: Floats,
    ry: Floats,
    q: float,
    kick_var: float,
    start_var_v: float,
    gate: float,
) -> tuple[Flags, Floats, Floats, float]:
    """Decide for each measurement of a track whether it is taken, and where the velocity jumps.

    A measurement whose normalised innovation squared exceeds ``gate`` is an outlier if a later one, within three,
    agrees again with the prediction; else the robot has turned, and the last steps share a kick, each by how likely a
    turn in it makes the measurements since and the next one.

    Returns:
        Which are taken (n,); the kicks' variances (n,); the innovations (n, 2) over their predicted standard
        deviations, NaN where there was no measurement, those of a turn with its kick allowed for; half the deviance
        -2 ln L of the whole track, in which no measurement counts for more than the gate lets pass.
    """
    n = len(t_s)
    use = np.zeros(n, dtype=np.bool_)
    kicks = np.zeros(n)
    innovations = np.full((n, 2), np.nan)
    cost = 0.0
    use[0] = True
    # Of each sample: x, vx, xx, xv, vv of the one axis, then of the other.
    states = np.zeros((n, 10))
    states[0] = np.array([x[0], 0.0, rx[0], 0.0, start_var_v, y[0], 0.0, ry[0], 0.0, start_var_v])
    for k in range(1, n):
        dt = t_s[k] - t_s[k - 1]
        states[k] = states[k - 1]
        _predict(states[k], dt, q, 0.0)
        if not (np.isfinite(x[k]) and np.isfinite(y[k])):
            continue
        sx, sy = states[k, 2] + rx[k], states[k, 7] + ry[k]
        dx, dy = x[k] - states[k, 0], y[k] - states[k, 5]
        odd = dx * dx / sx + dy * dy / sy
        innovations[k, 0], innovations[k, 1] = dx / np.sqrt(sx), dy / np.sqrt(sy)
        cost += 0.5 * (min(odd, gate) + np.log(sx) + np.log(sy))
        if odd > gate:
            if _agrees_later(k, t_s, x, y, rx, ry, states[k], q, gate):
                continue
            # The turn may have been anywhere since the last measurement that was taken.
            last = k - 1
            while not use[last]:
                last -= 1
            trial = states[last].copy()
            _predict(trial, t_s[k] - t_s[last], q, kick_var)
            if (x[k] - trial[0]) ** 2 / (trial[2] + rx[k]) + (y[k] - trial[5]) ** 2 / (trial[7] + ry[k]) > gate:
                # Too far for any turn: a mistaken spot, even if what follows should not agree either.
                continue
            use[k] = True
            _turn(k, t_s, x, y, rx, ry, use, kicks, innovations, states, q, kick_var)
            continue
        use[k] = True
        _update(states[k], x[k], y[k], rx[k], ry[k])
    return use, kicks, innovations, cost


@compiled()
def _predict(state: Floats, dt_s: float, q: float, kick_var: float) -> None:
    """Carry the state of both axes over a step, in place."""
    qxx, qxv, qvv = process_noise(dt_s, q, kick_var)
    for o in (0, 5):
        state[o] += dt_s * state[o + 1]
        state[o + 2] += 2.0 * dt_s * state[o + 3] + dt_s * dt_s * state[o + 4] + qxx
        state[o + 3] += dt_s * state[o + 4] + qxv
        state[o + 4] += qvv


@compiled()
def _update(state: Floats, x: float, y: float, rx: float, ry: float) -> float:
    """Take a measurement into the state of both axes, in place: half its deviance."""
    half = 0.0
    for o, z, r in ((0, x, rx), (5, y, ry)):
        s = state[o + 2] + r
        gain_x, gain_v = state[o + 2] / s, state[o + 3] / s
        innovation = z - state[o]
        state[o] += gain_x * innovation
        state[o + 1] += gain_v * innovation
        state[o + 4] -= gain_v * state[o + 3]
        state[o + 3] *= r / s
        state[o + 2] *= r / s
        half += 0.5 * (innovation * innovation / s + np.log(s))
    return half


@compiled()
def _turn(
    k: int,
    t_s: Floats,
    x: Floats,
    y: Floats,
    rx: Floats,
    ry: Floats,
    use: Flags,
    kicks: Floats,
    innovations: Floats,
    states: Floats,
    q: float,
    kick_var: float,
) -> None:
    """Share the kick of a turn that showed at sample k among the last steps by their chances, and filter on from there.

    A slight turn shows some frames late: the sum of its innovations must outgrow the noise.
    """
    until = k + 1
    while until < len(t_s) and not (np.isfinite(x[until]) and np.isfinite(y[until])):
        until += 1
    until = min(until, len(t_s) - 1)
    earliest = k
    costs = [np.inf]
    costs.clear()
    seen = 0
    for first in range(k, 0, -1):
        if kicks[first] > 0.0 or seen == _LATEST_SHOWN:
            break
        earliest = first
        seen += use[first]
        state = states[first - 1].copy()
        cost = 0.0
        for m in range(first, until + 1):
            _predict(state, t_s[m] - t_s[m - 1], q, kick_var if m == first else 0.0)
            if use[m] or (m > k and np.isfinite(x[m]) and np.isfinite(y[m])):
                cost += _update(state, x[m], y[m], rx[m], ry[m])
        costs.append(cost)
    chances = np.array([np.exp(min(costs) - cost) for cost in costs])
    chances /= np.sum(chances)
    # Through a long gap each step's chance is small, but the turn was in one of them.
    chances[chances < _LEAST_CHANCE * np.max(chances)] = 0.0
    for m in range(earliest, k + 1):
        kicks[m] = kick_var * chances[k - m]
    for m in range(earliest, k + 1):
        states[m] = states[m - 1]
        _predict(states[m], t_s[m] - t_s[m - 1], q, kicks[m])
        if use[m]:
            innovations[m, 0] = (x[m] - states[m, 0]) / np.sqrt(states[m, 2] + rx[m])
            innovations[m, 1] = (y[m] - states[m, 5]) / np.sqrt(states[m, 7] + ry[m])
            _update(states[m], x[m], y[m], rx[m], ry[m])


@compiled()
def _agrees_later(
    k: int, t_s: Floats, x: Floats, y: Floats, rx: Floats, ry: Floats, state: Floats, q: float, gate: float
) -> bool:
    """Whether one of the next three measurements lies where the prediction at sample k goes on to."""
    looked = 0
    for m in range(k + 1, len(t_s)):
        if not (np.isfinite(x[m]) and np.isfinite(y[m])):
            continue
        ahead = state.copy()
        _predict(ahead, t_s[m] - t_s[k], q, 0.0)
        if (x[m] - ahead[0]) ** 2 / (ahead[2] + rx[m]) + (y[m] - ahead[5]) ** 2 / (ahead[7] + ry[m]) <= gate:
            return True
        looked += 1
        if looked == 3:
            break
    return False
