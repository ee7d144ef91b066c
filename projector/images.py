"""A projector that writes its images to a folder, to look at or to show by other means."""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.base.files import write_aside
from projector.device import ProjectorError, ProjectorRequestError, check_image, now_s

INDEX = "index.csv"
_HEADER = ["image", "shown_s"]


class ImageFolder:
    """Writes every shown image as ``000001.png``, ``000002.png``, …; goes on after those already there.

    ``index.csv`` beside them has a row ``image, shown_s`` for each: its file's name and when it was shown,
    on the event loop's clock. An image counts as shown once it stands in the index; both files are written
    aside and then renamed, so that neither is ever half there.
    """

    def __init__(self, folder: str | os.PathLike[str], *, image_size: tuple[int, int] = (1920, 1080)) -> None:
        """Make ``folder`` where missing. Raises ProjectorRequestError when it or its index cannot be used."""
        self.folder = Path(folder)
        self._image_size = image_size
        self._shown_s: float | None = None
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ProjectorRequestError(
                self._device, f"cannot make the folder ({error.strerror}); name another"
            ) from error
        self._rows = self._read_index()
        taken = [int(path.stem) for path in self.folder.glob("*.png") if path.stem.isdecimal()]
        self._last = max(taken, default=0)

    @property
    def _device(self) -> str:
        return f"image:{self.folder}"

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._image_size

    @property
    def shown_s(self) -> float | None:
        """When the last image was written, on the event loop's clock; None before the first of this run."""
        return self._shown_s

    def show(self, image: NDArray[np.uint8]) -> None:
        """Write the next numbered PNG and its row. Raises ProjectorError when the disk refuses either."""
        check_image(image, self._image_size, self._device)
        _, data = cv2.imencode(".png", image)
        path = self.folder / f"{self._last + 1:06d}.png"
        try:
            write_aside(path, data.tobytes())
            shown_s = now_s()
            rows = [*self._rows, [path.name, f"{shown_s:.6f}"]]
            # an index that cannot be written leaves the number free: the next image takes the orphan's place
            path = self.folder / INDEX
            write_aside(path, _to_csv(rows))
        except OSError as error:
            raise ProjectorError(f"cannot write {path} ({error.strerror}); free some space or name another") from error
        self._rows = rows
        self._shown_s = shown_s
        self._last += 1

    def close(self) -> None:
        """Nothing to let go of."""

    def _read_index(self) -> list[list[str]]:
        """The rows of earlier runs in this folder."""
        try:
            with (self.folder / INDEX).open(encoding="utf-8", newline="") as file:
                header, *rows = list(csv.reader(file)) or [[]]
        except FileNotFoundError:
            return []
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise ProjectorRequestError(
                self._device, f"{INDEX} cannot be read ({type(error).__name__}); name another folder"
            ) from error
        if header != _HEADER or any(len(row) != len(_HEADER) for row in rows):
            raise ProjectorRequestError(self._device, f"{INDEX} is no index of projected images; name another folder")
        return rows


def _to_csv(rows: list[list[str]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_HEADER, *rows])
    return text.getvalue().encode()
