"""Light to crossings: where along a run the shape's boundary was passed, from samples of the ambient light.

The sensor sees a disc of floor, so at the boundary the light ramps over the width of that footprint. A
straight boundary stands where half of the footprint is lit, at the level midway between dark and light,
whatever the angle at which it is met. Two further levels on either side of the middle decide *whether* the
boundary was passed (hysteresis), the middle alone decides *where*.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lab.base.errors import ChordlabError
from robot.micropython.detector import Detector

# Half of the hysteresis: as many noise widths as make a false crossing rarer than 10^-9 a sample, and no more
# than that, for a chord that never lights the footprint beyond the upper threshold is lost. At the largest
# share, with levels that only just separate, 6.5 noise widths still lie beyond the thresholds.
MARGIN_NOISES = 6.0
LEAST_MARGIN, LARGEST_MARGIN = 0.05, 0.15  # of the span
SEPARATION_NOISES = 10.0
NOISE_FLOOR_LUX = 0.5  # a quiet or coarsely quantised sensor repeats itself; its noise is not then nil
FEWEST_SAMPLES = 5
_MAD_TO_SIGMA = 1.4826  # of a normal distribution


@dataclass(frozen=True, slots=True)
class Levels:
    """The light in the dark and in the shape, and the thresholds between them, in lux.

    ``low_lux`` confirms the dark and ``high_lux`` the light; the crossing is placed at ``mid_lux``.
    """

    dark_lux: float
    bright_lux: float
    low_lux: float
    mid_lux: float
    high_lux: float

    def __post_init__(self) -> None:
        if not self.dark_lux < self.low_lux < self.mid_lux < self.high_lux < self.bright_lux:
            raise LevelsError(
                "light levels must rise from dark over low, middle and high to bright: learn them anew",
                dark_lux=self.dark_lux,
                bright_lux=self.bright_lux,
                noise_lux=math.nan,
            )


@dataclass(frozen=True, slots=True)
class Crossing:
    """A passage of the shape's boundary at ``s_cm`` along the run, into the light if ``entering``."""

    t_s: float
    s_cm: float
    entering: bool


class LevelsError(ChordlabError):
    """Dark and light cannot be told apart, or were not seen. Cure: a darker room or a brighter projector.

    Attributes:
        dark_lux: Median of the samples taken in the dark; NaN if there were too few.
        bright_lux: Median of those taken in the light; NaN if there were too few.
        noise_lux: The larger of the two noise widths (one sigma); NaN if there were too few samples.
    """

    def __init__(self, message: str, *, dark_lux: float, bright_lux: float, noise_lux: float) -> None:
        super().__init__(message)
        self.dark_lux = dark_lux
        self.bright_lux = bright_lux
        self.noise_lux = noise_lux


def _level_and_noise(lux: NDArray[np.float64]) -> tuple[float, float]:
    """Median and MAD (as a sigma): up to half of the samples may be strays from the other side."""
    if len(lux) < FEWEST_SAMPLES:
        return math.nan, math.nan
    level = float(np.median(lux))
    return level, max(_MAD_TO_SIGMA * float(np.median(np.abs(lux - level))), NOISE_FLOOR_LUX)


def threshold_margin(noise_lux: float, span_lux: float) -> float:
    """Half of the hysteresis, lux, for levels ``span_lux`` apart and readings that scatter by ``noise_lux``."""
    noise = max(noise_lux, NOISE_FLOOR_LUX)
    return min(max(MARGIN_NOISES * noise, LEAST_MARGIN * span_lux), LARGEST_MARGIN * span_lux)


def learn_levels(dark_lux: ArrayLike, bright_lux: ArrayLike, *, separation: float = SEPARATION_NOISES) -> Levels:
    """Learn the two levels; set the middle halfway and the thresholds six noise widths to either side of it.

    The thresholds keep between 5 and 15 % of the span from the middle.

    Args:
        dark_lux: (n,) samples taken outside the shape; non-finite ones are left out.
        bright_lux: (m,) samples taken inside it.
        separation: Noise widths (the larger sigma of the two, at least 0.5 lux) that must lie between them.

    Raises:
        LevelsError: Fewer than five samples of either, or levels closer than ``separation`` noise widths.
    """
    dark = np.asarray(dark_lux, dtype=float).ravel()
    bright = np.asarray(bright_lux, dtype=float).ravel()
    dark, bright = dark[np.isfinite(dark)], bright[np.isfinite(bright)]
    low_level, low_noise = _level_and_noise(dark)
    high_level, high_noise = _level_and_noise(bright)
    noise = max(low_noise, high_noise) if math.isfinite(low_noise) and math.isfinite(high_noise) else math.nan
    seen = {"dark_lux": low_level, "bright_lux": high_level, "noise_lux": noise}
    if math.isnan(noise):
        raise LevelsError(
            f"{len(dark)} samples of the dark and {len(bright)} of the light, and {FEWEST_SAMPLES} of each are "
            "needed: hold the robot longer on each side, and check that its light stream runs",
            **seen,
        )
    span = high_level - low_level
    if span < separation * noise:
        cure = (
            "the two look swapped: put the robot outside the shape for the dark, inside for the light"
            if -span >= separation * noise
            else "darken the room, brighten the projector or dim the robot's own LEDs"
        )
        raise LevelsError(
            f"dark ({low_level:.1f} lux) and light ({high_level:.1f} lux) lie {span / noise:.1f} noise widths of "
            f"{noise:.1f} lux apart, and {separation:g} are needed: {cure}",
            **seen,
        )
    mid = low_level + 0.5 * span
    margin = threshold_margin(noise, span)
    return Levels(dark_lux=low_level, bright_lux=high_level, low_lux=mid - margin, mid_lux=mid, high_lux=mid + margin)


def scatter_of(levels: Levels) -> float:
    """How far, lux, samples may lie to either side of the dark and the bright level for `learn_levels` to find these.

    Half of them must lie below and half above.
    """
    return (levels.mid_lux - levels.low_lux) / (MARGIN_NOISES * _MAD_TO_SIGMA)


class CrossingDetector:
    """Crossings of one run after another, sample by sample, in constant memory.

    It is the ``Detector`` that also runs on robots of their own mind, whose documentation says where it places
    a crossing; here it speaks in ``Levels`` and ``Crossing``. The crossings of a run alternate, begin with an
    entry (at the start, if the run starts in the light) and end with an exit (at the end, if it ends there):
    what is measured is the part of the shape that the robot can reach.

    Samples whose light is not finite are passed over. ``s_cm`` must not decrease within a run.
    """

    __slots__ = ("_detector",)

    def __init__(self, levels: Levels) -> None:
        self._detector = Detector(levels.low_lux, levels.mid_lux, levels.high_lux)

    @property
    def lit(self) -> bool:
        """Whether the robot is in the light, as far as confirmed."""
        return self._detector.lit

    def start(self, t_s: float, s_cm: float, light_lux: float) -> Crossing | None:
        """Begin a run at a sample, whose side of the middle level says whether it starts in the light.

        Returns:
            An entry at this very sample if it lies in the light, None in the dark.
        """
        return _crossing(self._detector.start(t_s, s_cm, light_lux))

    def feed(self, t_s: float, s_cm: float, light_lux: float) -> Crossing | None:
        """Take the next sample of the run; the first one of all counts as ``start``.

        Returns:
            The crossing that this sample confirms, if any; it lies before the sample.
        """
        return _crossing(self._detector.feed(t_s, s_cm, light_lux))

    def finish(self, t_s: float, s_cm: float) -> Crossing | None:
        """End the run.

        Returns:
            An exit at the end if the run ended in the light, None in the dark.
        """
        return _crossing(self._detector.finish(t_s, s_cm))


def _crossing(found: tuple[float, float, bool] | None) -> Crossing | None:
    return None if found is None else Crossing(*found)


def crossings_of(t_s: ArrayLike, s_cm: ArrayLike, light_lux: ArrayLike, levels: Levels) -> list[Crossing]:
    """Crossings of one stored run, by the same detector; entries and exits pair up.

    Args:
        t_s: (n,) sample times in s.
        s_cm: (n,) path rolled at each.
        light_lux: (n,) light at each; NaN where it was lost.
        levels: The session's levels.
    """
    times: Sequence[float] = np.asarray(t_s, dtype=float).tolist()
    paths: Sequence[float] = np.asarray(s_cm, dtype=float).tolist()
    lights: Sequence[float] = np.asarray(light_lux, dtype=float).tolist()
    detector = CrossingDetector(levels)
    found = [detector.feed(*sample) for sample in zip(times, paths, lights, strict=True)]
    if times:
        found.append(detector.finish(times[-1], paths[-1]))
    return [crossing for crossing in found if crossing is not None]
