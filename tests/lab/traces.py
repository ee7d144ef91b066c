"""What the tests of sessions read with: the log as it stands, and sums by their definitions, no code of the lab."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lab.session.experiment import Finished, run_experiment
from lab.settings.load import load_settings
from robot.virtual.body import Body
from tests.lab.conftest import STARTED
from tests.lab.eventlog import EventLog


@dataclass
class Watched(EventLog):
    """A session, the bodies that rolled in it, and what was said."""

    finished: Finished
    bodies: list[Body]
    said: list[str] = field(default_factory=list)

    @property
    def folder(self) -> Path:
        return self.finished.folder

    def light(self, line: int) -> pd.DataFrame:
        return pd.read_parquet(self.folder / f"lines/{line:06d}/light.parquet")

    def come_to_rest(self) -> bool:
        """Whether every body was told to stop, or had time to stop by itself: half a second brakes, 2 s time out."""
        for body in self.bodies:
            body.advance(body.t_s + 0.5)
        return all(body.speed_cm_s == 0 and not body.moving for body in self.bodies)


class TracedBody(Body):
    """A body that keeps where it stood at each reading of its light sensor: t_s, x_cm, y_cm."""

    def __init__(self, *args, **kwargs) -> None:
        self.trace: list[tuple[float, float, float]] = []
        super().__init__(*args, **kwargs)

    def light_lux(self) -> float:
        self.trace.append((self.t_s, self.x_cm, self.y_cm))
        return super().light_lux()


@contextlib.contextmanager
def bodies_kept() -> Iterator[list[TracedBody]]:
    """Keep hold of the bodies that the virtual bench makes."""
    kept: list[TracedBody] = []

    def make(*args, **kwargs) -> TracedBody:
        kept.append(TracedBody(*args, **kwargs))
        return kept[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lab.bench.world.Body", make)
        yield kept


def rolled(out: Path, *, watch=None, say=None, **overrides) -> Watched:
    """A virtual session without video, whose bodies are kept. ``__`` in a name stands for a dot."""
    keys = {"out": str(out), "camera": "none", "shape": "square", "stop.lines": 12} | {
        name.replace("__", "."): value for name, value in overrides.items()
    }
    said: list[str] = []

    def keep(text: str) -> None:
        said.append(text)
        if say is not None:
            say(text)

    with bodies_kept() as bodies:
        finished = run_experiment(load_settings(None, keys), started=STARTED, watch=watch, say=keep)
    return Watched(finished, bodies, said)


def pair_sum(crossings: list[list], power: int) -> float:
    """𝓛_n by its definition, over all pairs of a line's crossings: + for unlike kinds, − for like."""
    return sum(
        (1 if one[2] != two[2] else -1) * abs(two[1] - one[1]) ** power
        for one, two in itertools.combinations(crossings, 2)
    )


def area_perimeter(lines: list[dict]) -> tuple[float, float]:
    """Area and perimeter by Eq. 1 and Cauchy's theorem, from the crossings of the log's lines and their weights."""
    crossed = [line for line in lines if line["crossings"]]
    weights = [line["weight"] for line in crossed]
    k = np.average([len(line["crossings"]) / 2 for line in crossed], weights=weights)
    l1 = np.average([pair_sum(line["crossings"], 1) for line in crossed], weights=weights)
    l3 = np.average([pair_sum(line["crossings"], 3) for line in crossed], weights=weights)
    area = math.pi / 3 * l3 / l1
    return area, math.pi * area * k / l1
