"""The estimator per crossing, packets through the parser, and light samples through the whole radio chain."""

import asyncio

import numpy as np
from shapely import box

from lab.clock import run
from robot.bolt import Bolt
from robot.commands import matrix_colour
from robot.onboard import Estimator
from robot.packets import PacketParser, encode
from robot.virtual.body import Body
from robot.virtual.bolt import VirtualBolt
from robot.virtual.radio import VirtualRadio

CROSSINGS = 10_000
FRAMES = 5_000
ROBOT_S = 60.0


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

    benchmark.extra_info["crossings"] = CROSSINGS
    benchmark(estimate)


def test_packets_through_the_parser(benchmark):
    stream = b"".join(encode(matrix_colour(number % 256, 7, 0xAB).packet(number % 255)) for number in range(FRAMES))
    benchmark.extra_info["packets"] = FRAMES
    assert len(benchmark(lambda: PacketParser().feed(stream))) == FRAMES


def test_a_minute_of_light_at_50_ms_through_the_radio(benchmark):
    """Virtual BOLT, bumble, the real bleak client, the driver: divide 60 s by the time for the ratio to real time."""

    async def minute():
        body = Body(box(-50, -50, 50, 50), lambda x, y: np.full(x.shape, 20.0), np.random.default_rng(1))
        radio = VirtualRadio()
        await radio.start()
        twin = VirtualBolt(radio, body, "SB-0001")
        await twin.start()
        robot = Bolt("SB-0001", backend=radio.client_backend, scanner_backend=radio.scanner_backend)
        samples = []
        robot.on_sample = samples.append
        await robot.connect()
        await robot.start_stream(0.05)
        await asyncio.sleep(ROBOT_S)
        await robot.disconnect()
        await twin.close()
        await radio.close()
        return len(samples)

    assert benchmark(lambda: run(minute(), virtual=True)) >= 1190
