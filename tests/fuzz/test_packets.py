"""What a radio may deliver: no bytes of a stranger end in anything but packets, records, or one line."""

import asyncio
import math
import struct
from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.session.run import Run
from lab.store.layout import to_json
from robot import commands
from robot.collision import AXES, wall_normal_heading
from robot.commands import Collision
from robot.crossings import CrossingDetector, Levels
from robot.errors import PayloadError
from robot.micropython import wire
from robot.packets import MAX_FRAME_BYTES, Packet, PacketParser, encode
from robot.selfguided import SelfGuided
from robot.stream import Stream
from robot.turning import Leg
from tests.fuzz.harness import fuzz
from tests.fuzz.mutate import generator, mangled, pick

COMMANDS = tuple(one for one in vars(commands).values() if isinstance(one, commands.Command))
LEVELS = Levels(10.0, 100.0, 45.0, 55.0, 65.0)
STREAMS = (
    Stream.every(0.05, 0.02, attitude=False, locator_scale=1.0),
    Stream.every(0.05, 0.02, attitude=True, locator_scale=1.02),
)
DELIMITERS = (
    b"\x8d",
    b"\xd8",
    b"\xab",
    b"\xab\x05",
    b"\xab\x50",
    b"\xab\x23",
    b"\xd8\x8d",
    b"\x8d" * 40,
    b"\xab" * 2100,
)


def frame(rng):
    """A whole frame with a payload of any bytes, of the flags that robots use."""
    flags = pick(rng, (0x0A, 0x3A, 0x09, 0x39, 0x28, 0x08))
    return encode(
        Packet(
            flags,
            *(int(rng.integers(256)) for _ in range(3)),
            data=rng.bytes(int(rng.integers(40))),
            target=int(rng.integers(256)) if flags & 0x10 else None,
            source=int(rng.integers(256)) if flags & 0x20 else None,
            error=int(rng.integers(256)) if flags & 0x01 else None,
        )
    )


def radio(rng):
    """Some frames end to end, most of them broken, and where the stream is cut."""
    frames = [frame(rng) for _ in range(int(rng.integers(1, 6)))]
    data = b"".join(one if rng.random() < 0.4 else mangled(one, rng, frames, most=2) for one in frames)
    for _ in range(int(rng.integers(3))):
        place = int(rng.integers(len(data) + 1))
        data = data[:place] + pick(rng, DELIMITERS) + data[place:]
    data = data[:6000]
    return data, np.sort(rng.integers(len(data) + 1, size=int(rng.integers(8))))


def parsed(chunks):
    parser, found = PacketParser(), []
    for chunk in chunks:
        found += parser.feed(chunk)
        assert len(parser._open) <= MAX_FRAME_BYTES
    return found, parser


def counts(parser):
    return parser.bad_checksums, parser.malformed, parser.garbage_bytes


def survives_the_radio(given):
    """However it is cut, the same packets and the same counts; and a good frame behind it is found."""
    data, cuts = given
    whole, parser = parsed([data])
    by_byte, bytewise = parsed([data[i : i + 1] for i in range(len(data))])
    pieces = [data[a:b] for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True)]
    in_chunks, chunkwise = parsed(bytearray(piece) for piece in pieces)
    assert whole == by_byte == in_chunks
    assert counts(parser) == counts(bytewise) == counts(chunkwise)
    good = Packet(0x0A, 1, 2, 3, b"last")
    assert parser.feed(encode(good))[-1:] == [good]
    for packet in whole:
        assert PacketParser().feed(encode(packet)) == [packet]


def test_streams_of_frames(share):
    fuzz("frames, whole, byte by byte, in chunks", share(15_000, 1_000), radio, survives_the_radio)


@given(st.lists(st.binary(max_size=30) | st.sampled_from(DELIMITERS), max_size=12))
def test_any_chunks(chunks):
    data = b"".join(chunks)
    whole, parser = parsed([data])
    cut, other = parsed(chunks)
    assert whole == cut
    assert counts(parser) == counts(other)


def payload(rng):
    """A payload of any command: as long as it should be, or not; floats beside all reason."""
    command = pick(rng, COMMANDS)
    size = struct.calcsize(f">{command.reply or ''}")
    if rng.random() < 0.3:
        size = int(rng.integers(80))
    return command, rng.bytes(size), rng.bytes(18 if rng.random() < 0.9 else int(rng.integers(40)))


def reads_answers(given):
    command, data, bump = given
    values = command.decode(data)
    assert len(struct.pack(f">{command.reply or ''}", *values)) == len(data)
    collision = Collision.decode(bump)
    assert Collision.decode(collision.encode()) == collision
    assert 0 <= wall_normal_heading(collision.x_g, collision.y_g, 1.0, AXES) < 2 * math.pi


def test_answers_and_collisions(share):
    fuzz("answers and collision reports", share(12_000, 1_000), payload, reads_answers)


FLOATS = (0.0, -0.0, 0.1, 1.0, 60.0, 100.0, 1e-40, 3.4e38, -3.4e38, math.nan, math.inf, -math.inf)


def frames_of_a_run(rng):
    """The sensor frames of one run: some whole, some with values beside all reason, some cut."""
    stream = STREAMS[int(rng.integers(2))]
    size, x = stream.layout.packer.size // 4, 0.0
    frames = []
    for _ in range(int(rng.integers(1, 25))):
        x += float(rng.uniform(0, 0.02))
        values = [0.0] * (size - 5) + [x, 0.0, 0.15, 0.0, float(pick(rng, (10.0, 100.0)))]
        for _ in range(int(rng.integers(3))):
            values[int(rng.integers(size))] = pick(rng, FLOATS)
        data = stream.layout.packer.pack(*values)
        frames.append(data if rng.random() < 0.9 else mangled(data, rng))
    return stream, frames


def rolls(given):
    """The run that the frames make can be measured and logged, whatever they held."""
    stream, frames = given
    run = Run(0, "SB", Leg(0.0, None, True), 0.0, 15.0, True, CrossingDetector(LEVELS))
    refused = 0
    for number, data in enumerate(frames):
        try:
            sample, _ = stream.read(data, 0.05 * number)
        except PayloadError as error:
            refused += 1
            assert len(str(error).splitlines()) == 1
            continue
        assert all(map(math.isfinite, (sample.x_cm, sample.y_cm, sample.speed_cm_s)))
        run.feed(sample)
    to_json(
        {"length_cm": run.length_cm, "rolled_cm": run.rolled_cm, "crossings": [astuple(one) for one in run.crossings]}
    )
    if refused:
        raise PayloadError("sensor data", b"", expected="a whole run")


def test_sensor_frames(share):
    fuzz("sensor frames, rolled into runs", share(10_000, 800), frames_of_a_run, rolls)


RECORDS = (wire.STATUS_FORMAT, wire.LINE_FORMAT, wire.ESTIMATE_FORMAT)


def notifications(rng):
    """What a robot that estimates by itself may say: lines and estimates that belong together, and nonsense."""
    said = []
    for _ in range(int(rng.integers(1, 12))):
        number = int(rng.integers(4))
        kind = int(rng.integers(3))
        floats = [pick(rng, FLOATS) if rng.random() < 0.2 else float(rng.uniform(0, 100)) for _ in range(3)]
        data = (
            struct.pack(wire.STATUS_FORMAT, 0, 0, number, 1, floats[0], 3900),
            struct.pack(wire.LINE_FORMAT, 0, number, 2, *floats, 1000),
            struct.pack(wire.ESTIMATE_FORMAT, 0, number, *floats[:2], 5),
        )[kind]
        said.append((kind, data if rng.random() < 0.9 else mangled(data, rng)))
    return said


def listens(said):
    """Each is heard or dropped; the lines that are heard can be logged."""
    heard = []

    async def listen():
        robot = SelfGuided("CL-1234")
        robot._session = 0
        robot.on_line = heard.append
        ears = [robot._guarded("x" * 8, one) for one in (robot._on_status, robot._on_half, robot._on_estimate)]
        for kind, data in said:
            ears[kind](None, bytearray(data))

    asyncio.run(listen())
    for line in heard:
        to_json({"l1_cm": line.l1_cm, "l3_cm3": line.l3_cm3, "length_cm": line.length_cm})


def test_records_of_a_robot_on_its_own(share):
    fuzz("records of a robot on its own", share(4_000, 400), notifications, listens)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", range(4))
def test_a_place_that_is_no_number_is_dropped(value, place):
    values = [0.1, 0.2, 0.1, 0.0, 50.0]
    values[place] = value
    with pytest.raises(PayloadError):
        STREAMS[0].read(STREAMS[0].layout.packer.pack(*values), 1.0)


def test_light_that_is_no_number_is_kept_as_lost():
    sample, _ = STREAMS[0].read(STREAMS[0].layout.packer.pack(0.1, 0.2, 0.1, 0.0, math.nan), 1.0)
    assert math.isnan(sample.light_lux)
    assert generator(1, 2).integers(1 << 62) == generator(1, 2).integers(1 << 62)
