"""One video segment on disk: encoder, Matroska file, and the table of its frames."""

# pyright: reportUnknownMemberType=false
# PyAV's stubs leave Packet's stream and add_stream's keywords open; nothing of them leaves this module.

from __future__ import annotations

import contextlib
import math
import os
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pandas as pd
from av.codec.codec import UnknownCodecError
from av.container import OutputContainer
from av.error import FFmpegError
from av.video.stream import VideoStream
from numpy.typing import ArrayLike

from lab.base.errors import RequestError
from tracking.cameras import Frame
from tracking.coded import CodedFrame

_TIME_BASE = Fraction(1, 1000)  # Matroska's own default; finer stamps are in the table


@dataclass(frozen=True, slots=True)
class EncoderSettings:
    """How segments are encoded.

    Attributes:
        codec: "auto" takes H.264 where the build has it, else Motion JPEG; or "h264", "mjpeg".
        quality: H.264's constant quality, 0 (best) to 51.
        max_bit_rate: bits a second that H.264 may not exceed over ``key_interval_s``; None = no bound, which
            saves the encoder its look ahead: a third of its time.
        key_interval_s: seconds between key frames.
        jpeg_quality: Motion JPEG's quantiser scale, 2 (best) to 31.
        threads: encoder threads.
    """

    codec: str = "auto"
    quality: int = 22
    max_bit_rate: int | None = 12_000_000
    key_interval_s: float = 1.0
    jpeg_quality: int = 4
    threads: int = 1

    def __post_init__(self) -> None:
        if self.codec not in {"auto", "h264", "mjpeg"}:
            raise RequestError(f'video codec "{self.codec}" is not known; choose auto, h264 or mjpeg')

    def encoder(self) -> str:
        """The codec that is used, "h264" or "mjpeg". Raises RequestError where it was asked for and is missing."""
        if self.codec == "mjpeg":
            return "mjpeg"
        try:
            av.Codec("libx264", "w")
        except UnknownCodecError as error:
            if self.codec == "auto":
                return "mjpeg"
            raise RequestError("this build of FFmpeg has no H.264 encoder; choose the codec mjpeg") from error
        return "h264"


@dataclass(frozen=True, slots=True)
class SegmentInfo:
    """A closed segment: camera times of its first and last frame (NaN if it has none, and then no file either).

    ``dropped`` counts the frames lost before each of its frames, the gap to the segment before included; ``late``
    those that reached us more than half a period after they were due by the camera's clock, which says that this
    machine or its bus was busy (their times are the camera's and remain right).
    """

    path: Path
    frames: int
    dropped: int
    t_first_s: float
    t_last_s: float
    codec: str
    late: int = 0


def frames_table(path: str | Path) -> Path:
    """Where a segment's table lies: ``video.mkv`` → ``video.frames.parquet``.

    Columns: frame (int, from 0, the row of the video), index (int, the camera's number), t_camera_s, t_host_s
    (float), dropped_before (int).
    """
    return Path(path).with_suffix(".frames.parquet")


def late_frames(t_camera_s: ArrayLike, t_host_s: ArrayLike, rate_hz: float) -> int:
    """Count the frames that came more than half a period after they were due.

    Due is what the camera's clock says, after the shortest way that any of these frames took. A camera without a clock
    of its own shows no late frames, but gaps.
    """
    way_s = np.asarray(t_host_s, dtype=float) - np.asarray(t_camera_s, dtype=float)
    return int((way_s > way_s.min() + 0.5 / rate_hz).sum()) if len(way_s) else 0


def part_of(path: str | Path) -> Path:
    """Where a segment is written until it is whole: ``video.mkv`` → ``video.mkv.part``."""
    file = Path(path)
    return file.with_name(file.name + ".part")


class SegmentWriter:
    """Writes one segment. Used from one thread; the file is made with its first frame.

    Args:
        path: the segment's own name.
        settings: codec and quality.
        rate_hz: the camera's nominal rate.
        last_index: number of the frame before the first one, where known, to count drops across segments.
    """

    def __init__(self, path: Path, settings: EncoderSettings, rate_hz: float, *, last_index: int | None = None) -> None:
        self.path = path
        self._settings = settings
        self._rate_hz = rate_hz
        self._last_index = last_index
        self._last_pts = -1
        self._container: OutputContainer | None = None
        self._stream: VideoStream | None = None
        self._rows: list[tuple[int, float, float, int]] = []
        self._codec = settings.encoder()
        self._source: CodedFrame | None = None

    def add(self, frame: Frame) -> None:
        """Encode one frame, or copy it. Raises OSError, ValueError or FFmpegError where the disk or the encoder fails.

        A segment that begins with a frame from a film, one that stands by itself, is copied from there.
        """
        if self._container is None or self._stream is None:
            self._source = frame.coded if frame.coded is not None and frame.coded.key else None
            self._container, self._stream = self._begin(frame.size)
        pts = max(round(frame.t_camera_s / _TIME_BASE), self._last_pts + 1)
        self._last_pts = pts
        if self._source is None:
            self._container.mux(self._stream.encode(self._picture(frame, pts)))
        elif frame.coded is not None and frame.coded.decodes_as(self._source):
            packet = frame.coded.packet(pts, _TIME_BASE)
            packet.stream = self._stream
            self._container.mux(packet)
        else:
            raise ValueError("a film that is copied goes on with frames of another kind")
        before = 0 if self._last_index is None else max(0, frame.index - self._last_index - 1)
        self._last_index = frame.index
        self._rows.append((frame.index, frame.t_camera_s, frame.t_host_s, before))

    def _picture(self, frame: Frame, pts: int) -> av.VideoFrame:
        # Motion JPEG knows only the full range; naming the planes so keeps their values as they are.
        layout = "yuvj420p" if self._codec == "mjpeg" else "yuv420p"
        picture = av.VideoFrame.from_numpy_buffer(np.ascontiguousarray(frame.i420), format=layout)
        picture.pts, picture.time_base = pts, _TIME_BASE
        return picture

    def close(self) -> SegmentInfo:
        """Flush, sync and give the file and its table their names. Raises OSError or FFmpegError."""
        if self._container is not None and self._stream is not None:
            if self._source is None:
                self._container.mux(self._stream.encode(None))
            self._container.close()
            self._container = None
            # The table first: a video under its own name always has one.
            _publish(self._write_table(), frames_table(self.path))
            _publish(part_of(self.path), self.path)
            _sync(self.path.parent)
        times = [row[1] for row in self._rows]
        return SegmentInfo(
            path=self.path,
            frames=len(times),
            dropped=sum(row[3] for row in self._rows),
            t_first_s=times[0] if times else math.nan,
            t_last_s=times[-1] if times else math.nan,
            codec=self._codec if self._source is None else self._source.stream.codec_context.name,
            late=late_frames([row[1] for row in self._rows], [row[2] for row in self._rows], self._rate_hz),
        )

    def abandon(self) -> None:
        """Give up after an error or a stop: leave what is on disk as ``.part``, for `recover`."""
        if self._container is not None:
            with contextlib.suppress(OSError, FFmpegError):
                self._container.close()
            self._container = None

    def _begin(self, size: tuple[int, int]) -> tuple[OutputContainer, VideoStream]:
        settings = self._settings
        # Clusters of a second, each sent to the disk as it is written, bound what a power cut takes.
        container = av.open(
            str(part_of(self.path)),
            mode="w",
            format="matroska",
            options={"cluster_time_limit": "1000", "flush_packets": "1"},
        )
        if self._source is not None:
            return container, container.add_stream_from_template(self._source.stream)
        rate = Fraction(self._rate_hz).limit_denominator(1001)
        gop = max(1, round(settings.key_interval_s * self._rate_hz))
        if self._codec == "mjpeg":
            stream = container.add_stream("mjpeg", rate=rate, options={"qmin": "2", "qmax": str(settings.jpeg_quality)})
            stream.pix_fmt = "yuvj420p"
        else:
            options = {"preset": "ultrafast", "tune": "zerolatency", "threads": str(settings.threads)}
            if settings.max_bit_rate is None:
                options["qp"] = str(settings.quality)
            else:
                options["crf"] = str(settings.quality)
                options["maxrate"] = str(settings.max_bit_rate)
                options["bufsize"] = str(round(settings.max_bit_rate * settings.key_interval_s))
            stream = container.add_stream("libx264", rate=rate, options=options)
            stream.pix_fmt = "yuv420p"
            stream.gop_size = gop
        stream.width, stream.height = size
        stream.codec_context.time_base = _TIME_BASE
        return container, stream

    def _write_table(self) -> Path:
        table = pd.DataFrame(self._rows, columns=["index", "t_camera_s", "t_host_s", "dropped_before"])
        table.insert(0, "frame", np.arange(len(table)))
        aside = part_of(frames_table(self.path))
        table.to_parquet(aside, index=False)
        return aside


def _publish(part: Path, path: Path) -> None:
    """Sync a finished file and give it its name."""
    _sync(part)
    part.replace(path)


def _sync(path: Path) -> None:
    """Bring a file, or a folder's list of names, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
