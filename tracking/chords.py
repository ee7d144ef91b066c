"""Chords of a table of crossings, and which of the robot's chords is which of the true ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tracking.runs import column

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

CHORDS = (
    "line", "chord", "s_in_cm", "s_out_cm", "length_cm", "t_in_s", "t_out_s", "x_cm", "y_cm", "sigma_length_cm", "sure",
)  # fmt: skip
MARGIN_CM = 1.0  # an edge may lie this far off by sampling and footprint
_STRAYING = 0.01  # overlap that a cm of straying must buy


def chord_table(crossings: pd.DataFrame) -> pd.DataFrame:
    """Chords of a table of crossings (the robot's or the true ones).

    Returns:
        One row a chord: ``line chord s_in_cm s_out_cm length_cm t_in_s t_out_s x_cm y_cm`` (its centre; NaN where the
        crossings carry no place or time), ``sigma_length_cm`` (0 where they carry none) and ``sure`` (whether it is
        surely there; so is one whose crossings do not say). A crossing without its partner (a missed edge) makes no
        chord.

    Raises:
        TrackError: a column is missing.
    """
    line, s_cm = column(crossings, "line"), column(crossings, "s_cm")
    entering = column(crossings, "entering") > 0.5
    order = np.lexsort((column(crossings, "order"), line))
    line, s_cm, entering = line[order], s_cm[order], entering[order]
    first = np.flatnonzero((line[1:] == line[:-1]) & entering[:-1] & ~entering[1:])
    last = first + 1
    extra = {
        name: column(crossings, name)[order] if name in crossings.columns else np.full(len(line), np.nan)
        for name in ("t_s", "x_cm", "y_cm")
    }
    said = {
        name: column(crossings, name)[order] if name in crossings.columns else np.full(len(line), otherwise)
        for name, otherwise in (("sigma_length_cm", 0.0), ("sure", 1.0))
    }
    number = line[first].astype(np.int64)
    begun = np.searchsorted(number, number, side="left")
    return pd.DataFrame(
        {
            "line": number,
            "chord": np.arange(len(number)) - begun,
            "s_in_cm": s_cm[first],
            "s_out_cm": s_cm[last],
            "length_cm": s_cm[last] - s_cm[first],
            "t_in_s": extra["t_s"][first],
            "t_out_s": extra["t_s"][last],
            "x_cm": (extra["x_cm"][first] + extra["x_cm"][last]) / 2,
            "y_cm": (extra["y_cm"][first] + extra["y_cm"][last]) / 2,
            "sigma_length_cm": said["sigma_length_cm"][first],
            "sure": said["sure"][first] > 0.5,
        },
        columns=list(CHORDS),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Which robot chord is which true one: rows into both tables, overlaps and their lines' offsets, all (m,)."""

    robot: Indices
    true: Indices
    overlap: Floats
    offset_cm: Floats


def _align_line(robot_cm: Floats, true_cm: Floats, near_cm: float, reach_cm: float, least: float) -> Alignment:
    """Match the chords (m, 2) and (n, 2) of one line in order, over offsets within ``reach_cm`` of ``near_cm``.

    Every offset that brings an edge onto its like is tried at once; for each, the matching that keeps the
    order and has the greatest overlap follows by dynamic programming (Needleman and Wunsch 1970). The
    overlap of two chords is that of both with 1 cm on either side, shared over covered, so that short
    chords may miss each other by as much as sampling allows.
    """
    offsets = (true_cm[None, :, :] - robot_cm[:, None, :]).ravel()
    offsets = np.concatenate([[near_cm], offsets[np.abs(offsets - near_cm) <= reach_cm]])
    moved = robot_cm[:, None, :, None] + offsets
    fixed = true_cm[None, :, :, None]
    shared = np.minimum(moved[:, :, 1], fixed[:, :, 1]) - np.maximum(moved[:, :, 0], fixed[:, :, 0]) + 2 * MARGIN_CM
    covered = np.maximum(moved[:, :, 1], fixed[:, :, 1]) - np.minimum(moved[:, :, 0], fixed[:, :, 0]) + 2 * MARGIN_CM
    overlap = np.clip(shared / covered, 0.0, None)
    gain = np.where(overlap >= least, overlap, 0.0)
    m, n = len(robot_cm), len(true_cm)
    best = np.zeros((m + 1, n + 1, len(offsets)))
    for i in range(m):
        for j in range(n):
            skipped = np.maximum(best[i, j + 1], best[i + 1, j])
            best[i + 1, j + 1] = np.maximum(skipped, best[i, j] + gain[i, j])
    chosen = int(np.argmax(best[m, n] - _STRAYING * np.abs(offsets - near_cm)))
    score, worth = best[:, :, chosen], gain[:, :, chosen]
    i, j, pairs = m, n, list[tuple[int, int]]()
    while i and j:
        if worth[i - 1, j - 1] > 0 and score[i, j] == score[i - 1, j - 1] + worth[i - 1, j - 1]:
            i, j = i - 1, j - 1
            pairs.append((i, j))
        elif score[i, j] == score[i - 1, j]:
            i -= 1
        else:
            j -= 1
    index = np.array(pairs[::-1], dtype=np.int64).reshape(-1, 2)
    found = np.asarray(overlap[index[:, 0], index[:, 1], chosen], dtype=float)
    return Alignment(index[:, 0], index[:, 1], found, np.full(len(index), offsets[chosen]))


def align(
    robot: pd.DataFrame, true: pd.DataFrame, *, scale: float, near_cm: float, reach_cm: float, least: float
) -> Alignment:
    """Match two tables of chords, line by line; indices count rows of the tables, which are sorted by line.

    ``scale`` is the length the robot counts for a true cm, ``near_cm`` and ``reach_cm`` say where the offset of a
    line is sought, ``least`` is the overlap below which two chords are different chords.
    """
    names = ["s_in_cm", "s_out_cm"]
    robot_cm, true_cm = np.asarray(robot[names], dtype=float) / scale, np.asarray(true[names], dtype=float)
    robot_line, true_line = column(robot, "line"), column(true, "line")
    found = [Alignment(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0), np.empty(0))]
    for number in np.intersect1d(robot_line, true_line).tolist():
        a, a_end = np.searchsorted(robot_line, [number, number + 1]).tolist()
        b, b_end = np.searchsorted(true_line, [number, number + 1]).tolist()
        one = _align_line(robot_cm[a:a_end], true_cm[b:b_end], near_cm, reach_cm, least)
        found.append(Alignment(a + one.robot, b + one.true, one.overlap, one.offset_cm))
    return Alignment(
        np.concatenate([one.robot for one in found]),
        np.concatenate([one.true for one in found]),
        np.concatenate([one.overlap for one in found]),
        np.concatenate([one.offset_cm for one in found]),
    )
