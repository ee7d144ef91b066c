"""Work spread over the workers of a Dask cluster, which need this program and the files that it is told of."""

# distributed is typed in part: its client is met here and nowhere else.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
from __future__ import annotations

import hashlib
import logging
import pickle
import queue
import time
import uuid
import warnings
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from lab.base.errors import RequestError
from lab.spread.task import ClusterError, Failure, Item, Outcome, Result, attempt, one_line, use_cores
from lab.spread.versions import Versions, differences, versions

try:
    from distributed import Client, Future, KilledWorker
    from distributed.versions import VersionMismatchWarning
except ImportError as error:
    raise RequestError("a cluster needs Dask's distributed: pip install 'chordlab[cluster]'") from error

_Answer = TypeVar("_Answer")

_CONNECT_S = 10.0
_ANSWER_S = 30.0  # what a scheduler or worker that lives takes at most to answer
_WORKERS_S = 60.0  # how long a cluster may be without any worker
_LOOK_S = 2.0
_AHEAD = 3  # items that are with the cluster, for each of its threads


def spread_cluster(
    task: Callable[[Item], Result],
    items: Iterable[Item],
    scheduler: str,
    key: Callable[[Item], str] | None = None,
) -> Generator[tuple[Item, Result | Failure]]:
    """Work on items on a cluster; give each with its result as it comes.

    A worker that is lost has its items done by others; an item that several workers died of is a `Failure`. Few items
    are with the cluster at a time, so that memory does not grow with their number.

    Raises:
        RequestError: the scheduler cannot be reached, has no workers, or a worker is of another version.
        ClusterError: the scheduler or all workers went away.
    """
    with _quiet(), _connected(scheduler) as client:
        cluster = _Cluster(client, scheduler)
        ours = cluster.check_versions()
        name = _name_of(task)
        room = cluster.room()
        source = iter(items)
        ended: queue.SimpleQueue[Future[Any]] = queue.SimpleQueue()
        waiting: dict[str, tuple[Future[Any], list[Item]]] = {}
        more = True
        try:
            while True:
                while more and len(waiting) < room:
                    try:
                        item = next(source)
                    except StopIteration:
                        more = False
                        break
                    content = key(item) if key is not None else hashlib.sha256(pickle.dumps(item)).hexdigest()
                    called = f"chordlab-{hashlib.sha256(f'{name} {content} {ours}'.encode()).hexdigest()}"
                    if called in waiting:
                        waiting[called][1].append(item)
                        continue
                    future = client.submit(_at_worker, task, item, ours, key=called)
                    waiting[called] = future, [item]
                    future.add_done_callback(ended.put)
                if not waiting:
                    return
                try:
                    future = ended.get(timeout=_LOOK_S)
                except queue.Empty:
                    room = cluster.room()
                    continue
                outcome = cluster.outcome_of(future)
                _, done = waiting.pop(str(future.key))
                future.release()
                for item in done:
                    yield item, outcome.failure or outcome.result  # pyright: ignore[reportReturnType]: one of both
        finally:
            left = [future for future, _ in waiting.values()]
            if left and client.status == "running":
                cluster.ask(client.cancel, left)


class _Cluster:
    """A client, each of whose questions is answered in time or by an error of one line."""

    def __init__(self, client: Any, scheduler: str) -> None:
        self._client, self._scheduler = client, scheduler
        self._seen_s = time.monotonic()

    def ask(self, question: Callable[..., _Answer], *args: Any, **options: Any) -> _Answer:
        """What a method of the client answers."""
        try:
            return question(*args, **options)
        except (OSError, TimeoutError) as error:
            raise ClusterError(self._scheduler, f"the scheduler does not answer ({one_line(error)})") from error

    def room(self) -> int:
        """How many items the cluster is given at a time. Raises ClusterError when it has had no worker for a minute."""
        if self._client.status not in ("running", "connecting"):
            raise ClusterError(self._scheduler, "the scheduler went away")
        threads = sum(self._threads().values())
        if threads:
            self._seen_s = time.monotonic()
        elif time.monotonic() - self._seen_s > _WORKERS_S:
            raise ClusterError(self._scheduler, f"all workers went away and none came back within {_WORKERS_S:.0f} s")
        return max(4, _AHEAD * threads)

    def check_versions(self) -> Versions:
        """Hold the workers' versions against this process's; give the latter."""
        deadline = time.monotonic() + _CONNECT_S
        while not self._threads():
            if time.monotonic() > deadline:
                raise RequestError(
                    f"{self._scheduler}: the scheduler has no workers; start some: dask worker {self._scheduler}"
                )
            time.sleep(0.1)
        ours = versions()
        asked = {worker: self._client.submit(versions, key=_new_key(), workers=[worker]) for worker in self._threads()}
        for worker, answer in asked.items():
            try:
                theirs = answer.result(timeout=_ANSWER_S)
            except TimeoutError:
                if worker in self._threads():
                    raise ClusterError(self._scheduler, f"worker {worker} does not answer") from None
            except Exception as error:
                raise RequestError(
                    f"worker {worker} has no chordlab that works ({one_line(error)}); install this version of it there"
                ) from error
            else:
                if theirs != ours:
                    raise _of_another_version(worker, theirs)
        return ours

    def outcome_of(self, future: Future[Any]) -> Outcome[Any]:
        """What became of an item whose future has ended."""
        if future.status == "cancelled":
            raise ClusterError(self._scheduler, "the scheduler went away, or somebody cancelled the work there")
        try:
            outcome = future.result(timeout=_ANSWER_S)
        except KilledWorker as error:
            return Outcome(None, Failure(f"{error.allowed_failures + 1} workers died while they worked on it"))
        except (OSError, TimeoutError) as error:
            raise ClusterError(self._scheduler, f"a result does not arrive ({one_line(error)})") from error
        except Exception as error:  # noqa: BLE001 - what the cluster itself could not do with an item
            return Outcome(None, Failure(one_line(error)))
        if isinstance(outcome, _Stranger):
            raise _of_another_version(outcome.worker, outcome.versions)
        return outcome

    def _threads(self) -> dict[str, int]:
        cores = self._client.scheduler.ncores
        return self.ask(self._client.sync, cores, workers=None, callback_timeout=_ANSWER_S)


@dataclass(frozen=True, slots=True)
class _Stranger:
    """Instead of an outcome: a worker of another version, that came later."""

    worker: str
    versions: Versions


def _at_worker(task: Callable[[Any], Any], item: Any, wanted: Versions) -> Outcome[Any] | _Stranger:
    """What a worker does with an item."""
    from distributed import get_worker  # noqa: PLC0415

    if versions() != wanted:
        return _Stranger(get_worker().address, versions())
    use_cores(1)  # as many items as the worker has threads are worked on at a time
    return attempt(task, item)


def _new_key() -> str:
    return f"chordlab-versions-{uuid.uuid4()}"


def _of_another_version(worker: str, theirs: Versions) -> RequestError:
    said = ", ".join(differences(versions(), theirs))
    return RequestError(f"worker {worker} would find other figures: {said}; install the same versions there")


def _name_of(task: Callable[..., Any]) -> str:
    """What a task is, whatever process it is in: its function and what is bound to it."""
    if isinstance(task, partial):
        bound = hashlib.sha256(pickle.dumps((task.args, sorted(task.keywords.items())))).hexdigest()
        return f"{_name_of(task.func)} {bound}"
    return f"{task.__module__}.{task.__qualname__}"


@contextmanager
def _connected(scheduler: str) -> Generator[Client]:
    """A client of a scheduler. Raises RequestError when it cannot be reached."""
    try:
        with warnings.catch_warnings():  # other versions are refused in one line by what asks for them here
            warnings.simplefilter("ignore", VersionMismatchWarning)
            client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False, name="chordlab")
    except (OSError, TimeoutError, ValueError) as error:
        raise RequestError(
            f"{scheduler}: no scheduler answers there within {_CONNECT_S:.0f} s; "
            "start one (dask scheduler) or give its address as tcp://HOST:PORT"
        ) from error
    try:
        yield client
    finally:
        client.close(timeout=_CONNECT_S)


@contextmanager
def _quiet() -> Generator[None]:
    """Keep Dask's own log lines off the screen: what they tell of is told here once."""
    logger = logging.getLogger("distributed")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)
