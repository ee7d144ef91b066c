"""Where a spot will be in the next frame: a constant-velocity filter in pixels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class PixelMotion:
    """Constant-velocity filter in pixels; both axes share the covariance (xx, xv, vv)."""

    x: float
    y: float
    vx: float = 0.0
    vy: float = 0.0
    xx: float = 4.0
    xv: float = 0.0
    vv: float = 3.0e4

    def predict(self, dt_s: float, q: float) -> None:
        """Go on by ``dt_s``; ``q`` is the spectral density of the acceleration (px²/s³)."""
        self.x += dt_s * self.vx
        self.y += dt_s * self.vy
        self.xx += 2.0 * dt_s * self.xv + dt_s * dt_s * self.vv + q * dt_s**3 / 3.0
        self.xv += dt_s * self.vv + q * dt_s * dt_s / 2.0
        self.vv += q * dt_s

    def update(self, x: float, y: float, variance: float = 0.25) -> None:
        """Take in a measured place; ``variance`` in px² per axis."""
        s = self.xx + variance
        gain_x, gain_v = self.xx / s, self.xv / s
        dx, dy = x - self.x, y - self.y
        self.x += gain_x * dx
        self.y += gain_x * dy
        self.vx += gain_v * dx
        self.vy += gain_v * dy
        self.vv -= gain_v * self.xv
        self.xx *= variance / s
        self.xv *= variance / s
