"""How a BOLT that is awake is brought into the state that its driver counts on."""

from __future__ import annotations

from robot import commands
from robot.commands import Request
from robot.link import Link
from robot.profile import RobotProfile
from robot.stream import OFF

STABILISED = Request(commands.STABILISATION, commands.STABILISATION.payload(commands.STABILISE_FULL))
MOTORS_OFF = commands.raw_motors(0, 0)
_COLLISION_METHOD = 1
_HALT_TIMEOUT_S = 1.0


async def halt(link: Link, heading_rad: float, *, raw: bool) -> None:
    """Come to rest, without the patience for a robot that is known to listen; ``raw``: its motors run by themselves."""
    if raw:
        await link.ask(MOTORS_OFF, timeout_s=_HALT_TIMEOUT_S)
    await link.ask(commands.drive(0, heading_rad), timeout_s=_HALT_TIMEOUT_S)


async def balance(link: Link) -> None:
    """End a stream that still runs, balance, and let the locator's y axis stay along heading 0 at every reset."""
    await link.ask(OFF)
    await link.ask(STABILISED)
    # 0: the locator's y axis stays along heading 0 when the yaw is reset, now and by ``aim``.
    await link.ask(Request(commands.LOCATOR_FLAGS, commands.LOCATOR_FLAGS.payload(0)))


async def reset_yaw(link: Link) -> None:
    """Make the way that the robot faces heading 0."""
    await link.ask(Request(commands.RESET_YAW))


async def reset_locator(link: Link) -> None:
    """Make where the robot stands the locator's origin."""
    await link.ask(Request(commands.RESET_LOCATOR))


async def feel_bumps(link: Link, profile: RobotProfile) -> None:
    """Have walls reported that the robot runs into."""
    threshold = profile.collision_threshold
    thresholds = (threshold, threshold, threshold, threshold)
    await link.ask(commands.collision_setup(_COLLISION_METHOD, thresholds, profile.collision_dead_s))
