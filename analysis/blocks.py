"""Long work in blocks that each own a random stream: the result depends on the seed, never on the threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import numpy as np

from analysis.kernels import available_cores

Progress = Callable[[int, int], None]
_Result = TypeVar("_Result")


def run_blocks(
    work: Callable[[int, int, np.random.Generator], _Result],
    total: int,
    size: int,
    rng: np.random.Generator,
    *,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Iterator[_Result]:
    """Yield ``work(first, last, stream)`` for blocks of ``size`` out of ``total``, in order, few under way at once.

    Each block gets the next stream spawned from ``rng``. ``work`` must release the GIL to gain from ``threads``
    (default: the cores). ``progress`` is called in this thread with (done, total) after each block. What it or the
    caller raises, Ctrl-C too, ends the work: blocks under way are waited for (milliseconds) and those that wait are
    dropped.
    """
    if total <= size:  # a thread pool costs more than a small block
        yield work(0, total, rng.spawn(1)[0])
        if progress is not None:
            progress(total, total)
        return
    workers = threads or available_cores()
    waiting: deque[tuple[int, Future[_Result]]] = deque()
    pool = ThreadPoolExecutor(workers, thread_name_prefix="blocks")
    try:
        for first in range(0, total + 2 * workers * size, size):
            last = min(first + size, total)
            if first < total:
                waiting.append((last, pool.submit(work, first, last, rng.spawn(1)[0])))
            if waiting and (len(waiting) >= 2 * workers or last == total):
                done, future = waiting.popleft()
                yield future.result()
                if progress is not None:
                    progress(done, total)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
