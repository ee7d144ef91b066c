"""Video files as a stream of luma planes with their own time stamps, read through PyAV.

Tracking needs brightness, not colour, so the luma plane is handed on as decoded and never turned
into RGB; chroma is there for whoever asks. Times come from the stream's PTS: phones and webcams film
at a variable rate, so a frame's number times 1 / rate is not its time.
"""

from __future__ import annotations

import logging
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import cast

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError, InvalidDataError
from av.video.stream import VideoStream
from numpy.typing import NDArray

from lab.base.errors import RequestError
from tracking.container import Wholeness, wholeness_of

Plane = NDArray[np.uint8]

_log = logging.getLogger(__name__)
# Formats whose first plane is 8-bit luma; everything else is converted to yuv420p first.
_LUMA_FIRST = frozenset({"yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "gray"})
_PLAY_THROUGH_FRAMES = 600
_SEEK_AT_MOST_FRAMES = 300


class VideoError(RequestError):
    """A video file cannot be read. Attribute ``path``: the file. Check that it is a whole video file."""

    def __init__(self, path: Path, message: str) -> None:
        super().__init__(message)
        self.path = path


@dataclass(frozen=True, slots=True)
class VideoInfo:
    """What a file says of itself, without decoding it.

    ``size`` is (width, height) in pixels of the upright picture, ``rotation_deg`` the counterclockwise
    turn in its metadata (already applied to the frames that are read), ``n_frames`` an estimate (0 =
    unknown, as in a file that was never closed), ``duration_s`` likewise (0.0 = unknown), ``start_s`` the
    first time stamp, ``stated_frames`` the number in the file's header (0 = none there; an .avi counts
    empty periods too), ``whole`` what its structure says of its end.
    """

    path: Path
    size: tuple[int, int]
    n_frames: int
    duration_s: float
    rate_hz: float
    rotation_deg: int
    start_s: float
    codec: str
    stated_frames: int
    whole: Wholeness


@dataclass(frozen=True, slots=True)
class Ending:
    """How a file ends: ``truncated`` where its end is missing, ``frames_lost`` with it (None: nobody can tell)."""

    truncated: bool
    frames_lost: int | None


@dataclass(frozen=True, slots=True, eq=False)
class VideoFrame:
    """One frame: ``index`` from 0, ``t_s`` from the PTS, ``luma`` (h, w) uint8, upright and row-contiguous.

    ``luma`` is a view of the decoder's own buffer, which lives as long as the array does.
    """

    index: int
    t_s: float
    luma: Plane
    decoded: av.VideoFrame = field(repr=False)
    quarter_turns: int = 0

    def chroma(self) -> tuple[Plane, Plane] | None:
        """The planes (U, V), each (ceil(h / 2), ceil(w / 2)) uint8 with 128 = neutral, or None in a grey video."""
        frame = self.decoded
        if frame.format.name == "gray":
            return None
        planes: list[Plane] = []
        for number in (1, 2):
            plane = _plane(frame, number)
            # 4:2:2 and 4:4:4 carry more rows or columns than 4:2:0: every second one will do for colour.
            down = 2 if plane.shape[0] > (frame.height + 1) // 2 else 1
            across = 2 if plane.shape[1] > (frame.width + 1) // 2 else 1
            planes.append(_upright(plane[::down, ::across], self.quarter_turns))
        return planes[0], planes[1]


class FrameReader(Iterator[VideoFrame]):
    """The frames of one file in order of presentation: iterate, or use as a context manager.

    ``damage`` is None, or after the last frame one line about what could not be read: a file cut
    short gives its good frames first and then says so (also as a logged warning). ``truncated`` is
    then True where its end is missing, and ``frames_lost`` says how many frames there should be
    more, None where the file does not know (0 where there is no damage).

    Args:
        path: the video file.
        threads: decoder threads; 1 where several files are read in parallel processes.
        quiet: keep damage out of the log, where somebody else reads the same file and says so.

    Raises:
        VideoError: the file is missing, empty, no video, or holds no frame that can be decoded.
    """

    def __init__(self, path: str | Path, *, threads: int = 2, quiet: bool = False) -> None:
        self.path = Path(path)
        self._container, self._stream = _open(self.path)
        self.info = _info(self.path, self._container, self._stream)
        if self.info.codec == "mjpeg":
            threads = 1  # every frame stands alone and decodes faster than it is handed between threads
        self._stream.codec_context.thread_count = threads
        self._stream.thread_type = "FRAME"
        self.damage: str | None = None
        self.truncated = False
        self.frames_lost: int | None = 0
        self.frames_read = 0
        self._quiet = quiet
        self._bad_packets = 0
        self._delay: int | None = None
        self._last_s = self.info.start_s - 1.0 / self.info.rate_hz
        self._frames = self._decode()

    def __iter__(self) -> FrameReader:
        return self

    def __next__(self) -> VideoFrame:
        return next(self._frames)

    def __enter__(self) -> FrameReader:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; frames already handed out stay valid."""
        self._frames.close()
        self._container.close()

    def seek(self, t_s: float) -> None:
        """Go to the last key frame at or before ``t_s``; frame numbers count on from where they were."""
        base = _time_base(self._stream)
        self._delay = self._delay or 0
        self._container.seek(int(t_s / base), stream=self._stream, backward=True)
        self._frames.close()
        self._frames = self._decode()

    def _decode(self) -> Generator[VideoFrame, None, None]:
        cut = ""
        packets = self._container.demux(self._stream)
        while True:
            try:
                packet = next(packets)
                if packet.is_corrupt:  # the file ends in the middle of it
                    self._bad_packets += 1
                    continue
                decoded = packet.decode()
            except StopIteration:
                break
            except InvalidDataError:
                self._bad_packets += 1
                continue
            except FFmpegError as error:
                cut = str(error.strerror)
                break
            for frame in decoded:
                yield self._frame(frame)
        self._judge(cut)

    def _frame(self, decoded: av.VideoFrame) -> VideoFrame:
        t_s, turned = self._time_of(decoded), decoded.rotation
        decoded_420 = decoded if decoded.format.name in _LUMA_FIRST else decoded.reformat(format="yuv420p")
        self._last_s = t_s
        turns = _quarter_turns(turned)
        frame = VideoFrame(self.frames_read, t_s, _upright(_plane(decoded_420, 0), turns), decoded_420, turns)
        self.frames_read += 1
        return frame

    def _time_of(self, decoded: av.VideoFrame) -> float:
        ticks = decoded.pts
        if self.info.whole.counts_periods:
            # An AVI has no PTS: its frames stand one in each period in the order in which they are decoded, those that
            # are shown a constant number of periods later.
            ticks = decoded.dts
            if ticks is not None and self._delay is None:
                self._delay = ticks - (self._stream.start_time or 0) if self.frames_read == 0 else 0
            ticks = None if ticks is None else ticks - (self._delay or 0)
        if ticks is None:
            return self._last_s + 1.0 / self.info.rate_hz
        base = decoded.time_base or self._stream.time_base or Fraction(1)
        return ticks * base.numerator / base.denominator

    def _judge(self, cut: str) -> None:
        """Say what was lost, at the end of the file."""
        if self.frames_read == 0:
            raise VideoError(self.path, f"{self.path}: not one frame can be decoded; copy the file or film it again")
        ending = ending_of(self.info, self.frames_read, self._last_s)
        self.truncated, self.frames_lost = ending.truncated or bool(cut), ending.frames_lost
        if not self.truncated:
            self.frames_lost = self._bad_packets
        if not self.truncated and not self._bad_packets:
            return
        good = f"{self.frames_read} frames are good" + (f", {self.frames_lost} are lost" if self.frames_lost else "")
        if cut:
            self.damage = f"reading stopped after {self._last_s:.3f} s: {cut}; {good}"
        elif not self.info.whole.closed:
            self.damage = f"the file was never closed; {good}"
        elif self.truncated:
            self.damage = f"the file is cut short at {self._last_s:.3f} s; {good}"
        else:
            self.damage = f"{self._bad_packets} packets could not be decoded; {good}"
        if not self._quiet:
            _log.warning("%s: %s", self.path, self.damage)


def ending_of(info: VideoInfo, frames_read: int, last_s: float) -> Ending:
    """Judge a file's end by what it says of itself and what it gave: ``frames_read`` frames, the last at ``last_s``."""
    end_s = info.start_s + info.duration_s
    if info.whole.known:
        truncated = not info.whole.is_whole
    else:
        # The stated duration counts the last frame's own length, and is rounded: allow two frames.
        truncated = last_s + max(3.0 / info.rate_hz, 0.05 + 2.0 / info.rate_hz) < end_s
    if not truncated:
        return Ending(False, 0)
    if info.whole.fragmented or not info.whole.closed or not (info.stated_frames or info.duration_s):
        return Ending(True, None)
    if info.stated_frames and not info.whole.counts_periods:
        return Ending(True, max(0, info.stated_frames - frames_read))
    if info.stated_frames:
        return Ending(True, max(0, info.stated_frames - 1 - round((last_s - info.start_s) * info.rate_hz)))
    return Ending(True, max(0, round((end_s - last_s) * info.rate_hz) - 1))


def read_frames(path: str | Path, *, threads: int = 2, quiet: bool = False) -> FrameReader:
    """Open a video and iterate over its frames; see FrameReader for errors and for files cut short."""
    return FrameReader(path, threads=threads, quiet=quiet)


def probe(path: str | Path) -> VideoInfo:
    """Read what a file says of itself (microseconds to milliseconds; nothing is decoded but one frame).

    Raises:
        VideoError: the file is missing, empty, or no video.
    """
    container, stream = _open(Path(path))
    with container:
        return _info(Path(path), container, stream)


def sample_frames(path: str | Path, count: int = 15) -> list[VideoFrame]:
    """Pick up to ``count`` frames spread evenly over a video, for a median background.

    Short videos are played through; long ones are sought into, a key frame at a time and then on to
    the frame itself. ``index`` of a sampled frame is its place in the sample, not in the video.

    Raises:
        VideoError: as ``read_frames``.
    """
    with FrameReader(path, quiet=True) as reader:
        total = reader.info.n_frames
        if not 0 < total <= _PLAY_THROUGH_FRAMES and reader.info.duration_s > 0.0:
            return _sought(reader, count)
        picked: list[VideoFrame] = []
        # A file that was never closed does not know its length: keep every `stride`-th frame, and thin when full.
        stride = max(1, total // count) if total else 1
        for frame in reader:
            if frame.index % stride == 0:
                picked.append(frame)
            if len(picked) >= 2 * count:
                picked, stride = picked[::2], stride * 2
        keep = np.unique(np.linspace(0, len(picked) - 1, min(count, len(picked))).round().astype(int))
        return [picked[place] for place in keep]


def _sought(reader: FrameReader, count: int) -> list[VideoFrame]:
    info = reader.info
    picked: list[VideoFrame] = []
    for place in range(count):
        wanted_s = info.start_s + info.duration_s * (place + 0.5) / count
        reader.seek(wanted_s)
        found: VideoFrame | None = None
        for steps, frame in enumerate(reader):
            found = frame
            if frame.t_s >= wanted_s or steps >= _SEEK_AT_MOST_FRAMES:
                break
        if found is not None and all(found.t_s != other.t_s for other in picked):
            picked.append(found)
    return picked


def _open(path: Path) -> tuple[InputContainer, VideoStream]:
    if not path.is_file():
        raise VideoError(path, f"{path}: no such video file; check the path")
    if path.stat().st_size == 0:
        raise VideoError(path, f"{path}: the file is empty; record it again")
    try:
        container = av.open(str(path), mode="r")
    except FFmpegError as error:
        is_mp4 = path.suffix.lower() in {".mp4", ".mov", ".m4v"}
        hint = "an mp4 cut short cannot be read at all, film in .mkv" if is_mp4 else "give a video, or copy it again"
        raise VideoError(path, f"{path}: cannot be read as a video ({error.strerror}); {hint}") from error
    if not container.streams.video:
        container.close()
        raise VideoError(path, f"{path}: holds no video stream (sound only?); give the file with the picture")
    stream = container.streams.video[0]
    if cast("object", stream.codec_context) is None:  # by chance, what is no video begins as one
        container.close()
        raise VideoError(path, f"{path}: cannot be read as a video (unknown codec); give a video, or copy it again")
    return container, stream


def _info(path: Path, container: InputContainer, stream: VideoStream) -> VideoInfo:
    duration_s = _duration_s(container, stream)
    rate = stream.average_rate or stream.guessed_rate or stream.base_rate
    rate_hz = float(rate) if rate else 30.0
    rotation = _stated_rotation(path)
    size = (stream.codec_context.width, stream.codec_context.height)
    if _quarter_turns(rotation) % 2:
        size = (size[1], size[0])
    start = stream.start_time
    return VideoInfo(
        path=path,
        size=size,
        n_frames=stream.frames or round(duration_s * rate_hz),
        duration_s=duration_s,
        rate_hz=rate_hz,
        rotation_deg=rotation,
        start_s=0.0 if start is None else start * _time_base(stream),
        codec=stream.codec_context.name,
        stated_frames=stream.frames,
        whole=wholeness_of(path),
    )


def _duration_s(container: InputContainer, stream: VideoStream) -> float:
    """Length of the picture (not of the sound beside it), 0 where the file does not know it."""
    if stream.duration is not None:
        return stream.duration * _time_base(stream)
    if container.duration is None or container.duration <= 0:
        return 0.0
    # Matroska states the end on the file's clock, whose zero need not be the first frame.
    start_s = 0.0 if stream.start_time is None else stream.start_time * _time_base(stream)
    stated = stream.metadata.get("DURATION", "")
    try:
        hours, minutes, seconds = (float(part) for part in stated.split(":"))
    except ValueError:
        return max(container.duration / 1e6, 0.0)
    return max(hours * 3600.0 + minutes * 60.0 + seconds - start_s, 0.0)


def _stated_rotation(path: Path) -> int:
    """The turn in the metadata. It is a frame's side data in PyAV, so one frame is decoded, on a handle of its own."""
    container = av.open(str(path), mode="r")
    with container:
        try:
            return next(container.decode(video=0)).rotation
        except (StopIteration, FFmpegError):
            return 0


def _time_base(stream: VideoStream) -> float:
    return float(stream.time_base or Fraction(1, 1000))


def _quarter_turns(rotation_deg: int) -> int:
    """Counterclockwise quarter turns that make the picture upright; odd angles are left as filmed."""
    return (rotation_deg // 90) % 4 if rotation_deg % 90 == 0 else 0


def _upright(plane: Plane, quarter_turns: int) -> Plane:
    if quarter_turns == 0:
        return plane
    return np.ascontiguousarray(np.rot90(plane, quarter_turns))


def _plane(frame: av.VideoFrame, number: int) -> Plane:
    """One plane as (rows, columns) without the padding of its lines; a view, nothing is copied."""
    plane = frame.planes[number]
    buffer = cast("memoryview[int]", plane)  # a plane speaks the buffer protocol; the stubs do not say so
    return np.ndarray((plane.height, plane.width), np.uint8, buffer, strides=(plane.line_size, 1))
