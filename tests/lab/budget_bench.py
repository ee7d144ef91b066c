"""Sessions with one planted fault, made with NumPy and shapely alone: no code of the budget is in their truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import shapely
from shapely import affinity, box

from analysis.estimate import estimate
from analysis.quadrature import exact_moments
from lab.settings.load import load_settings
from lab.store.layout import LIGHT, line_folder
from lab.store.reader import SessionReader
from tracking.runs import TRUE_LINES

TOWER = shapely.Polygon(
    [(-20, -28), (-11, -28), (-6, -12), (6, -12), (11, -28), (20, -28), (6, 4), (2.5, 30), (-2.5, 30), (-6, 4)]
)
SQUARE = box(-14, -14, 14, 14)
BLOCK = box(-20, -16, 20, 16)
LEVELS = {"dark_lux": 20.0, "low_lux": 65.0, "mid_lux": 70.0, "high_lux": 75.0, "bright_lux": 120.0}
_SUNFLOWER = 80
_GOLDEN = np.pi * (3 - np.sqrt(5))


@dataclass(frozen=True)
class Faults:
    """What is wrong: factors, cm and s; the defaults are a perfect robot that reads every millimetre."""

    told_cm_s: float = 4.0
    speed: float = 1.0
    speed_spread: float = 0.0
    footprint_cm: float = 0.0
    jitter_s: float = 0.0
    off_later_s: float = 0.0
    delay_s: float = 0.03
    image: float = 1.0
    uneven: float = 0.0
    camera_noise_cm: float = 0.02
    without_video: bool = False


def thrown(rng: np.random.Generator, runs: int, uneven: float) -> np.ndarray:
    """(runs, 2, 2) ends of chords of the arena, in a random sense; directions with the density 1 + uneven cos 2θ."""
    inner = load_settings(None, {}).arena.reachable
    radius = math.hypot(60, 45)
    kept = np.empty((0, 2, 2))
    while len(kept) < runs:
        theta, p = rng.uniform(0, np.pi, 4 * runs), rng.uniform(-radius, radius, 4 * runs)
        accepted = rng.random(4 * runs) * (1 + abs(uneven)) < 1 + uneven * np.cos(2 * theta)
        theta, p = theta[accepted], p[accepted]
        along = (
            np.stack([-np.sin(theta), np.cos(theta)], axis=1) * np.where(rng.random(len(theta)) < 0.5, 1, -1)[:, None]
        )
        foot = p[:, None] * np.stack([np.cos(theta), np.sin(theta)], axis=1)
        cut = shapely.intersection(shapely.linestrings(np.stack([foot - 90 * along, foot + 90 * along], axis=1)), inner)
        cut = cut[shapely.length(cut) > 8]
        kept = np.concatenate([kept, shapely.get_coordinates(cut).reshape(-1, 2, 2)])
    return kept[:runs]


def crossings_of(light: np.ndarray) -> np.ndarray:
    """Fractional indices at which the light passes one half, entering and leaving by turns."""
    above = light >= 0.5
    at = np.flatnonzero(above[1:] != above[:-1])
    return at + (0.5 - light[at]) / (light[at + 1] - light[at])


def pair_sum(s: np.ndarray, power: int) -> float:
    """𝓛_n by its definition."""
    sign = np.where(np.arange(len(s)) % 2 == 0, 1, -1)
    i, j = np.triu_indices(len(s), 1)
    return float(-(sign[i] * sign[j] * np.abs(s[j] - s[i]) ** power).sum())


def bench_session(
    folder: Path, geometry, faults: Faults, seed: int, *, runs: int = 300, moments=None, exact_lines: bool = False
) -> SimpleNamespace:
    """What ``session_budget`` reads of a reviewed session of ``runs`` runs, stored in ``folder`` where it must be.

    ``exact_lines``: the camera's lines and crossings without its noise.
    """
    rng = np.random.default_rng(seed)
    image = affinity.scale(geometry, faults.image, faults.image, origin=(0, 0))
    for part in (geometry, image):
        shapely.prepare(part)
    radius = faults.footprint_cm * np.sqrt((np.arange(_SUNFLOWER) + 0.5) / _SUNFLOWER)
    disc = np.column_stack(
        [radius * np.cos(_GOLDEN * np.arange(_SUNFLOWER)), radius * np.sin(_GOLDEN * np.arange(_SUNFLOWER))]
    )
    if faults.footprint_cm == 0:
        disc = np.zeros((1, 2))
    told, interval = faults.told_cm_s, 0.025
    lines, found, true_lines, true, frames = [], [], [], [], []
    for line, (start, end) in enumerate(thrown(rng, runs, faults.uneven)):
        length = float(np.hypot(*(end - start)))
        along = (end - start) / length
        speed = told / faults.speed / (1 + faults.speed_spread * rng.standard_normal())
        t0 = 1000.0 * line
        clock = t0 + np.arange(rng.random() * interval, length / speed, interval)
        place = (clock - t0) * speed
        spots = start + place[:, None] * along
        points = spots[:, None, :] + disc
        light = shapely.contains_xy(image, points[..., 0], points[..., 1]).mean(axis=1)
        stamp = np.maximum.accumulate(clock + faults.delay_s + faults.jitter_s * rng.standard_normal(len(clock)))
        at = crossings_of(light)
        whole = at.astype(int)
        times = stamp[whole] + (at - whole) * (stamp[whole + 1] - stamp[whole])
        times = times + np.where(np.arange(len(times)) % 2 == 1, faults.off_later_s, 0.0)
        s_cm = told * (times - t0)
        k = len(s_cm) // 2
        l1, l3 = (pair_sum(s_cm, 1), pair_sum(s_cm, 3)) if k else (0.0, 0.0)
        lines.append((line, "", length * faults.speed, k, l1, l3, "bump", True, 1.0, False, False))
        found += [(line, order, t, s, order % 2 == 0) for order, (t, s) in enumerate(zip(times, s_cm, strict=True))]
        normal = np.array([-along[1], along[0]])
        theta, p = math.atan2(normal[1], normal[0]), float(normal @ start)
        if theta < 0:
            theta, p = theta + np.pi, -p
        true_lines.append((line, theta, p, *start, *end, t0, t0 + length / speed, length, 0.05))
        cut = shapely.intersection(shapely.LineString([start, end]), geometry)
        parts = [part for part in shapely.get_parts(cut) if part.length > 1e-6]
        ends = sorted(
            float(np.hypot(*(np.array(c) - start))) for part in parts for c in part.coords[:: len(part.coords) - 1]
        )
        true += [(line, order, t0 + s / speed, s, order % 2 == 0, *(start + s * along)) for order, s in enumerate(ends)]
        t_frame = np.arange(t0, t0 + length / speed, 1 / (2 * told))
        seen = (
            start
            + ((t_frame - t0) * speed)[:, None] * along
            + faults.camera_noise_cm * rng.standard_normal((len(t_frame), 2))
        )
        frames.append(pd.DataFrame({"line": line, "t_s": t_frame, "x_cm": seen[:, 0], "y_cm": seen[:, 1]}))
        if k:
            path = line_folder(folder, line)
            path.mkdir(parents=True)
            noisy = 20 + 100 * light + rng.standard_normal(len(light)) * 0.5
            pd.DataFrame({"t_host_s": stamp, "light_lux": noisy}).to_parquet(path / LIGHT)
    (folder / "manifest.json").write_text('{"schema_version": 2}')
    reader = SessionReader(folder)
    reader.manifest["levels"] = LEVELS
    table = pd.DataFrame(
        lines,
        columns=[
            "line",
            "robot",
            "end_cm",
            "k",
            "l1_cm",
            "l3_cm3",
            "ended",
            "counts",
            "weight",
            "starts_lit",
            "ends_lit",
        ],
    )
    settings = load_settings(
        None,
        {
            "sensor.interval_s": interval,
            "motion.turning": "interior",
            "virtual.footprint_cm": faults.footprint_cm,
            "virtual.blur_px": 0.0,
            "virtual.light_noise_lux": 0.5,
            "virtual.speed_error_sigma": faults.speed_spread,
        },
    )
    filmed = SimpleNamespace(
        track=pd.concat(frames, ignore_index=True),
        lines=pd.DataFrame(
            true_lines,
            columns=[*TRUE_LINES[:10], "rms_cm"],
        ),
        crossings=pd.DataFrame(true, columns=["line", "order", "t_s", "s_cm", "entering", "x_cm", "y_cm"]),
        isotropy=None,
    )
    return SimpleNamespace(
        session=reader,
        settings=settings,
        shape=SimpleNamespace(name="it", geometry=geometry),
        tables=SimpleNamespace(
            lines=table, crossings=pd.DataFrame(found, columns=["line", "order", "t_s", "s_cm", "entering"])
        ),
        moments={"it": moments or exact_moments(geometry)},
        robot=estimate(table["k"], table["l1_cm"], table["l3_cm3"]),
        filmed=None if faults.without_video else filmed,
    )
