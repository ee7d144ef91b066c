"""Find red LED matrices in each frame on its own, for a moving camera or several robots, and keep their identities.

There is no background to subtract: a marker is a compact red patch in a shell that is brighter than the floor.
Chalk and tape are red too, but thin, and lie on floor. Frames are tied together by how the camera moved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Plane = NDArray[np.uint8]
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class MarkerSettings:
    """What a lit robot looks like.

    Attributes:
        ball_px: the ball's diameter in the picture.
        least_red: least mean redness (V above the picture's median) over the matrix.
        shell: the shell around the matrix must be this much brighter than the picture's median, luma.
        dark_room: where the median luma is lower, the shell cannot be seen and is not asked for.
        most_speed: how far a robot may move from frame to frame, in balls, the camera's motion taken off.
        least_frames: shorter sightings are noise.
        least_quality: and so are those whose median quality is lower.
        longest_gap: frames after which a robot out of sight is not looked for any more.
        farthest_gap: farthest from where it was lost that it is taken for the same robot, in balls.
    """

    ball_px: float
    least_red: float = 5.0
    shell: float = 20.0
    dark_room: float = 50.0
    most_speed: float = 0.6
    least_frames: int = 4
    least_quality: float = 0.7
    longest_gap: int = 300
    farthest_gap: float = 2.0


@dataclass(frozen=True, slots=True)
class Marker:
    """A lit matrix in one frame: its centre in luma pixels, its mean redness (V steps), how surely it is one (0..1)."""

    x_px: float
    y_px: float
    redness: float
    quality: float


def find_markers(luma: Plane, red: Plane, settings: MarkerSettings, *, most: int) -> list[Marker]:
    """Find up to ``most`` lit matrices, the surest first.

    Args:
        luma: (h, w).
        red: (h / 2, w / 2), the V plane.
        settings: what they look like.
        most: at most how many.
    """
    size = red.shape[1], red.shape[0]
    redness = np.maximum(red.astype(np.float32) - np.float32(np.median(red) + 4.0), 0.0)
    matrix = _odd(0.22 * settings.ball_px)
    response: Floats32 = np.asarray(
        cv2.blur(redness, (matrix, matrix), borderType=cv2.BORDER_CONSTANT), dtype=np.float32
    )
    middle = float(np.median(luma[::4, ::4]))
    sure = np.ones(response.shape, dtype=np.float32)
    if middle >= settings.dark_room:
        # The shell's brightness, over what is not red itself: chalk is bright and red, the floor under it is neither.
        small = np.asarray(cv2.resize(luma, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        plain = (redness < 8.0).astype(np.float32)
        ball = (_odd(0.42 * settings.ball_px),) * 2
        share = np.asarray(cv2.blur(plain, ball), dtype=np.float32)
        shell = np.asarray(cv2.blur(small * plain, ball), dtype=np.float32) / np.maximum(share, 0.02) - np.float32(
            middle
        )
        sure = np.asarray(np.clip((shell - 0.5 * settings.shell) / settings.shell, 0.0, 1.0), dtype=np.float32)
    score = response * sure
    # Chalk that touches the ball is as red as the matrix, but not as sure.
    redness *= sure
    reach = round(0.3 * settings.ball_px)
    found: list[Marker] = []
    for _ in range(most):
        _, highest, _, (column, row) = cv2.minMaxLoc(score)
        if highest < settings.least_red:
            break
        x, y = _centre(redness, column, row, 0.15 * settings.ball_px)
        found.append(Marker(2.0 * x + 0.5, 2.0 * y + 0.5, float(response[row, column]), float(sure[row, column])))
        score[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1] = 0.0
    return found


def _centre(redness: Floats32, column: int, row: int, reach: float) -> tuple[float, float]:
    """Centroid of the redness in a window that follows it, in pixels of the colour plane."""
    x, y = float(column), float(row)
    half = math.ceil(reach)
    for _ in range(3):
        left, top = max(0, round(x) - half), max(0, round(y) - half)
        window = redness[top : round(y) + half + 1, left : round(x) + half + 1]
        dim = 0.3 * float(window.max(initial=0.0))
        weight = np.maximum(window - dim, 0.0).astype(np.float64)
        total = float(weight.sum())
        if total <= 0.0:
            break
        columns, rows = np.arange(weight.shape[1], dtype=float), np.arange(weight.shape[0], dtype=float)
        x = left + float((weight @ columns).sum()) / total
        y = top + float((rows @ weight).sum()) / total
    return x, y


def _odd(width: float) -> int:
    return 2 * max(1, round((width - 1.0) / 2.0)) + 1


class CameraMotion:
    """How the picture shifts from frame to frame, by phase correlation of the luma at a quarter of its size."""

    def __init__(self) -> None:
        self._before: Floats32 | None = None
        self._window: Floats32 | None = None
        self.x_px = 0.0
        self.y_px = 0.0

    def step(self, luma: Plane) -> tuple[float, float]:
        """Take the next frame; return where the scene's first frame's origin now lies, (x, y) in px."""
        size = luma.shape[1] // 4, luma.shape[0] // 4
        small = np.asarray(cv2.resize(luma, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        if self._before is not None and self._window is not None:
            (dx, dy), _ = cv2.phaseCorrelate(self._before, small, self._window)
            self.x_px += 4.0 * dx
            self.y_px += 4.0 * dy
        else:
            self._window = np.asarray(cv2.createHanningWindow(size, cv2.CV_32F), dtype=np.float32)
        self._before = small
        return self.x_px, self.y_px


@dataclass(slots=True)
class _Piece:
    """A run of sightings of one marker: frames, markers, and where they lie in the scene's own frame of reference."""

    frames: list[int]
    markers: list[Marker]
    scene: list[tuple[float, float]]

    @property
    def weight(self) -> float:
        return sum(marker.redness * marker.quality for marker in self.markers)

    def ahead(self, frames: int = 1) -> tuple[float, float]:
        """Where it will be ``frames`` on, from its last three steps; it does not go on for longer than five."""
        x, y = self.scene[-1]
        back = min(3, len(self.scene) - 1)
        if back == 0:
            return x, y
        span = (self.frames[-1] - self.frames[-1 - back]) / min(frames, 5)
        then_x, then_y = self.scene[-1 - back]
        return x + (x - then_x) / span, y + (y - then_y) / span


def link(
    markers: Sequence[Sequence[Marker]], camera: Sequence[tuple[float, float]], robots: int, settings: MarkerSettings
) -> list[dict[int, Marker]]:
    """Tie the frames' markers to ``robots`` identities.

    First frame to frame, by the assignment of least total distance to where each was going; then the pieces are
    tied across gaps, the nearest first; the ``robots`` chains that shine most are the robots.

    Args:
        markers: one list a frame.
        camera: one (x, y) a frame, as ``CameraMotion`` gives them.
        robots: how many identities.
        settings: speeds and gaps.

    Returns:
        For each robot a mapping from frame number to marker; the robots in the order of their first sighting, those
        of the same frame from the top of the picture down.
    """
    pieces = _pieces(markers, camera, settings)
    chains = _tie([piece for piece in pieces if _is_sound(piece, settings)], settings)
    chains.sort(key=lambda chain: -sum(piece.weight for piece in chain))
    chosen = chains[:robots]
    identities = [
        {frame: marker for piece in chain for frame, marker in zip(piece.frames, piece.markers, strict=True)}
        for chain in chosen
    ]
    identities.sort(key=_reading_order)
    return identities + [{} for _ in range(robots - len(identities))]


def _is_sound(piece: _Piece, settings: MarkerSettings) -> bool:
    quality = float(np.median([marker.quality for marker in piece.markers]))
    return len(piece.frames) >= settings.least_frames and quality >= settings.least_quality


def _reading_order(identity: dict[int, Marker]) -> tuple[int, float, float]:
    frame = min(identity)
    return frame, identity[frame].y_px, identity[frame].x_px


def _pieces(
    markers: Sequence[Sequence[Marker]], camera: Sequence[tuple[float, float]], settings: MarkerSettings
) -> list[_Piece]:
    reach = settings.most_speed * settings.ball_px
    done: list[_Piece] = []
    live: list[_Piece] = []
    for frame, (found, (shift_x, shift_y)) in enumerate(zip(markers, camera, strict=True)):
        places = [(marker.x_px - shift_x, marker.y_px - shift_y) for marker in found]
        taken: set[int] = set()
        if live and found:
            cost = _distances([piece.ahead(frame - piece.frames[-1]) for piece in live], places)
            for at, to in _assign(cost, reach):
                piece = live[at]
                piece.frames.append(frame)
                piece.markers.append(found[to])
                piece.scene.append(places[to])
                taken.add(to)
        # Two frames may be missed; then the piece ends, and a later one may be tied to it.
        done += [piece for piece in live if frame - piece.frames[-1] > 2]
        live = [piece for piece in live if frame - piece.frames[-1] <= 2]
        live += [_Piece([frame], [found[k]], [places[k]]) for k in range(len(found)) if k not in taken]
    return done + live


def _tie(pieces: list[_Piece], settings: MarkerSettings) -> list[list[_Piece]]:
    """Join pieces across gaps into chains: repeatedly the pair that needs the least pace."""
    chains = [[piece] for piece in sorted(pieces, key=lambda piece: piece.frames[0])]
    while True:
        best: tuple[float, int, int] | None = None
        for i, before in enumerate(chains):
            for j, after in enumerate(chains):
                gap = after[0].frames[0] - before[-1].frames[-1]
                if i == j or not 0 < gap <= settings.longest_gap:
                    continue
                (x, y), (to_x, to_y) = before[-1].scene[-1], after[0].scene[0]
                # A robot out of sight or mistaken for a moment is looked for near where it was left.
                distance = math.hypot(to_x - x, to_y - y)
                if distance <= settings.ball_px * min(1.0 + 0.1 * gap, settings.farthest_gap):
                    cost = distance / settings.ball_px + 0.02 * gap
                    if best is None or cost < best[0]:
                        best = (cost, i, j)
        if best is None:
            return chains
        _, i, j = best
        chains[i] = chains[i] + chains[j]
        del chains[j]


def _distances(sources: Sequence[tuple[float, float]], targets: Sequence[tuple[float, float]]) -> Floats:
    a, b = np.asarray(sources, dtype=float), np.asarray(targets, dtype=float)
    return np.asarray(np.linalg.norm(a[:, None, :] - b[None, :, :], axis=2), dtype=float)


def _assign(cost: Floats, reach: float) -> list[tuple[int, int]]:
    """Pairs of least total cost, none dearer than ``reach`` (Hungarian method)."""
    rows, columns = linear_sum_assignment(np.minimum(cost, 10.0 * reach))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if cost[i, j] <= reach]
