"""The LED of a robot, which tells the camera whether the robot is over the shape."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from lab.base.colours import Rgb
from lab.base.errors import ChordlabError
from lab.settings.sections import LedSettings
from robot.device import RobotDevice

_log = logging.getLogger(__name__)


class Blinker:
    """Keeps the LED as the last crossing left it: a blink faster than the link can follow is skipped.

    Args:
        robot: whose LED it is.
        settings: how bright it is in the dark and over the shape.
        rgb: its colour, drive levels 0 to 1.
        is_lit: whether the robot is over the shape, as far as known now.
    """

    def __init__(self, robot: RobotDevice, settings: LedSettings, rgb: Rgb, is_lit: Callable[[], bool]) -> None:
        self._robot = robot
        self._settings = settings
        self._rgb = rgb
        self._is_lit = is_lit
        self._changed = asyncio.Event()

    def changed(self) -> None:
        """The robot may have come over the shape, or have left it."""
        self._changed.set()

    async def follow(self) -> None:
        """Set the LED whenever that has changed, until cancelled."""
        shown = self._settings.dark_level
        while True:
            await self._changed.wait()
            self._changed.clear()
            wanted = self._settings.lit_level if self._is_lit() else self._settings.dark_level
            if wanted != shown:
                try:
                    await self._robot.set_led(wanted, self._rgb)
                except ChordlabError as error:  # a missed blink costs the camera a label, not the session a line
                    _log.warning("LED not set: %s", error)
                else:
                    shown = wanted
