"""What all ways of spreading share: an item's failure, and a worker's cores."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import cv2
from threadpoolctl import threadpool_limits  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from analysis.kernels import CORES
from lab.base.errors import ChordlabError

Item = TypeVar("Item")
Result = TypeVar("Result")


class ClusterError(ChordlabError):
    """A cluster that went away while it worked. Carries ``scheduler``."""

    def __init__(self, scheduler: str, reason: str) -> None:
        super().__init__(f"{scheduler}: {reason}; what is done is kept, the same command goes on")
        self.scheduler = scheduler


@dataclass(frozen=True, slots=True)
class Failure:
    """Why an item has no result, in one line."""

    reason: str


@dataclass(frozen=True, slots=True)
class Outcome(Generic[Result]):
    """What became of an item where it was worked on: its result, or the reason why there is none."""

    result: Result | None
    failure: Failure | None = None


def attempt(task: Callable[[Item], Result], item: Item) -> Outcome[Result]:
    """Work on one item; what it raises becomes a failure, so that the worker goes on."""
    try:
        return Outcome(task(item))
    except Exception as error:  # noqa: BLE001 - an item's error of whatever kind is that item's row
        return Outcome(None, Failure(one_line(error)))


def one_line(error: BaseException) -> str:
    """An error as one line; one that is not of our own making with its kind."""
    text = " ".join(str(error).split())
    if isinstance(error, ChordlabError):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def use_cores(cores: int) -> None:
    """Keep this process to so many threads: our own kernels, OpenCV and the linear algebra."""
    os.environ[CORES] = str(cores)
    cv2.setNumThreads(cores)
    threadpool_limits(cores)
