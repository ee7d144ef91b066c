"""Functions compiled by numba, whose cache on disk several processes may fill at once.

numba numbers the files of a function's cache by looking which numbers are taken. Two processes that compile it for
different arguments at the same moment take the same number; the index then names the machine code of one signature
for the other, and whoever loads it calls garbage. Here one process at a time compiles, loads and saves.
"""

# numba carries no types: its dispatchers are met here and nowhere else.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])

_LOCK = "numba.lock"


def compiled(**options: Any) -> Callable[[_Function], _Function]:
    """Make a decorator that compiles by ``numba.njit(**options)`` and keeps the function's Python signature.

    The machine code is cached beside the module, or in the user's cache directory, or (where neither can be written)
    not at all.
    """
    njit = cast(Any, numba).njit

    def compile_it(function: _Function) -> _Function:
        try:
            dispatcher: Any = njit(cache=True, **options)(function)
        except RuntimeError:
            return cast(_Function, njit(**options)(function))
        alone = _Alone(Path(dispatcher.stats.cache_path) / _LOCK)
        build = dispatcher.compile

        def compile_alone(signature: Any) -> Any:
            with alone.held():
                return build(signature)

        dispatcher.compile = compile_alone
        return cast(_Function, dispatcher)

    return compile_it


class _Alone:
    """A lock between processes that its own thread may take again: a kernel compiles the kernels that it calls."""

    # One for all: two dispatchers of a folder share a file, and a thread must not wait for itself.
    _thread = threading.RLock()
    _depth = 0

    def __init__(self, path: Path) -> None:
        self._path = path

    @contextmanager
    def held(self) -> Generator[None]:
        with _Alone._thread:
            _Alone._depth += 1
            try:
                if _Alone._depth > 1:
                    yield
                    return
                with _locked(self._path):
                    yield
            finally:
                _Alone._depth -= 1


@contextmanager
def _locked(path: Path) -> Generator[None]:
    """Hold a file locked against other processes; where it cannot be, go on without."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a+b")
    except OSError:
        yield
        return
    with file:  # closing gives the lock back
        if sys.platform == "win32":
            import msvcrt  # noqa: PLC0415

            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_LOCK, 1)
            try:
                yield
            finally:
                file.seek(0)
                msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)
        else:
            import fcntl  # noqa: PLC0415

            fcntl.flock(file, fcntl.LOCK_EX)
            yield
