"""MCAP: everything that a session has to tell, by time, for Foxglove and other viewers."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from lab.export import schemas
from lab.export.aside import whole_file
from lab.export.messages import WorldClock, in_time, stretches_of
from lab.export.source import Source
from lab.reopen.stored import stored_shape

Progress = Callable[[int, int], None]

_OF_ROBOT = {schemas.LIGHT: "light", schemas.LINE: "line", schemas.CROSSING: "crossing", schemas.POSE: "pose"}
_OF_SESSION = {
    schemas.LOG: "/events",
    schemas.SCENE: "/scene",
    schemas.ESTIMATE: "/estimate",
    schemas.IMAGE: "/film",
}
_CHUNK_BYTES = 1 << 20


def write_mcap(
    source: Source, path: Path, *, every: int = 3, film: bool = True, progress: Progress | None = None
) -> dict[str, int]:
    """Write one MCAP file: JSON messages in chunks of 1 MB packed by zstd, in the order of their times.

    Topics: ``/events`` (foxglove.Log, one an event), ``/scene`` (the arena and the shape), ``/estimate``, ``/film``
    (JPEG), and for each robot ``/robots/NAME/line``, ``crossing``, ``light`` and, of a tracked film, ``pose``. A name's
    characters that a topic cannot bear become ``_``; the channel's metadata holds the name as it is. The manifest is
    attached. Log times are nanoseconds since 1970 (see ``WorldClock``).

    Args:
        source: the session.
        path: the file.
        every: which pictures of the film are taken: each third, by default.
        film: whether the film is taken at all.
        progress: called now and then with (seconds of the session written, seconds in all).

    Returns:
        How many messages each topic holds.

    Raises:
        RequestError: the file cannot be written, or something in the session cannot be read.
    """
    clock = WorldClock(source)
    topics = robot_topics(source.robots)
    counts: Counter[str] = Counter()
    ends_s = source.tables.lines["t_end_s"]
    end_ns = clock.ns(float(ends_s.max())) if len(ends_s) else 0
    first_ns: int | None = None
    with whole_file(path) as aside, aside.open("wb") as file:
        writer = Writer(file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile="", library="chordlab")
        known: dict[str, int] = {}
        channels: dict[tuple[str, str], tuple[int, str]] = {}
        for message in in_time(stretches_of(source, clock, every=every, film=film)):
            if message.key not in channels:
                schema, robot = message.key
                if schema not in known:
                    known[schema] = writer.register_schema(schema, "jsonschema", schemas.encoded(schema))
                topic = _OF_SESSION.get(schema) or f"{topics[robot]}/{_OF_ROBOT[schema]}"
                number = writer.register_channel(topic, "json", known[schema], {"robot": robot} if robot else {})
                channels[message.key] = number, topic
            number, topic = channels[message.key]
            data = json.dumps(message.content, allow_nan=False, ensure_ascii=False).encode()
            writer.add_message(number, message.t_ns, data, message.t_ns, sequence=counts[topic])
            counts[topic] += 1
            first_ns = message.t_ns if first_ns is None else first_ns
            if progress is not None and counts.total() % 500 == 0:
                total = max(1, end_ns - first_ns)
                progress(min(message.t_ns - first_ns, total) // 1_000_000_000, total // 1_000_000_000)
        _about(writer, source)
        writer.finish()
    return dict(sorted(counts.items()))


def robot_topics(robots: tuple[str, ...]) -> dict[str, str]:
    """The topic of each robot: ``/robots/NAME``, unlike any other's."""
    topics: dict[str, str] = {}
    for name in robots:
        wish = re.sub(r"[^A-Za-z0-9_-]", "_", name)[:60] or "robot"
        taken, number = set(topics.values()), 2
        topic = f"/robots/{wish}"
        while topic in taken:
            topic, number = f"/robots/{wish}_{number}", number + 1
        topics[name] = topic
    return topics


def _about(writer: Writer, source: Source) -> None:
    manifest: dict[str, Any] = source.session.manifest
    about = {
        "session": source.name,
        "shape": stored_shape(source.session).name,
        "started": str(manifest.get("started", "")),
        "seed": str(manifest.get("seed", "")),
        "schema_version": str(manifest.get("schema_version", "")),
    }
    writer.add_metadata("chordlab", about)
    data = json.dumps(manifest, ensure_ascii=False).encode()
    writer.add_attachment(0, 0, "manifest.json", "application/json", data)
