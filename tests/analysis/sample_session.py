"""A session made with numpy and shapely alone: lines thrown over a polygon, no code of the subject in its truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import shapely
from shapely import LineString, Polygon, box
from shapely.geometry.base import BaseGeometry

from analysis.figures.values import Entry, Isotropy
from analysis.report.result import SessionResult

ARENA = box(-60, -45, 60, 45)
SQUARE = box(-14, -14, 14, 14)
TOWER = Polygon([(-16, -28), (-9, -28), (-5, -12), (5, -12), (9, -28), (16, -28), (5, 4), (2, 30), (-2, 30), (-5, 4)])
CIRCLE = shapely.Point(0, 0).buffer(16, quad_segs=45)
TRIANGLE = Polygon([(-18, -14), (18, -14), (0, 17)])
SHAPES: dict[str, tuple[str, BaseGeometry]] = {
    "square": ("Square", SQUARE),
    "eiffel": ("Eiffel Tower", TOWER),
    "circle": ("Circle", CIRCLE),
    "triangle": ("Triangle", TRIANGLE),
}


def throw(rng: np.random.Generator, runs: int) -> np.ndarray:
    """Start and end points (runs, 4) of uniform isotropic chords of the arena."""
    ends = np.empty((0, 4))
    radius = np.hypot(60, 45)
    while len(ends) < runs:
        theta, p = rng.uniform(0, np.pi, runs), rng.uniform(-radius, radius, runs)
        along = np.stack([-np.sin(theta), np.cos(theta)], axis=1)
        foot = p[:, None] * np.stack([np.cos(theta), np.sin(theta)], axis=1)
        segments = shapely.linestrings(np.stack([foot - 80 * along, foot + 80 * along], axis=1))
        inside = shapely.intersection(segments, ARENA)
        inside = inside[shapely.length(inside) > 1e-6]
        ends = np.concatenate([ends, shapely.get_coordinates(inside).reshape(-1, 4)])
    return ends[:runs]


def chords_of(ends: np.ndarray, geometry: BaseGeometry) -> list[tuple[float, float]]:
    """(in, out) distances along one run."""
    cut = shapely.intersection(LineString(ends.reshape(2, 2)), geometry)
    parts = [part for part in shapely.get_parts(cut) if isinstance(part, LineString) and part.length > 0]
    start = ends[:2]
    pairs = [sorted(np.hypot(*(np.asarray(part.coords) - start).T)[[0, -1]]) for part in parts]
    return sorted((float(a), float(b)) for a, b in pairs)


def pair_sum(chords: list[tuple[float, float]], power: int) -> float:
    """𝓛_n by its definition: all unordered pairs of crossings, + for unlike kinds, − for like."""
    points = [(s, sign) for chord in chords for s, sign in zip(chord, (1, -1), strict=True)]
    return sum(
        -(points[i][1] * points[j][1]) * abs(points[j][0] - points[i][0]) ** power
        for i in range(len(points))
        for j in range(i + 1, len(points))
    )


@cache
def dictionary() -> dict[str, Entry]:
    """The entries of SHAPES."""
    return {key: entry_of(*value, np.random.default_rng(99)) for key, value in SHAPES.items()}


def entry_of(title: str, geometry: BaseGeometry, rng: np.random.Generator, lines: int = 600) -> Entry:
    """Entry with its one-line covariance from a bootstrap over simulated lines: no delta method."""
    values = invariants(throw(rng, 4 * lines), geometry)
    values = values[values[:, 0] > 0][:lines]
    block = 150
    picks = rng.integers(0, len(values), (600, block))
    k, l1, l3 = values[picks].mean(axis=1).T
    area = np.pi / 3 * l3 / l1
    perimeter = np.pi * area * k / l1
    return Entry(title, geometry.area, geometry.length, np.cov(area, perimeter) * block)


def invariants(ends: np.ndarray, geometry: BaseGeometry) -> np.ndarray:
    """(k, 𝓛_1, 𝓛_3) for each run."""
    found = [chords_of(row, geometry) for row in ends]
    return np.array([(len(chords), pair_sum(chords, 1), pair_sum(chords, 3)) for chords in found])


def session(
    name: str = "eiffel",
    *,
    runs: int = 400,
    seed: int = 7,
    video: bool = True,
    speed_error: float = 0.0,
    **changes: Any,
) -> SessionResult:
    """A whole session. ``speed_error`` stretches what the robot believes to have rolled."""
    rng = np.random.default_rng(seed)
    title, geometry = SHAPES[name]
    ends = throw(rng, runs)
    lines, crossings, true_crossings, track, pairs = [], [], [], [], []
    for line, row in enumerate(ends):
        chords = chords_of(row, geometry)
        length = float(np.hypot(row[2] - row[0], row[3] - row[1]))
        seen = [((1 + speed_error) * a, (1 + speed_error) * b) for a, b in chords]
        seen = [(a + rng.normal(0, 0.15), b + rng.normal(0, 0.15)) for a, b in seen]
        seen = [(a, max(b, a + 0.05)) for a, b in seen]
        start = 6.0 * line
        lines.append(
            {
                "line": line,
                "t_start_s": start,
                "t_end_s": start + length / 25,
                "length_cm": length,
                "speed_cm_s": 25.0,
                "k": len(seen),
                "l1_cm": pair_sum(seen, 1),
                "l3_cm3": pair_sum(seen, 3),
                "ended": "bump",
            }
        )
        for table, stretches in ((crossings, seen), (true_crossings, chords)):
            edges = [edge for stretch in stretches for edge in zip(stretch, (True, False), strict=True)]
            for order, (s, entering) in enumerate(edges):
                table.append({"line": line, "order": order, "t_s": start + s / 25, "s_cm": s, "entering": entering})
        pairs += [
            {"robot_length_cm": b - a, "true_length_cm": d - c} for (a, b), (c, d) in zip(seen, chords, strict=True)
        ]
        s = np.arange(0, length, 25 / 30)
        places = row[:2] + np.outer(s / length, row[2:] - row[:2])
        lit = np.any([(s >= a) & (s <= b) for a, b in chords], axis=0) if chords else np.zeros(len(s), bool)
        track.append(
            pd.DataFrame(
                {"line": line, "t_s": start + s / 25, "x_cm": places[:, 0], "y_cm": places[:, 1], "led_on": lit}
            )
        )
    line_table = pd.DataFrame(lines)
    entries = dictionary()
    estimates = running(line_table, entries)
    result = SessionResult(
        name=name,
        title=title,
        geometry=geometry,
        arena=ARENA,
        lines=line_table,
        crossings=pd.DataFrame(crossings),
        estimates=estimates,
        exact=entries[name],
        dictionary=entries,
        ranking=ranking(estimates, entries),
        session="2026-11-23T1042_sample",
        provenance={"run": {"seed": seed, "settings digest": "ab12"}, "devices": {"robot": "virtual"}},
    )
    if video:
        theta, p = normal_form(ends)
        result = replace(
            result,
            track=pd.concat(track, ignore_index=True),
            true_lines=pd.DataFrame(
                np.column_stack([ends, theta, p]),
                columns=["x_start_cm", "y_start_cm", "x_end_cm", "y_end_cm", "theta_rad", "p_cm"],
            ).assign(line=np.arange(runs)),
            true_crossings=pd.DataFrame(true_crossings),
            chord_pairs=pd.DataFrame(pairs),
            chords_missed=3,
            chords_extra=1,
            isotropy=Isotropy(
                rng.uniform(size=runs),
                rng.uniform(size=runs),
                {"Rayleigh": 0.61, "Cramér–von Mises": 0.34},
                True,
                "The runs are isotropic and homogeneous.",
            ),
        )
    return replace(result, **changes)


def normal_form(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(theta, p) of the runs."""
    step = ends[:, 2:] - ends[:, :2]
    theta = (np.arctan2(step[:, 1], step[:, 0]) + np.pi / 2) % np.pi
    return theta, ends[:, 0] * np.cos(theta) + ends[:, 1] * np.sin(theta)


def running(lines: pd.DataFrame, entries: dict[str, Entry]) -> pd.DataFrame:
    """The estimates table by plain means; sigmas from a jackknife over the lines so far."""
    crossing = lines[lines["k"] > 0]
    values = crossing[["k", "l1_cm", "l3_cm3"]].to_numpy(float)
    rows = []
    for n in range(1, len(values) + 1):
        total = values[:n].sum(axis=0)
        area, perimeter = area_perimeter(total)
        if n > 2:
            left_out = area_perimeter(total - values[:n])
            cov = np.cov(np.stack(left_out)) * (n - 1) ** 2 / n
            s_a, s_p = np.sqrt(np.diag(cov))
            rho = cov[0, 1] / (s_a * s_p)
        else:
            s_a = s_p = rho = np.nan
        rows.append((n, crossing["line"].iloc[n - 1], crossing["t_end_s"].iloc[n - 1], area, perimeter, s_a, s_p, rho))
    table = pd.DataFrame(
        rows,
        columns=["n", "line", "t_s", "area_cm2", "perimeter_cm", "sigma_area_cm2", "sigma_perimeter_cm", "correlation"],
    )
    ranked = [posterior_of(row.n, row.area_cm2, row.perimeter_cm, entries) for row in table.itertuples()]
    table["leading"] = [max(post, key=post.__getitem__) for post in ranked]
    table["posterior"] = [max(post.values()) for post in ranked]
    return table


def area_perimeter(total: np.ndarray) -> tuple[Any, Any]:
    """Eq. 1 and Cauchy from sums of (k, 𝓛_1, 𝓛_3)."""
    k, l1, l3 = np.moveaxis(np.asarray(total), -1, 0)
    area = np.pi / 3 * l3 / l1
    return area, np.pi * area * k / l1


def posterior_of(n: int, area: float, perimeter: float, entries: dict[str, Entry]) -> dict[str, float]:
    """Gaussian posterior over the entries, equal priors."""
    logs = {}
    for name, entry in entries.items():
        cov = entry.covariance_per_line / n
        gap = np.array([area - entry.area_cm2, perimeter - entry.perimeter_cm])
        logs[name] = -0.5 * (gap @ np.linalg.solve(cov, gap) + np.log(np.linalg.det(cov)))
    top = max(logs.values())
    weights = {name: np.exp(value - top) for name, value in logs.items()}
    return {name: float(weight / sum(weights.values())) for name, weight in weights.items()}


def ranking(estimates: pd.DataFrame, entries: dict[str, Entry]) -> list[tuple[str, float]]:
    """(name, posterior) at the last estimate."""
    if estimates.empty:
        return []
    last = estimates.iloc[-1]
    post = posterior_of(int(last["n"]), last["area_cm2"], last["perimeter_cm"], entries)
    return sorted(post.items(), key=lambda item: -item[1])
