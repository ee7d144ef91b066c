"""One check and what came of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "missing", "broken"]
Area = Literal["python", "package", "machine", "hardware"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One check. ``missing`` concerns hardware or extras that a virtual session does not need; ``broken`` stops it."""

    check: str
    state: State
    found: str
    cure: str = ""
    area: Area = "machine"
