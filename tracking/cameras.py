"""What every camera gives, whether it hangs on USB, plays a file or is drawn: frames with two clocks.

A frame carries the camera's own time and the host's, side by side; neither overwrites the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lab.base.errors import ChordlabError, RequestError

if TYPE_CHECKING:
    from tracking.coded import CodedFrame

Plane = NDArray[np.uint8]


class CameraError(ChordlabError):
    """A camera cannot be opened or has stopped giving frames. ``device``: its name. Check cable and number."""

    def __init__(self, device: str, message: str) -> None:
        super().__init__(message)
        self.device = device


class CameraRequestError(RequestError):
    """A camera was asked for that cannot be: a misspelt device, an odd image size. ``device``: its name."""

    def __init__(self, device: str, message: str) -> None:
        super().__init__(message)
        self.device = device


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One frame of a camera.

    Attributes:
        index: number of the frame at the camera, from 0; a jump means dropped frames.
        t_camera_s: time on the camera's own clock (middle of the exposure where it is known).
        t_host_s: time on the host's clock, the event loop's, when the frame reached us.
        i420: (h · 3/2, w) uint8, the planes Y, U, V one after the other as encoders take them.
        coded: the frame as an encoder made it, where it comes from a film.
    """

    index: int
    t_camera_s: float
    t_host_s: float
    i420: Plane
    coded: CodedFrame | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        rows, width = self.i420.shape
        return width, rows * 2 // 3

    @property
    def luma(self) -> Plane:
        """Brightness (h, w) uint8, a view."""
        return self.i420[: self.size[1]]

    @property
    def chroma(self) -> tuple[Plane, Plane]:
        """The colour planes (U, V), each (h / 2, w / 2) uint8 with 128 = neutral, views."""
        return chroma_planes(self.i420)


def chroma_planes(i420: Plane) -> tuple[Plane, Plane]:
    """The planes (U, V) of a packed (h · 3/2, w) picture as (h / 2, w / 2) views."""
    rows, width = i420.shape
    height = rows * 2 // 3
    planes = i420.reshape(-1)[height * width :].reshape(2, height // 2, width // 2)
    return planes[0], planes[1]


def pack_i420(luma: ArrayLike, chroma: tuple[ArrayLike, ArrayLike] | None = None) -> Plane:
    """Pack planes Y (h, w) and U, V (h / 2, w / 2) into (h · 3/2, w) uint8; without chroma, neutral grey.

    Raises:
        CameraRequestError: the width or the height is odd.
    """
    brightness = np.asarray(luma, dtype=np.uint8)
    height, width = brightness.shape
    check_even((width, height), "picture")
    packed: Plane = np.full((height * 3 // 2, width), 128, dtype=np.uint8)
    packed[:height] = brightness
    if chroma is not None:
        for target, plane in zip(chroma_planes(packed), chroma, strict=True):
            target[:] = np.asarray(plane, dtype=np.uint8)
    return packed


def check_even(size: tuple[int, int], device: str) -> None:
    """Check that a picture can carry half-size colour planes. Raises CameraRequestError where a side is odd."""
    if size[0] % 2 or size[1] % 2:
        raise CameraRequestError(
            device, f"{device}: {size[0]}x{size[1]} pixels; width and height must be even, choose another image size"
        )


@runtime_checkable
class Camera(Protocol):
    """A source of frames on the event loop.

    ``size`` is (width, height) in pixels and is known after ``start``; ``rate_hz`` is nominal;
    ``dropped`` counts frames that the camera took and we never got; ``live`` is True where frames
    come whether or not anyone is ready (a real camera), False where the source waits for us.
    """

    @property
    def name(self) -> str:
        """The device string it was opened by."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        ...

    @property
    def rate_hz(self) -> float:
        """Nominal frames a second."""
        ...

    @property
    def dropped(self) -> int:
        """Frames lost so far between the sensor and ``next_frame``."""
        ...

    @property
    def live(self) -> bool:
        """Whether frames come at their own pace and are lost when nobody takes them."""
        ...

    async def start(self) -> None:
        """Open the device. Raises CameraError where it cannot be opened."""
        ...

    async def next_frame(self) -> Frame | None:
        """Wait for the next frame; None when the source has ended or was stopped."""
        ...

    async def stop(self) -> None:
        """Close the device; may be called twice."""
        ...
