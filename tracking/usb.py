"""A USB camera through OpenCV, read in a thread of its own so that the event loop never waits for it."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.cameras import CameraError, Frame, check_even

_log = logging.getLogger(__name__)

_MANUAL_EXPOSURE = 1.0  # V4L2's word for it; 3 is automatic
_EXPOSURE_HELD = frozenset({1, 2})
_INTERVALS_KEPT = 30


class Capture(Protocol):
    """The part of ``cv2.VideoCapture`` that is used; tests put another in its place."""

    def isOpened(self) -> bool:  # noqa: N802
        """Whether the device is open."""
        ...

    def set(self, propId: int, value: float) -> bool:
        """Set a property; False where the driver does not take it."""
        ...

    def get(self, propId: int) -> float:
        """Read a property; 0 where the driver does not know it."""
        ...

    def grab(self) -> bool:
        """Wait for the next frame."""
        ...

    def retrieve(self) -> tuple[bool, NDArray[np.uint8]]:
        """Decode the grabbed frame as BGR (h, w, 3)."""
        ...

    def release(self) -> None:
        """Close the device."""
        ...


@dataclass(frozen=True, slots=True)
class UsbSettings:
    """What is asked of a USB camera.

    Attributes:
        size: (width, height) in pixels.
        rate_hz: frames a second.
        exposure: the driver's own number for the exposure time, or None to keep what is set; always held fixed.
        focus: the driver's number for the focus, or None to keep what is set; always held fixed.
        fourcc: pixel format on the cable; Motion JPEG, since raw 720p at 30 Hz does not fit through USB 2.
        timeout_s: a camera that gives no frame for so long has failed.
        waiting_frames: frames that may wait for the loop before new ones are dropped.
    """

    size: tuple[int, int] = (1280, 720)
    rate_hz: float = 30.0
    exposure: float | None = None
    focus: float | None = None
    fourcc: str = "MJPG"
    timeout_s: float = 5.0
    waiting_frames: int = 4


class UsbCamera:
    """A USB camera that speaks the ``Camera`` protocol.

    ``t_host_s`` is the loop's monotonic time when a frame reached us, ``t_camera_s`` the driver's stamp of
    it where there is one (Linux gives the time of the transfer), else the host's, counted from the first
    frame. Lost frames show as gaps in ``t_camera_s``: they are counted, and ``index`` jumps over them.

    Args:
        number: the N of "usb:N".
        settings: what is asked of the camera.
        opener: makes the capture device.
    """

    live = True

    def __init__(
        self, number: int, settings: UsbSettings | None = None, *, opener: Callable[[int], Capture] | None = None
    ) -> None:
        self.settings = settings or UsbSettings()
        self._number = number
        self._opener = opener or open_device
        self._size = self.settings.size
        self._rate_hz = self.settings.rate_hz
        self._dropped = 0
        self._frames: asyncio.Queue[Frame | CameraError] = asyncio.Queue(self.settings.waiting_frames)
        self._quit = threading.Event()
        self._thread: threading.Thread | None = None
        self.not_held: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The device string it was opened by."""
        return f"usb:{self._number}"

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels: what was asked for, after ``start`` what is given."""
        return self._size

    @property
    def rate_hz(self) -> float:
        """Frames a second: what was asked for, after ``start`` what the driver promises."""
        return self._rate_hz

    @property
    def dropped(self) -> int:
        """Frames lost so far on the cable or because the loop was behind."""
        return self._dropped

    async def start(self) -> None:
        """Open the camera, hold its exposure and focus, and read it in a thread.

        ``not_held`` then names what the driver would not hold fixed, which is also logged as a warning.

        Raises:
            CameraError: there is no such camera, or it gives no picture in time.
            CameraRequestError: it gives a picture with an odd side.
        """
        loop = asyncio.get_running_loop()
        self._quit.clear()
        self._dropped = 0
        self._frames = asyncio.Queue(self.settings.waiting_frames)
        try:
            # Opening can take seconds, so it waits in a thread too.
            capture = await asyncio.wait_for(asyncio.to_thread(self._open), 4.0 * self.settings.timeout_s)
        except TimeoutError as error:
            raise CameraError(self.name, f"{self.name}: opening takes too long; plug the camera in anew") from error
        self._thread = threading.Thread(
            target=self._read, args=(capture, loop), name=f"camera-{self.name}", daemon=True
        )
        self._thread.start()

    async def next_frame(self) -> Frame | None:
        """Wait for the next frame; None after ``stop``. Raises CameraError where the camera gives none."""
        if self._quit.is_set() or self._thread is None:
            return None
        try:
            found = await asyncio.wait_for(self._frames.get(), self.settings.timeout_s)
        except TimeoutError as error:
            if self._quit.is_set():
                return None
            raise CameraError(
                self.name, f"{self.name}: no frame for {self.settings.timeout_s:g} s; check the cable"
            ) from error
        if isinstance(found, CameraError):
            raise found
        return found

    async def stop(self) -> None:
        """Stop reading and close the camera."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._quit.set()
            await asyncio.to_thread(thread.join, self.settings.timeout_s)

    def _open(self) -> Capture:
        capture = self._opener(self._number)
        if not capture.isOpened():
            capture.release()
            raise CameraError(
                self.name, f"{self.name}: no camera there; is it plugged in, free, and is the number right?"
            )
        settings = self.settings
        capture.set(cv2.CAP_PROP_FOURCC, float(cv2.VideoWriter.fourcc(*settings.fourcc)))
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, float(settings.size[0]))
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, float(settings.size[1]))
        capture.set(cv2.CAP_PROP_FPS, settings.rate_hz)
        self._hold(capture)
        if not capture.grab():
            capture.release()
            raise CameraError(self.name, f"{self.name}: gives no picture; is another program using it?")
        _, picture = capture.retrieve()
        self._size = (picture.shape[1], picture.shape[0])
        check_even(self._size, self.name)
        if self._size != settings.size:
            _log.warning("%s: gives %dx%d pixels instead of %dx%d", self.name, *self._size, *settings.size)
        self._rate_hz = capture.get(cv2.CAP_PROP_FPS) or settings.rate_hz
        return capture

    def _hold(self, capture: Capture) -> None:
        """Hold exposure, focus and white balance: a camera that adapts makes the floor blink with the shape."""
        wishes: list[tuple[str, int, float]] = [
            ("exposure", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE),
            ("focus", cv2.CAP_PROP_AUTOFOCUS, 0.0),
            ("white balance", cv2.CAP_PROP_AUTO_WB, 0.0),
        ]
        if self.settings.exposure is not None:
            wishes.append(("exposure time", cv2.CAP_PROP_EXPOSURE, self.settings.exposure))
        if self.settings.focus is not None:
            wishes.append(("focus distance", cv2.CAP_PROP_FOCUS, self.settings.focus))
        self.not_held = tuple(what for what, number, value in wishes if not _holds(capture, number, value))
        if self.not_held:
            _log.warning("%s: the driver does not hold %s; set it by hand", self.name, ", ".join(self.not_held))

    def _read(self, capture: Capture, loop: asyncio.AbstractEventLoop) -> None:
        """The camera's thread."""
        clock = _GapClock(1.0 / self._rate_hz)
        try:
            while not self._quit.is_set():
                if not capture.grab():
                    self._hand_over(
                        loop, CameraError(self.name, f"{self.name}: stopped giving frames; check the cable")
                    )
                    return
                t_host_s = loop.time()
                index, t_camera_s, missed = clock.stamp(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0, t_host_s)
                self._dropped += missed
                good, picture = capture.retrieve()
                if not good:
                    self._dropped += 1
                    continue
                packed = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420), dtype=np.uint8)
                self._hand_over(loop, Frame(index=index, t_camera_s=t_camera_s, t_host_s=t_host_s, i420=packed))
        except cv2.error as error:
            self._hand_over(loop, CameraError(self.name, f"{self.name}: a frame cannot be decoded ({error.err})"))
        finally:
            capture.release()

    def _hand_over(self, loop: asyncio.AbstractEventLoop, found: Frame | CameraError) -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(self._arrive, found)

    def _arrive(self, found: Frame | CameraError) -> None:
        """On the loop: queue a frame, or count it as lost where nobody took the ones before."""
        if isinstance(found, CameraError) and self._frames.full():
            self._frames.get_nowait()
            self._dropped += 1
        if self._frames.full():
            self._dropped += 1
        else:
            self._frames.put_nowait(found)


class _GapClock:
    """Numbers frames by their time stamps, so that a gap of n periods advances the number by n."""

    def __init__(self, period_s: float) -> None:
        self._intervals_s: deque[float] = deque([period_s], maxlen=_INTERVALS_KEPT)
        self._first: tuple[float, float] | None = None
        self._last_s = 0.0
        self._index = 0
        self._by_driver = False

    def stamp(self, t_driver_s: float, t_host_s: float) -> tuple[int, float, int]:
        """The frame's number, its camera time (s, from 0) and how many frames were lost before it."""
        if self._first is None:
            self._first = (t_driver_s, t_host_s)
            self._by_driver = t_driver_s > 0.0
            return 0, 0.0, 0
        t_s = t_driver_s - self._first[0] if self._by_driver else t_host_s - self._first[1]
        if self._by_driver and t_s <= self._last_s and self._index == 0:
            # The driver's stamp stands still: it has none. Decided once, so that the two clocks never mix.
            self._by_driver = False
            t_s = t_host_s - self._first[1]
        interval_s = t_s - self._last_s
        # Exposure in the dark lengthens all intervals: compare with what is usual now, not with the promise.
        usual_s = _median(self._intervals_s)
        missed = max(0, round(interval_s / usual_s) - 1)
        if interval_s > 0.0:
            self._intervals_s.append(interval_s)
        self._index += 1 + missed
        self._last_s = t_s
        return self._index, t_s, missed


def _holds(capture: Capture, number: int, value: float) -> bool:
    """Set a property and read it back: many drivers say yes and do nothing."""
    if not capture.set(number, value):
        return False
    kept = capture.get(number)
    if number == cv2.CAP_PROP_AUTO_EXPOSURE:
        # V4L2 has two kinds of automatic exposure (0 and 3) and two that hold the time (1 and 2).
        return round(kept) in _EXPOSURE_HELD
    return abs(kept - value) <= max(1e-6, 0.1 * abs(value))


def _median(values: Sequence[float] | deque[float]) -> float:
    return float(np.median(np.asarray(values, dtype=float)))


def open_device(number: int) -> Capture:
    """OpenCV's own way to camera ``number``; ask ``isOpened`` whether there is one."""
    return cast("Capture", cv2.VideoCapture(number))
