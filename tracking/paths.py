"""The path of a run as it is known: straight line, bow, and how far it may lie beside itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon

from tracking.runs import column

Floats = NDArray[np.float64]

_TOUCHING_CM = 1e-6
_BOW_PARTS = 32
_STRAIGHT_MEAN = 2.0 / 3.0  # of 1 - u² over u from -1 to 1: where the straight fit runs through the bow


@dataclass(frozen=True, slots=True, eq=False)
class RunPath:
    """One run: ``start_cm`` (2,), unit vector ``along`` (2,), and the rest from `fit_lines`, 0 where it is unknown."""

    start_cm: Floats
    along: Floats
    length_cm: float
    bend_cm: float
    pivot_cm: float
    sigma_pivot_cm: float
    sigma_theta_rad: float
    sigma_bend_cm: float

    @property
    def left(self) -> Floats:
        """The unit vector (2,) to the left of the way it goes."""
        return np.array([-self.along[1], self.along[0]])

    def _bow(self, s_cm: Floats) -> Floats:
        """Shape of the bow beside the straight fit, at places along the run; 1/3 at its middle, -2/3 at its ends."""
        return 1.0 - (2.0 * s_cm / self.length_cm - 1.0) ** 2 - _STRAIGHT_MEAN

    def beside(self, s_cm: Floats) -> Floats:
        """How far (n,) the path lies left of its straight line, s cm from the start."""
        return self.bend_cm * self._bow(s_cm)

    def slant(self, s_cm: Floats) -> Floats:
        """Slope (n,) of the path against its straight line."""
        return -self.bend_cm * 2.0 * (2.0 * s_cm / self.length_cm - 1.0) * 2.0 / self.length_cm

    def covariance(self, s_cm: Floats) -> Floats:
        """Covariance (n, n) in cm² of how far the path lies beside where it is taken to lie, at n places."""
        arm = s_cm - self.pivot_cm
        bow = self._bow(s_cm)
        return (
            self.sigma_pivot_cm**2
            + self.sigma_theta_rad**2 * arm[:, None] * arm
            + self.sigma_bend_cm**2 * bow[:, None] * bow
        )

    def sigma_beside(self, s_cm: Floats) -> Floats:
        """Standard error (n,) in cm of where the path lies, across it."""
        return np.sqrt(np.diagonal(self.covariance(s_cm)))

    def points(self, s_cm: Floats, sigmas: float = 0.0) -> Floats:
        """The path (n, 2) in cm, moved left by so many of its standard errors."""
        beside = self.beside(s_cm)
        if sigmas:
            beside = beside + sigmas * self.sigma_beside(s_cm)
        return self.start_cm + s_cm[:, None] * self.along + beside[:, None] * self.left

    def stretches(self, geometry: Polygon | MultiPolygon, sigmas: float = 0.0) -> Floats:
        """Begin and end (m, 2) along the run, in order, of every stretch inside the shape.

        A point or an edge that the path only touches is no stretch; stretches that meet in a point are one.
        """
        bent = sigmas != 0.0 or abs(self.bend_cm) > _TOUCHING_CM
        s_cm = np.linspace(0.0, self.length_cm, _BOW_PARTS + 1 if bent else 2)
        lit = shapely.intersection(shapely.linestrings(self.points(s_cm, sigmas)), geometry)
        parts = shapely.get_parts(lit)
        points, part = shapely.get_coordinates(parts, return_index=True)
        place = (points - self.start_cm) @ self.along
        begins, ends = np.full(len(parts), np.inf), np.full(len(parts), -np.inf)
        np.minimum.at(begins, part, place)
        np.maximum.at(ends, part, place)
        long = ends - begins > _TOUCHING_CM
        begins, ends = begins[long], ends[long]
        # A touched edge comes back as a stretch with its middle on the boundary.
        drawn, centre = self.points(s_cm, sigmas), (begins + ends) / 2.0
        middle = np.stack([np.interp(centre, s_cm, drawn[:, 0]), np.interp(centre, s_cm, drawn[:, 1])], axis=1)
        inside = np.asarray(shapely.contains_properly(geometry, shapely.points(middle)), dtype=bool)
        return _merged(begins[inside], ends[inside])


def _merged(begins: Floats, ends: Floats) -> Floats:
    """Stretches in order, those that meet in a point joined: (m, 2)."""
    order = np.argsort(begins)
    begins, ends = begins[order], ends[order]
    apart = begins[1:] - ends[:-1] > _TOUCHING_CM
    first, last = np.concatenate([[True], apart]), np.concatenate([apart, [True]])
    return np.column_stack([begins[first[: len(begins)]], ends[last[: len(ends)]]])


def run_paths(lines: pd.DataFrame) -> dict[int, RunPath]:
    """The paths of the fitted lines, by row number of ``lines`` (from `fit_lines`).

    Raises:
        TrackError: an end's column is missing; the errors' columns may be.
    """
    ends = {
        end: np.column_stack([column(lines, f"x_{end}_cm"), column(lines, f"y_{end}_cm")]) for end in ("start", "end")
    }
    known = {
        name: np.nan_to_num(column(lines, name)) if name in lines.columns else np.zeros(len(lines))
        for name in ("bend_cm", "pivot_cm", "sigma_pivot_cm", "sigma_theta_rad", "sigma_bend_cm")
    }
    found: dict[int, RunPath] = {}
    for row in np.flatnonzero(np.isfinite(ends["start"]).all(axis=1) & np.isfinite(ends["end"]).all(axis=1)).tolist():
        way = ends["end"][row] - ends["start"][row]
        length = float(np.hypot(*way))
        if length > 0.0:
            found[row] = RunPath(
                ends["start"][row], way / length, length, **{name: float(value[row]) for name, value in known.items()}
            )
    return found
