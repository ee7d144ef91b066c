"""Trying again and again to win a lost robot back, with pauses that grow, for so long and no longer."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable

from robot.errors import DriveError, ReconnectError, RobotError

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 8.0


async def persist(
    robot: str, attempt: Callable[[], Awaitable[None]], give_up_s: float, wanted: Callable[[], bool]
) -> int:
    """Await ``attempt()`` until it raises nothing.

    The first pause between two attempts is 0.5 s, each further one twice as long, up to 8 s.

    Args:
        robot: Name of the robot, for the message.
        attempt: Raises ``RobotError`` when it fails, and cleans up behind itself, also when cancelled.
        give_up_s: No attempt goes on, or is begun, after this long.
        wanted: Asked after an attempt that failed; there is no further one when it says no.

    Returns:
        How many attempts it took.

    Raises:
        ReconnectError: None has succeeded.
        DriveError: ``give_up_s`` is no time.
    """
    if not 0 < give_up_s < math.inf:
        raise DriveError(f"giving up after {give_up_s:g} s is impossible: ask for a time above 0", value=give_up_s)
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + give_up_s
    attempts, pause_s = 0, _FIRST_PAUSE_S
    while True:
        attempts += 1
        try:
            async with asyncio.timeout_at(deadline_s):
                await attempt()
        except (RobotError, TimeoutError) as error:
            if not wanted() or loop.time() + pause_s >= deadline_s:
                reason = str(error) or "out of time"
                raise ReconnectError(robot, attempts=attempts, give_up_s=give_up_s, reason=reason) from error
        else:
            return attempts
        await asyncio.sleep(pause_s)
        pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
