"""Frames of the Sphero API v2: one record, its encoding, and a parser for whatever the radio delivers.

A frame is ``8D FLAGS [TID] [SID] DID CID SEQ [ERR] DATA… CHK D8``. CHK is 0xFF less the sum of the bytes
from FLAGS to the end of DATA, modulo 256. The bytes AB, 8D and D8 between the delimiters, CHK included,
are escaped as ``AB 23``, ``AB 05`` and ``AB 50``.
"""

from __future__ import annotations

from enum import IntFlag
from typing import NamedTuple

from lab.base.errors import RequestError

START = 0x8D
END = 0xD8
ESCAPE = 0xAB
_START, _END = bytes((START,)), bytes((END,))
NOTIFICATION_SEQ = 0xFF
"""Robots number their notifications with it, so no request may carry it."""
MAX_FRAME_BYTES = 2048
"""No frame is longer, up to its end byte: what is, is garbage from there on."""


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
# By FLAGS: bytes from FLAGS to CHK of a frame without data. No known robot extends its flags: more than any frame has.
_LEAST_BYTES = tuple(
    MAX_FRAME_BYTES if flags & _EXTENDED else 5 + sum(bool(flags & bit) for bit in (_RESPONSE, _TARGET, _SOURCE))
    for flags in range(0x100)
)


class Packet(NamedTuple):
    """One frame's content, escapes and checksum taken off.

    A tuple, since one is made for every notification, in a quarter of the time of a frozen dataclass.

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
    and the next good frame is found at the next start byte. Neither the frames nor the counts depend on
    where the stream is cut, and no more than ``MAX_FRAME_BYTES`` are kept between two calls.

    Attributes:
        bad_checksums: Frames dropped because their checksum did not fit.
        malformed: Frames dropped because they were cut short, too short, too long or wrongly escaped.
        garbage_bytes: Bytes dropped because they stood outside any frame.
    """

    def __init__(self) -> None:
        self.bad_checksums = 0
        self.malformed = 0
        self.garbage_bytes = 0
        # From its start byte on; no other delimiter is in it.
        self._open = b""

    def feed(self, chunk: bytes | bytearray) -> list[Packet]:
        """Add what has arrived; return the frames that it completes, in order."""
        packets: list[Packet] = []
        if END in chunk:
            # Delimiters are never escaped data, so each end byte ends whatever began last before it.
            *closed, chunk = (self._open + chunk).split(_END)
            self._open = b""
            for piece in closed:
                before, start, body = piece.rpartition(_START)
                if before:
                    self._skip(before)
                if not start:
                    self.garbage_bytes += len(body) + 1
                elif len(body) >= MAX_FRAME_BYTES:
                    self._break_off(len(body) + 1)
                    self.garbage_bytes += 1
                elif (packet := self._decode(body)) is not None:
                    packets.append(packet)
        if chunk:
            self._keep(chunk)
        return packets

    def _keep(self, chunk: bytes | bytearray) -> None:
        """Hold on to a frame that has not ended yet."""
        if START in chunk:
            before, start, body = (self._open + chunk).rpartition(_START)
            self._skip(before)
            self._open = start + body
        elif self._open:
            self._open += chunk
        else:
            self.garbage_bytes += len(chunk)
        if len(self._open) > MAX_FRAME_BYTES:
            self._break_off(len(self._open))
            self._open = b""

    def _skip(self, before: bytes) -> None:
        """Count what stood before a start byte: garbage, then frames that were cut short."""
        garbage, *broken = before.split(_START)
        self.garbage_bytes += len(garbage)
        for body in broken:
            self._break_off(len(body) + 1)

    def _break_off(self, length: int) -> None:
        self.malformed += 1
        self.garbage_bytes += max(0, length - MAX_FRAME_BYTES)

    def _decode(self, body: bytes) -> Packet | None:
        """The packet between two delimiters, or None after counting why not."""
        if ESCAPE in body:
            # The escape of the escape byte last: only then does none of the others' bytes come to stand for one.
            body = body.replace(b"\xab\x05", b"\x8d").replace(b"\xab\x50", b"\xd8")
            if body.count(b"\xab") != body.count(b"\xab\x23"):
                self.malformed += 1
                return None
            body = body.replace(b"\xab\x23", b"\xab")
        flags = body[0] if body else _EXTENDED
        if len(body) < _LEAST_BYTES[flags]:
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
        data_at = at + 3
        if flags & _RESPONSE:
            error = body[data_at]
            data_at += 1
        return Packet(flags, body[at], body[at + 1], body[at + 2], body[data_at:-1], target, source, error)
