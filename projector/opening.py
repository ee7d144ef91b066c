"""How a device string becomes a projector."""

from __future__ import annotations

from projector.device import ProjectorDevice, ProjectorRequestError
from projector.images import ImageFolder


def open_projector(device: str, *, image_size: tuple[int, int] = (1920, 1080)) -> ProjectorDevice:
    """Open ``display:N`` (full screen on display N, 0 is the main one) or ``image:DIR`` (numbered PNGs).

    ``image_size`` is for ``image:DIR``; a display has its own. The virtual projector is no device of
    this room alone: the lab composes it with the world. Raises ProjectorRequestError for any other
    string and ProjectorError when the display cannot be opened.
    """
    kind, _, rest = device.partition(":")
    if kind == "display":
        if not rest.isdecimal():
            raise ProjectorRequestError(device, "needs the display's number, for example display:1")
        from projector.window import Window  # noqa: PLC0415 - pygame is an optional extra

        return Window(int(rest))
    if kind == "image":
        if not rest:
            raise ProjectorRequestError(device, "needs a folder, for example image:out/images")
        return ImageFolder(rest, image_size=image_size)
    raise ProjectorRequestError(device, "is not a projector; use display:N or image:DIR")
