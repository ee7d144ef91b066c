"""Files that are there whole or not at all, and are what they seem: no link is followed to write one."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import BinaryIO

# Links are never followed; where the system does not know a flag, it has no such links or no such modes.
PLAIN = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)


def sync_folder(folder: Path) -> None:
    """Make renames and new names in ``folder`` outlive a power cut (where the system lets a folder be opened)."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_file(path: Path) -> None:
    """Bring what was written to a file, by whom ever, to the disk. Raises OSError, for a link too."""
    descriptor = os.open(path, (os.O_RDWR if os.name == "nt" else os.O_RDONLY) | PLAIN)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it that are missing, to outlive a power cut.

    Raises:
        FileExistsError: it is there already.
        OSError: it cannot be made.
    """
    if not folder.parent.is_dir():
        with contextlib.suppress(FileExistsError):
            make_folder(folder.parent)
    folder.mkdir()
    try:
        sync_folder(folder.parent)
    except OSError:
        with contextlib.suppress(OSError):
            folder.rmdir()
        raise


def write_all(descriptor: int, data: bytes) -> None:
    """Write all of it to an open file; the system may take a part at a time. Raises OSError, with a part written."""
    left = memoryview(data)
    while left:
        left = left[os.write(descriptor, left) :]


def open_new(path: Path) -> BinaryIO:
    """Open a file that is new for certain: what bears its name, a link too, is taken away first. Raises OSError."""
    path.unlink(missing_ok=True)
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | PLAIN, 0o666), "wb")


def write_synced(path: Path, data: bytes) -> None:
    """Write a new file, as `open_new` does, and sync it; its name is synced with its folder, by the caller."""
    with open_new(path) as file:
        write_all(file.fileno(), data)
        os.fsync(file.fileno())


def write_aside(path: Path, data: bytes) -> None:
    """Write a file whole or not at all: aside as ``NAME.part``, synced, renamed, its folder synced.

    A link at either name is replaced, not followed; what it leads to stays as it is. Raises OSError.
    """
    aside = path.with_name(path.name + ".part")
    try:
        write_synced(aside, data)
        aside.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            aside.unlink()
        raise
    sync_folder(path.parent)
