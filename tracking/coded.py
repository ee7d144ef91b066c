"""Frames as the encoder made them: what is copied from film to film loses nothing."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
from av.error import FFmpegError
from av.stream import Stream
from av.video.stream import VideoStream

COPIED = frozenset({"h264", "mjpeg"})


@dataclass(frozen=True, slots=True, eq=False)
class CodedFrame:
    """One frame of a film as it lies there.

    Attributes:
        data: the encoder's bytes.
        key: whether it can be decoded without those before it.
        stream: the film's, which says how to decode it.
    """

    data: bytes
    key: bool
    stream: VideoStream

    def decodes_as(self, other: CodedFrame) -> bool:
        """Whether both can stand in one film."""
        mine, its = self.stream.codec_context, other.stream.codec_context
        return self.stream is other.stream or (mine.name == its.name and mine.extradata == its.extradata)

    def packet(self, pts: int, time_base: Fraction) -> av.Packet[Stream]:
        """As a packet of another film, in which it stands at ``pts``."""
        packet = av.Packet(self.data)
        packet.pts = packet.dts = pts
        packet.time_base = time_base
        packet.is_keyframe = self.key
        return packet


def coded_frames(path: Path) -> list[CodedFrame]:
    """The frames of a film, in order, as they lie there.

    Returns:
        None of them where the film does not keep one packet a frame in the order of their times, as the films of
        `tracking.segment` do.
    """
    found: list[CodedFrame] = []
    last = -1
    try:
        container = av.open(str(path), mode="r")
        stream = container.streams.video[0]
        if stream.codec_context.name not in COPIED:
            return []
        for packet in container.demux(stream):
            if packet.size == 0:
                continue
            if packet.pts is None or packet.pts <= last or packet.is_corrupt:
                return []
            last = packet.pts
            found.append(CodedFrame(bytes(packet), packet.is_keyframe, stream))
    except (FFmpegError, IndexError):
        return []
    return found
