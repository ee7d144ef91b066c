"""A projector that writes its images to a folder, to look at or to show by other means."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.base.files import write_aside
from projector.device import ProjectorError, ProjectorRequestError, check_image


class ImageFolder:
    """Writes every shown image as ``000001.png``, ``000002.png``, …; goes on after those already there."""

    def __init__(self, folder: str | os.PathLike[str], *, image_size: tuple[int, int] = (1920, 1080)) -> None:
        """Make ``folder`` where missing. Raises ProjectorRequestError when it cannot be made."""
        self.folder = Path(folder)
        self._image_size = image_size
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ProjectorRequestError(
                self._device, f"cannot make the folder ({error.strerror}); name another"
            ) from error
        taken = [int(path.stem) for path in self.folder.glob("*.png") if path.stem.isdecimal()]
        self._last = max(taken, default=0)

    @property
    def _device(self) -> str:
        return f"image:{self.folder}"

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._image_size

    def show(self, image: NDArray[np.uint8]) -> None:
        """Write the next numbered PNG, aside first and then renamed, so that none is ever half written."""
        check_image(image, self._image_size, self._device)
        _, data = cv2.imencode(".png", image)
        path = self.folder / f"{self._last + 1:06d}.png"
        try:
            write_aside(path, data.tobytes())
        except OSError as error:
            raise ProjectorError(f"cannot write {path} ({error.strerror}); free some space or name another") from error
        self._last += 1

    def close(self) -> None:
        """Nothing to let go of."""
