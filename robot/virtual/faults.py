"""What goes wrong with a virtual BOLT, and when: from settings by ``schedule``, in tests by the twin's own methods."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

from lab.base.errors import RequestError
from robot.virtual.bolt import VirtualBolt

Kind = Literal["loss", "disconnect", "vanish", "stuck_sensor", "stall", "low_battery"]
KINDS: tuple[str, ...] = get_args(Kind)


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that goes wrong.

    Attributes:
        kind: ``loss`` (notifications do not arrive), ``disconnect`` (the link breaks, and the robot
            advertises again ``for_s`` later), ``vanish`` (no answer, no stream, no advertisement, and
            nobody is told; then it is back, its link gone), ``stuck_sensor`` (the light sensor keeps its
            reading), ``stall`` (the wheels are held) or ``low_battery``.
        at_s: When, counted from the start of the robot.
        for_s: For how long; endless when not given, but for ``disconnect``, which then is over at once.
        share: Share of the notifications that ``loss`` takes.
        charge: Charge of the battery, 0 to 1, that ``low_battery`` leaves.

    Raises:
        RequestError: The kind is unknown or a number is out of range.
    """

    kind: Kind
    at_s: float
    for_s: float | None = None
    share: float = 1.0
    charge: float = 0.05

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise RequestError(f"virtual fault: {self.kind!r} is no kind of fault; choose among {', '.join(KINDS)}")
        if not 0 <= self.at_s < math.inf:
            raise RequestError(f"virtual fault: `at_s` must be a time of 0 or more, got {self.at_s}")
        if self.for_s is not None and not self.for_s > 0:
            raise RequestError(f"virtual fault: `for_s` must be a time above 0, got {self.for_s}")
        for name in ("share", "charge"):
            if not 0 <= getattr(self, name) <= 1:
                raise RequestError(f"virtual fault: `{name}` must be 0 to 1, got {getattr(self, name)}")

    def strike(self, bolt: VirtualBolt) -> None:
        """Let it happen to ``bolt`` now."""
        for_s = math.inf if self.for_s is None else self.for_s
        match self.kind:
            case "loss":
                bolt.lose(self.share, for_s)
            case "disconnect":
                bolt.drop_link(self.for_s or 0.0)
            case "vanish":
                bolt.vanish(for_s)
            case "stuck_sensor":
                bolt.stick_sensor(for_s)
            case "stall":
                bolt.stall(for_s)
            case "low_battery":
                bolt.drain(self.charge, for_s)


def schedule(faults: Iterable[Fault], bolt: VirtualBolt) -> None:
    """Let each of ``faults`` happen to a started robot in its time; what is past already happens at once.

    Raises:
        RequestError: Notifications shall be lost, but the radio has no random generator.
        RadioError: The robot is off.
    """
    faults = tuple(faults)
    if not bolt.can_lose and any(fault.kind == "loss" and fault.share > 0 for fault in faults):
        raise RequestError("virtual fault: `loss` needs a radio with a random generator; hand it one")
    now_s = asyncio.get_running_loop().time()
    for fault in sorted(faults, key=lambda fault: fault.at_s):
        bolt.after(bolt.started_s + fault.at_s - now_s, lambda fault=fault: fault.strike(bolt))
