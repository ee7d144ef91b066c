"""Sessions that are killed: real processes, each told when to die.

A nursery is a process that holds a session just before its folder is made and forks off one child for each kill, so
that a kill costs no more than what was rolled until then. A child tells by a pipe when it made its folder and after
each append that returned. SIGKILL strikes it after a time, or before one of its operations on the file system.
"""

import asyncio
import hashlib
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from dataclasses import dataclass
from pathlib import Path

from lab.reopen.recover import recover
from lab.store.writer import SessionWriter
from tests.lab.conftest import roll

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["tests.lab.killing"])
_CHANGES = {"os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.link", "os.symlink"}
_LONGEST_S = 120


@dataclass(frozen=True)
class Killed:
    """What became of a child: what it told before its end, and whether it was killed."""

    folder: Path | None
    appended: int
    was_killed: bool
    operations: int
    took_s: float


class Nursery:
    """Where sessions of the same settings are killed, one after the other.

    With ``early`` a child is forked off before it opens its bench: a camera has threads, which no fork copies.
    """

    def __init__(self, keys, *, early=False):
        orders, self._orders = CONTEXT.Pipe(duplex=False)
        self._heard, telling = CONTEXT.Pipe(duplex=False)
        self._server = CONTEXT.Process(target=_hold, args=(orders, telling, keys, early), daemon=True)
        self._server.start()
        orders.close()
        telling.close()

    def begin(self, place, *, after_s=None, at_operation=None):
        """Have a child roll below ``place`` and die; `wait` for it before the next."""
        self._orders.send((str(place), after_s, at_operation))

    def wait(self):
        """Listen to the child to its end."""
        folder, appended, operations, took_s = None, 0, 0, float("nan")
        while True:
            if not self._heard.poll(_LONGEST_S):
                raise TimeoutError("a session neither ended nor died")
            kind, value = self._heard.recv()
            if kind == "made":
                folder = Path(value)
            elif kind == "appended":
                appended += 1
            elif kind == "done":
                operations, took_s = value
            else:
                return Killed(folder, appended, value, operations, took_s)

    def close(self):
        """Give it up; safe at any time. SIGTERM would be taken for the session's."""
        self._server.kill()
        self._server.join(_LONGEST_S)


def _hold(orders, telling, keys, early):
    """The nursery's process."""
    create, append = SessionWriter.create.__func__, SessionWriter.append
    count = made_s = die_after_s = None

    def child():
        """In each child: where it is to roll. The nursery never returns."""
        nonlocal count, die_after_s
        loop = asyncio._get_running_loop()
        while True:
            place, die_after_s, at_operation = orders.recv()
            pid = os.fork()
            if pid == 0:
                asyncio._set_running_loop(loop)  # which a fork forgets
                count = die_before(at_operation, place)
                return Path(place)
            _, status = os.waitpid(pid, 0)
            telling.send(("ended", os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL))

    def telling_create(cls, root, *args, **kwargs):
        nonlocal made_s
        writer = create(cls, root if early else child(), *args, **kwargs)
        telling.send(("made", str(writer.folder)))
        made_s = time.perf_counter()
        if die_after_s is not None:
            threading.Thread(target=_die, args=(die_after_s,), daemon=True).start()
        return writer

    def telling_append(self, kind, **data):
        append(self, kind, **data)
        telling.send(("appended", kind))

    SessionWriter.create, SessionWriter.append = classmethod(telling_create), telling_append
    try:
        roll(child() if early else Path(os.devnull), **keys)
        telling.send(("done", (count(), time.perf_counter() - made_s)))
    except BaseException:  # noqa: BLE001 - a child must not live on as its nursery's copy
        traceback.print_exc()
    finally:
        os._exit(1)


def _die(after_s):
    time.sleep(after_s)
    os.kill(os.getpid(), signal.SIGKILL)


def mend_dying(folder, at_operation):
    """Recover a folder in a process that dies before its n-th operation; whether it did, else how many there were."""
    heard, telling = CONTEXT.Pipe(duplex=False)
    child = CONTEXT.Process(target=_mend, args=(telling, str(folder), at_operation), daemon=True)
    child.start()
    telling.close()
    child.join(_LONGEST_S)
    if child.exitcode == -signal.SIGKILL:
        return None
    return heard.recv()


def _mend(telling, folder, at_operation):
    count = die_before(at_operation, folder)
    recover(Path(folder))
    telling.send(count())


def die_before(at_operation, within):
    """Have this process killed before its n-th change (from 0) below a folder: a name, a file opened, written, synced.

    Returns how to ask for the number of changes so far.
    """
    so_far = -1

    def change():
        nonlocal so_far
        so_far += 1
        if so_far == at_operation:
            os.kill(os.getpid(), signal.SIGKILL)

    def hook(event, args):
        is_change = event in _CHANGES
        if event == "open" and isinstance(args[2], int):
            is_change = bool(args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
        if not is_change or not isinstance(args[0], str | bytes | Path):
            return
        if os.fsdecode(args[0]).startswith(str(within)):
            change()

    def syncing(descriptor, fsync=os.fsync):
        change()
        fsync(descriptor)

    def writing(descriptor, data, write=os.write):
        if str(within) not in str(Path(f"/proc/self/fd/{descriptor}").readlink()):
            return write(descriptor, data)
        change()
        if so_far + 1 == at_operation:  # a record half written
            write(descriptor, data[: len(data) // 2])
        change()
        return write(descriptor, data)

    sys.addaudithook(hook)
    os.fsync, os.write = syncing, writing
    return lambda: so_far + 1


def digests(folder):
    """Every file below a folder, by name."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
