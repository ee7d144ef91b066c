"""The batch report's tables: per shape, the broken sessions, every session, and where it all comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from analysis.report.result import ENDED_WELL
from analysis.report.sheetrows import NONE_OF_THESE, Rows, texts
from analysis.report.sheetverdict import ShapeFigures, Side, shape_figures
from analysis.report.tables import Table
from analysis.report.words import count, listed, number, p_value, percent, plus_minus, signed, signed_with

_NOTHING = "–"
_SIMULATED = ("simulated_sigma_area_rel", "simulated_sigma_perimeter_rel")


def shapes_table(rows: Rows) -> Table | None:
    """One row a shape: sessions, share recognised, mean error and z of A and P."""
    figures = shape_figures(rows)
    if not figures:
        return None
    simulated = all(column in rows.simulated.columns for column in _SIMULATED)
    heads = ["shape", "sessions", "N, median", "rightly named (95 %)"]
    for symbol in ("A", "P"):
        heads += [f"error of {symbol} (%)", f"mean z of {symbol}", f"spread of z of {symbol}"]
    heads += ["scatter of A, P by Monte Carlo (%)"] if simulated else []
    body = tuple(_shape_row(rows, one, simulated=simulated) for one in figures)
    stray = int(rows.stray.sum())
    note = "± is one standard error. z is the deviation in units of " + (
        "the σ predicted by the shape's exact moments" if rows.exact else "the robot's own σ"
    )
    note += "; its mean should be 0 and its spread 1."
    note += f" {count(stray, 'session')} beyond all chance left out of errors and z." if stray else ""
    return Table("shapes", "Shape by shape", tuple(heads), body, note)


def _shape_row(rows: Rows, one: ShapeFigures, *, simulated: bool) -> tuple[str, ...]:
    right = one.right
    named = f"{percent(right.value, 0)} ({percent(right.low, 0)} – {percent(right.high, 0)})" if right.of else _NOTHING
    row = [one.name, str(len(rows.of_shape(one.name))), _of(one.lines, 0), named]
    for side in one.sides:
        row += [_error(side), _mean(side), _of(side.pull.spread, 2)]
    if simulated:
        known = one.name in rows.simulated.index
        scatter = [float(rows.simulated.loc[one.name, column]) if known else np.nan for column in _SIMULATED]  # pyright: ignore[reportArgumentType]: a number
        row.append(", ".join(_of(100 * value, 1) for value in scatter))
    return tuple(row)


def _error(side: Side) -> str:
    if not np.isfinite(side.error_rel):
        return _NOTHING
    if not np.isfinite(side.error_sigma_rel):
        return signed(100 * side.error_rel)
    return signed_with(100 * side.error_rel, 100 * side.error_sigma_rel)


def _mean(side: Side) -> str:
    return signed_with(side.pull.mean, side.pull.sigma) if side.pull.count else _NOTHING


def _of(value: float, digits: int) -> str:
    return number(value, digits) if np.isfinite(value) else _NOTHING


def broken_table(rows: Rows) -> Table | None:
    """The sessions that could not be analysed, and why."""
    if rows.broken.empty:
        return None
    body = tuple(zip(_labels(rows.broken, rows.every), texts(rows.broken, "error"), strict=True))
    return Table("broken", f"Broken sessions ({len(body)})", ("session", "reason"), body)


def sessions_table(rows: Rows) -> Table:
    """Every session, in the order of their beginning."""
    heads = (
        "session",
        "begun",
        "shape",
        "N",
        "A (cm²)",
        "error (%)",
        "z",
        "P (cm)",
        "error (%)",
        "z",
        "named",
        "posterior (%)",
        "isotropy p",
        "remarks",
    )
    labels = _labels(rows.every, rows.every)
    stray = set(texts(rows.measured[rows.stray], "folder")) | set(texts(rows.measured[rows.stray], "session"))
    body = tuple(
        (label, *_session_row(rows, row, stray)) for label, row in zip(labels, _records(rows.every), strict=True)
    )
    unit = "predicted by the shape's exact moments" if rows.exact else "that the robot states"
    note = (
        f"± is the robot's own standard error; z is in units of the σ {unit}. Times are UTC where the sessions state "
        "their zone."
    )
    return Table("sessions", f"All sessions ({len(body)})", heads, body, note)


Record = Mapping[str, object]


def _records(table: pd.DataFrame) -> list[Record]:
    return [{str(name): value for name, value in row.items()} for row in table.to_dict("records")]


def _session_row(rows: Rows, row: Record, stray: set[str]) -> tuple[str, ...]:
    shape = str(row["shape"]) or _NOTHING
    if row["error"]:
        return (_when(row), shape, *([_NOTHING] * 10), "broken")
    z = "z_exact" if rows.exact else "z"
    cells: list[str] = []
    for quantity, unit in (("area", "cm2"), ("perimeter", "cm")):
        value, sigma = _real(row, f"robot_{quantity}_{unit}"), _real(row, f"robot_sigma_{quantity}_{unit}")
        measured = plus_minus(value, sigma, "").strip() if np.isfinite(sigma) else _of(value, 1)
        error = _real(row, f"{quantity}_error_rel")
        pull = _real(row, f"{quantity}_{z}")
        cells += [
            measured,
            signed(100 * error) if np.isfinite(error) else _NOTHING,
            signed(pull) if np.isfinite(pull) else _NOTHING,
        ]
    p = _real(row, "isotropy_p_value")
    isotropy = p_value(p) if np.isfinite(p) else _NOTHING
    return (_when(row), shape, _of(_real(row, "lines"), 0), *cells, *_named(row), isotropy, _remarks(row, stray))


def _when(row: Record) -> str:
    started = row["started"]
    return f"{started:%Y-%m-%d %H:%M}" if isinstance(started, pd.Timestamp) else _NOTHING


def _named(row: Record) -> tuple[str, str]:
    name, posterior = str(row["recognised_name"]), _real(row, "recognised_posterior")
    if not name:
        return _NOTHING, _NOTHING
    if _real(row, "recognised_unknown") > 0.5:
        return NONE_OF_THESE, _of(100 * _real(row, "recognised_unknown"), 1)
    return name, "> 99.9" if posterior > 0.999 else _of(100 * posterior, 1)


def _remarks(row: Record, stray: set[str]) -> str:
    said: list[str] = []
    if _real(row, "recognised_right") == 0:
        said.append("wrong name")
    if (str(row["folder"]) or str(row["session"])) in stray:
        said.append("beyond all chance from the others")
    if str(row["end_state"]) not in ("", *ENDED_WELL):
        said.append(f"ended: {row['end_state']}")
    if _real(row, "parts") > 1:
        said.append(f"{_real(row, 'parts'):.0f} parts")
    if _real(row, "checksums_ok") == 0:
        said.append("files changed")
    if _real(row, "filter_honest") == 0:
        said.append("track's errors wrong")
    if _real(row, "link_losses") > 0:
        said.append(count(int(_real(row, "link_losses")), "link loss", "link losses"))
    return ", ".join(said)


def _real(row: Record, column: str) -> float:
    value = row[column]
    return float(value) if isinstance(value, (int, float)) else float("nan")


def _labels(table: pd.DataFrame, every: pd.DataFrame) -> list[str]:
    """The sessions' names; where a name occurs twice, the place that tells them apart."""
    twice = set(every.loc[every["session"].duplicated(keep=False), "session"])
    triples = zip(texts(table, "session"), texts(table, "root"), texts(table, "folder"), strict=True)
    return [
        f"{root}/{folder}".strip("/") if name in twice and (root or folder) else name for name, root, folder in triples
    ]


def provenance_table(rows: Rows, made: str) -> Table:
    """When and with what the sessions were recorded; ``made``: which program wrote this sheet."""
    every = rows.every
    started = every["started"].dropna()
    facts: list[tuple[str, str]] = []
    if len(started):
        first, last = f"{started.min():%Y-%m-%d %H:%M}", f"{started.max():%Y-%m-%d %H:%M}"
        facts.append(("begun", first if first == last else f"{first} to {last}"))
    bench = rows.every["virtual"].dropna()
    if len(bench):
        virtual = int((bench > 0.5).sum())
        facts.append(("bench", f"{virtual} virtual, {len(bench) - virtual} real"))
    facts += [
        (title, _values(texts(every, column)))
        for title, column in (
            ("seeds", "seed"),
            ("robots", "robots"),
            ("firmware", "firmware"),
            ("recorded with chordlab", "chordlab_version"),
            ("folders' schema", "schema_version"),
            ("roots", "root"),
        )
        if any(texts(every, column))
    ]
    settings = [value for value in dict.fromkeys(texts(every, "settings_digest")) if value]
    if settings:
        facts.append(("different settings, but for seeds", str(len(settings))))
    facts.append(("this sheet by chordlab", made))
    return Table("provenance", "Sessions", ("", "value"), tuple(facts))


def _values(values: Sequence[str]) -> str:
    """Different values with how often they occur, the most frequent first; of many whole numbers the range."""
    counts = pd.Series([value for value in values if value], dtype=object).value_counts()
    names = [str(name) for name in counts.index]
    if len(names) > 8 and all(name.isdigit() for name in names):
        whole = sorted(int(name) for name in names)
        return f"{len(whole)} different, {whole[0]} to {whole[-1]}"
    if len(names) == 1:
        return names[0]
    return listed([f"{name} ({times})" for name, times in zip(names, counts, strict=True)], 8)
