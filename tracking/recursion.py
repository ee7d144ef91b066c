"""The constant-velocity filter of one axis, written out as 2x2 recursions for numba.

Model: state (x, v), x' = x + v dt, white acceleration of spectral density q, so the process noise of a step is
q [[dt³/3, dt²/2], [dt²/2, dt]] (Bar-Shalom, Li & Kirubarajan 2001, Eq. 6.2.2-12). A kick is a jump of the velocity
somewhere in a step, of variance w: it adds w [[dt²/3, dt/2], [dt/2, 1]]. Measurements see x alone, variance r.
The smoother is that of Rauch, Tung & Striebel (1965). ``tracking.kalman`` holds the same filter on filterpy.
"""

# numba's decorators carry no types: the functions behind them are typed here by hand.
# pyright: reportUnknownMemberType=false, reportUntypedFunctionDecorator=false, reportMissingTypeStubs=false
from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


@njit(cache=True)
def process_noise(dt_s: float, q: float, kick_var: float) -> tuple[float, float, float]:
    """Give the process noise (xx, xv, vv) of a step of ``dt_s`` with a kick of variance ``kick_var`` (0 = none)."""
    xx = q * dt_s**3 / 3.0 + kick_var * dt_s**2 / 3.0
    xv = q * dt_s**2 / 2.0 + kick_var * dt_s / 2.0
    return xx, xv, q * dt_s + kick_var


@njit(cache=True)
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


@njit(cache=True)
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
) -> tuple[Flags, Floats, Floats]:
    """Decide for each measurement of a track whether it is taken, and where the velocity jumps.

    A measurement whose normalised innovation squared exceeds ``gate`` is an outlier if a later one, within three,
    agrees again with the prediction; else the robot has turned, and the step gets a kick.

    Returns:
        Which are taken (n,), the kicks' variances (n,), the normalised innovations squared (n,), NaN where none.
    """
    n = len(t_s)
    use = np.zeros(n, dtype=np.bool_)
    kicks = np.zeros(n)
    nis = np.full(n, np.nan)
    use[0] = True
    px, py, vx, vy = x[0], y[0], 0.0, 0.0
    a = np.array([rx[0], 0.0, start_var_v])
    b = np.array([ry[0], 0.0, start_var_v])
    for k in range(1, n):
        dt = t_s[k] - t_s[k - 1]
        qxx, qxv, qvv = process_noise(dt, q, 0.0)
        px += dt * vx
        py += dt * vy
        for p in (a, b):
            p[0] += 2.0 * dt * p[1] + dt * dt * p[2] + qxx
            p[1] += dt * p[2] + qxv
            p[2] += qvv
        if not (np.isfinite(x[k]) and np.isfinite(y[k])):
            continue
        dx, dy = x[k] - px, y[k] - py
        odd = dx * dx / (a[0] + rx[k]) + dy * dy / (b[0] + ry[k])
        if odd > gate:
            if _agrees_later(k, t_s, x, y, rx, ry, px, py, vx, vy, a, b, q, gate):
                continue
            kicks[k] = kick_var
            kxx, kxv, kvv = process_noise(dt, 0.0, kick_var)
            for p in (a, b):
                p[0] += kxx
                p[1] += kxv
                p[2] += kvv
            odd = dx * dx / (a[0] + rx[k]) + dy * dy / (b[0] + ry[k])
            if odd > gate:
                # Too far for any turn: a mistaken spot, even if what follows should not agree either.
                kicks[k] = 0.0
                for p in (a, b):
                    p[0] -= kxx
                    p[1] -= kxv
                    p[2] -= kvv
                continue
        else:
            nis[k] = odd
        use[k] = True
        sx, sy = a[0] + rx[k], b[0] + ry[k]
        px += a[0] / sx * dx
        vx += a[1] / sx * dx
        py += b[0] / sy * dy
        vy += b[1] / sy * dy
        a[2] -= a[1] * a[1] / sx
        a[1] *= rx[k] / sx
        a[0] *= rx[k] / sx
        b[2] -= b[1] * b[1] / sy
        b[1] *= ry[k] / sy
        b[0] *= ry[k] / sy
    return use, kicks, nis


@njit(cache=True)
def _agrees_later(
    k: int,
    t_s: Floats,
    x: Floats,
    y: Floats,
    rx: Floats,
    ry: Floats,
    px: float,
    py: float,
    vx: float,
    vy: float,
    a: Floats,
    b: Floats,
    q: float,
    gate: float,
) -> bool:
    """Whether one of the next three measurements lies where the prediction at sample k goes on to."""
    looked = 0
    for m in range(k + 1, len(t_s)):
        if not (np.isfinite(x[m]) and np.isfinite(y[m])):
            continue
        dt = t_s[m] - t_s[k]
        qxx = process_noise(dt, q, 0.0)[0]
        vxx = a[0] + 2.0 * dt * a[1] + dt * dt * a[2] + qxx + rx[m]
        vyy = b[0] + 2.0 * dt * b[1] + dt * dt * b[2] + qxx + ry[m]
        if (x[m] - px - dt * vx) ** 2 / vxx + (y[m] - py - dt * vy) ** 2 / vyy <= gate:
            return True
        looked += 1
        if looked == 3:
            break
    return False
