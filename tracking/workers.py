"""Segments that are followed each by itself, on several cores."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from pathlib import Path

import cv2
import pandas as pd

from lab.base.interrupts import interrupt_held
from tracking.background import Background
from tracking.calibration import Calibration
from tracking.passes import RawTrack, follow_one
from tracking.table import track_table

Followed = tuple[RawTrack, pd.DataFrame]

# A process costs a second or two to start.
_FEWEST_FOR_PROCESSES = 4


@contextmanager
def one_thread() -> Generator[None]:
    """Keep OpenCV to one thread: its threads cost more than they give on patches this small."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def follow_each(
    files: Sequence[Path], floor: Background, calibration: Calibration | None, workers: int
) -> Generator[Followed]:
    """Follow one robot through each file, in their order; the LED's state is left open in the tables.

    An interrupt, or closing this generator, ends the processes within some dozen frames. They leave the keyboard's
    interrupt to this one, so it is told once.

    Raises:
        VideoError: a file cannot be read.
        CalibrationError: the calibration is for pictures of another size.
        RequestError: a file's pictures are not of the floor's size.
    """
    if workers <= 1 or len(files) < _FEWEST_FOR_PROCESSES:
        with one_thread():
            for file in files:
                yield _segment(file, floor, calibration)
        return
    context = multiprocessing.get_context("spawn")
    stop = context.Event()  # with it comes multiprocessing's resource tracker, whose start unblocks signals
    with interrupt_held() as came:
        pool = ProcessPoolExecutor(
            workers, mp_context=context, initializer=_Job.prepare, initargs=(floor, calibration, stop)
        )
        # Chunks large enough to spare messages, small enough that no worker is left alone at the end.
        results = pool.map(_Job.run, files, chunksize=max(1, min(16, len(files) // (4 * workers))))
    try:
        if came:
            raise KeyboardInterrupt
        yield from results
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)


def _segment(file: Path, floor: Background, calibration: Calibration | None, stop: Event | None = None) -> Followed:
    def look_up(_done: int = 0, _total: int = 0) -> None:
        if stop is not None and stop.is_set():
            raise _Stopped

    look_up()
    raw = follow_one(file, floor, calibration, threads=1, progress=look_up)
    return raw, track_table(raw, calibration)


class _Stopped(Exception):  # noqa: N818 - no error: nobody waits for the result
    """The process that wanted this has gone on."""


class _Job:
    """What a worker process holds between segments: sent once, not with each."""

    floor: Background
    calibration: Calibration | None
    stop: Event

    @classmethod
    def prepare(cls, floor: Background, calibration: Calibration | None, stop: Event) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        cv2.setNumThreads(1)
        cls.floor, cls.calibration, cls.stop = floor, calibration, stop

    @classmethod
    def run(cls, file: Path) -> Followed:
        return _segment(file, cls.floor, cls.calibration, cls.stop)
