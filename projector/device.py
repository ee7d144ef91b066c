"""What every projector can do."""

from __future__ import annotations

import asyncio
import time
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lab.base.errors import ChordlabError, RequestError


class ProjectorError(ChordlabError):
    """The projector failed while it ran: its window cannot be opened or was closed, its file not written."""


class ProjectorRequestError(RequestError):
    """A projector or an image was asked for that cannot be had. ``device`` is the string that was given."""

    def __init__(self, device: str, problem: str) -> None:
        self.device = device
        super().__init__(f"projector {device}: {problem}")


@runtime_checkable
class ProjectorDevice(Protocol):
    """A projector: it shows one gray image until it is shown the next.

    ``show`` takes uint8 (height, width) in the projector's own pixels, row 0 at the top, and returns
    when the image is on its way to the light. ``close`` may be called twice.
    """

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        ...

    @property
    def shown_s(self) -> float | None:
        """When the image now shown was put out, by ``now_s``; None before the first."""
        ...

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show ``image``; raises ProjectorRequestError for another size or type."""
        ...

    def close(self) -> None:
        """Let go of the device."""
        ...


def now_s() -> float:
    """Seconds on the running event loop's clock, virtual time too; without a loop the monotonic clock's.

    The loop of a real session reads that same monotonic clock, so both agree.
    """
    try:
        return asyncio.get_running_loop().time()
    except RuntimeError:
        return time.monotonic()


def check_image(image: NDArray[np.uint8], image_size: tuple[int, int], device: str) -> None:
    """Raise ProjectorRequestError unless ``image`` is uint8 gray of ``image_size`` (width, height)."""
    width, height = image_size
    if image.dtype != np.uint8 or image.shape != (height, width):
        raise ProjectorRequestError(
            device,
            f"shows gray uint8 images of {width} x {height} pixels, got {image.dtype} of shape {image.shape};"
            " render for this projector's image size",
        )
