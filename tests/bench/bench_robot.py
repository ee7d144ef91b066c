"""The estimator per crossing, packets through our parser and another's, samples and notifications through the radio."""

import asyncio
import itertools
import statistics
import time

import numpy as np
import pytest
from bleak import BleakClient
from shapely import box
from spherov2.controls.v2 import Packet as TheirPacket

from lab.clock import run
from robot.bolt import Bolt
from robot.link import COMMANDS_UUID
from robot.onboard import Estimator
from robot.packets import PacketParser
from robot.virtual.body import Body
from robot.virtual.bolt import SERVICES, VirtualBolt
from robot.virtual.radio import Peripheral, VirtualRadio

CROSSINGS = 10_000
ROBOT_S = 60.0
NOTIFICATIONS = 20_000
# Sent in one turn of the loop.
BURST = 50
# How many times faster than spherov2's our parser must be, and the runs of each in which that is found.
LEAST_RATIO, LEAST_RATIO_ONE_BYTE = 5.0, 1.0
RATIO_RUNS = 15


@pytest.fixture(autouse=True)
def shown(benchmark, capsys):
    """Say what was worked out, since the table has room for times alone."""
    yield
    with capsys.disabled():
        print("\n  ", ", ".join(f"{name} {value:g}" for name, value in benchmark.extra_info.items()))


def test_estimator_per_crossing(benchmark):
    rng = np.random.default_rng(1)
    places = np.cumsum(rng.uniform(0.5, 5, CROSSINGS)).tolist()

    def estimate():
        estimator = Estimator()
        for first in range(0, CROSSINGS, 10):
            estimator.start_line()
            for order, place in enumerate(places[first : first + 10]):
                estimator.crossing(place, order % 2 == 0)
            estimator.end_line()
        return estimator.area()

    benchmark(estimate)
    benchmark.extra_info["crossings"] = CROSSINGS
    benchmark.extra_info["us_per_crossing"] = round(1e6 * benchmark.stats.stats.median / CROSSINGS, 2)


def rolling(body):
    """A minute of a rolling, streaming BOLT: the driver and the virtual robot, bumble and the real bleak between."""

    async def minute():
        radio = VirtualRadio()
        await radio.start()
        twin = VirtualBolt(radio, body, "SB-0001")
        await twin.start()
        robot = Bolt("SB-0001", backend=radio.client_backend, scanner_backend=radio.scanner_backend)
        samples = []
        robot.on_sample = samples.append
        await robot.connect()
        await robot.start_stream(0.05)
        for heading_rad in range(6):
            await robot.drive(heading_rad, 25.0)
            await asyncio.sleep(ROBOT_S / 6)
        await robot.disconnect()
        await twin.close()
        await radio.close()
        return len(samples)

    return run(minute(), virtual=True)


def body():
    return Body(box(-50, -50, 50, 50), lambda x, y: np.full(x.shape, 20.0), np.random.default_rng(1))


def test_packets_through_our_parser_and_theirs(benchmark, monkeypatch):
    """The notifications of a session, in the pieces in which they came, through both, turn and turn about."""
    pieces = []
    notify = Peripheral.notify

    def recorded(self, uuid, value):
        pieces.append(value)
        notify(self, uuid, value)

    monkeypatch.setattr(Peripheral, "notify", recorded)
    rolling(body())

    def ours(parser_pieces):
        feed = PacketParser().feed
        return sum(len(feed(piece)) for piece in parser_pieces)

    def theirs(parser_pieces):
        received = []
        add = TheirPacket.Collector(received.append).add
        for piece in parser_pieces:
            add(piece)
        return len(received)

    single = [bytes([value]) for value in b"".join(pieces)]
    packets = ours(pieces)
    assert packets == theirs(pieces) == ours(single) == theirs(single)
    ours_s, theirs_s = least_s(ours, theirs, pieces)
    ours_single_s, theirs_single_s = least_s(ours, theirs, single)
    benchmark(ours, pieces)
    benchmark.extra_info.update(
        packets=packets,
        ours_per_s=round(packets / ours_s),
        theirs_per_s=round(packets / theirs_s),
        ratio=round(theirs_s / ours_s, 1),
        ratio_one_byte=round(theirs_single_s / ours_single_s, 1),
    )
    assert theirs_s / ours_s >= LEAST_RATIO
    assert theirs_single_s / ours_single_s >= LEAST_RATIO_ONE_BYTE


def least_s(ours, theirs, pieces):
    """The quickest of the runs of each, run in turn: what a busy machine adds only ever makes them slower."""

    def spent_s(parse):
        began_s = time.perf_counter()
        parse(pieces)
        return time.perf_counter() - began_s

    spent = [(spent_s(ours), spent_s(theirs)) for _ in range(RATIO_RUNS)]
    return min(pair[0] for pair in spent), min(pair[1] for pair in spent)


def test_a_minute_of_light_at_50_ms_through_the_radio(benchmark):
    """Virtual BOLT, bumble, the real bleak client, the driver, at virtual time."""
    assert benchmark(lambda: rolling(body())) >= 1190
    benchmark.extra_info["times_real_time"] = round(ROBOT_S / benchmark.stats.stats.median)


def test_notifications_through_the_real_client(benchmark):
    """As many as the virtual radio carries to the real ``BleakClient`` and the parser, by the machine's own clock."""
    frame = bytes.fromhex("8d 28 12 18 02 ff 3d cc cc cd 3e 4c cc cd 00 00 00 00 3d 4c cc cd 42 f7 00 00 8c d8")

    async def flood():
        radio = VirtualRadio()
        await radio.start()
        peripheral = await radio.add_peripheral("SB-0002", "D0:5F:B8:00:00:02", SERVICES)
        await peripheral.start()
        parser, received, whole = PacketParser(), itertools.count(1), asyncio.Event()

        def heard(_, data):
            for _packet in parser.feed(data):
                if next(received) == NOTIFICATIONS:
                    whole.set()

        async with BleakClient(peripheral.address, backend=radio.client_backend, timeout=10.0) as client:
            await client.start_notify(COMMANDS_UUID, heard)
            began_s = time.perf_counter()
            for _ in range(NOTIFICATIONS // BURST):
                for _ in range(BURST):
                    peripheral.notify(COMMANDS_UUID, frame)
                await asyncio.sleep(0)
            async with asyncio.timeout(60.0):
                await whole.wait()
            spent_s = time.perf_counter() - began_s
        await peripheral.close()
        await radio.close()
        return spent_s

    spent_s = []
    benchmark.pedantic(lambda: spent_s.append(run(flood(), virtual=False)), rounds=5, warmup_rounds=1)
    benchmark.extra_info["notifications"] = NOTIFICATIONS
    benchmark.extra_info["per_s"] = round(NOTIFICATIONS / statistics.median(spent_s))
