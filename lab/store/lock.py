"""Who may write in a session's folder: one process at a time, by a lock that dies with it."""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from lab.base.files import PLAIN
from lab.store.layout import LOCK, SessionFolderError

_LONGEST_PID = 20


@contextmanager
def writing(folder: Path) -> Generator[None]:
    """Hold the lock of a session's folder. Within the process that holds it, it may be taken again.

    The kernel frees it when the process dies, so that a lock file left behind by one locks nothing.

    Raises:
        SessionFolderError: another process writes in the folder, or the folder cannot be written to.
    """
    if not folder.is_dir():
        raise SessionFolderError(folder, "is no folder; name a session's")
    path = folder.resolve() / LOCK
    lock = FileLock(path, timeout=0, thread_local=False, is_singleton=True, on_acquired=_sign)
    try:
        lock.acquire()
    except Timeout:
        raise SessionFolderError(
            folder, f"is being written by another chordlab ({_holder(path)}); wait until it ends"
        ) from None
    except OSError as error:
        raise SessionFolderError(
            folder, f"{LOCK} cannot be taken ({error.strerror}); free it, or write to a copy of the folder"
        ) from error
    try:
        yield
    finally:
        if lock.lock_counter == 1:
            # While it is still held: who waits on the file without a name takes it for no lock, and looks again.
            with suppress(OSError):
                path.unlink()
        lock.release()


def is_being_written(folder: Path) -> bool:
    """Whether another process writes in the folder, or nobody can."""
    try:
        with writing(folder):
            return False
    except SessionFolderError:
        return True


def writer_of(folder: Path) -> str | None:
    """Who writes in a session's folder at the moment; None where nobody does. Nothing is changed there."""
    path = folder / LOCK
    try:
        descriptor = os.open(path, os.O_RDONLY | PLAIN | getattr(os, "O_NONBLOCK", 0))
    except PermissionError:  # on Windows what is locked cannot be read
        return "another process"
    except OSError:  # no lock was taken, or none that is ours
        return None
    try:
        if sys.platform == "win32":
            os.read(descriptor, 1)
        else:
            import fcntl  # noqa: PLC0415

            # shared, so that looking on disturbs nobody who looks too
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return _holder(path)
    finally:
        os.close(descriptor)
    return None


def _sign(descriptor: int) -> None:
    """Say in the lock file who holds it; a file that has another name too is not ours to write to."""
    found = os.fstat(descriptor)
    if not stat.S_ISREG(found.st_mode) or found.st_nlink != 1:
        raise OSError(errno.EMLINK, "it is no plain file")
    os.ftruncate(descriptor, 0)
    os.lseek(descriptor, 0, os.SEEK_SET)
    os.write(descriptor, f"{os.getpid()}\n".encode("ascii"))


def _holder(path: Path) -> str:
    """Who holds the lock, where that can be read."""
    try:
        descriptor = os.open(path, os.O_RDONLY | PLAIN | getattr(os, "O_NONBLOCK", 0))
        try:
            said = os.read(descriptor, _LONGEST_PID).strip()
        finally:
            os.close(descriptor)
    except OSError:  # just given back, or, on Windows, locked for readers too
        said = b""
    return f"process {int(said)}" if said.isdigit() else "another process"
