"""Files that others wrote, read without trust: bounded, and with one line for whatever is wrong with them."""

from __future__ import annotations

import json
import os
import re
import stat
import tomllib
from pathlib import Path
from typing import Any

from lab.base.errors import RequestError

MAX_BYTES = 50_000_000
"""No settings, calibration or manifest is larger."""
_HALF_CHARACTER = re.compile(r"\\u[dD][89a-fA-F]")


def read_given(path: Path, most_bytes: int = MAX_BYTES) -> bytes:
    """The bytes of a file that the user, or another file, names.

    Raises:
        RequestError: it cannot be read, is larger than ``most_bytes``, or is a device or a pipe, which may never end.
    """
    try:
        # a pipe without a writer would otherwise be waited for; the flag changes nothing for a file
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise RequestError(one_line(f"{path}: is not a file; check the path"))
            data = file.read(most_bytes + 1)
    except (OSError, ValueError) as error:  # a name with a NUL, or that the file system cannot spell, is a ValueError
        reason = getattr(error, "strerror", None) or "cannot be read"
        raise RequestError(one_line(f"{path}: {reason}; check the path")) from error
    if len(data) > most_bytes:
        raise RequestError(one_line(f"{path}: is larger than {most_bytes / 1e6:g} MB; check the path"))
    return data


def json_of(data: bytes | str) -> Any:
    """Parse JSON in UTF-8. Raises ValueError for whatever is wrong with it, halves of characters included."""
    text = data if isinstance(data, str) else data.decode("utf-8")
    try:
        value = json.loads(text)
        if _HALF_CHARACTER.search(text):  # as long as both halves are there, it is a character
            json.dumps(value, ensure_ascii=False).encode("utf-8")
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    return value


def toml_of(data: bytes) -> dict[str, Any]:
    """Parse TOML. Raises ValueError for whatever is wrong with it."""
    try:
        return tomllib.loads(data.decode("utf-8"))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def one_line(text: str, most: int = 600) -> str:
    """``text`` on one line without what steers a terminal, its middle left out where it is longer than ``most``."""
    line = "".join(letter if letter.isprintable() else "\ufffd" for letter in " ".join(text.split()))
    return line if len(line) <= most else f"{line[: most // 2]} … {line[-most // 2 :]}"
