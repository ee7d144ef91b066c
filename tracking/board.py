"""The printed ChArUco board that a camera is calibrated with: its geometry, and the PDF to print.

A chessboard whose white squares carry ArUco markers, so that each inner corner is known by its number even
where only part of the board is seen. A marker is 3/4 of a square with 4 x 4 bits and a border of one, so the
whole board lies on a grid of eighths of a square: `Board.cells` is that grid, from which all else is drawn.

Board frame: origin at the board's centre, x right, y up, z out of the paper, cm. Laid at the arena's origin
with its arrows along the arena's axes, board frame and arena frame are one.
"""

from __future__ import annotations

import io
import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from lab.base.errors import RequestError
from lab.base.files import write_aside
from lab.base.given import read_given

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

CELLS_PER_SQUARE = 8
RULER_CM = 10.0
_MARKER_CELLS = 6
_CM_PER_INCH = 2.54
_PAPER_CM = {"A4": (29.7, 21.0), "A3": (42.0, 29.7)}
_TAG = "chordlab-board columns={columns} rows={rows} square_cm={square_cm:g}"
_TAG_FORM = re.compile(rb"chordlab-board columns=(\d{1,3}) rows=(\d{1,3}) square_cm=(\d{1,9}(?:\.\d{1,9})?)")
_MOST_MARKERS = 100


class BoardError(RequestError):
    """A board that cannot be: too many squares, a size that is none, a PDF that holds no board."""


@dataclass(frozen=True, slots=True, eq=False)
class Board:
    """A board of ``columns`` x ``rows`` squares, each ``square_cm`` wide; at least 3 x 3, at most 100 markers."""

    columns: int = 7
    rows: int = 5
    square_cm: float = 3.4
    charuco: cv2.aruco.CharucoBoard = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not math.isfinite(self.square_cm) or self.square_cm <= 0:
            raise BoardError(f"board: squares of {self.square_cm:g} cm; give their measured width in cm")
        if min(self.columns, self.rows) < 3 or self.columns * self.rows // 2 > _MOST_MARKERS:
            raise BoardError(f"board: {self.columns} x {self.rows} squares; from 3 x 3 up to {_MOST_MARKERS} markers")
        object.__setattr__(self, "charuco", charuco_board(self.columns, self.rows, self.square_cm))

    @property
    def size_cm(self) -> tuple[float, float]:
        """Width and height of the chessboard without its white margin."""
        return self.columns * self.square_cm, self.rows * self.square_cm

    @property
    def corners_cm(self) -> Floats:
        """The inner corners (n, 3) in the board frame, by their numbers."""
        width_cm, height_cm = self.size_cm
        # OpenCV counts from the top left corner, y down
        x, y, _ = np.asarray(self.charuco.getChessboardCorners(), dtype=float).T
        return np.column_stack([x - width_cm / 2, height_cm / 2 - y, np.zeros(len(x))])

    @property
    def cells(self) -> NDArray[np.bool_]:
        """The board as cells an eighth of a square wide, row 0 at the top; True is white."""
        return board_cells(self.charuco)

    def scaled(self, factor: float) -> Board:
        """The same board as a printer made it that prints lengths times ``factor``."""
        return replace(self, square_cm=self.square_cm * factor)


def charuco_board(columns: int, rows: int, square: float) -> cv2.aruco.CharucoBoard:
    """OpenCV's board with markers of 4 x 4 bits, in whatever unit ``square`` is."""
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    return cv2.aruco.CharucoBoard((columns, rows), square, square * _MARKER_CELLS / CELLS_PER_SQUARE, markers)


def board_cells(board: cv2.aruco.CharucoBoard) -> NDArray[np.bool_]:
    """A board's cells, True white: drawn at one pixel for each, which is exact."""
    columns, rows = board.getChessboardSize()
    picture = board.generateImage((columns * CELLS_PER_SQUARE, rows * CELLS_PER_SQUARE), marginSize=0)
    return np.asarray(picture) > 127


def board_for(paper: str) -> Board:
    """The board for a sheet of "A4" or "A3". Raises BoardError for other paper."""
    boards = {"A4": Board(7, 5, 3.4), "A3": Board(9, 7, 3.6)}
    if paper not in boards:
        raise BoardError(f"there is no board for {paper} paper; take {' or '.join(boards)}")
    return boards[paper]


def print_board(path: Path, paper: str = "A4") -> Board:
    """Write the board for ``paper`` as a PDF to print: vector, true size, with a ruler of 10 cm to check the printer.

    The file says in its subject which board it holds; `read_board` finds it there.

    Raises:
        BoardError: there is no board for such paper.
        RequestError: the file cannot be written.
    """
    # matplotlib is slow to import, and only this needs it
    from matplotlib.backends.backend_pdf import FigureCanvasPdf  # noqa: PLC0415

    board = board_for(paper)
    file = io.BytesIO()
    tag = _TAG.format(columns=board.columns, rows=board.rows, square_cm=board.square_cm)
    canvas: Any = FigureCanvasPdf(draw_sheet(board, paper))
    canvas.print_pdf(file, metadata={"Subject": tag, "Title": "chordlab board", "CreationDate": None})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_aside(path, file.getvalue())
    except OSError as error:
        raise RequestError(f"{path}: cannot be written ({error.strerror}); name another file") from error
    return board


def draw_sheet(board: Board, paper: str) -> Figure:
    """The sheet of ``paper`` with the board in its middle, arrows, ruler and text."""
    from matplotlib.figure import Figure  # noqa: PLC0415
    from matplotlib.patches import PathPatch  # noqa: PLC0415
    from matplotlib.path import Path as Outline  # noqa: PLC0415

    wide_cm, high_cm = _PAPER_CM[paper]
    figure: Any = Figure(figsize=(wide_cm / _CM_PER_INCH, high_cm / _CM_PER_INCH))
    axes: Any = figure.add_axes(
        (0.0, 0.0, 1.0, 1.0), xlim=(-wide_cm / 2, wide_cm / 2), ylim=(-high_cm / 2, high_cm / 2)
    )
    axes.set_axis_off()
    # One path for all black cells: cells drawn apart would show hairlines between them.
    rings = [ring for piece in _black(board) for ring in (piece.exterior, *piece.interiors)]
    outlines = [Outline(shapely.get_coordinates(ring), closed=True) for ring in rings]
    axes.add_patch(PathPatch(Outline.make_compound_path(*outlines), facecolor="black", linewidth=0))

    right, top = (side / 2 for side in board.size_cm)
    arrow = {"arrowstyle": "-|>", "color": "black", "linewidth": 1.0}
    axes.annotate("", (right + 1.9, 0), (right + 0.5, 0), arrowprops=arrow)
    axes.text(right + 1.1, 0.15, "x", ha="center", va="bottom", fontsize=11)
    axes.annotate("", (0, top + 1.6), (0, top + 0.4), arrowprops=arrow)
    axes.text(0.2, top + 0.95, "y", ha="left", va="center", fontsize=11)
    axes.plot([-right - 1.0, -right - 0.4], [0, 0], color="black", linewidth=1.0)
    axes.plot([0, 0], [-top - 1.0, -top - 0.4], color="black", linewidth=1.0)
    title = f"chordlab board, {paper}: {board.columns} x {board.rows} squares of {board.square_cm:g} cm"
    hints = {
        ("left", top + 0.95): f"{title}\nPrint at 100 % and glue it on something flat.",
        ("right", top + 0.95): "To give the arena its axes: its centre on the arena's\ncentre, x to the right, y up.",
        ("right", -top - 0.95): f"The ruler must measure {RULER_CM:g} cm; if it does not,\n"
        "give what it measures as --ruler-cm.",
    }
    for (side, y_cm), text in hints.items():
        x_cm = right if side == "right" else -right
        axes.text(x_cm, y_cm, text, fontsize=7, va="center", ha=side)
    _draw_ruler(axes, -right, -top - 0.95)
    return figure


def read_board(path: Path) -> Board:
    """The board that a PDF by `print_board` holds. Raises BoardError where it holds none or cannot be read."""
    try:
        found = _TAG_FORM.search(read_given(path))
    except RequestError as error:
        raise BoardError(f"cannot read the board {error}") from error
    if found is None:
        raise BoardError(f"{path} holds no chordlab board; make one with chordlab calibrate camera --make-board {path}")
    columns, rows, square_cm = found.groups()
    return Board(int(columns), int(rows), float(square_cm))


def _black(board: Board) -> list[shapely.Polygon]:
    """The black cells joined, board frame in cm."""
    cell_cm = board.square_cm / CELLS_PER_SQUARE
    rows, columns = np.nonzero(~board.cells)
    width_cm, height_cm = board.size_cm
    left, top = columns * cell_cm - width_cm / 2, height_cm / 2 - rows * cell_cm
    joined = shapely.union_all(shapely.box(left, top - cell_cm, left + cell_cm, top), grid_size=1e-9)
    return [piece for piece in shapely.get_parts(joined) if isinstance(piece, shapely.Polygon)]


def _draw_ruler(axes: Any, left_cm: float, y_cm: float) -> None:
    """A ruler with a tick each centimetre, its zero at ``left_cm``."""
    axes.plot([left_cm, left_cm + RULER_CM], [y_cm, y_cm], color="black", linewidth=0.6, solid_capstyle="butt")
    for centimetre in range(int(RULER_CM) + 1):
        x_cm, tick_cm = left_cm + centimetre, 0.35 if centimetre % 5 == 0 else 0.2
        axes.plot([x_cm, x_cm], [y_cm, y_cm + tick_cm], color="black", linewidth=0.6, solid_capstyle="butt")
        if centimetre % 5 == 0:
            axes.text(x_cm, y_cm - 0.08, str(centimetre), ha="center", va="top", fontsize=6)
    axes.text(left_cm + RULER_CM + 0.25, y_cm, "cm", va="center", fontsize=6)
