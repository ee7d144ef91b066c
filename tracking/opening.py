"""How a device string becomes a camera."""

from __future__ import annotations

from collections.abc import Callable

from tracking.cameras import Camera, CameraRequestError
from tracking.playback import FileCamera
from tracking.usb import UsbCamera, UsbSettings


def open_camera(device: str, *, rate_hz: float | None = None, size: tuple[int, int] | None = None) -> Camera:
    """Make the camera that a device string names: "usb:N" or "file:PATH" ("virtual" is composed by the lab).

    ``rate_hz`` and ``size`` are asked of a USB camera; a file has its own.

    Raises:
        CameraRequestError: the string names no such camera.
    """
    kind, _, rest = device.partition(":")
    makers: dict[str, Callable[[], Camera]] = {
        "usb": lambda: _usb(device, rest, rate_hz, size),
        "file": lambda: FileCamera(rest),
    }
    if kind not in makers or not rest:
        raise CameraRequestError(
            device, f'camera "{device}" is not known; write "usb:0", "file:video.mkv" or "virtual"'
        )
    return makers[kind]()


def _usb(device: str, number: str, rate_hz: float | None, size: tuple[int, int] | None) -> Camera:
    if not number.isdecimal():
        raise CameraRequestError(device, f'camera "{device}": the number after "usb:" must be 0, 1, 2, ...')
    defaults = UsbSettings()
    return UsbCamera(int(number), UsbSettings(rate_hz=rate_hz or defaults.rate_hz, size=size or defaults.size))
