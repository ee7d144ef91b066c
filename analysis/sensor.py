"""What a rolling light sensor makes of a shape's lines: the statistics that a robot will measure, by simulation.

A robot reads the light every few millimetres, averaged over a disc of floor and with some noise, and places a crossing
between two readings. Narrow chords are lost, narrow gaps are bridged, corners are rounded: perimeters come out too
small, by a sixth for an intricate shape. A dictionary whose entries are seen through the same sensor has the same
errors, and they cancel.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.blocks import Progress, run_blocks
from analysis.boundary import Boundary, Geometry
from analysis.estimate import relative_covariance
from analysis.invariants import area_cm2, perimeter_cm
from analysis.quadrature import Moments
from analysis.sensorkernels import sense_given, sense_lines
from lab.base.errors import RequestError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_SLICES = 7  # of the footprint; odd, so that one is the sensor's own line
_POINT_CM = 1e-4  # a footprint of none is this wide, so that its ramps have a slope
_BLOCK_LINES = 1 << 14


@dataclass(frozen=True, slots=True)
class SensorModel:
    """A robot's light sensor on its way along a line. Light is counted from 0 in the dark to 1 in the shape.

    Attributes:
        step_cm: way between two readings, above 0.
        footprint_cm: radius of the disc of floor that the sensor averages over. A blurred image of standard
            deviation σ widens it to √(ρ² + 4σ²), which has the same second moment.
        margin: half of the hysteresis: ``mid`` ± margin confirm a crossing.
        mid: light at which a crossing is placed.
        noise: standard deviation of a reading.
        speed_sigma: relative standard deviation of a run's speed, which the robot does not know of.
        jitter_cm: standard deviation of the place that a reading is taken to be at.

    Raises:
        RequestError: a value is out of range.
    """

    step_cm: float
    footprint_cm: float = 0.0
    margin: float = 0.05
    mid: float = 0.5
    noise: float = 0.0
    speed_sigma: float = 0.0
    jitter_cm: float = 0.0

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = float(getattr(self, name))
            if not (np.isfinite(value) and value >= 0):
                raise RequestError(f"sensor: `{name}` must be 0 or more, got {value}")
        if self.step_cm == 0:
            raise RequestError("sensor: `step_cm` must be above 0, got 0")
        if not 0 < self.mid - self.margin <= self.mid + self.margin < 1:
            raise RequestError(f"sensor: `mid` ± `margin` must lie between 0 and 1, got {self.mid} ± {self.margin}")

    @property
    def levels(self) -> tuple[float, float, float]:
        """Light at which the dark is confirmed, a crossing placed, the light confirmed."""
        return float(self.mid - self.margin), float(self.mid), float(self.mid + self.margin)

    def key(self) -> str:
        """All that it is, exactly, as text."""
        return ",".join(float(value).hex() for value in astuple(self))

    def footprint(self) -> tuple[Floats, Floats, Floats]:
        """Slices of the footprint along the run: offset across it and half length in cm, and weight, (7,) each.

        Gauss–Chebyshev quadrature of the second kind: ∫f dA over the disc is exact where the integral along a
        slice is a polynomial of degree 13 in its offset.
        """
        angle = np.pi * np.arange(1, _SLICES + 1) / (_SLICES + 1)
        radius_cm = max(self.footprint_cm, _POINT_CM)
        offsets_cm = radius_cm * np.cos(angle)
        offsets_cm[_SLICES // 2] = 0.0
        return offsets_cm, radius_cm * np.sin(angle), 2 / (_SLICES + 1) * np.sin(angle) ** 2

    def sense(
        self,
        geometry: Geometry,
        lines: int,
        rng: np.random.Generator,
        *,
        progress: Progress | None = None,
        threads: int | None = None,
    ) -> SensedLines:
        """Roll along about ``lines`` random lines that cross ``geometry`` (cm).

        The result depends on the generator alone, not on the number of ``threads`` (default: the cores).
        ``progress`` is called with (lines rolled, in all).

        Raises:
            RequestError: fewer than one line.
            analysis.boundary.BoundaryError: the geometry is empty or invalid.
        """
        if lines < 1:
            raise RequestError(f"`lines` must be at least 1, got {lines}")
        boundary = Boundary.of(geometry)
        footprint = self.footprint()
        extent_cm = boundary.radius_cm + self.footprint_cm
        measure_cm = 2 * np.pi * extent_cm
        thrown = max(lines, round(lines * measure_cm / boundary.hull_perimeter_cm))
        outline = (boundary.x_cm, boundary.y_cm, boundary.chunks, boundary.discs)
        motion = (float(self.step_cm), float(self.jitter_cm), float(self.speed_sigma))
        noise, levels = float(self.noise), self.levels

        def work(first: int, last: int, stream: np.random.Generator) -> tuple[Ints, Floats, Floats, Floats]:
            seen = _columns(last - first)
            excess = sense_lines(stream, extent_cm, outline, footprint, motion, levels, noise, seen)
            k, l1_cm, l3_cm3 = seen
            some = k > 0
            return k[some], l1_cm[some], l3_cm3[some], excess

        blocks = list(run_blocks(work, thrown, _BLOCK_LINES, rng, threads=threads, progress=progress))
        return SensedLines(
            k=np.concatenate([block[0] for block in blocks]),
            l1_cm=np.concatenate([block[1] for block in blocks]),
            l3_cm3=np.concatenate([block[2] for block in blocks]),
            measure_per_line_cm=measure_cm / thrown,
            excess=np.sum([block[3] for block in blocks], axis=0),
        )

    def along(
        self, boundary: Boundary, theta_rad: Floats, p_cm: Floats, rng: np.random.Generator
    ) -> tuple[Ints, Floats, Floats]:
        """Roll along given lines x cos θ + y sin θ = p: (k, 𝓛_1 in cm, 𝓛_3 in cm³), 0 where nothing is seen."""
        cos, sin = np.cos(theta_rad), np.sin(theta_rad)
        x_cm, y_cm = boundary.centre_cm
        seen = _columns(theta_rad.size)
        sense_given(
            rng,
            (cos, sin, p_cm - x_cm * cos - y_cm * sin),
            boundary.radius_cm + self.footprint_cm,
            (boundary.x_cm, boundary.y_cm, boundary.chunks, boundary.discs),
            self.footprint(),
            (float(self.step_cm), float(self.jitter_cm), float(self.speed_sigma)),
            self.levels,
            float(self.noise),
            seen,
        )
        return seen


@dataclass(frozen=True, slots=True, eq=False)
class SensedLines:
    """Lines of a shape as a sensor measures them; those on which it sees nothing are left out.

    Attributes:
        k: (lines,) chords, 1 or more.
        l1_cm: (lines,) 𝓛_1.
        l3_cm3: (lines,) 𝓛_3.
        measure_per_line_cm: ∫dG that one line stands for.
        excess: (2, 3) sums over all lines thrown, seen or not, of what was measured less the true (k, 𝓛_1, 𝓛_3),
            and of its squares.
    """

    k: Ints
    l1_cm: Floats
    l3_cm3: Floats
    measure_per_line_cm: float
    excess: Floats

    def invariants(self) -> tuple[Ints, Floats, Floats]:
        """(k, 𝓛_1 in cm, 𝓛_3 in cm³) of every line."""
        return self.k, self.l1_cm, self.l3_cm3

    def moments(self, geometry: Geometry) -> Moments:
        """Moments of ``geometry``, the shape of these lines, as the sensor sees it: for a `GaussianRecogniser`.

        ``area_cm2`` and ``perimeter_cm`` are what Eq. 1 tends to. The integrals P, πA and 3A² of the true lines
        are known; only what the sensor adds is estimated, line by line (a control variate), so that most of the
        lines' own scatter cancels. ``error`` is the largest relative standard error of the three integrals. The
        hitting measure is that of the lines on which something is seen; the hull is the true one.

        Raises:
            RequestError: the sensor saw fewer than two lines.
        """
        if self.k.size < 2:
            raise RequestError("this sensor sees nothing of the shape: take readings closer together")
        values = np.column_stack([np.asarray(column, dtype=float) for column in self.invariants()])
        area, perimeter = float(geometry.area), float(geometry.length)
        closed = np.array([perimeter, np.pi * area, 3 * area**2])
        integrals = closed + self.measure_per_line_cm * self.excess[0]
        hitting = self.measure_per_line_cm * len(values)
        mean = integrals / hitting
        covariance = np.cov(values, rowvar=False)
        return Moments(
            area_cm2=float(area_cm2(mean[1], mean[2])),
            perimeter_cm=float(perimeter_cm(mean[0], mean[1], mean[2])),
            hull_perimeter_cm=float(geometry.convex_hull.length),
            hitting_measure_cm=hitting,
            mean=mean,
            covariance=covariance,
            relative=relative_covariance(mean, covariance),
            error=float((self.measure_per_line_cm * np.sqrt(self.excess[1]) / integrals).max()),
        )


def _columns(lines: int) -> tuple[Ints, Floats, Floats]:
    return np.empty(lines, dtype=np.int64), np.empty(lines), np.empty(lines)
