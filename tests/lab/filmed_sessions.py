"""Short filmed sessions with a track that was drawn, not found: what is exported of it is what stands in it."""

from pathlib import Path

import numpy as np
import pandas as pd

from lab.store.reader import SessionReader
from lab.store.tables import tables_of
from tests.lab.conftest import roll


def filmed_alone(root: Path) -> Path:
    """One robot, one line over the square."""
    folder = roll(root, shape="square", camera="virtual", stop__lines=1, seed=13).folder
    parts = [_track(folder, line, seed=line) for line in _lines(folder)]
    pd.concat(parts, ignore_index=True).to_parquet(folder / "track.parquet", index=False)
    return folder


def filmed_pair(root: Path) -> Path:
    """Two robots, two lines."""
    robots = ["virtual", "virtual"]
    folder = roll(root, shape="square", camera="virtual", robot=robots, stop__lines=2, seed=8).folder
    parts = []
    for segment in _lines(folder):
        both = [_track(folder, segment, seed=10 * segment + n).assign(robot=f"SB-7E5{7 + n}") for n in range(2)]
        table = pd.concat(both).sort_values(["frame", "robot"], kind="stable").rename(columns={"line": "segment"})
        parts.append(table.assign(line=-1, identity=0.9))
    pd.concat(parts, ignore_index=True).to_parquet(folder / "track.parquet", index=False)
    return folder


def _lines(folder: Path) -> list[int]:
    return tables_of(SessionReader(folder)).lines["line"].tolist()


def _track(folder: Path, line: int, *, seed: int) -> pd.DataFrame:
    """A robot all over the place; some frames without it."""
    rng = np.random.default_rng(seed)
    stamps = pd.read_parquet(folder / f"lines/{line:06d}/video.frames.parquet")
    count = len(stamps)
    names = ["x_cm", "y_cm", "x_smooth_cm", "y_smooth_cm", "vx_cm_s", "vy_cm_s", "sigma_x_cm", "sigma_y_cm"]
    table = pd.DataFrame(rng.normal(0.0, 20.0, (count, len(names))), columns=names)
    table.loc[rng.random(count) < 0.1, names] = np.nan
    table.insert(0, "line", line)
    table.insert(1, "frame", np.arange(count))
    table.insert(2, "t_s", stamps["t_host_s"])
    table.insert(3, "x_px", rng.uniform(100, 1100, count))
    table.insert(4, "y_px", rng.uniform(100, 600, count))
    return table.assign(led_on=rng.random(count) < 0.5, quality=rng.random(count))
