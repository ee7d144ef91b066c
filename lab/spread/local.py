"""Work spread over processes of this machine, one item at a time each, so that a death costs one item."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from analysis.kernels import available_cores
from lab.base.interrupts import interrupt_held
from lab.spread.task import Failure, Item, Outcome, Result, attempt, use_cores

_TRIES = 2
_LOOK_S = 1.0  # so often a signal is heeded while nothing ends (systems whose waits are not woken by one)
_LEAVE_S = 5.0


@dataclass(slots=True, eq=False)
class _Worker:
    process: SpawnProcess
    line: Connection


@dataclass(frozen=True, slots=True, eq=False)
class _Try:
    item: Any
    number: int


def spread_processes(
    task: Callable[[Item], Result], items: Iterable[Item], workers: int
) -> Generator[tuple[Item, Result | Failure]]:
    """Work on items in ``workers`` processes; give each with its result as it comes.

    A process that dies takes its item along: it is tried once more in a new one, and is a `Failure` after that. Items
    are drawn as there is room for them. Closing this generator ends the processes.
    """
    share = max(1, available_cores() // workers)
    queue, again = iter(items), deque[_Try]()
    idle: list[_Worker] = []
    busy: dict[_Worker, _Try] = {}
    more = True
    try:
        while True:
            while len(busy) < workers and (again or more):
                try:
                    work = again.popleft() if again else _Try(next(queue), 1)
                except StopIteration:
                    more = False
                    break
                worker = idle.pop() if idle else _start(task, share)
                busy[worker] = work
                with contextlib.suppress(OSError):  # dead already: seen below
                    worker.line.send(work.item)
            if not busy:
                return
            ready = wait([worker.line for worker in busy], _LOOK_S)
            for worker in [worker for worker in busy if worker.line in ready]:
                work = busy[worker]
                try:
                    outcome: Outcome[Result] = worker.line.recv()
                except (EOFError, OSError):
                    del busy[worker]
                    death = _bury(worker)
                    if work.number < _TRIES:
                        again.append(_Try(work.item, work.number + 1))
                        continue
                    yield work.item, Failure(f"its process died {work.number} times ({death})")
                else:
                    idle.append(worker)
                    del busy[worker]
                    yield work.item, outcome.failure or outcome.result  # pyright: ignore[reportReturnType]: one of both
    finally:
        _end([*idle, *busy])


def _start(task: Callable[[Any], Any], share: int) -> _Worker:
    # spawn, not fork: the parent may hold threads
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    with interrupt_held() as came:
        process = context.Process(target=_serve, args=(theirs, task, share), daemon=True, name="chordlab-worker")
        process.start()
    theirs.close()
    worker = _Worker(process, ours)
    if came:
        _end([worker])
        raise KeyboardInterrupt
    return worker


def _serve(line: Connection, task: Callable[[Any], Any], share: int) -> None:
    """What a process does: item after item, until there is nobody to ask for more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    use_cores(share)
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            item = line.recv()
            outcome = attempt(task, item)
            try:
                line.send(outcome)
            except (AttributeError, TypeError, ValueError) as error:  # no result that could be sent
                line.send(Outcome(None, Failure(f"its result cannot be sent: {error}")))


def _bury(worker: _Worker) -> str:
    """Wait for a process that closed its line, and say how it ended."""
    worker.line.close()
    worker.process.join(_LEAVE_S)
    code = worker.process.exitcode
    _end([worker])
    if code is None or code >= 0:
        return f"exit code {code}"
    name = signal.Signals(-code).name
    return f"{name}: out of memory?" if name == "SIGKILL" else name


def _end(workers: list[_Worker]) -> None:
    for worker in workers:
        worker.line.close()
        worker.process.terminate()
    for worker in workers:
        worker.process.join(_LEAVE_S)
        if worker.process.exitcode is None:
            worker.process.kill()
            worker.process.join(_LEAVE_S)
        worker.process.close()
