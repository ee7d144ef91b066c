"""What a BOLT says of itself when it is asked: who it is, its battery and its charger."""

from __future__ import annotations

from typing import Any

from robot import commands
from robot.commands import BatteryState, ChargerState, Command, Request
from robot.device import Identity
from robot.errors import PayloadError
from robot.link import Link


async def identity(link: Link) -> Identity:
    """Name, address, firmware and battery."""
    (digits,) = await _read(link, commands.MAC_ADDRESS)
    version = await _read(link, commands.MAIN_APP_VERSION)
    text = bytes(digits).decode("ascii", errors="replace").upper()
    return Identity(
        name=link.name,
        address=":".join(text[i : i + 2] for i in range(0, 12, 2)),
        firmware=".".join(str(part) for part in version),
        battery_v=await battery_v(link),
    )


async def battery_v(link: Link) -> float:
    """Battery voltage, V."""
    (hundredths,) = await _read(link, commands.BATTERY_VOLTAGE)
    return hundredths / 100.0


async def battery_state(link: Link) -> BatteryState:
    """What the robot thinks of its battery.

    Raises:
        PayloadError: It says something else than fine, low or critical.
    """
    return BatteryState(await _read_state(link, commands.BATTERY_STATE))


async def charger_state(link: Link) -> ChargerState:
    """What the charger does.

    Raises:
        PayloadError: The robot says something else than not charging, charging or charged.
    """
    return ChargerState(await _read_state(link, commands.CHARGER_STATE))


async def _read(link: Link, command: Command) -> tuple[Any, ...]:
    return command.decode(await link.ask(Request(command)))


async def _read_state(link: Link, command: Command) -> int:
    """A state of the battery or charger, both numbered 1 to 3."""
    (state,) = await _read(link, command)
    if not 1 <= state <= 3:
        raise PayloadError(command.name, bytes((state,)), expected="1, 2 or 3")
    return state
