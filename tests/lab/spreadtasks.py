"""Work for the tests of spreading, importable in other processes."""

import os
import signal
import time
from pathlib import Path

from analysis.kernels import available_cores
from lab.base.errors import RequestError


def square(number):
    return number * number


def fussy(number):
    if number == 3:
        raise ValueError("three is\nno number")
    if number == 4:
        raise RequestError("four: not wanted; give five")
    if number == 5:
        return lambda: None  # cannot be sent
    return number


def deadly(item):
    """Dies each time when told "kill", once when given a path that is not there yet."""
    if item == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if isinstance(item, Path) and not item.exists():
        item.touch()
        os.kill(os.getpid(), signal.SIGSEGV)
    return str(item)


def slow(item):
    """Leaves a mark of each time that it is begun, and takes its time."""
    folder, number, seconds = item
    with Path(folder, f"{number}").open("a", encoding="ascii") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(seconds)
    return os.getpid()


def cores(_item):
    return available_cores(), os.getpid()
