"""What was measured of a robot, value by value, and how it goes into the robot's profile."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from robot.fitting import Figure
from robot.profile import RobotProfile


@dataclass(frozen=True, slots=True)
class Finding:
    """One value of the profile, as measured; ``value`` None where it was not, and ``how`` then says why.

    ``error`` is one standard error, or half the resolution of a value found by steps; None for what is exact.
    """

    key: str
    value: float | int | tuple[str, str] | None
    error: float | None
    n: int
    how: str

    @property
    def comment(self) -> str:
        """What the profile file says behind the value."""
        if self.value is None:
            return f"not measured: {self.how}"
        error = "" if self.error is None or not math.isfinite(self.error) else f" ± {self.error:.2g},"
        return f"measured: {self.how};{error} n = {self.n}"

    @property
    def number(self) -> float:
        """The value of one that is a number; NaN where it was not measured."""
        return float(self.value) if isinstance(self.value, (int, float)) else math.nan

    @classmethod
    def of(cls, key: str, figure: Figure, how: str) -> Finding:
        """A finding from a figure; not measured where the figure is NaN."""
        if not math.isfinite(figure.value):
            return cls(key, None, None, 0, f"too little was seen for it ({how})")
        # Six digits are more than any of these is good to, and can be read.
        return cls(key, float(f"{figure.value:.6g}"), figure.error, figure.n, how)


def applied(profile: RobotProfile, findings: Sequence[Finding]) -> RobotProfile:
    """``profile`` with the measured values put in; what was not measured stays."""
    measured: dict[str, Any] = {finding.key: finding.value for finding in findings if finding.value is not None}
    return replace(profile, **measured)


def comments_of(findings: Sequence[Finding]) -> Mapping[str, str]:
    """For ``save_profile``: how each value was measured."""
    return {finding.key: finding.comment for finding in findings}
