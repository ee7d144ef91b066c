"""What this machine has and what it lacks for a session, each finding with its cure."""

from __future__ import annotations

import asyncio
import importlib.metadata
import importlib.util
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bleak import BleakScanner
from bleak.exc import BleakError
from packaging.requirements import Requirement

from projector.text import find_font

OUR_PACKAGES = ("lab", "projector", "tracking", "robot", "analysis")
_PROBE_BYTES = 8 << 20
_SLOW_DISK_MB_S = 20.0
_LITTLE_SPACE_GB = 2.0
_SCAN_S = 3.0

State = Literal["ok", "missing", "broken"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One check. ``missing`` concerns hardware or extras that a virtual session does not need; ``broken`` stops it."""

    check: str
    state: State
    found: str
    cure: str = ""


def examine(folder: Path) -> list[Finding]:
    """Run every check; ``folder`` is where sessions would go."""
    checks = (
        _python(),
        _packages(),
        _clashes(),
        _fonts(),
        _bluetooth(),
        _cameras(),
        _displays(),
        _disk(folder),
        _clock(),
    )
    return [finding for check in checks for finding in check]


def _python() -> Iterator[Finding]:
    version = ".".join(map(str, sys.version_info[:3]))
    fine = sys.version_info >= (3, 11)
    yield Finding("python", "ok" if fine else "broken", version, "" if fine else "install Python 3.11 or newer")


def _packages() -> Iterator[Finding]:
    """Every requirement of chordlab itself, from its own metadata; extras are optional."""
    for text in importlib.metadata.requires("chordlab") or ():
        requirement = Requirement(text)
        extra = requirement.marker is not None and not requirement.marker.evaluate({"extra": ""})
        if extra and 'extra == "dev"' in str(requirement.marker):
            continue
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            cure = f"pip install '{requirement.name}{requirement.specifier}'"
            yield Finding(requirement.name, "missing" if extra else "broken", "not installed", cure)
            continue
        if requirement.specifier.contains(version, prereleases=True):
            yield Finding(requirement.name, "ok", version)
        else:
            cure = f"pip install '{requirement.name}{requirement.specifier}'"
            yield Finding(requirement.name, "broken", f"{version}, but {requirement.specifier} is needed", cure)


def _clashes() -> Iterator[Finding]:
    """Our top-level names are common (`robot` is also Robot Framework's): see that ours are the ones found."""
    home = Path(__file__).resolve().parent.parent
    for name in OUR_PACKAGES:
        spec = importlib.util.find_spec(name)
        origin = Path(spec.origin).resolve().parent if spec and spec.origin else None
        if origin == home / name:
            continue
        where = origin or "nowhere"
        yield Finding(
            f"package {name}", "broken", f"found in {where}", "use a virtual environment of its own for chordlab"
        )


def _fonts() -> Iterator[Finding]:
    font = find_font()
    if font.fallback:
        yield Finding("font", "missing", font.name, "install TeX Gyre Heros or Liberation Sans, or give --font")
    else:
        yield Finding("font", "ok", font.name)


def _bluetooth() -> Iterator[Finding]:
    async def scan() -> int:
        async with asyncio.timeout(4 * _SCAN_S):
            return len(await BleakScanner.discover(timeout=_SCAN_S))

    try:
        seen = asyncio.run(scan())
    except (BleakError, OSError, TimeoutError, EOFError) as error:
        reason = str(error) or type(error).__name__
        yield Finding("bluetooth", "missing", reason.splitlines()[0], "switch Bluetooth on, plug in an adapter")
    else:
        yield Finding("bluetooth", "ok", f"{seen} devices in range")


def _cameras() -> Iterator[Finding]:
    nodes = sorted(Path("/dev").glob("video*")) if sys.platform == "linux" else []
    if nodes:
        yield Finding("camera", "ok", ", ".join(node.name for node in nodes))
    elif sys.platform == "linux":
        yield Finding("camera", "missing", "no /dev/video*", "plug in a webcam")
    else:
        yield Finding("camera", "missing", "not looked for here", "try chordlab run with camera = usb:0")


def _displays() -> Iterator[Finding]:
    if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        yield Finding("display", "ok", os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or "present")
    else:
        yield Finding("display", "missing", "no screen", "start from a desktop, with the projector attached")


def _disk(folder: Path) -> Iterator[Finding]:
    try:
        place = next(parent for parent in (folder, *folder.resolve().parents) if parent.is_dir())
        free_gb = shutil.disk_usage(place).free / 1e9
        speed_mb_s = _write_speed_mb_s(place)
    except OSError as error:
        yield Finding("disk", "broken", f"{folder}: {error.strerror}", "choose another folder for sessions")
        return
    enough = free_gb > _LITTLE_SPACE_GB
    yield Finding(
        "disk space", "ok" if enough else "broken", f"{free_gb:.1f} GB free", "" if enough else "free some space"
    )
    fast = speed_mb_s > _SLOW_DISK_MB_S
    yield Finding(
        "disk speed",
        "ok" if fast else "missing",
        f"{speed_mb_s:.0f} MB/s synced",
        "" if fast else "record to a local disk",
    )


def _write_speed_mb_s(folder: Path) -> float:
    with tempfile.NamedTemporaryFile(dir=folder) as file:
        started_s = time.perf_counter()
        file.write(bytes(_PROBE_BYTES))
        file.flush()
        os.fsync(file.fileno())
        return _PROBE_BYTES / (time.perf_counter() - started_s) / 1e6


def _clock() -> Iterator[Finding]:
    resolution_s = time.get_clock_info("monotonic").resolution
    fine = resolution_s <= 1e-3
    yield Finding(
        "clock", "ok" if fine else "missing", f"{resolution_s:.1e} s steps", "" if fine else "use another machine"
    )
