"""Bluetooth, cameras, displays: what a session on the bench needs and the virtual one does not."""

from __future__ import annotations

import asyncio
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
from bleak import BleakScanner
from bleak.exc import BleakError

from lab.doctor.finding import Finding
from projector.device import ProjectorError
from projector.window import display_sizes
from tracking.usb import Capture, open_device

_SCAN_S = 3.0
_CAMERA_S = 5.0
_TRIED_BLINDLY = 3  # where the system does not list its cameras


def bluetooth() -> Iterator[Finding]:
    """Whether the radio hears anything."""

    async def scan() -> int:
        async with asyncio.timeout(4 * _SCAN_S):
            return len(await BleakScanner.discover(timeout=_SCAN_S))

    try:
        seen = asyncio.run(scan())
    except (BleakError, OSError, TimeoutError, EOFError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        text = f"no answer from the system's Bluetooth ({reason})" if isinstance(error, OSError) else reason
        cure = "switch Bluetooth on, plug in an adapter, let the terminal use it"
        yield Finding("bluetooth", "missing", text, cure, "hardware")
    else:
        yield Finding("bluetooth", "ok", f"{seen} devices in range", area="hardware")


def cameras() -> Iterator[Finding]:
    """Open each camera for one picture."""
    if sys.platform == "linux":
        numbers = sorted(int(node.name[5:]) for node in Path("/dev").glob("video*") if node.name[5:].isdigit())
        locked = [number for number in numbers if not os.access(f"/dev/video{number}", os.R_OK | os.W_OK)]
    else:
        numbers, locked = list(range(_TRIED_BLINDLY)), []
    if locked:
        cure = "let yourself use cameras: sudo usermod -aG video YOUR_NAME, then log in again"
        text = ", ".join(f"usb:{number}" for number in locked) + " may not be opened"
        yield Finding("camera rights", "missing", text, cure, "hardware")
    yield look_through([number for number in numbers if number not in locked])


def look_through(
    numbers: Sequence[int], opener: Callable[[int], Capture] = open_device, timeout_s: float = _CAMERA_S
) -> Finding:
    """What the cameras of these numbers show, each asked for one picture and given ``timeout_s`` for it."""
    sizes = {number: _first_picture(number, opener, timeout_s) for number in numbers}
    seen = [f"usb:{number} ({size[0]} x {size[1]})" for number, size in sizes.items() if size]
    if seen:
        return Finding("camera", "ok", ", ".join(seen), area="hardware")
    if numbers and sys.platform == "linux":
        silent = ", ".join(f"usb:{number}" for number in numbers)
        cure = "close other programs that use it, plug it in anew"
        return Finding("camera", "missing", f"no picture from {silent} in {timeout_s:g} s", cure, "hardware")
    return Finding("camera", "missing", "none", "plug in a webcam", "hardware")


def _first_picture(number: int, opener: Callable[[int], Capture], timeout_s: float) -> tuple[int, int] | None:
    """Width and height of a camera's first picture, or None. A driver that hangs is left behind in its thread."""
    found: list[tuple[int, int]] = []

    def look() -> None:
        capture = opener(number)
        try:
            if capture.isOpened() and capture.grab():
                good, picture = capture.retrieve()
                if good:
                    found.append((picture.shape[1], picture.shape[0]))
        except cv2.error:
            return
        finally:
            capture.release()

    thread = threading.Thread(target=look, name=f"look-usb-{number}", daemon=True)
    thread.start()
    thread.join(timeout_s)
    return found[0] if found else None


def displays() -> Iterator[Finding]:
    """The displays that a projector may be one of."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        cure = "start from a desktop, with the projector attached"
        yield Finding("display", "missing", "no screen", cure, "hardware")
        return
    try:
        sizes = display_sizes()
    except ProjectorError as error:
        text, _, cure = str(error).partition("; ")
        yield Finding("display", "missing", re.sub(r"\s+", " ", text), cure, "hardware")
        return
    listed = ", ".join(f"display:{number} ({width} x {height})" for number, (width, height) in enumerate(sizes))
    if len(sizes) > 1:
        yield Finding("display", "ok", listed, area="hardware")
    else:
        cure = "attach the projector and extend the desktop to it"
        yield Finding("display", "missing", f"only {listed or 'none'}", cure, "hardware")
