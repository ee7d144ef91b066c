"""The session's side of the live page: controls, the clock's pace, the lossy feed. All without a page."""

import asyncio
import contextlib
import json
import math
import selectors
import socket
import time

import numpy as np
import pytest

from lab.clock import Pace, VirtualTimeLoop
from lab.clock import run as run_on_clock
from lab.live.channel import make_channel, read_news, send_command, send_news, take_commands
from lab.live.feed import Feed
from lab.live.live import Live
from lab.session.experiment import run_experiment
from lab.settings.load import load_settings
from lab.store.reader import SessionReader
from robot.device import Sample
from tests.lab.conftest import STARTED
from tracking.cameras import Frame


def roll_live(out, live, press=lambda live, step: None, **overrides):
    keys = {"out": str(out), "camera": "none", "shape": "square", "stop.lines": 8, "seed": 3}
    keys |= {name.replace("__", "."): value for name, value in overrides.items()}
    settings = load_settings(None, keys)
    return run_experiment(settings, started=STARTED, watch=lambda step: press(live, step), live=live)


def events_of(finished):
    return list(SessionReader(finished.folder).events())


def test_a_watched_session_is_byte_for_byte_the_unwatched_one(tmp_path):
    here, there = make_channel()
    live = Live(here)
    watched = roll_live(tmp_path / "a", live, press=lambda live, step: live.feed.look())
    alone = roll_live(tmp_path / "b", None, press=lambda live, step: None)
    logs = [(finished.folder / "events.jsonl").read_bytes() for finished in (watched, alone)]
    assert logs[0] == logs[1]
    heads = []
    there.news.setblocking(False)
    while True:
        try:
            heads.append(read_news(there.news.recv(1 << 16))[0])
        except BlockingIOError:
            break
    assert heads[-1]["folder"] == str(watched.folder)
    assert any(head.get("robots", {}).get("SB-7E57", {}).get("battery_v", 0) > 3 for head in heads)
    here.close()
    there.close()


def test_stop_ends_the_session_at_once_and_the_robot_stands(tmp_path):
    def press(live, step):
        if step.n == 3:
            live.controls.stop()

    finished = roll_live(tmp_path, live := Live(), press)
    *_, end = events_of(finished)
    assert (end["event"], end["state"], end["n"]) == ("end", "stopped", 3)
    assert finished.outcome.state == "stopped"
    assert finished.failure is None
    assert not live.controls.wants_next


def test_next_shape_is_a_stop_that_says_so(tmp_path):
    live = Live(next_shape="circle")
    finished = roll_live(tmp_path, live, lambda live, step: live.controls.take({"do": "next"}))
    assert finished.outcome.state == "stopped"
    assert live.controls.wants_next


@pytest.mark.parametrize("robots", [1, 2])
def test_time_stands_still_in_a_pause(tmp_path, robots):
    """Resumed by the wall's clock, since no virtual timer can fire; the log shows no time gone by."""
    here, there = make_channel()
    live = Live(here)
    presses = []

    def press(live, step):
        if step.n == 3 and not presses:
            live.controls.pause()
            presses.append(time.monotonic())
            loop = asyncio.get_running_loop()
            loop.run_in_executor(None, lambda: (time.sleep(0.3), send_command(there, {"do": "resume"})))

    settings = {"robot": ["virtual"] * robots} if robots > 1 else {}
    finished = roll_live(tmp_path, live, press, **settings)
    events = events_of(finished)
    kinds = [event["event"] for event in events]
    pause, resume = events[kinds.index("pause")], events[kinds.index("resume")]
    assert (pause["by"], pause["robot"], resume["by"], resume["robot"]) == ("page", "", "page", "")
    assert finished.outcome.state == "complete"
    if robots == 1:
        assert resume["t_s"] - pause["t_s"] < 0.06  # to the next sample at most
        after = next(event for event in events[kinds.index("resume") :] if event["event"] == "line")
        assert not after["counts"]  # the robot may have been carried meanwhile
    here.close()
    there.close()


def test_a_page_that_dies_in_a_pause_lets_the_session_go_on(tmp_path):
    here, there = make_channel()
    said = []

    def press(live, step):
        if step.n == 2 and not live.controls.paused and not said:
            live.controls.pause()
            there.close()

    finished = roll_live(tmp_path, Live(here, say=said.append), press)
    assert finished.outcome.state == "complete"
    assert "gone" in said[0]
    here.close()


def test_a_note_is_kept_and_one_of_before_the_start_too(tmp_path):
    live = Live()
    live.controls.note("darkened\nthe room \x1b[2J")
    pressed = []

    def press(live, step):
        if not pressed:
            live.controls.take({"do": "note", "text": "x" * 2000})
        pressed.append(step)

    first, second = [event for event in events_of(roll_live(tmp_path, live, press)) if event["event"] == "note"]
    assert first["text"] == "darkened the room \ufffd[2J"
    assert len(second["text"]) < 510
    assert math.isfinite(first["t_s"])
    assert second["t_s"] > first["t_s"]


def test_a_robot_that_rolls_alone_stops_but_does_not_pause(tmp_path):
    live = Live(can_pause=False)

    def press(live, step):
        live.controls.pause()
        assert not live.controls.paused
        if step.n == 2:
            live.controls.stop()

    finished = roll_live(tmp_path, live, press, robot="onboard:virtual")
    assert (finished.outcome.state, finished.outcome.n) == ("stopped", 2)


def test_nonsense_from_the_page_changes_nothing(tmp_path):
    here, there = make_channel()
    taken = []

    async def listen():
        there.commands.sendall(b'no json\n[1]\n{"do": "stop"}\n\xff\n')
        there.commands.sendall(b"x" * 100_000 + b"\n")
        await asyncio.wait_for(take_commands(here, taken.append), 5)

    asyncio.run(listen())
    assert taken == [{"do": "stop"}]  # and a line without end breaks the channel, not the session
    live = Live()
    for command in [*taken, {}, {"do": 3}, {"do": "note"}, {"do": "note", "text": 7}, {"do": "fly"}]:
        live.controls.take(command)
    assert live.controls.stop_asked
    here.close()
    there.close()


def test_news_that_nobody_takes_are_dropped_without_waiting():
    here, there = make_channel()
    sent = [send_news(here, {"n": n}, b"\0" * 50_000) for n in range(50)]
    assert sent[0]
    assert not send_news(here, {}, b"\0" * 100_000)
    there.close()
    for n in range(20):
        send_news(here, {"n": n})
    assert not any(send_news(here, {"n": n}) and send_news(here, {"n": n}) for n in range(3))
    here.close()


def test_datagrams_of_others_are_not_read():
    here, there = make_channel()
    there.news.settimeout(0.3)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b'{"kind": "news", "paused": true}\n', there.news.getsockname())
        send_news(here, {"kind": "news", "paused": False})
        assert read_news(there.news.recv(1 << 16)) == ({"kind": "news", "paused": False}, b"")
        with pytest.raises(TimeoutError):
            there.news.recv(1 << 16)
    here.close()
    there.close()


def test_the_feed_speaks_a_few_times_a_second_and_pictures_are_small():
    here, there = make_channel()
    there.news.settimeout(1)
    now_s = [0.0]
    feed = Feed(here, now=lambda: now_s[0])
    for step in range(1000):  # ten seconds at 100 samples/s
        now_s[0] = step / 100
        feed.look()
        feed.sample("r", Sample(now_s[0], 20.0, 0, 0, 0), lit=False, line=1, battery_v=3.9)
    there.news.setblocking(False)
    heads = []
    while True:
        try:
            heads.append(read_news(there.news.recv(1 << 16))[0])
        except BlockingIOError:
            break
    assert 40 <= len(heads) <= 60
    assert sum(len(head["light"].get("r", [])) for head in heads) >= 950
    picture = np.full((720 * 3 // 2, 1280), 128, dtype=np.uint8)
    picture[:720] = np.random.default_rng(1).integers(0, 255, (720, 1280))
    feed.look()
    for index in range(3):
        feed.frame(Frame(index, 0.0, 0.0, picture))
    head, jpeg = read_news(there.news.recv(1 << 16))
    assert head["kind"] == "picture"
    assert jpeg.startswith(b"\xff\xd8")
    with pytest.raises(BlockingIOError):
        there.news.recv(1 << 16)
    here.close()
    there.close()


def test_while_nobody_looks_nothing_is_made():
    here, there = make_channel()
    there.news.setblocking(False)
    now_s = [0.0]
    feed = Feed(here, now=lambda: now_s[0])
    picture = Frame(0, 0.0, 0.0, np.zeros((72 * 3 // 2, 128), dtype=np.uint8))

    def told():
        feed.sample("r", Sample(now_s[0], 20.0, 0, 0, 0), lit=False, line=1, battery_v=3.9)
        feed.frame(picture)
        kinds = []
        with contextlib.suppress(BlockingIOError):
            while True:
                kinds.append(read_news(there.news.recv(1 << 16))[0]["kind"])
        return kinds

    assert told() == []
    feed.look()
    assert told() == ["news", "picture"]
    now_s[0] += 1
    assert told() == ["news", "picture"]
    now_s[0] += 60  # the page was closed, or its server hangs
    assert told() == []
    feed.tell(said="on")  # what is kept is told whoever looks: it is little, and never said again
    assert told() == ["news"]
    here.close()
    there.close()


class _Clock:
    """A machine's clock that only waiting moves on."""

    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s


def paced_loop(monkeypatch, pace, clock, start_s=0.0):
    class Selector(selectors.DefaultSelector):
        def select(self, timeout=None):
            clock.now_s += timeout or 0.0
            return super().select(0)

    monkeypatch.setattr("lab.clock.selectors.DefaultSelector", Selector)
    return VirtualTimeLoop(start_s, pace)


def test_a_paced_clock_goes_at_its_multiple_of_real_time(monkeypatch):
    clock = _Clock()
    loop = paced_loop(monkeypatch, Pace(20.0, now=clock), clock)

    async def roll():
        for _ in range(4000):
            await asyncio.sleep(0.05)

    loop.run_until_complete(roll())
    loop.close()
    assert clock.now_s - 100.0 == pytest.approx(200 / 20, abs=0.05)


def test_a_clock_that_fell_behind_does_not_hurry_afterwards(monkeypatch):
    clock = _Clock()
    loop = paced_loop(monkeypatch, Pace(20.0, now=clock), clock)

    async def roll():
        await asyncio.sleep(20)
        clock.now_s += 50  # something took long
        since_s = clock.now_s
        await asyncio.sleep(20)
        return clock.now_s - since_s

    assert loop.run_until_complete(roll()) == pytest.approx(1.0, abs=0.02)
    loop.close()


def test_pacing_does_not_change_the_times(tmp_path):
    async def ticks():
        seen = []
        for step in (0.1, 0.025, 0.3):
            await asyncio.sleep(step)
            seen.append(asyncio.get_running_loop().time())
        return seen

    assert run_on_clock(ticks(), virtual=True) == run_on_clock(ticks(), virtual=True, pace=Pace(100.0))
    logs = []
    for speed, name in ((None, "a"), (2000.0, "b")):
        finished = roll_live(tmp_path / name, Live(speed=speed), stop__lines=3)
        logs.append((finished.folder / "events.jsonl").read_text())
    assert logs[0] == logs[1]
    assert json.loads(logs[0].splitlines()[-1])["state"] == "complete"
