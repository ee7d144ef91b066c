"""Films a session: takes every frame of a camera and writes Matroska segments, one for each run.

Matroska, because a file cut short can still be read. A segment is written aside as ``NAME.part``, synced,
and renamed when it is closed, so a file under its own name is whole. Its PTS is the camera's clock in
milliseconds, and beside it lies a table of every frame's two times and of the frames lost before it.

Encoding runs in a worker thread behind a bounded queue. A live camera never waits for it: on a full queue
frames are dropped and counted. A camera that waits for us (virtual, file) is held back instead, by blocking
the loop, so that nothing is lost and no timer of a jumping clock runs ahead of the encoder.
"""

from __future__ import annotations

import asyncio
import logging
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from av.error import FFmpegError

from lab.base.errors import ChordlabError, RequestError
from tracking.cameras import Camera, Frame
from tracking.segment import EncoderSettings, SegmentInfo, SegmentWriter

__all__ = ["EncoderSettings", "Recorder", "RecorderError", "SegmentInfo"]

_log = logging.getLogger(__name__)
_LIVE_BIT_RATE = 12_000_000


class RecorderError(ChordlabError):
    """A segment could not be written, or recording has stopped. Check the disk and the camera.

    Attribute ``path``: the segment, where it is one that could not be written.
    """

    def __init__(self, message: str, path: Path | None = None) -> None:
        super().__init__(message)
        self.path = path


@dataclass(frozen=True, slots=True)
class _Open:
    path: Path


@dataclass(frozen=True, slots=True)
class _Close:
    done: Future[SegmentInfo]


class _Quit:
    """The worker's last order."""


_Order = Frame | _Open | _Close | _Quit


class Recorder:
    """Writes what a camera sees, segment after segment, without losing a frame in between.

    Use as an async context manager, or ``start`` and ``stop``.

    Args:
        camera: the camera; the recorder starts and stops it.
        settings: codec, quality, bit rate; by default a live camera's bit rate is bounded, and that of one that
            waits for us is not, since its encoder's speed is what it waits for.
        queue_frames: how many frames may wait for the encoder.
        timeout_s: longest wait for the encoder, in real seconds.
        on_frame: called on the loop with every frame, recorded or not (a live page, an online tracker).

    Raises:
        RequestError: the settings name a codec that this build of FFmpeg lacks.
    """

    def __init__(
        self,
        camera: Camera,
        settings: EncoderSettings | None = None,
        *,
        queue_frames: int = 8,
        timeout_s: float = 60.0,
        on_frame: Callable[[Frame], None] | None = None,
    ) -> None:
        self.camera = camera
        self.latest: Frame | None = None
        self._settings = settings or EncoderSettings(max_bit_rate=_LIVE_BIT_RATE if camera.live else None)
        self._settings.encoder()  # a missing encoder is told here, not in the middle of a session
        self._timeout_s = timeout_s
        self._on_frame = on_frame
        self._orders: queue.Queue[_Order] = queue.Queue(maxsize=queue_frames)
        self._worker: threading.Thread | None = None
        self._pump_task: asyncio.Task[None] | None = None
        self._path: Path | None = None
        self._overruns = 0
        self._late = 0
        self._failure: BaseException | None = None

    @property
    def segment(self) -> Path | None:
        """The segment that is being written, or None."""
        return self._path

    @property
    def dropped(self) -> int:
        """Frames lost so far: at the camera, and here because the encoder was behind."""
        return self.camera.dropped + self._overruns

    @property
    def late(self) -> int:
        """Frames of the segments closed so far that reached us more than half a period after they were due."""
        return self._late

    @property
    def failure(self) -> BaseException | None:
        """Why no more frames come, where the camera or the encoder has failed; the next open raises it too."""
        return self._failure

    async def __aenter__(self) -> Recorder:
        await self.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        await self.stop()

    async def start(self) -> None:
        """Start the camera and take its frames. Raises CameraError where the camera cannot be opened."""
        await self.camera.start()
        self._worker = threading.Thread(target=self._work, name="chordlab-recorder", daemon=True)
        self._worker.start()
        self._pump_task = asyncio.create_task(self._pump())
        self._pump_task.add_done_callback(self._pump_ended)

    async def stop(self) -> SegmentInfo | None:
        """Close the segment that is open, stop the camera and the worker; what was closed, or None.

        Raises:
            RecorderError: the open segment could not be written.
        """
        if self._worker is None:
            return None
        try:
            return await self.close_segment() if self._path is not None else None
        finally:
            await self.camera.stop()
            if self._pump_task is not None:
                self._pump_task.cancel()
                await asyncio.gather(self._pump_task, return_exceptions=True)
            await self._order(_Quit())
            self._worker.join(self._timeout_s)
            self._worker = None

    async def open_segment(self, path: str | Path) -> SegmentInfo | None:
        """Send all frames from now on to ``path``; close the segment before it, if one is open, and return it.

        Raises:
            RequestError: the folder is missing, or the file is there already.
            RecorderError: the segment before could not be written, or the camera has failed.
        """
        file = Path(path)
        _check_free(file)
        self._check_running()
        done = await self._hand_in() if self._path is not None else None
        await self._order(_Open(file))
        self._path = file
        return None if done is None else await self._finished(done)

    async def close_segment(self) -> SegmentInfo:
        """Close the open segment: encoded to its last frame, synced and under its own name.

        Where the camera has failed meanwhile the frames until then are kept and returned; see ``failure``.

        Raises:
            RecorderError: none is open, or it could not be written.
        """
        if self._path is None:
            raise RecorderError("no video segment is open; open one first")
        return await self._finished(await self._hand_in())

    async def _hand_in(self) -> Future[SegmentInfo]:
        done: Future[SegmentInfo] = Future()
        await self._order(_Close(done))
        self._path = None
        return done

    async def _finished(self, done: Future[SegmentInfo]) -> SegmentInfo:
        try:
            if self.camera.live:
                segment = await asyncio.wait_for(asyncio.wrap_future(done), self._timeout_s)
            else:
                segment = done.result(self._timeout_s)
        except TimeoutError as error:
            raise RecorderError(f"the video encoder did not finish within {self._timeout_s:g} s") from error
        self._late += segment.late
        return segment

    async def _order(self, order: _Order) -> None:
        """Queue an order that must not be lost."""
        if not self.camera.live:
            self._put(order)
            return
        try:
            self._orders.put_nowait(order)
        except queue.Full:
            await asyncio.wait_for(asyncio.to_thread(self._put, order), self._timeout_s + 1.0)

    def _put(self, order: _Order) -> None:
        try:
            self._orders.put(order, timeout=self._timeout_s)
        except queue.Full as error:
            raise RecorderError(f"the video encoder took nothing for {self._timeout_s:g} s") from error

    def _check_running(self) -> None:
        if self._worker is None:
            raise RecorderError("the recorder is not running; start it first")
        if self._failure is not None:
            raise RecorderError(f"recording has stopped: {self._failure}") from self._failure

    async def _pump(self) -> None:
        """Take frames until the camera ends."""
        while (frame := await self.camera.next_frame()) is not None:
            self.latest = frame
            if self._on_frame is not None:
                self._on_frame(frame)
            if self._path is not None:
                self._take(frame)

    def _pump_ended(self, task: asyncio.Task[None]) -> None:
        """Keep what ended the pump, a failed camera or an error in ``on_frame``, for the next open to raise."""
        if not task.cancelled() and (error := task.exception()) is not None:
            self._failure = error
            _log.error("recording stopped: %s", error)

    def _take(self, frame: Frame) -> None:
        if not self.camera.live:
            self._put(frame)
            return
        try:
            self._orders.put_nowait(frame)
        except queue.Full:
            # The frame's number is missing from the file, which the next frame's `dropped_before` tells.
            self._overruns += 1

    def _work(self) -> None:
        """The worker thread: encode until told to quit. A broken segment swallows its frames and tells at its close."""
        writer: SegmentWriter | None = None
        trouble: RecorderError | None = None
        last_index: int | None = None
        while not isinstance(order := self._orders.get(), _Quit):
            try:
                match order:
                    case _Open():
                        trouble = None
                        writer = SegmentWriter(order.path, self._settings, self.camera.rate_hz, last_index=last_index)
                    case Frame():
                        last_index = order.index
                        if writer is not None and trouble is None:
                            writer.add(order)
                    case _Close():
                        if trouble is not None:
                            order.done.set_exception(trouble)
                        elif writer is not None:
                            order.done.set_result(writer.close())
                        writer = None
            except (OSError, ValueError, FFmpegError) as error:
                path = None if writer is None else writer.path
                trouble = RecorderError(f"{path}: cannot write the video ({error}); is the disk full?", path)
                trouble.__cause__ = error
                if writer is not None:
                    writer.abandon()
                if isinstance(order, _Close):
                    order.done.set_exception(trouble)
        if writer is not None:
            writer.abandon()


def _check_free(path: Path) -> None:
    if not path.parent.is_dir():
        raise RequestError(f"{path.parent}: no such folder for a video segment; make it first")
    if path.exists():
        raise RequestError(f"{path}: this segment is there already; choose another name")
