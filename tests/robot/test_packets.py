from __future__ import annotations

import itertools
import math
import struct
import sys
from collections.abc import Iterable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.base.errors import RequestError
from robot import commands
from robot.commands import Collision, Request
from robot.errors import DriveError, PayloadError
from robot.packets import MAX_FRAME_BYTES, Flag, Packet, PacketParser, checksum, encode

REQUESTS = {
    "8d 0a 13 0d 00 d5 d8": Request(commands.WAKE),
    "8d 0a 13 01 00 e1 d8": Request(commands.SLEEP),
    "8d 0a 13 03 00 df d8": Request(commands.BATTERY_VOLTAGE),
    "8d 0a 10 01 00 e4 d8": Request(commands.API_VERSION),
    "8d 0a 11 00 00 e4 d8": Request(commands.MAIN_APP_VERSION),
    "8d 0a 11 06 00 de d8": Request(commands.MAC_ADDRESS),
    "8d 0a 10 00 00 ab 23 ab 05 ab 50 d5 d8": Request(commands.PING, bytes.fromhex("ab8dd8")),
    "8d 3a 12 01 16 06 00 96 d8": Request(commands.RESET_YAW),
    "8d 3a 12 01 16 07 00 3c 00 5a 00 ff d8": commands.drive(60, math.pi / 2),
    "8d 3a 12 01 16 07 00 28 01 67 00 05 d8": commands.drive(40, math.radians(-1)),
    "8d 3a 12 01 16 07 00 ab 05 00 ab 50 00 30 d8": commands.drive(141, math.radians(216)),
    "8d 3a 12 01 16 07 00 00 00 00 00 95 d8": commands.drive(0, 0.0),
    "8d 3a 12 01 16 01 00 01 78 02 78 a8 d8": Request(commands.RAW_MOTORS, commands.RAW_MOTORS.payload(1, 120, 2, 120)),
    "8d 3a 12 01 16 0c 00 01 8f d8": Request(
        commands.STABILISATION, commands.STABILISATION.payload(commands.STABILISE_FULL)
    ),
    "8d 3a 11 01 1a 1c 00 3f ff 00 00 00 00 ff 40 d8": commands.leds({0: 255, 1: 0, 2: 0, 3: 0, 4: 0, 5: 255}),
    "8d 3a 12 01 1a 2f 00 ff 80 00 ea d8": commands.matrix_colour(0xFF, 0x80, 0),
    "8d 3a 12 01 18 30 00 6a d8": Request(commands.AMBIENT_LIGHT),
    "8d 3a 12 01 18 0c 00 00 04 00 00 8a d8": commands.stream_extended(commands.layout_for("ambient_lux").extended),
    "8d 3a 12 01 18 00 00 00 32 00 00 07 00 78 e9 d8": commands.stream(
        50,
        commands.layout_for(
            *("pitch_deg", "roll_deg", "yaw_deg", "locator_x_m", "locator_y_m", "velocity_x_m_s", "velocity_y_m_s")
        ).primary,
    ),
    "8d 3a 12 01 18 11 00 01 5a 82 5a 82 01 cf d8": commands.collision_setup(1, (90, 130, 90, 130), 0.01),
    "8d 3a 12 01 18 13 00 87 d8": Request(commands.RESET_LOCATOR),
}
ANSWERS = {
    "8d 09 13 0d 00 00 d6 d8": Packet(0x09, 0x13, 0x0D, 0, error=0),
    "8d 39 01 12 16 07 00 00 96 d8": Packet(0x39, 0x16, 0x07, 0, target=1, source=0x12, error=0),
    "8d 39 01 12 16 07 00 07 8f d8": Packet(0x39, 0x16, 0x07, 0, target=1, source=0x12, error=7),
    "8d 09 13 03 00 00 01 8e 51 d8": Packet(0x09, 0x13, 0x03, 0, b"\x01\x8e", error=0),
    "8d 39 01 12 18 30 00 00 42 f7 00 00 32 d8": Packet(
        0x39, 0x18, 0x30, 0, bytes.fromhex("42f70000"), target=1, source=0x12, error=0
    ),
    "8d 28 12 18 02 ff 3d cc cc cd 3e 4c cc cd 00 00 00 00 3d 4c cc cd 42 f7 00 00 8c d8": Packet(
        0x28, 0x18, 0x02, 0xFF, struct.pack(">5f", 0.1, 0.2, 0.0, 0.05, 123.5), source=0x12
    ),
    "8d 28 12 18 12 ff 10 00 f8 00 00 64 01 00 c8 00 0a 00 00 3c 00 00 30 39 b8 d8": Packet(
        0x28, 0x18, 0x12, 0xFF, bytes.fromhex("1000f80000640100c8000a00003c00003039"), source=0x12
    ),
    "8d 28 01 13 11 ff b3 d8": Packet(0x28, 0x13, 0x11, 0xFF, source=1),
    "8d 08 13 06 ff 05 da d8": Packet(0x08, 0x13, 0x06, 0xFF, b"\x05"),
}


@pytest.mark.parametrize("frame", REQUESTS)
def test_a_request_encodes_to_the_known_bytes(frame: str) -> None:
    assert encode(REQUESTS[frame].packet(0)).hex(" ") == frame


@pytest.mark.parametrize("frame", ANSWERS)
def test_known_bytes_decode_and_encode_back(frame: str) -> None:
    data = bytes.fromhex(frame)
    assert PacketParser().feed(data) == [ANSWERS[frame]]
    assert encode(ANSWERS[frame]) == data


def test_answers_decode_to_their_values() -> None:
    assert commands.BATTERY_VOLTAGE.decode(b"\x01\x8e") == (398,)
    assert commands.AMBIENT_LIGHT.decode(bytes.fromhex("42f70000")) == (123.5,)
    layout = commands.layout_for("ambient_lux", "velocity_y_m_s", "velocity_x_m_s", "locator_y_m", "locator_x_m")
    data = ANSWERS["8d 28 12 18 02 ff 3d cc cc cd 3e 4c cc cd 00 00 00 00 3d 4c cc cd 42 f7 00 00 8c d8"].data
    assert layout.names == ("locator_x_m", "locator_y_m", "velocity_x_m_s", "velocity_y_m_s", "ambient_lux")
    assert layout.decode(data) == pytest.approx((0.1, 0.2, 0.0, 0.05, 123.5))
    collision = Collision.decode(bytes.fromhex("1000f80000640100c8000a00003c00003039"))
    assert collision == Collision(1.0, -0.5, 100 / 4096, 1, (200, 10, 0), 60, 12.345)
    assert collision.encode() == bytes.fromhex("1000f80000640100c8000a00003c00003039")


def test_the_twenty_floats_of_another_client_come_in_the_order_of_the_bits() -> None:
    layout = commands.layout_of(0x03C7E27A, 0x03840000)
    assert len(layout.names) == 20
    bits = [commands.PRIMARY_CHANNELS.get(name, 0) << 32 or commands.EXTENDED_CHANNELS[name] for name in layout.names]
    primary = [bit for bit in bits if bit >> 32]
    extended = [bit for bit in bits if not bit >> 32]
    assert primary == sorted(primary, reverse=True)
    assert extended == sorted(extended, reverse=True)
    assert bits == primary + extended


def test_payloads_of_the_wrong_length_are_named() -> None:
    with pytest.raises(PayloadError, match="`battery voltage` carried 1 bytes") as caught:
        commands.BATTERY_VOLTAGE.decode(b"\x01")
    assert caught.value.data == b"\x01"
    with pytest.raises(PayloadError, match="1 float32"):
        commands.layout_for("ambient_lux").decode(bytes(8))
    with pytest.raises(DriveError, match="finite"):
        commands.drive(10, math.nan)


byte = st.integers(0, 255)
# Bytes that need escapes are drawn as often as all the others.
awkward = st.lists(st.one_of(st.sampled_from([0xAB, 0x8D, 0xD8, 0x23, 0x05, 0x50]), byte), max_size=60).map(bytes)


@st.composite
def packets(draw: st.DrawFn) -> Packet:
    flags = draw(st.integers(0, 0x7F))
    return Packet(
        flags,
        *(draw(byte) for _ in range(3)),
        data=draw(awkward),
        target=draw(byte) if flags & Flag.HAS_TARGET else None,
        source=draw(byte) if flags & Flag.HAS_SOURCE else None,
        error=draw(byte) if flags & Flag.RESPONSE else None,
    )


def cut(data: bytes, places: list[int]) -> list[bytes]:
    edges = sorted({0, len(data), *(place % (len(data) + 1) for place in places)})
    return [data[a:b] for a, b in itertools.pairwise(edges)]


@given(st.lists(packets(), max_size=6), st.lists(st.integers(0, 10_000), max_size=30))
def test_any_packets_survive_glueing_and_cutting(sent: list[Packet], places: list[int]) -> None:
    parser = PacketParser()
    stream = b"".join(encode(packet) for packet in sent)
    received = [packet for piece in cut(stream, places) for packet in parser.feed(piece)]
    assert received == sent
    assert (parser.bad_checksums, parser.malformed, parser.garbage_bytes) == (0, 0, 0)


@given(packets())
def test_one_byte_at_a_time(packet: Packet) -> None:
    parser = PacketParser()
    frame = encode(packet)
    received = [parser.feed(bytes([value])) for value in frame]
    assert received[-1] == [packet]
    assert not any(received[:-1])


@given(packets(), awkward, packets(), st.lists(st.integers(0, 10_000), max_size=10))
def test_garbage_never_costs_the_next_good_frame(
    first: Packet, garbage: bytes, last: Packet, places: list[int]
) -> None:
    parser = PacketParser()
    stream = encode(first) + garbage + encode(last)
    received = [packet for piece in cut(stream, places) for packet in parser.feed(piece)]
    assert received[0] == first
    # Garbage that ends in an open frame takes nothing with it: the next start byte begins anew.
    assert received[-1] == last


@given(packets(), st.data())
@settings(max_examples=200)
def test_one_damaged_byte_is_never_taken_for_the_packet(packet: Packet, data: st.DataObject) -> None:
    frame = bytearray(encode(packet))
    place = data.draw(st.integers(1, len(frame) - 2))
    frame[place] ^= data.draw(st.integers(1, 255))
    parser = PacketParser()
    received = parser.feed(bytes(frame)) + parser.feed(encode(packet))
    assert received[-1] == packet
    assert packet not in received[:-1]
    assert parser.bad_checksums + parser.malformed + parser.garbage_bytes > 0 or len(received) == 1


def read(pieces: Iterable[bytes]) -> tuple[list[Packet], tuple[int, int, int]]:
    parser = PacketParser()
    received = [packet for piece in pieces for packet in parser.feed(piece)]
    return received, (parser.bad_checksums, parser.malformed, parser.garbage_bytes)


# Longer than any frame may be, with and without what could end it.
overlong = st.builds(
    lambda head, size, tail: head + bytes(size) + tail,
    st.sampled_from([b"", b"\x8d", b"\xd8\x8d", b"\x8d\x0a\x8d"]),
    st.integers(MAX_FRAME_BYTES - 3, 2 * MAX_FRAME_BYTES + 2),
    st.sampled_from([b"", b"\xd8", b"\x8d", b"\x00\xd8"]),
)


@given(
    st.lists(st.one_of(awkward, packets().map(encode), overlong), max_size=5),
    st.lists(st.integers(0, 10_000), max_size=20),
)
def test_neither_packets_nor_counts_depend_on_where_the_stream_is_cut(parts: list[bytes], places: list[int]) -> None:
    stream = b"".join(parts) + b"\xd8"
    assert read(cut(stream, places)) == read([stream]) == read(bytes([value]) for value in stream)


@given(packets(), packets(), st.data())
def test_a_frame_cut_short_costs_itself_alone(broken: Packet, good: Packet, data: st.DataObject) -> None:
    """The next start byte may stand anywhere in it, even behind an escape byte."""
    frame = encode(broken)
    short = frame[: data.draw(st.integers(1, len(frame) - 1))]
    received, (_, malformed, garbage) = read([short + encode(good)])
    assert (received, malformed, garbage) == ([good], 1, 0)


@given(packets(), packets(), st.data())
def test_a_delimiter_inside_a_frame_costs_that_frame_alone(broken: Packet, good: Packet, data: st.DataObject) -> None:
    frame = bytearray(encode(broken))
    frame.insert(data.draw(st.integers(1, len(frame) - 1)), data.draw(st.sampled_from([0x8D, 0xD8])))
    received, counts = read([bytes(frame) + encode(good)])
    assert received[-1] == good
    assert sum(counts) > 0 or received[:-1] == [broken]


@pytest.mark.parametrize("garbage", [b"\x00", b"\x8d", b"\xd8", b"\xab", b"\x8d" + bytes(63), bytes(range(0x8E, 0xD0))])
def test_endless_garbage_takes_no_memory(garbage: bytes) -> None:
    parser = PacketParser()
    parser.feed(b"\x8d")
    for _ in range(20_000):
        assert parser.feed(garbage) == []
        assert sum(map(sys.getsizeof, vars(parser).values())) < MAX_FRAME_BYTES + 300
    good = Packet(0x0A, 0x13, 0x0D, 0)
    assert parser.feed(encode(good)) == [good]


@pytest.mark.parametrize(("size", "fits"), [(MAX_FRAME_BYTES - 6, True), (MAX_FRAME_BYTES - 5, False)])
def test_a_frame_may_be_so_long_and_no_longer(size: int, fits: bool) -> None:
    """Six bytes beside the data, the end byte not counted."""
    packet = Packet(0x0A, 0x10, 0x00, 0, bytes(size))
    frame = encode(packet)
    assert len(frame) == size + 7
    assert read([frame]) == (([packet], (0, 0, 0)) if fits else ([], (0, 1, 2)))


def test_what_is_dropped_is_counted() -> None:
    parser = PacketParser()
    good = bytes.fromhex("8d 0a 13 0d 00 d5 d8")
    assert parser.feed(b"\x00\x01" + good[:-2] + b"\xd4\xd8") == []
    assert (parser.garbage_bytes, parser.bad_checksums, parser.malformed) == (2, 1, 0)
    assert parser.feed(b"\x8d\x0a\xd8") == []
    assert parser.feed(b"\x8d\x0a\x13\xab\x01\x00\xd5\xd8") == []
    assert parser.malformed == 2
    assert parser.feed(good[:4] + good) == [Packet(0x0A, 0x13, 0x0D, 0)]
    assert parser.malformed == 3
    assert parser.feed(b"\x8d" + bytes(MAX_FRAME_BYTES + 1)) == []
    assert parser.malformed == 4
    assert parser.feed(good) == [Packet(0x0A, 0x13, 0x0D, 0)]
    assert parser.feed(b"\x8d\x8a" + good[2:-2] + bytes([checksum(b"\x8a" + good[2:-2])]) + b"\xd8") == []
    assert parser.malformed == 5


@pytest.mark.parametrize(
    "packet",
    [
        Packet(0x39, 1, 2, 3, target=1, source=2),
        Packet(0x0A, 1, 2, 3, target=1),
        Packet(0x0A, 1, 2, 256),
        Packet(0x8A, 1, 2, 3),
    ],
)
def test_a_packet_that_contradicts_itself_is_refused(packet: Packet) -> None:
    with pytest.raises(RequestError):
        encode(packet)
