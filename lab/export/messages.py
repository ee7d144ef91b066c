"""A session as messages with a time: one source a run or a piece of film, opened when its time has come."""

from __future__ import annotations

import base64
import heapq
import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, cast

import cv2
import numpy as np
import pandas as pd
from shapely import MultiPolygon, Polygon

from lab.export import schemas
from lab.export.source import Segment, Source
from lab.reopen.stored import stored_settings, stored_shape
from lab.store.layout import SessionFolderError
from tracking.video import read_frames

FRAME = "arena"
_NS = 1_000_000_000
_LATEST_NS = 1 << 63
_JPEG_QUALITY = 85
_INFO, _WARNING, _ERROR = 2, 3, 4  # Foxglove's levels
_WARNINGS = frozenset({"lost", "gone", "pause", "recover"})
_UNSAID = frozenset({"event", "t_s", "levels", "light"})


@dataclass(frozen=True, slots=True)
class Message:
    """One message: nanoseconds of the world's clock, where it goes (``key`` of a channel), and its content."""

    t_ns: int
    key: tuple[str, str]
    content: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Stretch:
    """Messages that begin at ``t_ns`` or later, in the order of their times, made when ``open`` is called."""

    t_ns: int
    open: Callable[[], Iterable[Message]]


class WorldClock:
    """Session time to nanoseconds since 1970.

    The log's first time is the manifest's ``started``, and that of each part that a resumed session was continued in
    is the part's own. A ``started`` without a time zone is what the clock on the wall showed; it is kept as if the
    wall stood in Greenwich, so that an export is the same wherever it is made.

    Attributes:
        first_s: the log's first time.

    Raises SessionFolderError where the manifest does not say when the session started.
    """

    def __init__(self, source: Source) -> None:
        self._folder = source.session.folder
        manifest = source.session.manifest
        try:
            self.first_s = next((float(event["t_s"]) for event in source.events if "t_s" in event), 0.0)
            self._anchors = [(self.first_s, _ns(str(manifest["started"])))]
            for part in manifest.get("parts") or ():
                t_s, t_ns = float(part["t_s"]), _ns(str(part["started"]))
                # a wall clock that was set back must not turn time round
                self._anchors.append((t_s, max(t_ns, self._at(*self._anchors[-1], t_s))))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise SessionFolderError(
                self._folder, f"the manifest does not say when the session started ({error!r})"
            ) from error

    def ns(self, t_s: float) -> int:
        """Nanoseconds since 1970 of a session time. Raises SessionFolderError for what is no time."""
        before = [anchor for anchor in self._anchors if anchor[0] <= t_s]
        try:
            t_ns = self._at(*(before or self._anchors)[-1 if before else 0], t_s)
        except (ValueError, OverflowError):
            t_ns = -1
        if not 0 <= t_ns < _LATEST_NS:
            raise SessionFolderError(self._folder, f"it tells of a time that cannot be, {t_s} s")
        return t_ns

    @staticmethod
    def _at(anchor_s: float, anchor_ns: int, t_s: float) -> int:
        return anchor_ns + round((t_s - anchor_s) * _NS)


def _ns(started: str) -> int:
    when = datetime.fromisoformat(started)
    return round((when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()) * _NS


def stamp(t_ns: int) -> dict[str, int]:
    """A time as Foxglove writes it."""
    return {"sec": t_ns // _NS, "nsec": t_ns % _NS}


def in_time(stretches: Iterable[Stretch]) -> Iterator[Message]:
    """All messages by time; a stretch is opened when nothing earlier is left, so only those under way are in memory."""
    count = itertools.count()
    waiting = sorted(stretches, key=lambda stretch: stretch.t_ns, reverse=True)
    heap: list[tuple[int, int, Message, Iterator[Message]]] = []
    while waiting or heap:
        while waiting and (not heap or waiting[-1].t_ns <= heap[0][0]):
            opened = iter(waiting.pop().open())
            if (first := next(opened, None)) is not None:
                heapq.heappush(heap, (first.t_ns, next(count), first, opened))
        if not heap:
            continue
        _, order, message, opened = heap[0]
        yield message
        if (following := next(opened, None)) is None:
            heapq.heappop(heap)
        else:
            heapq.heapreplace(heap, (following.t_ns, order, following, opened))


def stretches_of(source: Source, clock: WorldClock, *, every: int, film: bool) -> Iterator[Stretch]:
    """Everything that a session has to tell; of its film each ``every``-th picture."""
    yield Stretch(0, lambda: _scene(source, clock))
    yield Stretch(0, lambda: _log(source, clock))
    names = dict(zip(source.tables.lines["line"].tolist(), source.tables.lines["robot"].tolist(), strict=True))
    for schema, table, t_name in (
        (schemas.LINE, source.tables.lines, "t_end_s"),
        (schemas.CROSSING, source.tables.crossings, "t_s"),
        (schemas.ESTIMATE, source.tables.estimates, "t_s"),
    ):
        alone = schema == schemas.ESTIMATE
        yield Stretch(0, _rows(table, schema, t_name, clock, (lambda _: "") if alone else names.__getitem__))
    for line, robot in names.items():
        light = source.light_starts_s(line)
        if light is not None:
            yield Stretch(clock.ns(light), _light(source, clock, line, robot))
    if source.track is not None:
        for robot in source.robots:
            yield Stretch(0, _poses(source, clock, robot))
    if film:
        before = 0
        for segment in source.film:
            yield Stretch(clock.ns(segment.t_first_s), _pictures(segment, clock, every, -before % every))
            before += segment.frames


def plain(value: Any) -> Any:
    """A table's cell as JSON has it: what is not known, or not finite, is null."""
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _rows(
    table: pd.DataFrame, schema: str, t_name: str, clock: WorldClock, robot_of: Callable[[int], str]
) -> Callable[[], Iterator[Message]]:
    """One message a row, by time."""

    def messages() -> Iterator[Message]:
        columns = [name for name in table.columns if name != "robot"]
        ordered = table.dropna(subset=[t_name]).sort_values(t_name, kind="stable")
        for row in ordered[columns].itertuples(index=False):
            content = {name: plain(value) for name, value in zip(columns, row, strict=True)}
            t_ns = clock.ns(float(content[t_name]))
            yield Message(t_ns, (schema, robot_of(content["line"])), {"timestamp": stamp(t_ns), **content})

    return messages


def _light(source: Source, clock: WorldClock, line: int, robot: str) -> Callable[[], Iterator[Message]]:
    def messages() -> Iterator[Message]:
        samples = source.light(line).rename(columns={"t_host_s": "t_s"})
        samples.insert(1, "line", line)
        yield from _rows(samples, schemas.LIGHT, "t_s", clock, lambda _: robot)()

    return messages


def _poses(source: Source, clock: WorldClock, robot: str) -> Callable[[], Iterator[Message]]:
    """The tracked places of one robot, smoothed; none where it was not to be told where it was.

    It faces the way it rolls. The film of one robot bears no names, and its rows follow each other in time by run;
    those of several by slice and picture. Either way one robot's rows are in time.
    """
    alone = len(source.robots) == 1

    def messages() -> Iterator[Message]:
        last_ns = 0
        for rows in source.track_rows():
            own = rows if alone or "robot" not in rows.columns else rows[rows["robot"] == robot]
            seen = own.dropna(subset=["t_s", "x_smooth_cm", "y_smooth_cm"])
            facing_rad = np.arctan2(seen["vy_cm_s"].fillna(0.0), seen["vx_cm_s"].fillna(0.0))
            places = zip(seen["t_s"], seen["x_smooth_cm"], seen["y_smooth_cm"], facing_rad, strict=True)
            for t_s, x_cm, y_cm, angle_rad in places:
                last_ns = max(last_ns, clock.ns(float(t_s)))
                pose = _pose(float(x_cm) / 100.0, float(y_cm) / 100.0, float(angle_rad))
                content = {"timestamp": stamp(last_ns), "frame_id": FRAME, "pose": pose}
                yield Message(last_ns, (schemas.POSE, robot), content)

    return messages


def _pose(x_m: float = 0.0, y_m: float = 0.0, angle_rad: float = 0.0) -> dict[str, Any]:
    turn = {"x": 0.0, "y": 0.0, "z": math.sin(angle_rad / 2.0), "w": math.cos(angle_rad / 2.0)}
    return {"position": {"x": x_m, "y": y_m, "z": 0.0}, "orientation": turn}


def _pictures(segment: Segment, clock: WorldClock, every: int, first: int) -> Callable[[], Iterator[Message]]:
    """Each ``every``-th frame of one piece of film as a JPEG, beginning with its ``first``."""

    def messages() -> Iterator[Message]:
        with read_frames(segment.path, threads=1) as reader:
            for frame in reader:
                if frame.index % every != first:
                    continue
                colour = np.asarray(frame.decoded.to_ndarray(format="bgr24"), dtype=np.uint8)
                _, jpeg = cv2.imencode(".jpg", colour, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
                t_ns = clock.ns(frame.t_s + segment.shift_s)
                data = base64.b64encode(jpeg.tobytes()).decode()
                content = {"timestamp": stamp(t_ns), "frame_id": "camera", "data": data, "format": "jpeg"}
                yield Message(t_ns, (schemas.IMAGE, ""), content)

    return messages


def _scene(source: Source, clock: WorldClock) -> Iterator[Message]:
    """The arena's wall and the projected shape, once, at the beginning."""
    t_ns = clock.ns(clock.first_s)
    shape = stored_shape(source.session).geometry
    entities = [
        _entity("arena", [stored_settings(source.session).arena.polygon], (0.5, 0.5, 0.5), t_ns),
        _entity("shape", list(shape.geoms) if isinstance(shape, MultiPolygon) else [shape], (1.0, 0.8, 0.2), t_ns),
    ]
    yield Message(t_ns, (schemas.SCENE, ""), {"deletions": [], "entities": entities})


def _entity(name: str, polygons: list[Polygon], colour: tuple[float, float, float], t_ns: int) -> dict[str, Any]:
    red, green, blue = colour
    rings = [ring for polygon in polygons for ring in (polygon.exterior, *polygon.interiors)]
    lines = [
        {
            "type": 1,  # a closed loop
            "pose": _pose(),
            "thickness": 2.0,
            "scale_invariant": True,  # so many pixels, whatever the zoom
            "points": [{"x": x / 100.0, "y": y / 100.0, "z": 0.0} for x, y, *_ in list(ring.coords)[:-1]],
            "color": {"r": red, "g": green, "b": blue, "a": 1.0},
            "colors": [],
            "indices": [],
        }
        for ring in rings
    ]
    return {
        "timestamp": stamp(t_ns),
        "frame_id": FRAME,
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": False,
        "metadata": [],
        "lines": lines,
        **{unused: list[Any]() for unused in schemas.UNUSED_PRIMITIVES},
    }


def _log(source: Source, clock: WorldClock) -> Iterator[Message]:
    """The events in words, each at its time; one that bears none is told with the event before it."""
    told: list[tuple[int, int, str, str]] = []
    t_ns = clock.ns(clock.first_s)
    lines = cast("Iterator[Any]", source.tables.lines.itertuples(index=False))  # one an event, in the log's order
    for event in source.events:
        kind, t_s = event["event"], event.get("t_s")
        if kind == "line":
            run = next(lines)
            t_ns = clock.ns(run.t_end_s)
            share = "counts" if run.counts else "does not count"
            text = f"run {run.line}: {run.ended} after {run.length_cm:.1f} cm, k = {run.k}, {share}"
            told.append((t_ns, _INFO, run.robot, text))
            continue
        t_ns = t_ns if t_s is None else clock.ns(float(t_s))
        level = _ERROR if event.get("state") == "failed" else _WARNING if kind in _WARNINGS else _INFO
        said = ", ".join(f"{key} {value}" for key, value in event.items() if key not in _UNSAID)
        told.append((t_ns, level, str(event.get("robot") or "session"), f"{kind}: {said}" if said else kind))
    for t_ns, level, name, text in sorted(told, key=lambda one: one[0]):
        content = {"timestamp": stamp(t_ns), "level": level, "message": text, "name": name, "file": "", "line": 0}
        yield Message(t_ns, (schemas.LOG, ""), content)
