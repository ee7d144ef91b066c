"""The bench of a stored session: its robots, its film and a projector that shows nothing, on one shared timeline."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lab.base.errors import RequestError
from lab.base.timeline import Mark, Timeline
from lab.reopen.rerun import BUMPS, Rerun, StoredLine, session_levels
from lab.session.levels import SessionLevels
from lab.settings.sections import LinkSettings
from lab.settings.settings import Settings
from lab.store.layout import SessionFolderError
from lab.store.reader import SessionReader, numbers_of
from projector.replayed import ReplayedProjector
from robot.crossings import scatter_of
from robot.device import Identity, Sample
from robot.replayed import ReplayedRobot, StoredRun
from tracking.replayed import ReplayedCamera, StoredSegment
from tracking.segment import frames_table

_ACK_S = 0.1  # of a stop that nothing followed, so that a contact that the other robot reports later is heard
_FIELDS = ("floor", "lit", "ring")
_LEVEL_SAMPLES = 20
_LONGEST_STOP_S = 10.0  # longer pauses between two runs are no part of stopping
_TURN_S = 2e-9  # more than the event loop's clock takes for one moment


@dataclass(frozen=True, slots=True)
class ReplayedBench:
    """The devices of a stored session; ``camera`` is None where no film is asked for."""

    robots: tuple[ReplayedRobot, ...]
    projector: ReplayedProjector
    camera: ReplayedCamera | None


def replayed_bench(folder: Path, settings: Settings, image_size: tuple[int, int], settle_s: float) -> ReplayedBench:
    """Make the devices that play a stored session back.

    Args:
        folder: the stored session.
        settings: of the session that is to be played.
        image_size: of the projector's images, pixels.
        settle_s: how long a picture is waited for before its light is read.

    Raises:
        SessionFolderError: it is no session, not whole, or its robot estimated by itself.
        RequestError: the settings list another number of robots, or ask for a film that was not made.
    """
    rerun = Rerun(SessionReader(folder))
    names, filmed = rerun.names, settings.camera != "none"
    if len(settings.robots) != len(names):
        raise RequestError(
            f'{folder}: rolled by {len(names)} robots, not {len(settings.robots)}; list robot = "replay:{folder}" '
            "once for each, or run with --replay"
        )
    lines = list(rerun.lines())
    if not lines:
        raise SessionFolderError(folder, "holds no run to replay")
    timeline = Timeline()
    segments = rerun.session.segments() if filmed else {}
    breaks, plain = _breaks(rerun), _plain_light(rerun)
    ends = list(zip(lines, _over_s(lines, breaks, segments if len(names) == 1 else {}), strict=True))
    robots = tuple(
        ReplayedRobot(
            _identity(rerun, number),
            _runs(rerun, [(line, over_s) for line, over_s in ends if line.robot == number], breaks),
            plain[number],
            timeline,
            settle_s=settle_s,
        )
        for number in range(len(names))
    )

    def shown(picture: int) -> None:
        for robot in robots:
            robot.expose(picture)

    camera = None
    if filmed:
        pieces = _film(lines, segments, several=len(names) > 1)
        if not pieces:
            raise RequestError(f"{folder}: was not filmed; set camera to none, or run with --no-video")
        camera = ReplayedCamera(settings.camera, pieces, _rate_hz(rerun), timeline)
    return ReplayedBench(robots, ReplayedProjector(image_size, shown), camera)


def replay_devices(folder: Path) -> dict[str, Any]:
    """The settings of a stored session with its devices replaced by their replay: plain data, as in a TOML file.

    Raises:
        SessionFolderError: it is no session.
    """
    session = SessionReader(folder)
    stored: Any = session.manifest.get("settings")
    if not isinstance(stored, dict):
        raise SessionFolderError(folder, "the manifest holds no settings")
    rerun = Rerun(session)
    device, count, link = f"replay:{folder}", len(rerun.names), rerun.settings.link
    # A session that ended with a lost link, and was resumed, goes on here as if the robot had been called back.
    called_back_s = link.reconnect_s or LinkSettings().reconnect_s
    return {
        **stored,
        "link": link.model_dump(mode="json") | {"reconnect_s": called_back_s},
        "robot": device if count == 1 else [device] * count,
        "projector": device,
        "camera": device if session.segments() else "none",
    }


def _identity(rerun: Rerun, number: int) -> Identity:
    try:
        stored = rerun.session.manifest["devices"]["robots"][number]
        return Identity(*(stored[name] for name in Identity.__slots__))
    except (KeyError, TypeError, IndexError) as error:
        raise SessionFolderError(rerun.session.folder, f"the manifest's robots are not whole ({error!r})") from error


def _breaks(rerun: Rerun) -> dict[tuple[str, int], str]:
    """After which run of which robot the next one began in mid-arena, and why."""
    found: dict[tuple[str, int], str] = {}
    last: dict[str, int] = {}
    for event in rerun.session.events():
        robot = str(event.get("robot", ""))
        match event["event"]:
            case "line":
                last[robot] = int(event["line"])
            case "lost" if robot in last:
                found[robot, last[robot]] = str(event.get("reason", "its link broke here"))
            case "pause" if robot in last:
                found.setdefault((robot, last[robot]), "its battery was low here")
            case "start":
                for name, line in last.items():
                    found[name, line] = "the session was cut here and resumed"
            case _:
                pass
    return found


def _over_s(lines: Sequence[StoredLine], breaks: dict[tuple[str, int], str], filmed: dict[int, Path]) -> list[float]:
    """When each run was over and in the log: its robot's next one begins at once. In the log's order."""
    found: list[float] = []
    begins_s: dict[int, float] = {}  # of each robot's next run
    follows_s = math.inf
    for line in reversed(lines):
        event, number = line.event, int(line.event["line"])
        t_end_s, next_s = float(event["t_end_s"]), begins_s.get(line.robot)
        if next_s is not None and (str(event["robot"]), number) not in breaks:
            over_s = min(next_s, t_end_s + _LONGEST_STOP_S)
        elif number in filmed:
            over_s = _last_frame_s(filmed[number])
        else:
            over_s = t_end_s + _ACK_S
        follows_s = max(t_end_s, min(over_s, follows_s))
        found.append(follows_s)
        begins_s[line.robot] = float(event["t_start_s"])
    found.reverse()
    # Two robots that met end at once: each must have heard of both ends, and the log says who was first.
    before_s = -math.inf
    for place, line in enumerate(lines if len(begins_s) > 1 else ()):
        before_s = found[place] = max(found[place], float(line.event["t_end_s"]) + _TURN_S, before_s + _TURN_S)
    return found


def _runs(
    rerun: Rerun, lines: Sequence[tuple[StoredLine, float]], breaks: dict[tuple[str, int], str]
) -> list[StoredRun]:
    """One robot's runs, each with when it was over and with what lies between it and the next."""
    found: list[StoredRun] = []
    for (line, over_s), following in zip(lines, [*(line for line, _ in lines[1:]), None], strict=True):
        event = line.event
        number, ended = int(event["line"]), str(event["ended"])
        found.append(
            StoredRun(
                number=number,
                t_start_s=float(event["t_start_s"]),
                samples=line.light[list(Sample.__slots__)].to_numpy(),
                t_end_s=float(event["t_end_s"]),
                ended=ended,
                normal_heading_rad=_normal(line),
                rest_cm=_rest(line) if ended in BUMPS else None,
                t_over_s=over_s,
                reply_s=_reply_s(rerun, event) if ended == "timeout" else 0.0,
                lost=breaks.get((str(event["robot"]), number), "") if following is not None else "",
                depth_cm=0.0 if following is None or line.levels.edge is None else _depth(rerun, line, following),
            )
        )
    return found


def _normal(line: StoredLine) -> float | None:
    """The wall's normal; where an old log does not keep it, back along the way that the robot came."""
    event = line.event
    if "normal_heading_rad" in event or event["ended"] != "bump" or len(line.light) < 2:
        return event.get("normal_heading_rad")
    dx_cm, dy_cm = (float(line.light[name].iloc[-1] - line.light[name].iloc[0]) for name in ("x_cm", "y_cm"))
    return math.atan2(-dx_cm, -dy_cm) % math.tau


def _rest(line: StoredLine) -> tuple[float, float] | None:
    """Where it rested after a bump, from the stored length; not known where that begins at an edge of light."""
    if line.levels.edge is not None or line.light.empty:
        return None
    x_cm, y_cm = line.light["x_cm"].to_numpy(), line.light["y_cm"].to_numpy()
    along_rad = math.atan2(x_cm[-1] - x_cm[0], y_cm[-1] - y_cm[0])
    length_cm = float(line.event["length_cm"])
    return float(x_cm[0] + length_cm * math.sin(along_rad)), float(y_cm[0] + length_cm * math.cos(along_rad))


def _depth(rerun: Rerun, line: StoredLine, following: StoredLine) -> float:
    """How far from the edge of light it rested before the next run, from that run's stored length."""
    normal_rad, heading_rad = line.event.get("normal_heading_rad"), following.event.get("heading_rad")
    if normal_rad is None or heading_rad is None:
        return 0.0
    run_up_cm = rerun.roll(following, following.levels).run_up_cm
    return max(0.0, run_up_cm * math.cos(heading_rad - normal_rad))


def _reply_s(rerun: Rerun, event: dict[str, Any]) -> float:
    """How long the robot took to answer: a time-out counts from then."""
    took_s = float(event["t_end_s"]) - float(event["t_start_s"])
    return min(max(0.0, took_s - rerun.settings.motion.run_timeout_s), _LONGEST_STOP_S)


def _film(lines: Sequence[StoredLine], segments: dict[int, Path], *, several: bool) -> list[StoredSegment]:
    """The film's pieces in order, each held back until the replay has come to it.

    One robot's film has a piece for each run. That of several runs on, and each piece ends with a run.
    """
    pieces: list[StoredSegment] = []
    before: Mark = ("begun", min(line.event["line"] for line in lines))
    for line in lines:
        number = int(line.event["line"])
        if number in segments:
            pieces.append(StoredSegment(segments[number], before if several else ("begun", number)))
        before = ("over", number)
    return pieces


def _last_frame_s(segment: Path) -> float:
    return float(numbers_of(frames_table(segment), ("t_host_s",))["t_host_s"].max())


def _rate_hz(rerun: Rerun) -> float:
    try:
        return float(rerun.session.manifest["devices"]["camera"]["rate_hz"])
    except (KeyError, TypeError, ValueError) as error:
        raise SessionFolderError(rerun.session.folder, f"the manifest's camera is not whole ({error!r})") from error


def _plain_light(rerun: Rerun) -> list[list[list[float]]]:
    """For each robot its light under the plain fields of floor, shape and ring; of a resumed session its first."""
    start = next(event for event in rerun.session.events() if event["event"] == "start")
    found: list[list[list[float]]] = []
    try:
        for light, levels in zip(start["light"], start["levels"], strict=True):
            fields = _light_giving(session_levels(levels)) if light is None else [light[name] for name in _FIELDS]
            found.append([[float(lux) for lux in field] for field in fields if field is not None])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise SessionFolderError(rerun.session.folder, f"the event 'start' is not whole ({error!r})") from error
    return found


def _light_giving(levels: SessionLevels) -> list[list[float]]:
    """Samples from which a session learns these levels; of old folders, which do not keep their own."""
    shape, edge = levels.shape, levels.edge
    scatter_lux = scatter_of(shape)
    if edge is None:
        return [_around(shape.dark_lux, scatter_lux), _around(shape.bright_lux, scatter_lux)]
    ring_scatter_lux = scatter_of(edge.ring)
    least_lux = min(scatter_lux, ring_scatter_lux)  # of the field that both pairs of levels are learnt from
    return [
        _around(shape.dark_lux, scatter_lux if edge.bright else least_lux),
        _around(shape.bright_lux, least_lux if edge.bright else scatter_lux),
        _around(edge.ring.bright_lux if edge.bright else edge.ring.dark_lux, ring_scatter_lux),
    ]


def _around(level_lux: float, scatter_lux: float) -> list[float]:
    return [level_lux - scatter_lux, level_lux + scatter_lux] * (_LEVEL_SAMPLES // 2)
