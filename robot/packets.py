"""Frames of the Sphero API v2: one record, its encoding, and a parser for whatever the radio delivers.

A frame is ``8D FLAGS [TID] [SID] DID CID SEQ [ERR] DATA… CHK D8``. CHK is 0xFF less the sum of the bytes
from FLAGS to the end of DATA, modulo 256. The bytes AB, 8D and D8 between the delimiters, CHK included,
are escaped as ``AB 23``, ``AB 05`` and ``AB 50``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

from lab.base.errors import RequestError

START = 0x8D
END = 0xD8
ESCAPE = 0xAB
# An escaped byte is its value with the bits of this mask off.
_ESCAPE_MASK = 0x88
_ESCAPED = {byte & ~_ESCAPE_MASK: byte for byte in (START, END, ESCAPE)}
NOTIFICATION_SEQ = 0xFF
"""Robots number their notifications with it, so no request may carry it."""
MAX_FRAME_BYTES = 2048
"""No frame is longer: a start without an end is garbage once it is."""


class Flag(IntFlag):
    """Bits of the FLAGS byte."""

    RESPONSE = 0x01
    WANTS_RESPONSE = 0x02
    ONLY_ERROR = 0x04
    ACTIVITY = 0x08
    HAS_TARGET = 0x10
    HAS_SOURCE = 0x20
    EXTENDED = 0x80


_RESPONSE, _TARGET, _SOURCE, _EXTENDED = 0x01, 0x10, 0x20, 0x80


@dataclass(frozen=True, slots=True)
class Packet:
    """One frame's content, escapes and checksum taken off.

    ``target`` (TID), ``source`` (SID) and ``error`` are None where the flags say that they are absent;
    ``data`` is the payload.
    """

    flags: int
    did: int
    cid: int
    seq: int
    data: bytes = b""
    target: int | None = None
    source: int | None = None
    error: int | None = None

    @property
    def is_response(self) -> bool:
        """Whether it answers a request."""
        return bool(self.flags & _RESPONSE)


def encode(packet: Packet) -> bytes:
    """The frame of ``packet``, delimiters, checksum and escapes included.

    Raises:
        RequestError: A field that the flags announce is missing, one that they deny is there, or a field
            is not a byte.
    """
    flags = packet.flags
    optional = ((_TARGET, packet.target, "target"), (_SOURCE, packet.source, "source"))
    head = [flags]
    for bit, value, name in (*optional, (_RESPONSE, packet.error, "error")):
        if bool(flags & bit) != (value is not None):
            raise RequestError(f"packet: flags 0x{flags:02X} and the field `{name}` = {value} do not agree")
    if flags & _EXTENDED:
        raise RequestError(f"packet: flags 0x{flags:02X} announce a second flags byte, which no known robot uses")
    head += [value for _, value, _ in optional if value is not None]
    head += [packet.did, packet.cid, packet.seq]
    if packet.error is not None:
        head.append(packet.error)
    try:
        body = bytes(head) + packet.data
    except ValueError as error:
        raise RequestError(f"packet: every field must be 0 to 255, got {packet}") from error
    return bytes((START,)) + _escape(body + bytes((checksum(body),))) + bytes((END,))


def checksum(body: bytes | bytearray) -> int:
    """CHK of the unescaped bytes FLAGS…DATA."""
    return 0xFF - (sum(body) & 0xFF)


def _escape(body: bytes) -> bytes:
    # The escape byte first, or the escapes themselves would be escaped.
    return body.replace(b"\xab", b"\xab\x23").replace(b"\x8d", b"\xab\x05").replace(b"\xd8", b"\xab\x50")


class PacketParser:
    """Takes a byte stream cut anywhere and gives back its frames.

    Frames may come a byte at a time or several glued together. What is no frame is dropped and counted,
    and the next good frame is found at the next start byte.

    Attributes:
        bad_checksums: Frames dropped because their checksum did not fit.
        malformed: Frames dropped because they were too short, too long or wrongly escaped.
        garbage_bytes: Bytes dropped because they stood outside any frame.
    """

    def __init__(self) -> None:
        self.bad_checksums = 0
        self.malformed = 0
        self.garbage_bytes = 0
        self._buffer = bytearray()

    def feed(self, chunk: bytes | bytearray) -> list[Packet]:
        """Add what has arrived; return the frames that it completes, in order."""
        buffer = self._buffer
        buffer += chunk
        packets: list[Packet] = []
        begin = 0
        while True:
            start = buffer.find(START, begin)
            if start < 0:
                self.garbage_bytes += len(buffer) - begin
                buffer.clear()
                return packets
            self.garbage_bytes += start - begin
            end = buffer.find(END, start)
            # A start byte inside a frame is never escaped data: the frame before it was cut short.
            again = buffer.find(START, start + 1, end if end >= 0 else len(buffer))
            if again >= 0:
                self.malformed += 1
                begin = again
                continue
            if end < 0:
                if len(buffer) - start > MAX_FRAME_BYTES:
                    self.malformed += 1
                    buffer.clear()
                else:
                    del buffer[:start]
                return packets
            packet = self._decode(buffer[start + 1 : end])
            if packet is not None:
                packets.append(packet)
            begin = end + 1

    def _decode(self, body: bytearray) -> Packet | None:
        """The packet between two delimiters, or None after counting why not."""
        if ESCAPE in body:
            plain = _unescape(body)
            if plain is None:
                self.malformed += 1
                return None
            body = plain
        flags = body[0] if body else 0
        least = 5 + bool(flags & _TARGET) + bool(flags & _SOURCE) + bool(flags & _RESPONSE)
        if len(body) < least or flags & _EXTENDED:
            self.malformed += 1
            return None
        if sum(body) & 0xFF != 0xFF:
            self.bad_checksums += 1
            return None
        at = 1
        target = source = error = None
        if flags & _TARGET:
            target = body[at]
            at += 1
        if flags & _SOURCE:
            source = body[at]
            at += 1
        did, cid, seq = body[at : at + 3]
        at += 3
        if flags & _RESPONSE:
            error = body[at]
            at += 1
        return Packet(flags, did, cid, seq, bytes(body[at:-1]), target, source, error)


def _unescape(body: bytearray) -> bytearray | None:
    """Take the escapes off, or None when an escape byte is followed by none of the three codes."""
    first, *rest = body.split(b"\xab")
    plain = bytearray(first)
    for part in rest:
        byte = _ESCAPED.get(part[0]) if part else None
        if byte is None:
            return None
        plain.append(byte)
        plain += part[1:]
    return plain
