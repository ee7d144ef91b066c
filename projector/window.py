"""A full-screen window on a real projector, by pygame-ce (the extra ``projector``)."""

from __future__ import annotations

import os
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from projector.device import ProjectorError, ProjectorRequestError, check_image

_EXTRA = "pygame-ce is missing; pip install chordlab[projector]"


def _import_pygame() -> ModuleType:
    """Import pygame where a window is wanted, not before: it is an optional extra."""
    # its greeting would go to stdout, where --json promises nothing but JSON
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    # a click on the operator's screen must not minimise the projector's window
    os.environ.setdefault("SDL_VIDEO_MINIMIZE_ON_FOCUS_LOSS", "0")
    try:
        import pygame  # noqa: PLC0415 - optional extra
    except ImportError as error:
        raise ProjectorError(_EXTRA) from error
    return pygame


class Window:
    """Shows images full screen on display ``display`` (0 is the main one), pixel for pixel.

    The image size is read back from the window that was really opened. The pointer is hidden and the
    screen saver is off while it is open. All calls belong to one thread, the one that opened it.
    """

    def __init__(self, display: int) -> None:
        """Open the window, black. Raises ProjectorRequestError for a display that is not there."""
        self._display = display
        self._open = False
        pygame = _import_pygame()
        self._pygame = pygame
        try:
            pygame.display.init()
            sizes: list[tuple[int, int]] = pygame.display.get_desktop_sizes()
        except pygame.error as error:
            raise ProjectorError(f"no display can be opened ({error}); run it in a desktop session") from error
        if not 0 <= display < len(sizes):
            pygame.display.quit()
            known = ", ".join(f"display:{n} ({width} x {height})" for n, (width, height) in enumerate(sizes))
            raise ProjectorRequestError(
                f"display:{display}", f"is not connected; there is {known}; extend the desktop to the projector"
            )
        try:
            self._surface = pygame.display.set_mode(sizes[display], pygame.FULLSCREEN, display=display)
        except pygame.error as error:
            pygame.display.quit()
            raise ProjectorError(f"display:{display} cannot go full screen ({error}); check its mode") from error
        self._open = True
        pygame.display.set_caption("chordlab projector")
        pygame.display.set_allow_screensaver(False)
        pygame.mouse.set_visible(False)
        width, height = self._surface.get_size()
        self._image_size = (int(width), int(height))
        self.show(np.zeros((height, width), dtype=np.uint8))

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) in pixels of the window as opened."""
        return self._image_size

    @property
    def is_open(self) -> bool:
        """Whether the window still stands."""
        return self._open

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show gray ``image``, uint8 (height, width). Raises ProjectorError once the window is closed."""
        check_image(image, self._image_size, f"display:{self._display}")
        if not self.pump():
            raise ProjectorError(f"the window on display:{self._display} was closed; open it again")
        # pygame's arrays run (x, y, channel)
        self._pygame.surfarray.blit_array(self._surface, np.repeat(image.T[:, :, None], 3, axis=2))
        self._pygame.display.flip()

    def pump(self) -> bool:
        """Answer the desktop, which else takes the window for dead: call it every second or so.

        Returns whether the window is still open: Escape, Alt+F4 and the like close it.
        """
        if self._open:
            pygame = self._pygame
            for event in pygame.event.get():
                escaped = event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE
                if event.type == pygame.QUIT or escaped:
                    self.close()
                    break
        return self._open

    def close(self) -> None:
        """Close the window and give pointer and screen saver back."""
        if self._open:
            self._open = False
            self._pygame.mouse.set_visible(True)
            self._pygame.display.set_allow_screensaver(True)
            self._pygame.display.quit()
