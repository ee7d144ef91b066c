"""A batch's sessions by shape, against what exact moments and simulation predict."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lab.batch.rows import SIDES

Floats = NDArray[np.float64]

_BY = ["shape", *(f"truth_{side}_{unit}" for side, unit in SIDES)]


def per_shape(table: pd.DataFrame) -> pd.DataFrame:
    """One row a shape and size: how many sessions, how many right, errors and their spread; docs/batch.md names all.

    ``table`` is of `lab.batch.analyse`; sessions with an error, or without an estimate, are left out of what they lack.
    """
    whole = table[(table["error"] == "") & table["shape"].notna()]
    rows = [
        {**dict(zip(_BY, key, strict=True)), **dict(_summary(sessions))}
        for key, sessions in whole.groupby(_BY, sort=True)
    ]
    columns = [*_BY, *(name for name, _ in _summary(whole.iloc[:0]))]
    return pd.DataFrame(rows, columns=columns)


def _summary(sessions: pd.DataFrame) -> Iterator[tuple[str, Any]]:
    yield "sessions", len(sessions)
    yield "lines_mean", _mean(_values(sessions, "lines"))
    yield "right_share", _mean(_values(sessions, "recognised_right"))
    for side, unit in SIDES:
        truth = _values(sessions, f"truth_{side}_{unit}")
        error = _values(sessions, f"{side}_error_rel")
        yield f"{side}_error_rel", _mean(error)
        yield f"{side}_error_sigma_rel", _sd(error) / np.sqrt(max(1, error.size))
        for name in (f"{side}_z", f"{side}_z_exact"):
            z = _values(sessions, name)
            yield f"{name}_mean", _mean(z)
            yield f"{name}_sd", _sd(z)
        for kind in ("exact", "simulated"):
            sigma = _values(sessions, f"{kind}_sigma_{side}_{unit}")
            yield f"{kind}_sigma_{side}_rel", float(np.sqrt(_mean(sigma**2))) / _mean(truth)


def _values(sessions: pd.DataFrame, column: str) -> Floats:
    """What is known of a column."""
    values = sessions[column].to_numpy(dtype=float, na_value=np.nan)
    return values[np.isfinite(values)]


def _mean(values: Floats) -> float:
    return float(values.mean()) if values.size else float("nan")


def _sd(values: Floats) -> float:
    return float(values.std(ddof=1)) if values.size > 1 else float("nan")
