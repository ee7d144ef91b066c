"""A stored film as a camera, in step with the robots of the same session: its frames with their own stamps."""

from __future__ import annotations

import logging
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from lab.base.timeline import Mark, Timeline, sleep_until
from tracking.cameras import CameraError, Frame, check_even, pack_i420
from tracking.coded import coded_frames
from tracking.segment import frames_table
from tracking.video import FrameReader, probe

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class StoredSegment:
    """A piece of the film: ``path``, beside it the table of its frames; it begins once ``after`` is reached."""

    path: Path
    after: Mark


class ReplayedCamera:
    """Plays stored segments through the ``Camera`` protocol; waits for whoever takes its frames.

    A frame keeps its number and its camera's time; its host's time is moved to the replay's clock. It carries its
    encoded form too, so that a recorder can copy it. Frames that were lost then are missing now.

    Args:
        name: the device string it is opened by.
        segments: the segments in order; at least one.
        rate_hz: the camera's nominal rate.
        timeline: the clock that it shares with the other devices of the replay.
    """

    live = False
    dropped = 0

    def __init__(self, name: str, segments: Sequence[StoredSegment], rate_hz: float, timeline: Timeline) -> None:
        if not segments:
            raise CameraError(name, f"{name}: no film lies there; set camera to none")
        self._name = name
        self._segments = tuple(segments)
        self._rate_hz = rate_hz
        self._timeline = timeline
        self._size: tuple[int, int] | None = None
        self._frames: Generator[Frame] | None = None
        self._waiting_for: Mark | None = None
        self._place = 0
        self._stopped = True

    @property
    def name(self) -> str:
        """The device string it was opened by."""
        return self._name

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels. Raises CameraError before ``start``."""
        if self._size is None:
            raise CameraError(self.name, f"{self.name}: not started; its image size is not known yet")
        return self._size

    @property
    def rate_hz(self) -> float:
        """Nominal frames a second."""
        return self._rate_hz

    async def start(self) -> None:
        """Open the first segment.

        Raises:
            VideoError: it cannot be read.
            CameraRequestError: its picture has an odd side.
        """
        info = probe(self._segments[0].path)
        check_even(info.size, self.name)
        self._size, self._place, self._frames, self._stopped = info.size, 0, None, False

    async def next_frame(self) -> Frame | None:
        """Wait until the next frame is due; None after the last one, or after ``stop``.

        Raises:
            VideoError: a segment cannot be read.
        """
        while not self._stopped:
            if self._frames is None:
                if self._place >= len(self._segments):
                    return None
                segment = self._segments[self._place]
                self._waiting_for = segment.after
                await self._timeline.reached(segment.after)
                self._frames = self._play(segment)
                self._place += 1
                continue
            frame = next(self._frames, None)
            if frame is None:
                self._frames = None
                continue
            due_s = self._timeline.due_s(frame.t_host_s)
            await sleep_until(due_s)
            if not self._stopped:
                return Frame(frame.index, frame.t_camera_s, due_s, frame.i420, frame.coded)
        return None

    async def stop(self) -> None:
        """Close the film; a frame that is being waited for comes back as None."""
        self._stopped = True
        if self._frames is not None:
            self._frames.close()
            self._frames = None
        if self._waiting_for is not None:
            self._timeline.reach(self._waiting_for)

    def _play(self, segment: StoredSegment) -> Generator[Frame]:
        """The frames of one segment with their stored times."""
        stamps = pd.read_parquet(frames_table(segment.path), columns=["index", "t_camera_s", "t_host_s"])
        coded = coded_frames(segment.path)
        with FrameReader(segment.path) as reader:
            for row, picture in zip(stamps.itertuples(index=False), reader, strict=False):
                index, t_camera_s, t_host_s = row
                yield Frame(
                    index=int(index),
                    t_camera_s=float(t_camera_s),
                    t_host_s=float(t_host_s),
                    i420=pack_i420(picture.luma, picture.chroma()),
                    coded=coded[picture.index] if len(coded) == len(stamps) else None,
                )
            if reader.frames_read < len(stamps):
                _log.warning("%s: %d frames are not played", segment.path, len(stamps) - reader.frames_read)
