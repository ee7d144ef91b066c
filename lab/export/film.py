"""mp4: the whole film of a session in one file."""

# pyright: reportUnknownMemberType=false
# PyAV's stubs leave Packet's stream and add_stream's keywords open; nothing of them leaves this module.

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import av
import pandas as pd
from av.container import InputContainer
from av.error import FFmpegError
from av.video.stream import VideoStream

from lab.base.errors import ChordlabError, RequestError
from lab.export.aside import whole_file
from lab.export.source import Segment, Source
from tracking.overlay import write_preview
from tracking.segment import EncoderSettings
from tracking.video import VideoError, read_frames

Progress = Callable[[int, int], None]

_MS = Fraction(1, 1000)
_QUALITY = 20
_SPARSE = 25  # frames between two calls of progress


def write_film(source: Source, path: Path, progress: Progress | None = None) -> bool:
    """Join the pieces of a session's film into one mp4.

    A picture stands at its time in the session: the film's time is the session's since the film's first frame, gaps
    between runs included, where the last picture stands still. H.264 of one kind is copied as it is; anything else
    (Motion JPEG, pieces of several encoders) is encoded anew. The index stands first, so that it plays while it loads.

    Args:
        source: a session with a film.
        path: the .mp4.
        progress: called now and then with (frames written, frames in all).

    Returns:
        Whether the pictures were copied bit by bit.

    Raises:
        RequestError: the pieces differ in size, one cannot be read, or the file cannot be written.
    """
    kinds = {_kind(segment) for segment in source.film}
    sizes = {size for _, size, _ in kinds}
    if len(sizes) > 1:
        raise RequestError(f"{source.name}: its film has pictures of several sizes; export each run's video.mkv")
    codecs = {codec for codec, _, _ in kinds}
    copied = len(kinds) == 1 and (codecs == {"h264"} or EncoderSettings().encoder() != "h264")
    with whole_file(path) as aside, _film_faults(path):
        (_copy if copied else _encode)(source.film, aside, progress)
    return copied


def write_overlay(source: Source, path: Path, progress: Progress | None = None) -> None:
    """The same film with the track drawn over it, as ``chordlab track --preview`` draws it; encoded anew.

    Raises:
        RequestError: there is no track, it belongs to another film, or the file cannot be written.
    """
    if source.track is None:
        raise RequestError(f"{source.name}: has no track to draw; run chordlab validate on it first")
    table = pd.concat(list(source.track_rows()), ignore_index=True)
    several = "segment" in table.columns
    if "robot" in table.columns:
        numbers = {name: number for number, name in enumerate(sorted(map(str, table["robot"].unique())))}
        table["robot"] = table["robot"].map(numbers).astype(int)
    of_piece = dict(iter(table.groupby("segment" if several else "line")))
    tracks = [of_piece.get(segment.line, table.iloc[:0]) for segment in source.film]
    starts_s = [segment.t_first_s - source.film[0].t_first_s for segment in source.film]
    write_preview([segment.path for segment in source.film], tracks, path, starts_s=starts_s, progress=progress)


def _kind(segment: Segment) -> tuple[str, tuple[int, int], bytes]:
    """Codec, size and the codec's own header: pieces that agree in these can follow each other in one stream."""
    with _opened(segment) as (_, stream):
        context = stream.codec_context
        return context.name, (context.width, context.height), bytes(context.extradata or b"")


def _copy(film: tuple[Segment, ...], aside: Path, progress: Progress | None) -> None:
    total, done, last = sum(segment.frames for segment in film), 0, -1
    with av.open(str(aside), mode="w", format="mp4", options={"movflags": "faststart"}) as container:
        target: VideoStream | None = None
        for segment in film:
            with _opened(segment) as (file, stream):
                if target is None:
                    target = container.add_stream_from_template(stream)
                    target.time_base = _MS
                shift = segment.shift_s - film[0].t_first_s
                for packet in file.demux(stream):
                    if packet.dts is None or packet.pts is None or packet.is_corrupt:
                        continue
                    base = packet.time_base
                    dts = max(last + 1, _ticks(packet.dts * base, shift))
                    packet.pts = dts + round((packet.pts - packet.dts) * base / _MS)
                    packet.dts, last = dts, dts
                    packet.duration = round((packet.duration or 0) * base / _MS)
                    packet.time_base, packet.stream = _MS, target
                    container.mux(packet)
                    done += 1
                    if progress is not None and done % _SPARSE == 0:
                        progress(min(done, total), total)


def _encode(film: tuple[Segment, ...], aside: Path, progress: Progress | None) -> None:
    total, done, last = sum(segment.frames for segment in film), 0, -1
    with av.open(str(aside), mode="w", format="mp4", options={"movflags": "faststart"}) as opened:
        container = cast("Any", opened)  # PyAV promises a union over all codecs
        target: Any = None
        for segment in film:
            with read_frames(segment.path) as reader:
                for frame in reader:
                    if target is None:
                        rate = Fraction(reader.info.rate_hz).limit_denominator(1001)
                        target = container.add_stream("libx264", rate=rate)
                        target.width, target.height = frame.decoded.width, frame.decoded.height
                        target.pix_fmt = "yuv420p"
                        target.options = {"crf": str(_QUALITY), "preset": "veryfast"}
                        target.codec_context.time_base = _MS
                    picture = frame.decoded.reformat(format="yuv420p")
                    last = max(last + 1, _ticks(Fraction(frame.t_s), segment.shift_s - film[0].t_first_s))
                    picture.pts, picture.time_base = last, _MS
                    container.mux(target.encode(picture))
                    done += 1
                    if progress is not None and done % _SPARSE == 0:
                        progress(min(done, total), total)
        if target is not None:
            container.mux(target.encode(None))


def _ticks(t_s: Fraction, shift_s: float) -> int:
    return round((t_s + Fraction(shift_s)) / _MS)


@contextmanager
def _opened(segment: Segment) -> Generator[tuple[InputContainer, VideoStream]]:
    try:
        container = av.open(str(segment.path.absolute()), mode="r")
    except (FFmpegError, OSError) as error:
        raise VideoError(segment.path, f"{segment.path}: cannot be read as a video ({error})") from error
    with container:
        if not container.streams.video:
            raise VideoError(segment.path, f"{segment.path}: holds no picture; leave mp4 out of --to")
        yield container, container.streams.video[0]


@contextmanager
def _film_faults(path: Path) -> Generator[None]:
    try:
        yield
    except ChordlabError:
        raise
    except FFmpegError as error:
        raise RequestError(f"{path}: the film cannot be written ({error.strerror}); choose another --out") from error
