"""One way to have many items worked on: here, on this machine's cores, or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Any

from analysis.kernels import available_cores
from lab.base.errors import ChordlabError, RequestError
from lab.spread.local import spread_processes
from lab.spread.task import Failure, Item, Result, attempt

Spread = Callable[[Callable[[Any], Any], Sequence[Any]], Generator[tuple[Any, Any]]]


class ItemFailedError(ChordlabError):
    """An item that the whole depends on has no result. Carries ``item`` and ``reason``."""

    def __init__(self, item: object, reason: str) -> None:
        super().__init__(reason)
        self.item, self.reason = item, reason


def spread(
    task: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    key: Callable[[Item], str] | None = None,
) -> Generator[tuple[Item, Result | Failure]]:
    """Have ``task`` work on each item; give (item, result) as results come, in any order.

    An item whose task raises, or whose process dies twice, comes with a `Failure`; the others go on. ``items`` may be
    a generator of any length: they are drawn as there is room. Closing the generator ends the work under way.

    Args:
        task: a function of a module, or a partial of one: it is sent to other processes.
        items: what to work on; sent too.
        workers: processes of this machine, each kept to its share of the cores; default: one a core. 0 works in this
            very process, which a crash then takes along.
        scheduler: ``tcp://HOST:PORT`` of a Dask scheduler, whose workers do the work instead.
        key: names an item's content, so that a cluster does nothing twice; default: by task and item.

    Raises:
        RequestError: ``workers`` below 0; a scheduler that cannot be reached, has no workers or others than this
            program's version; `distributed` is not installed.
    """
    if scheduler is not None:
        from lab.spread.cluster import spread_cluster  # noqa: PLC0415 - `distributed` is optional, and slow to import

        return spread_cluster(task, items, scheduler, key)
    if workers is not None and workers < 0:
        raise RequestError(f"the number of workers must be at least 0, got {workers}")
    if workers == 0:
        return _here(task, items)
    return spread_processes(task, items, workers or available_cores())


def _here(task: Callable[[Item], Result], items: Iterable[Item]) -> Generator[tuple[Item, Result | Failure]]:
    for item in items:
        outcome = attempt(task, item)
        yield item, outcome.failure or outcome.result  # pyright: ignore[reportReturnType]: one of both


def spreading(workers: int | None = None, scheduler: str | None = None) -> Spread | None:
    """A way to have all of some items worked on, for those who need every result.

    Returns None where neither is given: then the caller works by itself, with threads.
    The first failure ends the work as an `ItemFailedError`.
    """
    if workers is None and scheduler is None:
        return None

    def every(task: Callable[[Item], Result], items: Sequence[Item]) -> Generator[tuple[Item, Result]]:
        for item, result in spread(task, items, workers=workers, scheduler=scheduler):
            if isinstance(result, Failure):
                raise ItemFailedError(item, result.reason)
            yield item, result

    return every
