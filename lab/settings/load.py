"""Settings from a TOML file, with what a command lays over it."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any, cast

from pydantic import ValidationError

from lab.base.errors import RequestError
from lab.base.given import one_line, read_given, toml_of
from lab.settings.settings import Settings


def load_settings(
    path: Path | None,
    overrides: dict[str, Any] | None = None,
    *,
    simulate: bool = False,
    base: dict[str, Any] | None = None,
) -> Settings:
    """Read a session's TOML (none: the defaults) and lay ``overrides`` (dotted keys) over it.

    ``simulate`` puts a virtual device in the place of each real one. ``base``: what stands for the TOML without one.

    Raises:
        RequestError: the file cannot be read or a key is unknown or out of range; the line names it.
    """
    data: dict[str, Any] = copy.deepcopy(base or {})
    if path is not None:
        try:
            data = toml_of(read_given(path))
        except ValueError as error:
            raise RequestError(one_line(f"{path} is not TOML: {error}")) from error
    for dotted, value in (overrides or {}).items():
        section = data
        *parents, key = dotted.split(".")
        for parent in parents:
            inner: Any = section.setdefault(parent, {})
            if not isinstance(inner, dict):  # no table: refused below
                break
            section = cast("dict[str, Any]", inner)
        else:
            section[key] = value
    if simulate:
        asked: Any = data.get("robot", "virtual")
        robots = cast("list[Any]", asked) if isinstance(asked, list) else [asked]
        data |= {"robot": [_simulated(robot) for robot in robots], "projector": "virtual"}
        if data.get("camera") != "none":
            data["camera"] = "virtual"
    return parse_settings(data, origin=str(path) if path else "settings")


def _simulated(robot: object) -> str:
    """The virtual robot that stands for a real one."""
    return "onboard:virtual" if str(robot).startswith("onboard:") else "virtual"


def parse_settings(data: dict[str, Any], *, origin: str) -> Settings:
    """Check settings that came as plain data. Raises RequestError with one line for the first fault."""
    try:
        return Settings.model_validate(data)
    except ValidationError as error:
        fault = error.errors()[0]
        where = ".".join(str(part) for part in fault["loc"])
        reason = fault["msg"].removeprefix("Value error, ")
        if fault["type"] == "extra_forbidden":
            reason = "is not a setting; see docs for the list, or take it out"
        message = f"{origin}: {where} {reason}"
        raise RequestError(one_line(message)) from error  # a key may hold line breaks
