"""What is whole in the bytes of a log, and what is not."""

from __future__ import annotations

import json
from collections.abc import Container
from dataclasses import dataclass
from typing import Any, cast

Event = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Torn:
    """A stretch of a log that holds no whole record.

    Attributes:
        data: its bytes, as they stood.
        first, last: the lines of the log that it took, from 1.
        is_tail: whether no whole record follows.
    """

    data: bytes
    first: int
    last: int
    is_tail: bool


@dataclass(frozen=True, slots=True)
class Salvage:
    """A log, sorted.

    Attributes:
        kept: the bytes of its whole records.
        events: what they tell.
        lines: in which line of the log each of them stood, from 1.
        torn: the stretches between, in order.
    """

    kept: bytes
    events: tuple[Event, ...]
    lines: tuple[int, ...]
    torn: tuple[Torn, ...]


def salvage(log: bytes, unfit: Container[int] = ()) -> Salvage:
    """Sort the bytes of a log into whole records and torn stretches; every byte lands in one of the two.

    A last record that lacks no more than its newline is whole: an object's closing brace says so. The NUL
    bytes that some file systems leave after a power cut are torn.

    Args:
        log: the bytes of the file.
        unfit: lines of the log, from 1, that are to be taken for torn whatever they hold.
    """
    *records, tail = log.split(b"\n")
    pieces = [(number, record + b"\n") for number, record in enumerate(records, start=1)]
    if tail:
        rest = tail.rstrip(b"\0")
        whole = _event_of(rest) is not None
        pieces += [(len(pieces) + 1, piece) for piece in ((rest, tail[len(rest) :]) if whole else (tail,)) if piece]
    kept: list[bytes] = []
    events: list[Event] = []
    lines: list[int] = []
    torn: list[Torn] = []
    stretch: list[tuple[int, bytes]] = []

    def end_stretch(*, is_tail: bool) -> None:
        if stretch:
            torn.append(Torn(b"".join(piece for _, piece in stretch), stretch[0][0], stretch[-1][0], is_tail))
            stretch.clear()

    for number, piece in pieces:
        event = None if number in unfit else _event_of(piece)
        if event is None:
            stretch.append((number, piece))
            continue
        end_stretch(is_tail=False)
        kept.append(piece if piece.endswith(b"\n") else piece + b"\n")
        events.append(event)
        lines.append(number)
    end_stretch(is_tail=True)
    return Salvage(b"".join(kept), tuple(events), tuple(lines), tuple(torn))


def _event_of(record: bytes) -> Event | None:
    try:
        found: Any = json.loads(record)
    except (ValueError, RecursionError):
        return None
    if not isinstance(found, dict):
        return None
    event = cast("Event", found)
    return event if isinstance(event.get("event"), str) else None
