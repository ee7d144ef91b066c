"""The views of a printed board that a camera's calibration needs: filmed live, or from stored pictures."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.base.errors import RequestError
from lab.calibrate.stage import LOOKS, Stage, Step
from tracking.board import Board
from tracking.charuco import BoardDetector, Collector, View
from tracking.video import FrameReader

Plane = NDArray[np.uint8]
Say = Callable[[str], None]

FLOOR_VIEWS = 8
_GIVE_UP_S = 300.0
_STILL_PX = 1.0
_MOST_VIEWS = 3  # times the views asked for: who then still lacks some will not get them
_APART_S = 1.0  # between the board at the origin and what comes before and after it, in a video
_LEFT_PX = 10.0  # nearer, it still lies at the origin
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


class CoverageError(RequestError):
    """The views do not show enough. ``missing``: what to show yet."""

    def __init__(self, message: str, missing: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.missing = tuple(missing)


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """A board as seen: held in the air, at the arena's origin, elsewhere on the floor; in pictures of ``size``."""

    held: list[View]
    origin: View
    floor: list[View]
    size: tuple[int, int]


async def film_board(stage: Stage, board: Board, wanted: int, say: Say) -> Views:
    """Lead the operator through the three steps: board in the air, at the origin, over the floor.

    Raises:
        CoverageError: what is still missing does not come.
        ChordlabError: there is no camera, or it fails.
    """
    if stage.camera is None:
        raise RequestError('a calibration needs a camera: set camera = "usb:0" in the settings')
    detector, size = BoardDetector(board.charuco), stage.camera.size
    await stage.operator.ask(Step.HOLD)
    airborne = await _gather(stage, detector, Collector(board, size), wanted, say, covering=True)
    await stage.operator.ask(Step.ORIGIN)
    origin = detector.find(await stage.look(LOOKS), "origin")
    if origin is None:
        raise CoverageError("the board is not seen at the arena's origin; lay it there, lit evenly, and begin again")
    await stage.operator.ask(Step.FLOOR)
    floor = await _gather(stage, detector, Collector(board, size), FLOOR_VIEWS, say, covering=False)
    return Views(_named(airborne, "held"), origin, _named(floor, "floor"), size)


def _named(views: Sequence[View], kind: str) -> list[View]:
    return [replace(view, name=f"{kind} {number}") for number, view in enumerate(views, 1)]


async def _gather(
    stage: Stage, detector: BoardDetector, collector: Collector, wanted: int, say: Say, *, covering: bool
) -> list[View]:
    """Take views in which the board stands still at a new place, until there are enough."""
    loop = asyncio.get_running_loop()
    until_s = loop.time() + _GIVE_UP_S
    last: View | None = None
    told: tuple[str, ...] | None = None
    while loop.time() < until_s and len(collector.views) < _MOST_VIEWS * wanted:
        view = detector.find(await stage.next_luma())
        still = view is not None and last is not None and view.moved_px(last) < _STILL_PX
        last = view
        if view is None or not still or not collector.offer(view):
            continue
        missing = collector.coverage.missing if covering else ()
        if missing != told or len(collector.views) % 5 == 0:
            say(f"{len(collector.views)} of {wanted} views{''.join(f'; still: {text}' for text in missing)}")
            told = missing
        if len(collector.views) >= wanted and not missing:
            return collector.views
    missing = collector.coverage.missing if covering else ()
    raise CoverageError(
        f"{len(collector.views)} of {wanted} views; still missing: "
        f"{'; '.join(missing) or 'the board at other places, held still'}; begin again in more light or with a larger "
        "board",
        missing,
    )


def stored_views(source: Path, board: Board, origin_s: float | None) -> Views:
    """The views that a video or a folder of pictures shows.

    In a video the board is held, then lies at the origin around ``origin_s`` (None: at the end), then elsewhere
    on the floor. Of pictures, names beginning with `origin` and `floor` say which is which.

    Raises:
        RequestError: it cannot be read, or the board is not seen at the origin.
    """
    detector = BoardDetector(board.charuco)
    views = (
        _views_of_folder(source, detector) if source.is_dir() else _views_of_video(source, board, detector, origin_s)
    )
    if views is None:
        raise CoverageError(
            f"{source}: the board is not seen at the arena's origin; "
            "name such pictures origin*.png, or say when it lies there with --origin-s"
        )
    return views


def _views_of_folder(folder: Path, detector: BoardDetector) -> Views | None:
    found: dict[str, list[View]] = {"held": [], "origin": [], "floor": []}
    sizes: set[tuple[int, int]] = set()
    for path in sorted(path for path in folder.iterdir() if path.suffix.lower() in _PICTURES):
        luma = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if luma is None:  # pyright: ignore[reportUnnecessaryComparison]
            raise RequestError(f"{path} is no picture; take it out of the folder")
        sizes.add((luma.shape[1], luma.shape[0]))
        view = detector.find(np.asarray(luma, dtype=np.uint8), path.stem)
        kind = next((kind for kind in ("origin", "floor") if path.stem.lower().startswith(kind)), "held")
        if view is not None:
            found[kind].append(view)
    if len(sizes) > 1:
        raise RequestError(f"{folder}: pictures of {len(sizes)} sizes; a calibration needs them all of one")
    if not found["origin"]:
        return None
    return Views(found["held"], found["origin"][0], found["floor"], sizes.pop())


def _views_of_video(path: Path, board: Board, detector: BoardDetector, origin_s: float | None) -> Views | None:
    at_s = origin_s if origin_s is not None else max((frame_s for frame_s, _ in _frames(path)), default=0.0)
    collectors: tuple[Collector, Collector] | None = None
    lying: list[Plane] = []
    last: View | None = None
    for t_s, luma in _frames(path):
        size = (luma.shape[1], luma.shape[0])
        collectors = collectors or (Collector(board, size), Collector(board, size))
        if abs(t_s - at_s) < _APART_S / 4:
            lying.append(luma.copy())
        if abs(t_s - at_s) < _APART_S:
            continue
        view = detector.find(luma)
        if view is not None and last is not None and view.moved_px(last) < _STILL_PX:
            collectors[int(t_s > at_s)].offer(view)
        last = view
    if collectors is None or not lying:
        return None
    origin = detector.find(np.rint(np.mean(lying, axis=0)).astype(np.uint8), "origin")
    if origin is None:
        return None
    airborne, floor = (
        [view for view in collector.views if view.moved_px(origin) > _LEFT_PX] for collector in collectors
    )
    return Views(_named(airborne, "held"), origin, _named(floor, "floor"), (lying[0].shape[1], lying[0].shape[0]))


def _frames(path: Path) -> Iterator[tuple[float, Plane]]:
    for frame in FrameReader(path):
        yield frame.t_s, frame.luma
