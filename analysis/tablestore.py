"""What a dictionary's entries look like to a sensor, learnt once and kept on disk.

Each entry is learnt by itself, from a random stream that follows from the seed and the entry's own outline, so that
a dictionary that grows learns only what is new. A file is named after the digest of all that went into it: outline,
sensor, number of lines, seed, and the code that learns.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import inspect
import io
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import fields
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from analysis.boundary import Geometry
from analysis.kernels import available_cores
from analysis.sensor import SensedLines, SensorModel
from lab.base.errors import RequestError
from lab.base.files import write_aside

Progress = Callable[[int, int], None]
Packed = dict[str, NDArray[np.generic]]
# Has a task done on each of some items, and gives (item, result) in any order.
Mapper = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[tuple[Any, Any]]]

DEFAULT_LINES = 50_000
_LIMIT_BYTES = 512 << 20
_SUFFIX = ".lines"
_DIGEST_BYTES = 32
_CODE = ("analysis.boundary", "analysis.kernels", "analysis.sensorkernels", "analysis.sensor")
_OUTLINE_STEP_CM = 1e-6


def cache_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Where this user's programs keep what can be made again: ``CHORDLAB_CACHE``, or the system's place for it."""
    chosen = environment.get("CHORDLAB_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    if sys.platform == "win32":
        root = Path(environment.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        root = Path.home() / "Library" / "Caches"
    else:
        # The XDG rules: a path that is not absolute is to be ignored.
        root = Path(environment.get("XDG_CACHE_HOME", ""))
        root = root if root.is_absolute() else Path.home() / ".cache"
    return root / "chordlab"


class TableStore:
    """A folder of named arrays that may be lost at any time: whatever is missing or damaged is made anew.

    Nothing here raises OSError: a folder that cannot be written keeps nothing.

    Args:
        folder: made when first needed; default: ``sensed`` in `cache_folder`.
        limit_bytes: beyond it the files that were not used for longest are deleted.
    """

    def __init__(self, folder: Path | None = None, *, limit_bytes: int = _LIMIT_BYTES) -> None:
        self.folder = cache_folder() / "sensed" if folder is None else folder
        self._limit_bytes = limit_bytes

    def load(self, key: str) -> dict[str, NDArray[np.generic]] | None:
        """The arrays kept under ``key``; None where there are none, or they are damaged."""
        path = self._path(key)
        with contextlib.suppress(OSError):
            data = path.read_bytes()
            body = data[_DIGEST_BYTES:]
            if hashlib.sha256(body).digest() != data[:_DIGEST_BYTES]:
                path.unlink()
                return None
            os.utime(path)
            with np.load(io.BytesIO(body), allow_pickle=False) as arrays:
                return dict(arrays)
        return None

    def save(self, key: str, arrays: Mapping[str, NDArray[np.generic]]) -> None:
        """Keep ``arrays`` under ``key``, whole or not at all."""
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, **arrays)
        body = buffer.getvalue()
        with contextlib.suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
            write_aside(self._path(key), hashlib.sha256(body).digest() + body)

    def tidy(self) -> None:
        """Delete what was not used for longest, down to the limit."""
        with contextlib.suppress(OSError):
            kept: list[tuple[float, int, Path]] = []
            for path in self.folder.glob(f"*{_SUFFIX}*"):  # those that a crash left half written too
                with contextlib.suppress(OSError):  # another process may tidy too
                    known = path.stat()
                    kept.append((known.st_mtime, known.st_size, path))
            left = sum(size for _, size, _ in kept)
            for _, size, path in sorted(kept):
                if left <= self._limit_bytes:
                    break
                with contextlib.suppress(OSError):
                    path.unlink()
                left -= size

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}{_SUFFIX}"


def learn_lines(
    entries: Mapping[str, Geometry],
    sensor: SensorModel,
    *,
    lines: int = DEFAULT_LINES,
    seed: int = 0,
    store: TableStore | None = None,
    workers: int | None = None,
    mapper: Mapper | None = None,
    progress: Progress | None = None,
) -> dict[str, SensedLines]:
    """Learn how the lines of each entry look through ``sensor``, or read it from ``store``.

    The result is the same to the last bit whether it was learnt or read, whatever the number of ``workers``
    (threads; default: the cores) and whatever else is in the dictionary. ``mapper`` spreads what is to be learnt
    otherwise, over processes or a cluster; the store is used here alone. ``progress`` is told, from the caller's own
    thread, how many of the entries are there.

    Raises:
        RequestError: no entries, or fewer than one line.
        analysis.boundary.BoundaryError: an entry's geometry is empty or invalid.
    """
    if not entries:
        raise RequestError("the dictionary is empty; give at least one entry to learn")
    found: dict[str, SensedLines] = {}
    to_learn: list[tuple[str, Geometry]] = []
    keys: dict[str, str] = {}

    def keep(name: str, sensed: SensedLines) -> None:
        found[name] = sensed
        if progress is not None:
            progress(len(found), len(entries))

    for name, geometry in entries.items():
        keys[name] = _key(_outline_digest(geometry), sensor, lines, seed)
        sensed = _unpacked(store.load(keys[name])) if store is not None else None
        if sensed is None:
            to_learn.append((name, geometry))
        else:
            keep(name, sensed)
    learn = partial(learn_entry, sensor=sensor, lines=lines, seed=seed)
    for (name, _), packed in (mapper or partial(_by_threads, workers=workers))(learn, to_learn):
        if store is not None:
            store.save(keys[name], packed)
        keep(name, _whole(packed))
    if store is not None:
        store.tidy()
    return {name: found[name] for name in entries}


def learn_entry(entry: tuple[str, Geometry], *, sensor: SensorModel, lines: int, seed: int) -> Packed:
    """Learn one entry (name, geometry): the arrays that are kept of it. The name does not matter."""
    stream = np.frombuffer(bytes.fromhex(_outline_digest(entry[1])), dtype=np.uint32)
    return _packed(sensor.sense(entry[1], lines, np.random.default_rng([seed, *stream.tolist()]), threads=1))


def _by_threads(
    learn: Callable[[tuple[str, Geometry]], Packed], entries: Sequence[tuple[str, Geometry]], *, workers: int | None
) -> Iterator[tuple[tuple[str, Geometry], Packed]]:
    with ThreadPoolExecutor(workers or available_cores(), thread_name_prefix="learn") as pool:
        futures = {pool.submit(learn, entry): entry for entry in entries}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _outline_digest(geometry: Geometry) -> str:
    """SHA-256 of an outline, the same wherever its rings begin."""
    # + 0.0 turns -0.0 into 0.0, which would otherwise differ in its bytes.
    rounded = shapely.transform(geometry, lambda xy: np.round(xy / _OUTLINE_STEP_CM) * _OUTLINE_STEP_CM + 0.0)
    return hashlib.sha256(shapely.to_wkb(rounded.normalize(), byte_order=1)).hexdigest()


def _key(outline: str, sensor: SensorModel, lines: int, seed: int) -> str:
    parts = [outline, sensor.key(), str(lines), str(seed), _code_digest()]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


@cache
def _code_digest() -> str:
    """SHA-256 of the code that decides what is learnt: a change of it makes all files stale."""
    sources = [inspect.getsource(importlib.import_module(name)) for name in _CODE]
    return hashlib.sha256("\n".join([*sources, inspect.getsource(_packed)]).encode()).hexdigest()


def _packed(sensed: SensedLines) -> dict[str, NDArray[np.generic]]:
    """As it is kept: single precision is a thousand times finer than a table's bins."""
    return {
        "k": sensed.k.astype(np.uint16),
        "l1_cm": sensed.l1_cm.astype(np.float32),
        "l3_cm3": sensed.l3_cm3.astype(np.float32),
        "measure_per_line_cm": np.array(sensed.measure_per_line_cm),
        "excess": sensed.excess,
    }


def _unpacked(arrays: Mapping[str, NDArray[np.generic]] | None) -> SensedLines | None:
    if arrays is None or set(arrays) != {field.name for field in fields(SensedLines)}:
        return None
    return _whole(arrays)


def _whole(arrays: Mapping[str, NDArray[np.generic]]) -> SensedLines:
    return SensedLines(
        k=arrays["k"].astype(np.int64),
        l1_cm=arrays["l1_cm"].astype(np.float64),
        l3_cm3=arrays["l3_cm3"].astype(np.float64),
        measure_per_line_cm=float(arrays["measure_per_line_cm"].astype(np.float64)),
        excess=arrays["excess"].astype(np.float64),
    )
