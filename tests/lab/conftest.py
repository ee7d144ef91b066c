from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import pytest

from lab.session.experiment import Finished, run_experiment
from lab.session.ledger import Progress
from lab.settings.load import load_settings

STARTED = datetime(2026, 11, 23, 10, 42)


@dataclass(frozen=True)
class Rolled:
    finished: Finished
    steps: list[Progress]

    @property
    def folder(self) -> Path:
        return self.finished.folder


def roll(out: Path, **overrides) -> Rolled:
    """A virtual session, without video unless asked."""
    steps: list[Progress] = []
    keys = {"out": str(out), "camera": "none", "stop.lines": 20} | {
        name.replace("__", "."): value for name, value in overrides.items()
    }
    return Rolled(run_experiment(load_settings(None, keys), started=STARTED, watch=steps.append), steps)


@pytest.fixture(scope="session")
def square_session(tmp_path_factory) -> Rolled:
    """150 lines over the square, no video."""
    return roll(tmp_path_factory.mktemp("square"), shape="square", stop__lines=150, seed=5)


@pytest.fixture(scope="session")
def filmed_session(tmp_path_factory) -> Rolled:
    """A dozen lines over the square, filmed."""
    return roll(tmp_path_factory.mktemp("filmed"), shape="square", camera="virtual", stop__lines=12, seed=2)


@pytest.fixture(scope="session")
def uniform_session(tmp_path_factory) -> Rolled:
    """100 lines over the tower by a robot that turns by a uniform angle, as it should not; no video."""
    return roll(tmp_path_factory.mktemp("uniform"), motion__turning="uniform", stop__lines=100, seed=5)


@pytest.fixture(scope="session")
def alone_on_film(tmp_path_factory) -> Path:
    """One robot's short session, filmed, with a drawn track; to be read only."""
    from tests.lab.filmed_sessions import filmed_alone

    return filmed_alone(tmp_path_factory.mktemp("alone"))


@pytest.fixture(scope="session")
def pair_on_film(tmp_path_factory) -> Path:
    """The same with two robots."""
    from tests.lab.filmed_sessions import filmed_pair

    return filmed_pair(tmp_path_factory.mktemp("pair"))


@pytest.fixture(scope="session")
def onboard_session(tmp_path_factory) -> Path:
    """A robot that estimated by itself."""
    return roll(tmp_path_factory.mktemp("onboard"), shape="square", robot="onboard:virtual", stop__lines=5).folder
