"""A full-screen window on a real projector, by pygame-ce (the extra ``projector``)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from projector.device import ProjectorError, ProjectorRequestError, check_image, now_s

_NO_DESKTOP = "no display can be opened ({}); run it in a desktop session"
_PRETENDED = ("offscreen", "dummy")  # what SDL takes where there is no screen
_EXTRA = "pygame-ce is missing; pip install chordlab[projector]"

# What SDL must know before it starts; whoever sets these in the environment has the last word.
_HINTS = {
    # its greeting would go to stdout, where --json promises nothing but JSON
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",
    # a click on the operator's screen must not minimise the projector's window
    "SDL_VIDEO_MINIMIZE_ON_FOCUS_LOSS": "0",
    # a scaled Windows desktop would else stretch the image: count true pixels
    "SDL_WINDOWS_DPI_AWARENESS": "permonitorv2",
    # Ctrl-C and SIGTERM belong to the session, which stops the robots first
    "SDL_NO_SIGNAL_HANDLERS": "1",
}


def _import_pygame() -> ModuleType:
    """Import pygame where a window is wanted, not before: it is an optional extra."""
    for name, value in _HINTS.items():
        os.environ.setdefault(name, value)
    try:
        import pygame  # noqa: PLC0415 - optional extra
    except ImportError as error:
        raise ProjectorError(_EXTRA) from error
    return pygame


def _listed(sizes: Sequence[tuple[int, int]]) -> str:
    return ", ".join(f"display:{n} ({width} x {height})" for n, (width, height) in enumerate(sizes))


def display_sizes() -> list[tuple[int, int]]:
    """(width, height) in pixels of every display there is, in the order of their numbers.

    Raises:
        ProjectorError: pygame is missing, or there is no desktop.
    """
    pygame = _import_pygame()
    was_open = pygame.display.get_init()
    try:
        pygame.display.init()
        if pygame.display.get_driver() in _PRETENDED:
            raise ProjectorError(_NO_DESKTOP.format("none is there"))
        return [(int(width), int(height)) for width, height in pygame.display.get_desktop_sizes()]
    except pygame.error as error:
        raise ProjectorError(_NO_DESKTOP.format(error)) from error
    finally:
        if not was_open:
            pygame.display.quit()


class Window:
    """Shows images full screen on display ``display`` (0 is the main one), pixel for pixel.

    The image size is read back from the window that was really opened. The pointer is hidden and the
    screen saver is off while it is open. Once the window no longer covers its display as it did when it was
    opened (closed, minimised, moved, unplugged, another mode), it is closed and ``problem`` says why.
    All calls belong to one thread, the one that opened it; a process has one window.
    """

    def __init__(self, display: int) -> None:
        """Open the window, black.

        Raises:
            ProjectorRequestError: there is no such display; the line lists those there are.
            ProjectorError: pygame is missing, or no window can be opened.
        """
        self._display = display
        self._open = False
        self._problem: str | None = None
        self._shown_s: float | None = None
        pygame = _import_pygame()
        self._pygame = pygame
        if pygame.display.get_surface() is not None:
            raise ProjectorError(f"display:{display} cannot be opened beside another window; close that one first")
        try:
            pygame.display.init()
            sizes: list[tuple[int, int]] = pygame.display.get_desktop_sizes()
        except pygame.error as error:
            raise ProjectorError(_NO_DESKTOP.format(error)) from error
        if not 0 <= display < len(sizes):
            pygame.display.quit()
            raise ProjectorRequestError(
                f"display:{display}",
                f"is not connected; there is {_listed(sizes)}; extend the desktop to the projector",
            )
        try:
            pygame.display.set_mode(sizes[display], pygame.FULLSCREEN, display=display)
            pygame.display.set_caption("chordlab projector")
            pygame.display.set_allow_screensaver(False)
            pygame.mouse.set_visible(False)
            # what the desktop makes of the request arrives as events; only then do the sizes hold
            pygame.event.get()
            sizes = pygame.display.get_desktop_sizes()
            width, height = pygame.display.get_surface().get_size()
        except pygame.error as error:
            pygame.display.quit()
            raise ProjectorError(f"display:{display} cannot go full screen ({error}); check its mode") from error
        self._image_size = (int(width), int(height))
        # another size than the display's is the desktop's choice, but another display's size betrays another display:
        # those that mirror each other lie in one place, and the desktop takes the first
        self._desktop_size = sizes[display : display + 1]
        if [self._image_size] != self._desktop_size and self._image_size in sizes:
            pygame.display.quit()
            raise ProjectorError(
                f"the window for display:{display} opened on display:{sizes.index(self._image_size)}, there is"
                f" {_listed(sizes)}; extend the desktop to the projector instead of mirroring it"
            )
        self._open = True
        self.show(np.zeros((height, width), dtype=np.uint8))

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) in pixels of the window as opened."""
        return self._image_size

    @property
    def shown_s(self) -> float | None:
        """When the image now shown was handed to the desktop (after the flip), on the event loop's clock.

        The light follows within a refresh of the display and the projector's own lag.
        """
        return self._shown_s

    @property
    def is_open(self) -> bool:
        """Whether the window still stands."""
        return self._open

    @property
    def problem(self) -> str | None:
        """One line that says why the window closed by itself; None while it stands or when told to close."""
        return self._problem

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show gray ``image``, uint8 (height, width). Raises ProjectorError once the window is closed."""
        check_image(image, self._image_size, f"display:{self._display}")
        if self.pump():
            pygame = self._pygame
            try:
                # pygame's arrays run (x, y, channel)
                surface = pygame.display.get_surface()
                pygame.surfarray.blit_array(surface, np.repeat(image.T[:, :, None], 3, axis=2))
                pygame.display.flip()
                self._shown_s = now_s()
            except pygame.error as error:
                self._give_up(f"failed ({error}); open it again")
        if not self._open:
            raise ProjectorError(self._problem or self._line("was closed; open it again"))

    def pump(self) -> bool:
        """Answer the desktop, which else takes the window for dead: call it every second or so.

        Returns whether the window still stands as it was opened; where not, ``problem`` says why. Escape,
        Alt+F4 and the like close it.
        """
        if self._open:
            try:
                problem = self._find_problem()
            except self._pygame.error as error:
                problem = f"failed ({error}); open it again"
            if problem is not None:
                self._give_up(problem)
        return self._open

    def close(self) -> None:
        """Close the window and give pointer and screen saver back."""
        if self._open:
            self._open = False
            # which also ends what set_visible and set_allow_screensaver began, and never raises
            self._pygame.display.quit()

    def _find_problem(self) -> str | None:
        """What happened to the window since the last look, or None."""
        pygame = self._pygame
        for event in pygame.event.get():
            if event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE):
                return "was closed; open it again"
            if event.type == pygame.WINDOWMINIMIZED:
                return "was minimised; open it again and leave it in front"
            if event.type == pygame.WINDOWDISPLAYCHANGED and event.display_index != self._display:
                return f"was moved to display:{event.display_index}; open it again"
        sizes: list[tuple[int, int]] = pygame.display.get_desktop_sizes()
        if sizes[self._display : self._display + 1] != self._desktop_size:
            return (
                f"lost its display or its mode; there is {_listed(sizes) or 'none'};"
                " connect the projector as it was calibrated and open the window again"
            )
        width, height = pygame.display.get_window_size()
        if (width, height) != self._image_size:
            return f"was resized to {width} x {height} pixels; open it again and leave it full screen"
        return None

    def _give_up(self, problem: str) -> None:
        self._problem = self._line(problem)
        self.close()

    def _line(self, problem: str) -> str:
        return f"the window on display:{self._display} {problem}"
