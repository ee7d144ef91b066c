"""Light to crossings, sample by sample: the one detector, on the host (``robot.crossings``) and on the robot.

Two levels on either side of the middle decide *whether* the boundary was passed (hysteresis), the middle
alone decides *where*. Pure Python on ``math`` alone, so that it runs under MicroPython.
"""

import math


class Detector:
    """Crossings of one run after another, in constant memory, as tuples (t_s, s_cm, entering).

    A crossing is reported once the light reaches the far threshold, and is placed where it passed the middle,
    linearly between the two samples on either side. On a ramp that noise makes pass the middle several times
    between the thresholds, it is placed at the mean of those passages: the first alone would come early, the
    last late. A wiggle that never reaches the far threshold leaves nothing.

    The crossings of a run alternate and begin with an entry: a run that starts in the light has one at its
    start (returned by ``start``) and a run that ends there has an exit at its end (by ``finish``).

    Samples whose light is not finite are passed over. ``s_cm`` must not decrease within a run.

    Attributes:
        lit: Whether the robot is in the light, as far as confirmed.
    """

    __slots__ = (
        "_begun",
        "_high",
        "_last_lux",
        "_last_s_cm",
        "_last_t_s",
        "_low",
        "_mid",
        "_passages",
        "_sum_s_cm",
        "_sum_t_s",
        "lit",
    )

    def __init__(self, low_lux: float, mid_lux: float, high_lux: float):
        """Take the thresholds: ``low_lux`` confirms the dark, ``high_lux`` the light, ``mid_lux`` places."""
        self._low = low_lux
        self._mid = mid_lux
        self._high = high_lux
        self._begun = False
        self._last_t_s = 0.0
        self._last_s_cm = 0.0
        self._last_lux = 0.0
        self.lit = False
        self._forget_passages()

    def _forget_passages(self) -> None:
        self._passages = 0
        self._sum_t_s = 0.0
        self._sum_s_cm = 0.0

    def _remember(self, t_s: float, s_cm: float, light_lux: float) -> None:
        self._last_t_s = t_s
        self._last_s_cm = s_cm
        self._last_lux = light_lux

    def start(self, t_s: float, s_cm: float, light_lux: float) -> tuple[float, float, bool] | None:
        """Begin a run at a sample, whose side of the middle level says whether it starts in the light.

        Returns:
            An entry at this very sample if it lies in the light, None in the dark.
        """
        self._forget_passages()
        self.lit = False
        self._begun = math.isfinite(light_lux)
        if not self._begun:
            return None  # the first sample that can be read will begin the run
        self._remember(t_s, s_cm, light_lux)
        self.lit = light_lux >= self._mid
        return (t_s, s_cm, True) if self.lit else None

    def feed(self, t_s: float, s_cm: float, light_lux: float) -> tuple[float, float, bool] | None:
        """Take the next sample of the run; the first one of all counts as ``start``.

        Returns:
            The crossing that this sample confirms, if any; it lies before the sample.
        """
        if not self._begun:
            return self.start(t_s, s_cm, light_lux)
        if not math.isfinite(light_lux):
            return None
        last_lux = self._last_lux
        if (last_lux >= self._mid) != (light_lux >= self._mid):
            part = (self._mid - last_lux) / (light_lux - last_lux)
            self._passages += 1
            self._sum_t_s += self._last_t_s + part * (t_s - self._last_t_s)
            self._sum_s_cm += self._last_s_cm + part * (s_cm - self._last_s_cm)
        self._remember(t_s, s_cm, light_lux)
        confirmed = light_lux <= self._low if self.lit else light_lux >= self._high
        refuted = light_lux >= self._high if self.lit else light_lux <= self._low
        if confirmed:
            self.lit = not self.lit
            crossing = (self._sum_t_s / self._passages, self._sum_s_cm / self._passages, self.lit)
            self._forget_passages()
            return crossing
        if refuted:  # back where it came from: the ramp, if it was one, begins anew
            self._forget_passages()
        return None

    def finish(self, t_s: float, s_cm: float) -> tuple[float, float, bool] | None:
        """End the run.

        Returns:
            An exit at the end if the run ended in the light, None in the dark.
        """
        was_lit = self.lit
        self.lit = False
        self._begun = False
        self._forget_passages()
        return (t_s, s_cm, False) if was_lit else None
