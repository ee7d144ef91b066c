"""Ctrl-C, and processes that are being started."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager


@contextmanager
def interrupt_held() -> Generator[list[int]]:
    """Start processes so that they never see the keyboard's interrupt; give a list that is not empty if it came.

    In the middle of a start it would leave a process that nobody knows of. Processes inherit what is blocked; where
    signals cannot be blocked (Windows), they ignore this one once they run.
    """
    came: list[int] = []
    in_main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number)) if in_main else None
    try:
        if sys.platform == "win32":
            yield came
        else:
            blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                yield came
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
    finally:
        if in_main:
            signal.signal(signal.SIGINT, handler)
