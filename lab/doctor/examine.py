"""Every check, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from lab.doctor import hardware, machine, software
from lab.doctor.finding import Finding

Progress = Callable[[int, int], None]


def examine(folder: Path, progress: Progress | None = None) -> list[Finding]:
    """Run every check (about five seconds, most of them listening for Bluetooth).

    Args:
        folder: where sessions would go.
        progress: called with (checks done, checks in all).
    """
    checks: list[Callable[[], Iterator[Finding]]] = [
        software.python,
        software.packages,
        software.extras,
        software.clashes,
        software.fonts,
        software.encoders,
        software.kernel_cache,
        machine.cores,
        partial(machine.disk, folder),
        machine.clock,
        machine.wall_clock,
        machine.timer,
        hardware.displays,
        hardware.cameras,
        hardware.bluetooth,
    ]
    findings: list[Finding] = []
    for done, check in enumerate(checks, start=1):
        findings += check()
        if progress is not None:
            progress(done, len(checks))
    return findings
