"""Feeds a subject with inputs that strangers made, and holds it to one promise.

It answers, or refuses in one line. It never raises anything else, takes no more than ``CPU_S`` seconds of this
process for one input, and does not grow without bound.
"""

import gc
import resource
import signal
import time
import traceback
import warnings
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

from lab.base.errors import ChordlabError
from tests.fuzz.mutate import generator

CPU_S = 20.0
GROWTH_MB = 600.0
LONGEST_MESSAGE = 1500
SEED = 20261123


class Hang(BaseException):
    """An input took more than ``CPU_S``."""


@dataclass
class Tally:
    """How a target fared."""

    name: str
    inputs: int = 0
    refused: int = 0
    worst_s: float = 0.0
    grown_mb: float = 0.0

    def __str__(self):
        return (
            f"{self.name}: {self.inputs} inputs, {self.refused} refused, worst {self.worst_s * 1e3:.0f} ms, "
            f"peak memory +{self.grown_mb:.0f} MB"
        )


def fuzz(name, count, make, subject, *, seed=SEED, most_mb=GROWTH_MB):
    """Give ``subject`` the ``count`` inputs of ``make(rng)``; returns a Tally, fails with the seed of the first fault.

    A fault is made again by ``subject(make(generator(seed, number)))``.
    """
    tally = Tally(name)
    before_mb = peak_mb()
    for number in range(count):
        given = make(generator(seed, number))
        begun = time.process_time()
        try:
            tally.refused += is_refused(subject, given)
        except (Exception, Hang):  # noqa: BLE001 - whatever it is, it is a fault to be shown
            pytest.fail(
                f"{name}: input {number} of seed {seed}: {short(given)}\n{traceback.format_exc(limit=-6)}",
                pytrace=False,
            )
        tally.worst_s = max(tally.worst_s, time.process_time() - begun)
        tally.inputs += 1
    tally.grown_mb = peak_mb() - before_mb
    print(f"\n[fuzz] {tally}")
    assert tally.grown_mb < most_mb, tally
    return tally


def is_refused(subject, given):
    """Whether ``subject`` refuses what it is given, in one line; raises whatever else comes of it."""
    try:
        with limited():
            subject(given)
    except ChordlabError as error:
        message = str(error)
        assert message.strip(), f"{type(error).__name__} says nothing"
        assert len(message.splitlines()) == 1, f"more than one line: {message!r}"
        assert len(message) < LONGEST_MESSAGE, f"{len(message)} letters: {message[:300]!r}"
        return True
    return False


@contextmanager
def limited(cpu_s=CPU_S):
    """Raise Hang once the process has worked for ``cpu_s`` seconds; its own time, so that a busy machine is no hang."""

    def ring(*_):
        raise Hang(f"more than {cpu_s:g} s")

    before = signal.signal(signal.SIGVTALRM, ring)
    signal.setitimer(signal.ITIMER_VIRTUAL, cpu_s)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def peak_mb():
    """The largest that this process has ever been."""
    gc.collect()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def short(given):
    """An input as a failure shows it."""
    text = repr(given)
    return text if len(text) < 3000 else f"{text[:2000]} … {text[-800:]} ({len(text)} letters)"
