"""Our packets and spherov2's, an independent client's: the same bytes out, the same packets in."""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import Generator
from spherov2.commands.sensor import CollisionDetectionMethods
from spherov2.controls import PacketDecodingException
from spherov2.controls.v2 import Packet as TheirPacket
from spherov2.toy.bolt import BOLT

from lab.clock import run
from robot.packets import END, MAX_FRAME_BYTES, START, Flag, Packet, PacketParser, checksum, encode
from robot.virtual.bolt import BoltSettings
from robot.virtual.radio import Peripheral
from tests.robot.spherov2_peer import ours, theirs
from tests.robot.test_packets import ANSWERS, REQUESTS, packets

AWKWARD = np.array([0xAB, 0x8D, 0xD8, 0x23, 0x05, 0x50], dtype=np.uint8)
PACKETS = 10_000
# Every FLAGS byte with one byte of flags: theirs knows nothing of a second either, but reads on regardless.
FLAGS = range(0x80)

ATTITUDE_LOCATOR_VELOCITY = 0x70078
CALLS: dict[str, Callable[[Any], Any]] = {
    "8d 0a 13 0d 00 d5 d8": BOLT.wake,
    "8d 0a 13 01 00 e1 d8": BOLT.sleep,
    "8d 0a 13 03 00 df d8": BOLT.get_battery_voltage,
    "8d 0a 10 01 00 e4 d8": BOLT.get_api_protocol_version,
    "8d 0a 11 00 00 e4 d8": BOLT.get_main_app_version,
    "8d 0a 11 06 00 de d8": BOLT.get_mac_address,
    "8d 0a 10 00 00 ab 23 ab 05 ab 50 d5 d8": lambda toy: BOLT.ping(toy, bytes.fromhex("ab8dd8")),
    "8d 3a 12 01 16 06 00 96 d8": BOLT.reset_yaw,
    "8d 3a 12 01 16 07 00 3c 00 5a 00 ff d8": lambda toy: BOLT.drive_with_heading(toy, 60, 90, 0),
    "8d 3a 12 01 16 07 00 28 01 67 00 05 d8": lambda toy: BOLT.drive_with_heading(toy, 40, 359, 0),
    "8d 3a 12 01 16 07 00 ab 05 00 ab 50 00 30 d8": lambda toy: BOLT.drive_with_heading(toy, 141, 216, 0),
    "8d 3a 12 01 16 07 00 00 00 00 00 95 d8": lambda toy: BOLT.drive_with_heading(toy, 0, 0, 0),
    "8d 3a 12 01 16 01 00 01 78 02 78 a8 d8": lambda toy: BOLT.set_raw_motors(toy, 1, 120, 2, 120),
    "8d 3a 12 01 16 0c 00 01 8f d8": lambda toy: BOLT.set_stabilization(toy, 1),
    "8d 3a 11 01 1a 1c 00 3f ff 00 00 00 00 ff 40 d8": lambda toy: BOLT.set_all_leds_with_8_bit_mask(
        toy, 0x3F, [255, 0, 0, 0, 0, 255]
    ),
    "8d 3a 12 01 1a 2f 00 ff 80 00 ea d8": lambda toy: BOLT.set_compressed_frame_player_one_color(toy, 255, 128, 0),
    "8d 3a 12 01 18 30 00 6a d8": BOLT.get_ambient_light_sensor_value,
    "8d 3a 12 01 18 0c 00 00 04 00 00 8a d8": lambda toy: BOLT.set_extended_sensor_streaming_mask(toy, 0x40000),
    "8d 3a 12 01 18 00 00 00 32 00 00 07 00 78 e9 d8": lambda toy: BOLT.set_sensor_streaming_mask(
        toy, 50, 0, ATTITUDE_LOCATOR_VELOCITY
    ),
    "8d 3a 12 01 18 11 00 01 5a 82 5a 82 01 cf d8": lambda toy: BOLT.configure_collision_detection(
        toy, CollisionDetectionMethods.ACCELEROMETER_BASED_DETECTION, 90, 130, 90, 130, 1
    ),
    "8d 3a 12 01 18 13 00 87 d8": BOLT.reset_locator_x_and_y,
}


class ToldError(Exception):
    """Carries what a command of theirs would have sent."""


class Toy:
    """As much of their toy as their commands need: it numbers packets, and sends none."""

    _require_target = False

    def __init__(self) -> None:
        self._packet_manager = TheirPacket.Manager()

    def _execute(self, packet: TheirPacket) -> None:
        raise ToldError(packet)


def random_packets(rng: Generator, count: int = PACKETS) -> Iterable[Packet]:
    """Packets of every flag style, half of their bytes such as need escapes or look like one."""

    def awkward(size: int) -> list[int]:
        plain = rng.integers(0, 256, size)
        return np.where(rng.random(size) < 0.5, rng.choice(AWKWARD, size), plain).tolist()

    for number in range(count):
        flags = FLAGS[number % len(FLAGS)]
        did, cid, seq, target, source = awkward(5)
        yield Packet(
            flags,
            *(did, cid, seq),
            bytes(awkward(int(rng.integers(0, 41)))),
            target=target if flags & Flag.HAS_TARGET else None,
            source=source if flags & Flag.HAS_SOURCE else None,
            # Theirs knows these errors and no others.
            error=int(rng.integers(0, 0x0B)) if flags & Flag.RESPONSE else None,
        )


def their_reading(pieces: Iterable[bytes]) -> list[Packet]:
    received: list[TheirPacket] = []
    collector = TheirPacket.Collector(received.append)
    for piece in pieces:
        collector.add(piece)
    return [ours(packet) for packet in received]


def our_reading(pieces: Iterable[bytes]) -> list[Packet]:
    parser = PacketParser()
    received = [packet for piece in pieces for packet in parser.feed(piece)]
    assert (parser.bad_checksums, parser.malformed, parser.garbage_bytes) == (0, 0, 0)
    return received


def cut(stream: bytes, rng: Generator, mean_bytes: float) -> list[bytes]:
    edges = np.unique(rng.integers(0, len(stream) + 1, int(len(stream) / mean_bytes)))
    return [stream[a:b] for a, b in itertools.pairwise([0, *edges.tolist(), len(stream)])]


@pytest.mark.parametrize("frame", REQUESTS)
def test_their_own_commands_send_the_known_bytes(frame: str) -> None:
    with pytest.raises(ToldError) as told:
        CALLS[frame](Toy())
    assert told.value.args[0].build().hex(" ") == frame
    assert ours(told.value.args[0]) == REQUESTS[frame].packet(0)


@pytest.mark.parametrize("frame", [*REQUESTS, *ANSWERS])
def test_both_read_and_write_the_known_bytes(frame: str) -> None:
    data = bytes.fromhex(frame)
    packet = ANSWERS[frame] if frame in ANSWERS else REQUESTS[frame].packet(0)
    assert their_reading([data]) == our_reading([data]) == [packet]
    assert bytes(theirs(packet).build()) == encode(packet) == data


def test_both_encoders_write_the_same_bytes() -> None:
    for packet in random_packets(np.random.default_rng(1)):
        assert encode(packet) == bytes(theirs(packet).build())


def test_both_number_and_address_requests_alike() -> None:
    manager = TheirPacket.Manager()
    rng = np.random.default_rng(2)
    for number in range(600):
        data = bytes(rng.choice(AWKWARD, 9))
        target = [None, 0x11, 0x12][number % 3]
        sent = manager.new_packet(0x16, 0x07, target, data)
        flags = 0x0A if target is None else 0x3A
        own = Packet(flags, 0x16, 0x07, number % 255, data, target=target, source=None if target is None else 1)
        assert ours(sent) == own
        assert encode(own) == bytes(sent.build())


@pytest.mark.parametrize("mean_bytes", [1.5, 20.0, 400.0])
def test_both_parsers_read_glued_and_cut_packets_alike(mean_bytes: float) -> None:
    rng = np.random.default_rng(3)
    sent = list(random_packets(rng))
    pieces = cut(b"".join(map(encode, sent)), rng, mean_bytes)
    assert our_reading(pieces) == sent
    assert their_reading(pieces) == sent


@pytest.mark.parametrize("chunk_bytes", [0, 20, 1])
def test_both_parsers_read_what_the_virtual_robot_sends(
    bench: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, chunk_bytes: int
) -> None:
    sent: list[bytes] = []
    notify = Peripheral.notify

    def recorded(self: Peripheral, uuid: str, value: bytes) -> None:
        sent.append(value)
        notify(self, uuid, value)

    monkeypatch.setattr(Peripheral, "notify", recorded)

    async def session() -> int:
        async with bench(manners=BoltSettings(chunk_bytes=chunk_bytes)) as b:
            await b.robot.identity()
            await b.robot.start_stream(0.05)
            for degrees in range(0, 360, 40):
                await b.robot.drive(math.radians(degrees), 40.0)
                await asyncio.sleep(2.0)
            await b.robot.stop()
            return len(b.bumps)

    assert run(session(), virtual=True) >= 4
    received = our_reading(sent)
    assert received == their_reading(sent)
    kinds = {(packet.did, packet.cid) for packet in received}
    assert {(0x18, 0x02), (0x18, 0x12), (0x16, 0x07), (0x11, 0x06)} <= kinds
    assert len(received) > 300
    assert chunk_bytes == 0 or max(map(len, sent)) == chunk_bytes


GOOD = Packet(0x0A, 0x13, 0x0D, 0)
FRAME = encode(GOOD)


@pytest.mark.parametrize(
    ("before", "why"),
    [
        (b"\x00\x01", "Unexpected start"),
        (FRAME[:4], "Bad response checksum"),
        (FRAME[:-2] + b"\xd4\xd8", "Bad response checksum"),
        (b"\x8d\x0a\x13\xab\x01\x00\xd5\xd8", "Unexpected escaping"),
        (b"\x8d\x0a\xd8", "Very small packet"),
    ],
)
def test_after_garbage_theirs_loses_the_good_frame_and_ours_does_not(before: bytes, why: str) -> None:
    """Theirs raises, and drops the rest of what came with it; the driver must go on with what is whole."""
    received: list[TheirPacket] = []
    with pytest.raises(PacketDecodingException, match=why):
        TheirPacket.Collector(received.append).add(before + FRAME + FRAME)
    assert received == []
    assert PacketParser().feed(before + FRAME + FRAME) == [GOOD, GOOD]


def test_errors_and_flags_that_theirs_does_not_know() -> None:
    unknown = encode(Packet(0x09, 0x13, 0x0D, 0, error=0x0B))
    assert PacketParser().feed(unknown) == [Packet(0x09, 0x13, 0x0D, 0, error=0x0B)]
    with pytest.raises(ValueError, match="11 is not a valid"):
        their_reading([unknown])
    # A second byte of flags would shift every field; theirs takes it for the DID.
    body = bytes([0x8A, 0x00, 0x13, 0x0D, 0x00])
    extended = bytes([START]) + body + bytes([checksum(body), END])
    assert [packet.did for packet in their_reading([extended])] == [0x00]
    parser = PacketParser()
    assert parser.feed(extended) == []
    assert parser.malformed == 1


def reference(stream: bytes) -> list[Packet]:
    """Framing a byte at a time, in the plainest way; what is in a frame is read by theirs, one frame at a time."""
    received: list[Packet] = []
    frame: bytearray | None = None
    for byte in stream:
        if byte == START:
            frame = bytearray()
        elif frame is None:
            continue
        elif byte != END:
            frame.append(byte)
            frame = None if len(frame) >= MAX_FRAME_BYTES else frame
        else:
            try:
                packet = ours(TheirPacket.parse_response([START, *frame, END]))
            except (PacketDecodingException, ValueError, IndexError):
                packet = None
            if packet is not None and not packet.flags & Flag.EXTENDED:
                received.append(packet)
            frame = None
    return received


@st.composite
def streams(draw: st.DrawFn) -> bytes:
    """Good frames, frames with a byte changed, taken out or put in, frames cut short, and garbage."""
    pieces: list[bytes] = []
    kinds = st.sampled_from(["good", "good", "changed", "less", "more", "short", "noise"])
    for kind in draw(st.lists(kinds, max_size=8)):
        frame = bytearray(encode(draw(packets())))
        place = draw(st.integers(0, len(frame) - 1))
        byte = draw(st.one_of(st.sampled_from(AWKWARD.tolist()), st.integers(0, 255)))
        if kind == "changed":
            frame[place] = byte
        elif kind == "less":
            del frame[place]
        elif kind == "more":
            frame.insert(place, byte)
        elif kind == "short":
            del frame[place:]
        pieces.append(draw(st.binary(max_size=30)) if kind == "noise" else bytes(frame))
    return b"".join(pieces)


@given(streams(), st.lists(st.integers(0, 10_000), max_size=20))
def test_any_stream_is_read_as_the_plain_reference_reads_it(stream: bytes, places: list[int]) -> None:
    parser = PacketParser()
    edges = sorted({0, len(stream), *(place % (len(stream) + 1) for place in places)})
    received = [packet for a, b in itertools.pairwise(edges) for packet in parser.feed(stream[a:b])]
    assert [packet for packet in received if packet.error is None or packet.error < 0x0B] == reference(stream)
