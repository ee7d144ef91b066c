"""The batch table as the sheet reads it: every column there and of one kind, whatever the file held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.pulls import FEWEST, extreme_z
from lab.base.errors import RequestError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

NONE_OF_THESE = "none of these"

_TEXT = (
    "session",
    "root",
    "folder",
    "error",
    "shape",
    "recognised_name",
    "recognised_twins",
    "end_state",
    "verdict",
    "robots",
    "firmware",
    "schema_version",
    "chordlab_version",
    "settings_digest",
    "content_digest",
    "seed",
)
_NUMBERS = (
    "lines",
    "runs",
    "truth_area_cm2",
    "truth_perimeter_cm",
    "robot_area_cm2",
    "robot_perimeter_cm",
    "robot_sigma_area_cm2",
    "robot_sigma_perimeter_cm",
    "robot_correlation",
    "exact_sigma_area_cm2",
    "exact_sigma_perimeter_cm",
    "area_error_rel",
    "perimeter_error_rel",
    "area_z",
    "perimeter_z",
    "area_z_exact",
    "perimeter_z_exact",
    "recognised_posterior",
    "recognised_unknown",
    "recognised_right",
    "latency_entering_s",
    "latency_leaving_s",
    "latency_jitter_s",
    "isotropy_p_value",
    "homogeneity_p_value",
    "run_length_p_value",
    "montecarlo_p_value",
    "chords_bias_cm",
    "filter_honest",
    "filter_mean_nis",
    "checksums_ok",
    "runs_given_up",
    "link_losses",
    "frames",
    "frames_dropped",
    "parts",
    "virtual",
)
_TRUTHS = {"true": 1.0, "false": 0.0}


class SheetError(RequestError):
    """The table is none of `chordlab batch`'s. Attribute: the ``missing`` columns."""

    def __init__(self, missing: Sequence[str]) -> None:
        self.missing = tuple(missing)
        super().__init__(f"the batch table lacks {', '.join(missing)}: make it anew with `chordlab batch`")


@dataclass(frozen=True, eq=False)
class Rows:
    """The sessions, in the order of their beginning, with every column the sheet may ask for.

    Attributes:
        every: All sessions; text columns hold "" and numbers NaN where nothing is known. ``started`` is a time.
        simulated: Per shape, what the batch adds to it: ``simulated_sigma_…`` and the like; the index is the shape.
    """

    every: pd.DataFrame
    simulated: pd.DataFrame

    @classmethod
    def of(cls, sessions: pd.DataFrame, shapes: pd.DataFrame) -> Rows:
        """Read the batch's two tables.

        Raises:
            SheetError: There is no column ``session`` or ``error``.
        """
        missing = [name for name in ("session", "error") if name not in sessions.columns]
        if missing:
            raise SheetError(missing)
        columns: dict[str, Any] = {name: _text(sessions, name) for name in _TEXT}
        columns |= {name: _number(sessions, name) for name in _NUMBERS}
        given = sessions["started"] if "started" in sessions.columns else pd.Series(pd.NaT, index=sessions.index)
        columns["started"] = pd.to_datetime(given, errors="coerce", utc=True, format="ISO8601")
        every = pd.DataFrame(columns).reset_index(drop=True)
        every = every.sort_values("started", kind="stable", na_position="last").reset_index(drop=True)
        by_shape = shapes.set_index("shape") if "shape" in shapes.columns else pd.DataFrame()
        return cls(every, by_shape)

    @cached_property
    def broken(self) -> pd.DataFrame:
        """The sessions that could not be analysed."""
        return self.every[self.every["error"] != ""]

    @cached_property
    def whole(self) -> pd.DataFrame:
        """The sessions with figures."""
        return self.every[self.every["error"] == ""].reset_index(drop=True)

    @cached_property
    def measured(self) -> pd.DataFrame:
        """The whole sessions with A and P."""
        known = self.whole[["robot_area_cm2", "robot_perimeter_cm"]].notna().all(axis=1)
        return self.whole[known].reset_index(drop=True)

    @cached_property
    def shapes(self) -> list[str]:
        """The projected shapes, those with most sessions first."""
        counts = self.whole.loc[self.whole["shape"] != "", "shape"].value_counts()
        return sorted((str(name) for name in counts.index), key=lambda name: (-int(counts[name]), name))

    @property
    def exact(self) -> bool:
        """Whether z in units of the exact σ is known; else that of the robot's own stands in for it."""
        return bool(self.measured["area_z_exact"].notna().any())

    def z(self, table: pd.DataFrame, quantity: str) -> Floats:
        """Pulls of "area" or "perimeter" (n,) in units of the predicted σ, where the table knows it."""
        return numbers(table, f"{quantity}_z_exact" if self.exact else f"{quantity}_z")

    def of_shape(self, name: str) -> pd.DataFrame:
        """The measured sessions of one shape."""
        return self.measured[self.measured["shape"] == name]

    @cached_property
    def stray(self) -> Bools:
        """Which measured sessions lie beyond all chance from the others of their shape, or alone from the truth.

        Unit is the predicted σ, or the scatter of the shape's own sessions where that is larger.
        """
        found = np.zeros(len(self.measured), dtype=np.bool_)
        limit = extreme_z(2 * len(self.measured))
        for name in self.shapes:
            own = (self.measured["shape"] == name).to_numpy(dtype=bool)
            for quantity in ("area", "perimeter"):
                z = self.z(self.measured[own], quantity)
                known = z[np.isfinite(z)]
                many = known.size >= FEWEST
                middle = float(np.median(known)) if many else 0.0
                unit = max(1.0, 1.4826 * float(np.median(np.abs(known - middle)))) if many else 1.0
                found[own] |= np.isfinite(z) & (np.abs(z - middle) > limit * unit)
        return found

    @cached_property
    def steady(self) -> pd.DataFrame:
        """The measured sessions without the stray ones: what bias and spread are judged by."""
        return self.measured[~self.stray]


def numbers(table: pd.DataFrame, column: str) -> Floats:
    """A column as floats (n,)."""
    return table[column].to_numpy(dtype=float)


def texts(table: pd.DataFrame, column: str) -> list[str]:
    """A column as text."""
    return [str(value) for value in table[column]]


def _text(table: pd.DataFrame, name: str) -> pd.Series[str]:
    if name not in table.columns:
        return pd.Series("", index=table.index, dtype=object)
    known = table[name].notna()
    said = [str(value) if there else "" for value, there in zip(table[name], known, strict=True)]
    # JSON may have made floats of whole numbers that are missing somewhere
    said = [word.removesuffix(".0") if word[:-2].isdigit() else word for word in said]
    return pd.Series(said, index=table.index, dtype=object)


def _number(table: pd.DataFrame, name: str) -> pd.Series[float]:
    if name not in table.columns:
        return pd.Series(np.nan, index=table.index, dtype=float)
    given = [_TRUTHS.get(str(value).lower(), value) for value in table[name]]
    found = pd.to_numeric(pd.Series(given, index=table.index, dtype=object), errors="coerce").astype(float)
    return found.where(np.isfinite(found))
