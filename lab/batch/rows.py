"""Many stored sessions, analysed one by one on every core; a broken one is a row with its reason."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import pandas as pd

from lab.base.errors import ChordlabError, RequestError
from lab.review import review
from lab.store import MANIFEST

Progress = Callable[[int, int], None]

_TWINS = "; "


def sessions_below(roots: Sequence[Path]) -> list[Path]:
    """Every session folder at or below the roots, in order. Raises RequestError when there is none."""
    for root in roots:
        if not root.is_dir():
            raise RequestError(f"{root}: no such folder; name folders that hold sessions")
    found = sorted({manifest.parent for root in roots for manifest in root.rglob(MANIFEST)})
    if not found:
        raise RequestError(f"no session below {', '.join(map(str, roots))}; a session folder holds a {MANIFEST}")
    return found


def row_of(folder: Path) -> dict[str, Any]:
    """One session's figures as one flat row; ``error`` says why there are none."""
    try:
        summary = review(folder, report=False, workers=1)
    except (ChordlabError, OSError, ValueError, KeyError) as error:
        return {"session": folder.name, "folder": str(folder), "error": " ".join(str(error).split()) or repr(error)}
    row: dict[str, Any] = {"session": folder.name, "folder": str(folder), "error": ""}
    row.update(_flat(summary))
    return row


def _flat(summary: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in summary.items():
        if name in ("folder", "report"):
            continue
        if isinstance(value, dict):
            for inner, item in value.items():  # pyright: ignore[reportUnknownVariableType]: a summary's section
                if inner == "twins" and isinstance(item, list):
                    yield f"{name}_{inner}", _TWINS.join(map(str, item))  # pyright: ignore[reportUnknownArgumentType]: names
                elif not isinstance(item, (list, dict)):
                    yield f"{name}_{inner}", item
        else:
            yield name, value


def analyse(folders: Sequence[Path], *, workers: int, progress: Progress | None = None) -> pd.DataFrame:
    """Analyse sessions on ``workers`` processes; one row each, in the order given."""
    rows: dict[Path, dict[str, Any]] = {}
    if workers == 1 or len(folders) == 1:
        for done, folder in enumerate(folders, start=1):
            rows[folder] = row_of(folder)
            if progress is not None:
                progress(done, len(folders))
    else:
        # spawn, not fork: the parent may hold threads
        with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
            pending = {pool.submit(row_of, folder): folder for folder in folders}
            for done, future in enumerate(as_completed(pending), start=1):
                rows[pending[future]] = future.result()
                if progress is not None:
                    progress(done, len(folders))
    return pd.DataFrame([rows[folder] for folder in folders])


def _is_right(row: pd.Series[Any]) -> bool:
    """Whether a session's answer is its shape; a twin's name, which no lines tell apart, is as good."""
    named = {row["recognised_name"], *str(row.get("recognised_twins", "")).split(_TWINS)}
    unknown = row.get("recognised_unknown")
    return row["shape"] in named and not (unknown is not None and unknown > 0.5)


def per_shape(table: pd.DataFrame) -> pd.DataFrame:
    """Per shape: sessions, share recognised, mean relative error of A and P and their spread in standard errors."""
    if "shape" not in table.columns:
        return pd.DataFrame()
    whole = table[table["error"] == ""]
    frame = pd.DataFrame(
        {
            "shape": whole["shape"],
            "right": [_is_right(row) for _, row in whole.iterrows()],
            "area_error": whole["robot_area_cm2"] / whole["truth_area_cm2"] - 1,
            "perimeter_error": whole["robot_perimeter_cm"] / whole["truth_perimeter_cm"] - 1,
            "area_z": (whole["robot_area_cm2"] - whole["truth_area_cm2"]) / whole["robot_sigma_area_cm2"],
            "perimeter_z": (whole["robot_perimeter_cm"] - whole["truth_perimeter_cm"])
            / whole["robot_sigma_perimeter_cm"],
        }
    )
    means = frame.groupby("shape").mean(numeric_only=False)
    means.insert(0, "sessions", frame.groupby("shape").size())
    return means.reset_index()
