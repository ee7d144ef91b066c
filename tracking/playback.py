"""A video file as a camera: its frames at their own times on the event loop's clock."""

from __future__ import annotations

import asyncio
from pathlib import Path

from tracking.cameras import CameraError, Frame, check_even, pack_i420
from tracking.video import FrameReader, probe


class FileCamera:
    """Plays a file through the ``Camera`` protocol; waits for whoever takes its frames and drops none.

    ``t_camera_s`` is the file's PTS, ``t_host_s`` the loop's time at which the frame was due and given.
    """

    live = False
    dropped = 0

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._reader: FrameReader | None = None
        self._size: tuple[int, int] | None = None
        self._rate_hz = 30.0
        self._offset_s: float | None = None

    @property
    def name(self) -> str:
        """The device string it was opened by."""
        return f"file:{self._path}"

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels of the upright picture. Raises CameraError before ``start``."""
        if self._size is None:
            raise CameraError(self.name, f"{self.name}: not started; its image size is not known yet")
        return self._size

    @property
    def rate_hz(self) -> float:
        """The file's mean frame rate (30 before ``start``)."""
        return self._rate_hz

    async def start(self) -> None:
        """Open the file.

        Raises:
            VideoError: it cannot be read.
            CameraRequestError: its picture has an odd side.
        """
        info = probe(self._path)
        check_even(info.size, self.name)
        self._size, self._rate_hz = info.size, info.rate_hz
        self._reader = FrameReader(self._path)
        self._offset_s = None

    async def next_frame(self) -> Frame | None:
        """Wait until the next frame is due; None at the end of the file or after ``stop``."""
        reader = self._reader
        picture = None if reader is None else next(reader, None)
        if reader is None or picture is None:
            return None
        loop = asyncio.get_running_loop()
        if self._offset_s is None:
            self._offset_s = loop.time() - picture.t_s
        # The wait is as long as the file says, at most the gap between two of its frames.
        await asyncio.sleep(max(0.0, self._offset_s + picture.t_s - loop.time()))
        if self._reader is not reader:
            return None
        packed = pack_i420(picture.luma, picture.chroma())
        return Frame(index=picture.index, t_camera_s=picture.t_s, t_host_s=loop.time(), i420=packed)

    async def stop(self) -> None:
        """Close the file."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None
