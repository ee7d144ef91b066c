"""A dictionary as Figs. 2G–J and 3 need it: sizes, scatter, confusions and lines needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.confusion import PlaneConfusion, fewest_lines
from analysis.quadrature import Moments
from analysis.recognition import GaussianRecogniser

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """A dictionary in the (P, A) plane.

    Attributes:
        titles: how each entry is written.
        moments: of each entry.
        recogniser: the paper's, over these entries.
        confusion: how often one is taken for another.
        twins: classes of two or more entries that no lines tell apart.
        by_line: lines for 95 % right of the recogniser that goes line by line; empty where it was not asked.
    """

    titles: Mapping[str, str]
    moments: Mapping[str, Moments]
    recogniser: GaussianRecogniser
    confusion: PlaneConfusion
    twins: tuple[tuple[str, ...], ...]
    by_line: Mapping[str, int | None]

    @classmethod
    def of(
        cls,
        titles: Mapping[str, str],
        moments: Mapping[str, Moments],
        classes: Sequence[Sequence[str]],
        by_line: Mapping[str, int | None] | None = None,
    ) -> Known:
        """Put a dictionary together from its entries' ``moments`` and its ``classes`` of twins."""
        names = list(moments)
        twins = {name: tuple(members) for members in classes for name in members}
        rivals = np.array([[other not in twins.get(name, (name,)) for other in names] for name in names])
        return cls(
            titles,
            moments,
            GaussianRecogniser(moments, classes=classes),
            PlaneConfusion(list(moments.values()), rivals),
            tuple(tuple(members) for members in classes if len(members) > 1),
            by_line or {},
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The entries."""
        return tuple(self.moments)

    def lines_needed(self, confidence: float = 0.95) -> dict[str, int | None]:
        """Lines after which each entry, when true, is the likeliest with ``confidence``; None for never."""
        return {
            name: fewest_lines(lambda n, row=row: self.confusion.error(row, n), 1 - confidence)
            for row, name in enumerate(self.names)
        }

    def rival(self, name: str, n: float) -> str:
        """The entry that ``name`` is taken for most often after ``n`` lines."""
        return self.names[int(np.argmax(self.confusion.errors(self.names.index(name), n)))]

    def nearest(self, name: str) -> tuple[str, float]:
        """The entry whose (P, A) lies nearest, and how far, in standard deviations of one line over ``name``."""
        own = self.moments[name]
        inverse = np.linalg.inv(own.covariance_at(1))
        row = self.names.index(name)
        apart = {
            other: np.array([m.area_cm2 - own.area_cm2, m.perimeter_cm - own.perimeter_cm])
            for column, (other, m) in enumerate(self.moments.items())
            if self.confusion.rivals[row, column]
        }
        far = {other: float(np.sqrt(off @ inverse @ off)) for other, off in apart.items()}
        closest = min(far, key=far.__getitem__)
        return closest, far[closest]

    def table(self, n: float) -> pd.DataFrame:
        """One row an entry: its size, its scatter after ``n`` lines and its chance of being named rightly then."""
        rows: list[dict[str, object]] = []
        for row, (name, m) in enumerate(self.moments.items()):
            covariance = m.covariance_at(n)
            rows.append(
                {
                    "entry": name,
                    "n": n,
                    "perimeter_cm": m.perimeter_cm,
                    "area_cm2": m.area_cm2,
                    "sigma_perimeter_cm": float(np.sqrt(covariance[1, 1])),
                    "sigma_area_cm2": float(np.sqrt(covariance[0, 0])),
                    "correlation": m.correlation,
                    "right": 1 - self.confusion.error(row, n),
                }
            )
        return pd.DataFrame(rows)
