"""The report's tables: rows of text, units in the headings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import pandas as pd

from analysis.budget import Budget
from analysis.compare import deviation
from analysis.estimate import Estimate
from analysis.figures.budget import name_of
from analysis.figures.camera import agreement
from analysis.report.problems import lines_to_tell_apart
from analysis.report.result import SessionResult
from analysis.report.words import number, p_value, percent, plus_minus, probability, signed, signed_with

_MOST_ENTRIES = 12


@dataclass(frozen=True, slots=True)
class Table:
    """A table as text. The first column heads its row; ``note`` stands under it. A ``told`` one ends in words."""

    name: str
    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    told: bool = False


def tables_of(result: SessionResult) -> list[Table]:
    """Give the tables that the session has something to put in."""
    measured = result.measured
    tables: list[Table] = []
    if measured is not None:
        tables += [_sizes(result, measured), _milestones(result)]
    if result.ranking:
        tables.append(_ranking(result))
    if result.isotropy is not None and result.isotropy.p_values:
        rows = tuple((name, p_value(value)) for name, value in result.isotropy.p_values.items())
        note = "After correction for the number of tests. Below 0.05 the runs are not random enough."
        tables.append(Table("isotropy", "Tests of the runs' randomness", ("test", "p-value"), rows, note))
    chords = _chords(result)
    if chords is not None:
        tables.append(chords)
    if result.budget is not None:
        tables.append(_budget(result.budget))
    return tables


def _sizes(result: SessionResult, measured: Estimate) -> Table:
    exact, off = result.exact, deviation(measured, result.exact)
    heads = ["", "robot", "projected shape", "deviation (%)", "deviation (σ)"]
    area = [
        "area A",
        plus_minus(measured.area_cm2, measured.sigma_area_cm2, "cm²"),
        f"{number(exact.area_cm2)} cm²",
        signed(100 * off.area_rel),
        signed(off.z_area),
    ]
    perimeter = [
        "perimeter P",
        plus_minus(measured.perimeter_cm, measured.sigma_perimeter_cm, "cm"),
        f"{number(exact.perimeter_cm)} cm",
        signed(100 * off.perimeter_rel),
        signed(off.z_perimeter),
    ]
    if result.camera is not None:
        heads.append("camera")
        area.append(plus_minus(result.camera.area_cm2, result.camera.sigma_area_cm2, "cm²"))
        perimeter.append(plus_minus(result.camera.perimeter_cm, result.camera.sigma_perimeter_cm, "cm"))
    note = (
        f"± is one standard error, estimated from the robot's own {measured.n} lines. σ is the exact scatter that so "
        f"many lines have on the projected shape; so large a joint deviation has probability {p_value(off.p_value)}."
    )
    return Table("sizes", "Area and perimeter", tuple(heads), (tuple(area), tuple(perimeter)), note)


def _milestones(result: SessionResult) -> Table:
    ordered = result.estimates.sort_values("n")
    last = int(np.asarray(ordered["n"])[-1])
    wanted = {step * 10**decade for decade in range(7) for step in (1, 3)} | {last}
    chosen = ordered[ordered["n"].isin([n for n in wanted if n <= last])]
    recognised = {"leading", "posterior"} <= set(ordered.columns)
    heads = ("N", "run", "A (cm²)", "P (cm)", "correlation", *(("leading", "posterior") if recognised else ()))
    rows: list[tuple[str, ...]] = []
    for record in cast("list[dict[str, object]]", chosen.to_dict("records")):
        row = [
            _whole(record["n"]),
            _whole(record["line"]),
            _pair(record["area_cm2"], record["sigma_area_cm2"]),
            _pair(record["perimeter_cm"], record["sigma_perimeter_cm"]),
            number(_real(record["correlation"]), 2).replace("unknown", "–"),
        ]
        if recognised:
            leading = record["leading"]
            known = isinstance(leading, str) and bool(leading)
            row += [result.title_of(str(leading)) if known else "–", _share(record["posterior"]) if known else "–"]
        rows.append(tuple(row))
    note = "N counts runs that crossed the shape; the run's number counts those that missed it as well, from 0."
    return Table("milestones", "The estimates as lines arrived", heads, tuple(rows), note)


def _ranking(result: SessionResult) -> Table:
    heads = ("entry", "posterior", "A (cm²)", "P (cm)", "lines to tell it from the projected shape")
    rows: list[tuple[str, ...]] = []
    for name, posterior in result.ranking[:_MOST_ENTRIES]:
        entry = result.dictionary.get(name)
        sizes = ("–", "–", "–")
        if entry is not None:
            needed = lines_to_tell_apart(result.exact, entry, result.stop_at)
            lines = "projected" if name == result.name else "not by (A, P)" if needed > 1e7 else _two_digits(needed)
            sizes = (number(entry.area_cm2), number(entry.perimeter_cm), lines)
        rows.append((result.title_of(name), probability(posterior), *sizes))
    left = len(result.ranking) - len(rows)
    note = f"By theory, from (A, P) alone, to reach {percent(result.stop_at, 0)} in 95 of 100 sessions."
    note += f" {left} less probable entries are not shown." if left > 0 else ""
    return Table("ranking", "The dictionary, the most probable first", heads, tuple(rows), note)


def _chords(result: SessionResult) -> Table | None:
    found = None if result.chord_pairs is None else agreement(result.chord_pairs)
    if found is None:
        return None
    low, high = found.limits_cm
    rows = [
        ("matched chords", str(found.chords)),
        ("robot − camera, mean", f"{signed(found.bias_cm, 2)} cm"),
        ("robot − camera, standard deviation", f"{number(found.sd_cm, 2)} cm"),
        ("limits of agreement (95 %)", f"{signed(low, 2)} to {signed(high, 2)} cm"),
        ("scale, robot : camera", number(found.scale, 4)),
    ]
    if result.chords_missed is not None:
        rows.append(("chords missed by the robot", str(result.chords_missed)))
    if result.chords_extra is not None:
        rows.append(("chords only the robot saw", str(result.chords_extra)))
    return Table("chords", "Robot against camera, chord by chord", ("", "value"), tuple(rows))


def _budget(budget: Budget) -> Table:
    rows = [
        (
            name_of(area.term),
            signed_with(area.percent, area.sigma_percent),
            signed_with(perimeter.percent, perimeter.sigma_percent),
            area.how,
        )
        for area, perimeter in zip(budget.area.terms, budget.perimeter.terms, strict=True)
    ]
    rows.append(("seen", signed(budget.area.seen_percent), signed(budget.perimeter.seen_percent), "robot − truth"))
    closed = "It adds up to what was seen, within its errors." if budget.closes else "It does NOT add up within 3 σ."
    counted = " and ".join(
        f"{number(abs(side.counting_sigmas))} σ in {name}"
        for name, side in (("A", budget.area), ("P", budget.perimeter))
    )
    note = f"Per cent of the truth, ± one standard error. {closed} Counting statistics is off by {counted}."
    return Table("budget", "Error budget", ("term", "A (%)", "P (%)", "how"), tuple(rows), note, told=True)


def history_table(result: SessionResult) -> Table | None:
    """Give what befell the session, its parts, notes, pauses and lost links; None if nothing did."""
    if not result.history:
        return None
    rows = tuple((number(t_s), text) for t_s, text in result.history)
    return Table("history", "The session's log", ("time (s)", "what happened"), rows, told=True)


def provenance_of(result: SessionResult) -> list[Table]:
    """Give one table for each section of the provenance; nested settings become ``outer.inner``."""
    tables: list[Table] = []
    for section, values in result.provenance.items():
        rows = tuple(_flat(values))
        if rows:
            tables.append(Table(f"provenance-{len(tables)}", section, ("", "value"), rows))
    return tables


def _flat(values: Mapping[str, object], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            rows += _flat(cast("Mapping[str, object]", value), f"{prefix}{key}.")
            continue
        parts = _parts(value)
        if any(isinstance(part, Mapping) for part in parts):
            rows += _flat({str(index): part for index, part in enumerate(parts, start=1)}, f"{prefix}{key}.")
        else:
            rows.append((f"{prefix}{key}", _written(value)))
    return rows


def _parts(value: object) -> Sequence[object]:
    return cast("Sequence[object]", value) if isinstance(value, list | tuple) else ()


def _written(value: object) -> str:
    if parts := _parts(value):
        return ", ".join(map(_written, parts))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "–" if value in (None, [], ()) else f"{value:.6g}" if isinstance(value, float) else str(value)


def _real(value: object) -> float:
    return float(str(value)) if not pd.isna(value) else float("nan")  # pyright: ignore[reportArgumentType, reportCallIssue]


def _whole(value: object) -> str:
    return str(int(_real(value)))


def _pair(value: object, sigma: object) -> str:
    return plus_minus(_real(value), _real(sigma), "").removesuffix(" (uncertainty unknown)").strip()


def _share(value: object) -> str:
    return probability(_real(value)) if np.isfinite(_real(value)) else "–"


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):,.0f}".replace(",", "\u202f")
