"""The camera's calibration: from a pixel of the LED to a place in the arena."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lab.base.errors import RequestError
from lab.base.files import write_aside
from lab.base.given import json_of, one_line, read_given
from lab.base.pinhole import Pinhole

DEFAULT_LED_HEIGHT_CM = 7.3


class CalibrationError(RequestError):
    """A calibration is missing, garbled or belongs to another camera. ``path``: the file, where there is one.

    Mend the file, or measure the camera's pose anew.
    """

    def __init__(self, message: str, path: Path | None = None) -> None:
        super().__init__(message)
        self.path = path


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A calibrated camera and the height of the LED above the floor, in cm."""

    optics: Pinhole
    led_height_cm: float = DEFAULT_LED_HEIGHT_CM

    def __post_init__(self) -> None:
        if not (np.isfinite(self.led_height_cm) and 0.0 <= self.led_height_cm < self.optics.centre_cm[2]):
            raise CalibrationError(
                f"calibration: `led_height_cm` is {self.led_height_cm}; it must lie between the floor (0) "
                f"and the camera ({self.optics.centre_cm[2]:.1f} cm)"
            )

    def to_arena(self, pixels: ArrayLike) -> NDArray[np.float64]:
        """Map pixels (n, 2) of the LED to arena cm (n, 2): undistort, cut the ray with z = led height.

        NaN pixels (no LED seen) give NaN positions.
        """
        return self.optics.to_plane(pixels, self.led_height_cm)

    def cm_per_px(self, pixels: ArrayLike) -> NDArray[np.float64]:
        """Jacobians (n, 2, 2) of ``to_arena``: d(x, y) in cm by d(u, v) in pixels, by central differences.

        Carries a pixel covariance S into the arena as J S Jᵀ.
        """
        centre = np.asarray(pixels, dtype=float).reshape(-1, 2)
        step = 0.5
        columns = [
            (self.to_arena(centre + move) - self.to_arena(centre - move)) / (2.0 * step)
            for move in (np.array([step, 0.0]), np.array([0.0, step]))
        ]
        return np.stack(columns, axis=-1)

    def check_size(self, size: tuple[int, int]) -> None:
        """Check that ``size`` (width, height) is the image size that was calibrated.

        Raises:
            CalibrationError: it is not, so every position would be wrong.
        """
        if tuple(size) != tuple(self.optics.image_size):
            width, height = self.optics.image_size
            raise CalibrationError(
                f"the calibration is for {width}x{height} pixels but the video has {size[0]}x{size[1]}; "
                "record at the calibrated size or calibrate again"
            )

    def to_dict(self) -> dict[str, Any]:
        """The JSON form of calibration.json."""
        return {**self.optics.to_dict(), "led_height_cm": float(self.led_height_cm)}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Calibration:
        """Read the JSON form. Raises CalibrationError (or its root) naming the key at fault."""
        try:
            led_height_cm = float(data["led_height_cm"])
        except KeyError as error:
            raise CalibrationError("calibration: `led_height_cm` is missing; add it or calibrate again") from error
        except (TypeError, ValueError, OverflowError) as error:
            raise CalibrationError("calibration: `led_height_cm` must be a number of cm") from error
        return cls(Pinhole.from_dict(data), led_height_cm)


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration.json.

    Raises:
        CalibrationError: the file is missing or is not JSON, or a key is missing or malformed.
    """
    file = Path(path)
    try:
        data: Any = json_of(read_given(file))
    except RequestError as error:
        raise CalibrationError(f"cannot read the calibration {error}", file) from error
    except ValueError as error:
        raise CalibrationError(f"{file}: not a JSON file; give a calibration.json", file) from error
    if not isinstance(data, dict):
        raise CalibrationError(f"{file}: a calibration is one JSON object; give a calibration.json", file)
    try:
        return Calibration.from_dict(cast("dict[str, Any]", data))
    except RequestError as error:
        raise CalibrationError(one_line(f"{file}: {error}"), file) from error


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write calibration.json, aside first and then renamed, so that a cut never leaves half a file."""
    text = json.dumps(calibration.to_dict(), indent=2, allow_nan=False)
    write_aside(Path(path), f"{text}\n".encode())
