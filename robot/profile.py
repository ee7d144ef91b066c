"""The numbers that a BOLT is driven by. Every assumption about the hardware that may have to change is here.

A profile is kept as a TOML file, one line a key. The defaults are what published clients use; calibration
replaces them by what one robot did on one floor.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

from lab.base.errors import RequestError
from lab.base.files import write_aside
from lab.base.given import one_line, read_given, toml_of
from robot.collision import AXES, check_axes
from robot.errors import DriveError

_NO_COMMENTS: Mapping[str, str] = MappingProxyType({})
_MAY_BE_ZERO = ("command_pacing_s", "collision_dead_s", "motion_latency_s", "light_latency_s", "dark_lux", "bright_lux")
_MAY_BE_NEGATIVE = ("drift_rad_per_cm",)
_BYTES = ("collision_threshold", "least_speed_units")
_MOST = sys.float_info.max
_RESPONSE_FLAG, _EXTENDED_FLAG = 0x01, 0x80


@dataclass(frozen=True, slots=True)
class RobotProfile:
    """Scales, rates and time-outs of one robot.

    Attributes:
        cm_s_per_unit: Speed of one unit of the drive command's speed byte; 255 units are about 1.5 m/s.
            Depends on the floor: calibrate.
        command_pacing_s: Least time between two commands.
        reply_timeout_s: How long an answer is awaited.
        refresh_s: A rolling robot is told again this often; it stops by itself about 2 s after the last word.
        keep_alive_s: Longest silence towards the robot; its inactivity timer must not run out.
        scan_timeout_s: How long a name is looked for.
        connect_timeout_s: How long a connection may take.
        silence_s: A stream silent for this long counts as a lost link.
        write_with_response: Ask the radio to acknowledge each write.
        collision_threshold: Threshold (0-255) of the collision detector, for both axes and their speed
            terms alike, since sources disagree on the order of two of those four bytes.
        collision_dead_s: Time after a collision in which no other is reported.
        least_speed_units: Smallest speed byte that rolls; below it the motors do not overcome friction.
        least_interval_s: Shortest stream interval that the link holds.
        motion_latency_s: Time from a drive command to the motion.
        light_latency_s: Time from a change of light to the notification that shows it.
        drift_rad_per_cm: Systematic curvature of a run that should be straight, clockwise positive.
        locator_scale: True cm per cm of the locator.
        reply_flags: Flags byte of the answer to a command that names its target.
        collision_axes: What the collision report's x and y point along: one of "right", "left" and one of
            "forward", "back".
        dark_lux: Light seen where the floor is dark; None when not measured.
        bright_lux: Light seen where it is bright; None when not measured.

    Raises:
        RequestError: A value is of the wrong kind or out of range.
    """

    cm_s_per_unit: float = 0.59
    command_pacing_s: float = 0.075
    reply_timeout_s: float = 10.0
    refresh_s: float = 0.8
    keep_alive_s: float = 8.0
    scan_timeout_s: float = 10.0
    connect_timeout_s: float = 20.0
    silence_s: float = 3.0
    write_with_response: bool = True
    collision_threshold: int = 60
    collision_dead_s: float = 0.2
    least_speed_units: int = 1
    least_interval_s: float = 0.025
    motion_latency_s: float = 0.0
    light_latency_s: float = 0.0
    drift_rad_per_cm: float = 0.0
    locator_scale: float = 1.0
    reply_flags: int = 0x39
    collision_axes: tuple[str, str] = AXES
    dark_lux: float | None = None
    bright_lux: float | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            self._check(field.name, getattr(self, field.name), field.default)
        if not (self.reply_flags & _RESPONSE_FLAG and 0 <= self.reply_flags < _EXTENDED_FLAG):
            raise RequestError(
                f"robot profile: `reply_flags` must be a byte with bit 0 (answer) set and bit 7 clear, "
                f"got {self.reply_flags}"
            )
        if self.collision_dead_s > 2.55:
            raise RequestError("robot profile: `collision_dead_s` must be at most 2.55 s, one byte of 10 ms")
        if self.dark_lux is not None and self.bright_lux is not None and not self.dark_lux < self.bright_lux:
            raise RequestError(
                f"robot profile: `dark_lux` must be below `bright_lux`, got {self.dark_lux:g} and {self.bright_lux:g}"
            )
        try:
            check_axes(self.collision_axes)
        except RequestError as error:
            raise RequestError(f"robot profile: `collision_axes`: {error}") from error

    @staticmethod
    def _check(name: str, value: Any, default: object) -> None:
        """Make sure that ``value`` is of the kind of ``default`` and in range."""
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if isinstance(default, bool):
            good, wanted = isinstance(value, bool), "true or false"
        elif isinstance(default, tuple):
            good, wanted = isinstance(value, tuple), "two names"
        elif isinstance(default, int):
            # The range of the flags byte is checked by its bits.
            good = number and isinstance(value, int) and (name not in _BYTES or 0 < value <= 255)
            wanted = "a whole number, 1 to 255"
        elif name in _MAY_BE_NEGATIVE:
            good, wanted = number and abs(value) <= _MOST, "a finite number"
        elif name in _MAY_BE_ZERO:
            good, wanted = number and 0 <= value <= _MOST, "a number of 0 or more"
        else:
            good, wanted = number and 0 < value <= _MOST, "a number above 0"
        if not good and not (value is None and default is None):
            raise RequestError(f"robot profile: `{name}` must be {wanted}, got {value!r}")

    @property
    def max_speed_cm_s(self) -> float:
        """Speed of the highest value of the speed byte."""
        return 255 * self.cm_s_per_unit

    @property
    def least_speed_cm_s(self) -> float:
        """Speed of the lowest value of the speed byte that rolls."""
        return self.least_speed_units * self.cm_s_per_unit

    def cruising_cm_s(self, speed_cm_s: float) -> float:
        """The speed that a robot is really told where ``speed_cm_s`` is asked for: its command counts in whole units.

        Raises as ``speed_units``.
        """
        return self.speed_units(speed_cm_s) * self.cm_s_per_unit

    def speed_units(self, speed_cm_s: float) -> int:
        """The speed byte nearest to ``speed_cm_s``; at least 1 for any speed above 0.

        Raises:
            DriveError: The speed is negative, not a number or beyond ``max_speed_cm_s``, or its byte is one
                that does not roll.
        """
        if not 0 <= speed_cm_s <= self.max_speed_cm_s:
            raise DriveError(
                f"a speed of {speed_cm_s:g} cm/s is out of reach: ask for 0 to {self.max_speed_cm_s:.0f} cm/s",
                value=speed_cm_s,
            )
        if speed_cm_s == 0:
            return 0
        units = max(1, round(speed_cm_s / self.cm_s_per_unit))
        if units < self.least_speed_units:
            raise DriveError(
                f"a speed of {speed_cm_s:g} cm/s does not roll this robot: "
                f"ask for at least {self.least_speed_cm_s:.4g} cm/s",
                value=speed_cm_s,
            )
        return units


def load_profile(path: Path) -> RobotProfile:
    """Read a profile; keys that the file does not have keep their defaults.

    Raises:
        RequestError: The file cannot be read, is not TOML, or has an unknown key or a bad value.
    """
    try:
        data = toml_of(read_given(path))
    except ValueError as error:
        raise RequestError(one_line(f"{path} is not TOML: {error}")) from error
    try:
        return profile_of(data)
    except RequestError as error:
        raise RequestError(one_line(f"{path}: {error}")) from error


def profile_of(data: Any) -> RobotProfile:
    """The profile of plain data, as TOML or JSON has it; keys that it lacks keep their defaults.

    Raises:
        RequestError: It is no table, or has an unknown key or a bad value.
    """
    if not isinstance(data, dict):
        raise RequestError("a robot profile is a table of keys and values")
    values = {str(key): value for key, value in cast("dict[Any, Any]", data).items()}
    known = {field.name for field in fields(RobotProfile)}
    for key in values:
        if key not in known:
            raise RequestError(one_line(f"`{key}` is no key of a robot profile; take it out"))
    if isinstance(values.get("collision_axes"), list):
        values["collision_axes"] = tuple(values["collision_axes"])
    return RobotProfile(**values)


def save_profile(profile: RobotProfile, path: Path, comments: Mapping[str, str] = _NO_COMMENTS) -> None:
    """Write ``profile`` as TOML, one line a key with a comment behind it, whole or not at all.

    Args:
        profile: What to write. A level that was not measured becomes a comment.
        path: The file; one that exists is replaced.
        comments: Comment by key, such as how a value was measured; others say whether it is the default.

    Raises:
        RequestError: A comment belongs to no key, or the file cannot be written.
    """
    names = [field.name for field in fields(RobotProfile)]
    for key in comments:
        if key not in names:
            raise RequestError(f"robot profile: there is no `{key}` to comment on")
    lines = ["# A robot profile of chordlab. Times in s, lengths in cm, angles in rad, light in lux."]
    for field in fields(RobotProfile):
        value = getattr(profile, field.name)
        comment = comments.get(field.name, "default" if value == field.default else "set")
        line = f"{field.name} = {_toml(value)}" if value is not None else f"# {field.name}: not measured"
        lines.append(f"{line}  # {_one_line(comment)}" if value is not None or field.name in comments else line)
    try:
        write_aside(path, ("\n".join(lines) + "\n").encode("utf-8"))
    except OSError as error:
        raise RequestError(f"{path}: {error.strerror or 'cannot be written'}; choose another file") from error


def _toml(value: object) -> str:
    """``value`` in TOML. Python's shortest decimal form of a float is TOML's too, and reads back bit by bit."""
    if isinstance(value, tuple):
        return json.dumps(value)
    # Not ``repr(value)``: a float of NumPy's would say its type.
    return float.__repr__(value) if isinstance(value, float) else str(value).lower()


def _one_line(text: str) -> str:
    """``text`` without what a TOML comment may not hold."""
    return "".join(c for c in " ".join(text.split()) if c.isprintable())
