"""Latency and health of many sessions: what is followed over time, and which sessions stand out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.pulls import outlying
from analysis.report.conclusion import Finding, Problem
from analysis.report.result import ENDED_WELL
from analysis.report.sheetrows import Rows, numbers, texts
from analysis.report.words import count, listed, number

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Vital:
    """One thing that is followed: ``values`` (n,) of the whole sessions, which of them are ``outlying``."""

    title: str
    unit: str
    values: Floats
    outlying: Bools


# title, unit, column, column it is a share of or "", factor, least distance from the others that is worth a word
_FOLLOWED = (
    ("delay at the light's beginning", "ms", "latency_entering_s", "", 1e3, 2.0),
    ("delay at the light's end", "ms", "latency_leaving_s", "", 1e3, 2.0),
    ("jitter of crossings", "ms", "latency_jitter_s", "", 1e3, 1.0),
    ("chords, robot − camera", "cm", "chords_bias_cm", "", 1.0, 0.05),
    ("track's mean NIS (2 is right)", "", "filter_mean_nis", "", 1.0, 0.1),
    ("runs given up", "%", "runs_given_up", "runs", 100.0, 0.5),
    ("links lost", "", "link_losses", "", 1.0, 0.2),
    ("frames dropped", "%", "frames_dropped", "frames", 100.0, 0.2),
)


def vitals(rows: Rows) -> list[Vital]:
    """Everything that is followed and known of any session; what is nought in all of them is left out."""
    found: list[Vital] = []
    for title, unit, column, whole, factor, least in _FOLLOWED:
        values = factor * numbers(rows.whole, column)
        if whole:
            of = numbers(rows.whole, whole)
            values = np.divide(values, of, out=np.full(values.shape, np.nan), where=of > 0)
        if np.isfinite(values).any() and np.nanmax(np.abs(values)) > 0:
            found.append(Vital(title, unit, values, outlying(values, least=least)))
    return found


def health_finding(rows: Rows) -> list[Finding]:
    """How the sessions ended, what was lost on the way, and who stands out."""
    whole = rows.whole
    said: list[str] = []
    early = [state for state in texts(whole, "end_state") if state and state not in ENDED_WELL]
    if early:
        kinds = listed([f"{early.count(state)} {state}" for state in dict.fromkeys(early)])
        said.append(f"{count(len(early), 'session')} ended early ({kinds}).")
    resumed = int((numbers(whole, "parts") > 1).sum())
    if resumed:
        said.append(f"{count(resumed, 'session')} resumed.")
    for vital in vitals(rows):
        if vital.outlying.any():
            names = [
                f"{whole['session'].iloc[index]} ({number(float(vital.values[index]))} {vital.unit})".replace(" )", ")")
                for index in np.flatnonzero(vital.outlying).tolist()
            ]
            middle = f"{number(float(np.nanmedian(vital.values)))} {vital.unit}".strip()
            said.append(f"Unlike the others in {vital.title.split(' (')[0]} ({middle} in the middle): {listed(names)}.")
    known = [column for column in ("end_state", "latency_entering_s") if _is_known(rows, column)]
    if not said and not known:
        return []
    return [Finding("Health", " ".join(said) or "No session stands out.")]


def _is_known(rows: Rows, column: str) -> bool:
    values = rows.whole[column]
    return bool((values.notna() & (values != "")).any())


def health_problems(rows: Rows) -> list[Problem]:
    """What must not be trusted: changed files, a track whose errors are wrong."""
    problems: list[Problem] = []
    changed = texts(rows.whole[rows.whole["checksums_ok"] == 0.0], "session")
    if changed:
        problems.append(
            Problem(
                f"The files of {listed(changed)} are not those of SHA256SUMS: they were changed or damaged.",
                "Compare with a copy from before; `chordlab finalize` writes the sums anew where it was meant.",
            )
        )
    doubtful = texts(rows.whole[rows.whole["filter_honest"] == 0.0], "session")
    if doubtful:
        problems.append(
            Problem(
                f"The camera's track has other errors than it states: {listed(doubtful)}.",
                "Calibrate the camera, check focus and exposure, and trust these sessions' isotropy less.",
            )
        )
    return problems
