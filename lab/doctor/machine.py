"""Disk, clocks, cores: what the machine itself brings."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import psutil

from analysis.montecarlo import available_cores
from lab.doctor.finding import Finding

_PROBE_BYTES = 8 << 20
_SLOW_DISK_MB_S = 20.0
_LITTLE_SPACE_GB = 2.0
_LITTLE_MEMORY_GB = 1.0
_NAPS, _NAP_S = 40, 0.01
# A robot at 30 cm/s rolls 0.3 cm in it: a third of what a crossing is known to.
_LATE_S = 0.01
_ASK_S = 2.0


def cores() -> Iterator[Finding]:
    """Cores and memory. One core cannot film and lead a session at once."""
    count = available_cores()
    fine = count > 1
    cure = "" if fine else "leave out the camera, or take a machine with two cores"
    yield Finding("cores", "ok" if fine else "missing", f"{count} for this process", cure)
    free_gb = psutil.virtual_memory().available / 1e9
    fine = free_gb > _LITTLE_MEMORY_GB
    cure = "" if fine else "close other programs"
    yield Finding("memory", "ok" if fine else "missing", f"{free_gb:.1f} GB free", cure)


def disk(folder: Path) -> Iterator[Finding]:
    """Space and speed where sessions go."""
    try:
        place = next(parent for parent in (folder, *folder.resolve().parents) if parent.is_dir())
        free_gb = shutil.disk_usage(place).free / 1e9
        speed_mb_s = _write_speed_mb_s(place)
    except OSError as error:
        yield Finding("disk", "broken", f"{folder}: {error.strerror}", "choose another folder for sessions")
        return
    enough = free_gb > _LITTLE_SPACE_GB
    cure = "" if enough else "free some space"
    yield Finding("disk space", "ok" if enough else "broken", f"{free_gb:.1f} GB free", cure)
    fast = speed_mb_s > _SLOW_DISK_MB_S
    cure = "" if fast else "record to a local disk"
    yield Finding("disk speed", "ok" if fast else "missing", f"{speed_mb_s:.0f} MB/s synced", cure)


def _write_speed_mb_s(folder: Path) -> float:
    with tempfile.NamedTemporaryFile(dir=folder) as file:
        started_s = time.perf_counter()
        file.write(bytes(_PROBE_BYTES))
        file.flush()
        os.fsync(file.fileno())
        return _PROBE_BYTES / (time.perf_counter() - started_s) / 1e6


def clock() -> Iterator[Finding]:
    """The steps of the clock that crossings are timed by."""
    resolution_s = time.get_clock_info("monotonic").resolution
    fine = resolution_s <= 1e-3
    cure = "" if fine else "use another machine"
    yield Finding("clock", "ok" if fine else "missing", f"{resolution_s:.1e} s steps", cure)


def wall_clock() -> Iterator[Finding]:
    """The time of day, which sessions are named and dated by: behind our own files it is wrong for certain."""
    now = datetime.now(tz=UTC)
    installed = datetime.fromtimestamp(Path(__file__).stat().st_mtime, tz=UTC)
    synchronised = _synchronised()
    text = f"{now:%Y-%m-%d %H:%M} UTC" + {True: ", synchronised", False: ", not synchronised", None: ""}[synchronised]
    behind = now < installed - timedelta(days=1)
    cure = "set the clock: it is behind the installation of chordlab" if behind else ""
    if synchronised is False:
        cure = cure or "switch on network time (timedatectl set-ntp true)"
    yield Finding("time of day", "missing" if cure else "ok", text, cure)


def _synchronised() -> bool | None:
    """Whether the system says that it follows a time server; None where it does not say."""
    command = shutil.which("timedatectl")
    if command is None:
        return None
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        said = subprocess.run(
            [command, "show", "--property=NTPSynchronized", "--value"],
            capture_output=True,
            text=True,
            timeout=_ASK_S,
            check=True,
        )
        return {"yes": True, "no": False}.get(said.stdout.strip())
    return None


def timer() -> Iterator[Finding]:
    """How late the event loop wakes, over less than a second: a busy machine stamps samples late."""
    late_s = asyncio.run(_lateness_s())
    middle_s, worst_s = float(np.median(late_s)), float(np.quantile(late_s, 0.95))
    fine = worst_s < _LATE_S
    text = f"{1e3 * middle_s:.1f} ms late, 95 % below {1e3 * worst_s:.1f} ms"
    yield Finding("timer", "ok" if fine else "missing", text, "" if fine else "close other programs, plug in the mains")


async def _lateness_s() -> list[float]:
    loop = asyncio.get_running_loop()
    late_s: list[float] = []
    for _ in range(_NAPS):
        due_s = loop.time() + _NAP_S
        await asyncio.sleep(_NAP_S)
        late_s.append(max(0.0, loop.time() - due_s))
    return late_s
