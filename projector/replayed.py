"""The projector of a stored session: its light is in the stored samples, so it shows nothing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from projector.device import check_image, now_s


class ReplayedProjector:
    """A ``ProjectorDevice`` that takes images and shows none.

    Args:
        image_size: (width, height) in pixels of the images that it takes.
        on_show: told the number of each image that is shown, from 0.
    """

    def __init__(self, image_size: tuple[int, int], on_show: Callable[[int], None]) -> None:
        self._image_size = image_size
        self._on_show = on_show
        self._count = 0
        self._shown_s: float | None = None

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._image_size

    @property
    def shown_s(self) -> float | None:
        """When the last image was taken; None before the first."""
        return self._shown_s

    def show(self, image: NDArray[np.uint8]) -> None:
        """Take an image. Raises ProjectorRequestError for another size or type."""
        check_image(image, self._image_size, "replay")
        self._shown_s = now_s()
        self._on_show(self._count)
        self._count += 1

    def close(self) -> None:
        """Nothing is to be let go."""
