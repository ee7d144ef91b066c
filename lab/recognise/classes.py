"""Stored sessions sorted into classes of one shape each, without a dictionary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

import numpy as np
import pandas as pd

from analysis.classes import (
    FEWEST_LINES,
    Classes,
    Kind,
    LabelScore,
    Method,
    describe,
    features_of,
    score_labels,
    sort_runs,
)
from analysis.figures.classes import ClassPoint
from lab.base.errors import ChordlabError, RequestError
from lab.store.reader import SessionReader
from lab.store.tables import tables_of

_NEAREST = 2


@dataclass(frozen=True, slots=True)
class Sorted:
    """Sessions, or stretches of them, in classes.

    Attributes:
        points: one a run, with its class.
        classes: how they were found.
        nearest: of each run the runs that look most like it, and how many standard errors away.
        score: against the shapes that the manifests name; None where there is but one shape.
        left_out: sessions that could not be used, and why.
    """

    points: tuple[ClassPoint, ...]
    classes: Classes
    nearest: tuple[tuple[tuple[int, float], ...], ...]
    score: LabelScore | None
    left_out: tuple[tuple[str, str], ...]


def sort_sessions(
    folders: Sequence[Path],
    rng: np.random.Generator,
    *,
    number: int | None = None,
    method: str = "errors",
    lines: int | None = None,
    kind: str = "size",
) -> Sorted:
    """Sort sessions into classes by their whole crossing lines.

    The shapes' names in the manifests are looked at only to score the result.

    Args:
        folders: of the sessions.
        rng: source of the random starts.
        number: of classes; None: as many as are found.
        method: see `analysis.classes`.
        lines: cut each session into runs of so many crossing lines; None: one run each.
        kind: what they are sorted by.

    Raises:
        analysis.classes.TooFewRunsError: fewer than four runs of ten lines or more.
        RequestError: no such method or kind, or too many classes.
    """
    if method not in get_args(Method) or kind not in get_args(Kind):
        raise RequestError(
            f"--method {method} --by {kind} is not known; methods: {', '.join(get_args(Method))}; "
            f"by: {', '.join(get_args(Kind))}"
        )
    names: list[str] = []
    truth: list[str] = []
    runs: list[tuple[pd.Series[float], pd.Series[float], pd.Series[float]]] = []
    left_out: list[tuple[str, str]] = []
    for folder in folders:
        try:
            session = SessionReader(folder)
            table = tables_of(session).lines
        except ChordlabError as error:
            left_out.append((folder.name, " ".join(str(error).split())))
            continue
        crossed = table[table["whole"] & table["counts"] & (table["k"] > 0)]
        stretch = lines or max(len(crossed), 1)
        cut = [crossed.iloc[first : first + stretch] for first in range(0, len(crossed) - stretch + 1, stretch)]
        cut = [part for part in cut if len(part) >= FEWEST_LINES]
        if not cut:
            left_out.append((folder.name, f"only {len(crossed)} whole crossing lines"))
        for place, part in enumerate(cut):
            scale = part["weight"] / part["weight"].mean()
            # lines of unequal weight: ratios of weighted sums are those of weighted vectors
            runs.append((scale * part["k"], scale * part["l1_cm"], scale * part["l3_cm3"]))
            names.append(folder.name if len(cut) == 1 else f"{folder.name}:{place + 1}")
            truth.append(str(session.manifest.get("shape", {}).get("name", "")))
    features = features_of(runs, cast("Kind", kind))
    found = sort_runs(features, rng, method=cast("Method", method), number=number)
    points: list[ClassPoint] = []
    for name, label, run in zip(names, found.labels, runs, strict=True):
        (log_area, log_perimeter), error = describe(*run)
        points.append(
            ClassPoint(name, int(label), len(run[0]), float(np.exp(log_area)), float(np.exp(log_perimeter)), error)
        )
    return Sorted(
        tuple(points),
        found,
        tuple(tuple(features.nearest(run, _NEAREST)) for run in range(len(runs))),
        score_labels(found.labels, truth) if len(set(truth)) > 1 else None,
        tuple(left_out),
    )
