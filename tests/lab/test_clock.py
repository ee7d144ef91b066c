import asyncio
import threading
import time

import pytest

from lab.clock import VirtualTimeLoop, run


def test_virtual_time_jumps_instead_of_waiting():
    async def sleeper():
        loop = asyncio.get_running_loop()
        assert loop.time() == 0.0
        for _ in range(1000):
            await asyncio.sleep(3.6)
        return loop.time()

    started_s = time.monotonic()
    assert run(sleeper(), virtual=True) == pytest.approx(3600.0, abs=1e-6)
    assert time.monotonic() - started_s < 60  # an hour of it


def test_timers_fire_in_order_whatever_the_order_they_were_set():
    seen: list[float] = []

    async def note(delay_s: float):
        await asyncio.sleep(delay_s)
        seen.append(delay_s)

    async def main():
        await asyncio.gather(*(note(delay_s) for delay_s in (5.0, 0.1, 3.0, 0.2)))

    run(main(), virtual=True)
    assert seen == [0.1, 0.2, 3.0, 5.0]


def test_timeouts_hold_at_virtual_time():
    async def main():
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(7):
                await asyncio.sleep(1e6)
        return asyncio.get_running_loop().time()

    assert run(main(), virtual=True) == pytest.approx(7.0)


@pytest.mark.parametrize("start_s", [1e7, 3.3e7, 1e9])
def test_timers_fire_after_months_of_virtual_time(start_s):
    seen: list[float] = []

    async def main():
        loop = asyncio.get_running_loop()
        for delay_s in (0.1, 0.3, 0.7):
            loop.call_later(delay_s, seen.append, delay_s)
        await asyncio.sleep(1)
        return loop.time()

    assert run(main(), virtual=True, not_before_s=start_s) == pytest.approx(start_s + 1, rel=1e-15)
    assert seen == [0.1, 0.3, 0.7]


def test_a_thread_can_wake_a_loop_that_has_no_timer():
    async def main():
        done = asyncio.Event()
        loop = asyncio.get_running_loop()
        threading.Timer(0.05, lambda: loop.call_soon_threadsafe(done.set)).start()
        await done.wait()
        return loop.time()

    assert run(main(), virtual=True) == 0.0


def test_the_real_clock_is_the_machines_monotonic_clock():
    async def main():
        return asyncio.get_running_loop().time(), type(asyncio.get_running_loop())

    before = time.monotonic()
    at_s, kind = run(main(), virtual=False)
    assert before <= at_s <= time.monotonic()
    assert kind is not VirtualTimeLoop


def test_an_interrupt_lets_the_session_clean_up():
    cleaned: list[str] = []

    async def main():
        try:
            asyncio.get_running_loop().call_soon(_raise_sigint)
            await asyncio.sleep(1e9)
        finally:
            await asyncio.sleep(1)
            cleaned.append("stopped")

    def _raise_sigint():
        import signal

        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run(main(), virtual=True)
    assert cleaned == ["stopped"]
