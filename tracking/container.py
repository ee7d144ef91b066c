"""Whether a video file is all there: what its outermost boxes promise against its length.

A file that was cut short may still play, and the library that decodes it then guesses its length from what is left.
The three containers that cameras write (Matroska, MP4, AVI) say how long their parts are; nothing else is read here.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

_EBML, _SEGMENT = 0x1A45DFA3, 0x18538067
# What an MP4 or QuickTime file may begin with (ISO 14496-12).
_FIRST_BOXES = frozenset({b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"styp", b"moof", b"pnot"})


@dataclass(frozen=True, slots=True)
class Wholeness:
    """What a file's structure tells.

    Attributes:
        known: whether its container is one of those that can be judged; if not, the rest means nothing.
        missing_bytes: how much of it is missing at its end at least.
        closed: whether whoever wrote it came to finish it.
        fragmented: an MP4 in fragments, which nowhere says how long it is as a whole.
        counts_periods: an AVI, which has no time stamps: its frames stand one in each period, some of them empty.
    """

    known: bool = True
    missing_bytes: int = 0
    closed: bool = True
    fragmented: bool = False
    counts_periods: bool = False

    @property
    def is_whole(self) -> bool:
        """Whether nothing is missing, as far as can be told."""
        return self.closed and self.missing_bytes == 0


def wholeness_of(path: str | Path) -> Wholeness:
    """Judge a file by its outermost boxes (microseconds: some tens of bytes are read). Raises OSError."""
    file = Path(path)
    length = file.stat().st_size
    with file.open("rb") as stream:
        start = stream.read(12)
        stream.seek(0)
        if start[:4] == b"RIFF":
            return _riff(stream, length)
        if start[:4] == _EBML.to_bytes(4, "big"):
            return _matroska(stream, length)
        if start[4:8] in _FIRST_BOXES:
            return _mp4(stream, length)
    return Wholeness(known=False)


def _riff(stream: BinaryIO, length: int) -> Wholeness:
    """AVI: one RIFF list, or several in a row in files above a gigabyte (OpenDML)."""
    place = 0
    while place + 8 <= length:
        stream.seek(place)
        name, size = struct.unpack("<4sI", stream.read(8))
        if name != b"RIFF":
            break
        if size in (0, 0xFFFFFFFF):  # a place held free for whoever closes the file
            return Wholeness(closed=False, counts_periods=True)
        place += 8 + size + size % 2
    return Wholeness(missing_bytes=max(0, place - length - 1), counts_periods=True)


def _mp4(stream: BinaryIO, length: int) -> Wholeness:
    place, fragmented = 0, False
    while place + 8 <= length:
        stream.seek(place)
        size, name = struct.unpack(">I4s", stream.read(8))
        fragmented = fragmented or name == b"moof"
        if size == 1:  # the size follows in 64 bits
            wide = stream.read(8)
            if len(wide) < 8:
                return Wholeness(missing_bytes=1, fragmented=fragmented)
            size = int.from_bytes(wide, "big")
        elif size == 0:  # as far as the file goes
            return Wholeness(fragmented=fragmented)
        if size < 8:
            break
        place += size
    missing = place - length if place > length else int(0 < length - place < 8)
    return Wholeness(missing_bytes=missing, fragmented=fragmented)


def _matroska(stream: BinaryIO, length: int) -> Wholeness:
    """EBML header, then the segment with all the rest."""
    stream.seek(4)
    header = _vint(stream)
    if header is None:
        return Wholeness(missing_bytes=1)
    stream.seek(header, 1)
    name = stream.read(4)
    if len(name) < 4:
        return Wholeness(missing_bytes=1)
    if int.from_bytes(name, "big") != _SEGMENT:
        return Wholeness(known=False)
    size = _vint(stream)
    if size is None:  # all ones: not known when it was begun, and nobody came back to say
        return Wholeness(closed=False)
    return Wholeness(missing_bytes=max(0, stream.tell() + size - length))


def _vint(stream: BinaryIO) -> int | None:
    """EBML's integer: the first byte's leading zeros count the bytes that follow. None where it says "unknown"."""
    first = stream.read(1)
    if not first or first[0] == 0:
        return None
    width = 8 - first[0].bit_length()
    value = int.from_bytes(bytes([first[0] & (0x7F >> width)]) + stream.read(width), "big")
    return None if value == (1 << 7 * (width + 1)) - 1 else value
