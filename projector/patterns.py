"""Pictures that a camera can measure: a chessboard over the whole image, markers at places of the arena, crosses."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely.geometry import Polygon

from lab.base.errors import RequestError
from projector.shape import Silhouette

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

_CELLS_PER_SQUARE = 8  # markers are 3/4 of a square, 4 x 4 bits and a border of one: all lies on eighths
_MARKER_CELLS = 6
_SQUARES_HIGH = 9
_MOST_MARKERS = 250
_FIDUCIAL_CELLS = 7  # 5 x 5 bits and a border of one
_QUIET_CELLS = 1
_CROSS_PLACES = ((0.12, 0.15), (0.88, 0.15), (0.12, 0.85), (0.88, 0.85), (0.5, 0.5))


class PatternError(RequestError):
    """A pattern that cannot be drawn: an image too small for it, too many markers."""


@dataclass(frozen=True, slots=True, eq=False)
class Chessboard:
    """A ChArUco chessboard that fills a projector's image.

    Attributes:
        image: (height, width) uint8.
        board: for a detector; its corners' numbers are the rows of ``corners_px``.
        corners_px: inner corners (n, 2) in the projector's pixels, centres of pixels at whole numbers.
    """

    image: Image
    board: cv2.aruco.CharucoBoard
    corners_px: Floats


def chessboard(image_size: tuple[int, int]) -> Chessboard:
    """Fill an image of (width, height) pixels with a chessboard nine squares high.

    Raises:
        PatternError: the image is too small for cells of whole pixels.
    """
    width, height = image_size
    cell_px = height // (_SQUARES_HIGH * _CELLS_PER_SQUARE)
    if cell_px < 2:
        raise PatternError(f"an image of {width} x {height} pixels is too small for the pattern; raise its resolution")
    side_px = cell_px * _CELLS_PER_SQUARE
    rows, columns = height // side_px, min(width // side_px, 2 * _MOST_MARKERS // (height // side_px))
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    board = cv2.aruco.CharucoBoard(
        (columns, rows), float(side_px), side_px * _MARKER_CELLS / _CELLS_PER_SQUARE, markers
    )
    # one pixel for each cell is exact, and so are whole multiples of it
    cells = np.asarray(
        board.generateImage((columns * _CELLS_PER_SQUARE, rows * _CELLS_PER_SQUARE), marginSize=0), dtype=np.uint8
    )
    picture = np.kron(cells, np.ones((cell_px, cell_px), dtype=np.uint8))
    left, top = (width - picture.shape[1]) // 2, (height - picture.shape[0]) // 2
    image = np.full((height, width), 255, dtype=np.uint8)
    image[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    corners = np.asarray(board.getChessboardCorners(), dtype=float)[:, :2]
    # the edge between pixels k − 1 and k lies at k − 1/2
    return Chessboard(image, board, corners + np.array([left - 0.5, top - 0.5]))


@dataclass(frozen=True, slots=True, eq=False)
class Fiducials:
    """ArUco markers at places of the arena, each with a lit rim; the number of a marker is its row.

    ``centres_cm`` (n, 2) in the plane that they are rendered for, ``size_cm`` the width of a marker's black.
    """

    centres_cm: Floats
    size_cm: float
    _detector: cv2.aruco.ArucoDetector = field(init=False, repr=False)

    def __post_init__(self) -> None:
        known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
        if not 0 < len(self.centres_cm) <= 250:
            raise PatternError(f"{len(self.centres_cm)} markers; from 1 to 250 can be told apart")
        settings = cv2.aruco.DetectorParameters()
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        object.__setattr__(self, "_detector", cv2.aruco.ArucoDetector(known, settings))

    @property
    def reach_cm(self) -> float:
        """Half the width of a marker with its rim."""
        return self.size_cm * (0.5 + _QUIET_CELLS / _FIDUCIAL_CELLS)

    @property
    def lit(self) -> Silhouette:
        """What the projector must light."""
        cell_cm = self.size_cm / _FIDUCIAL_CELLS
        known = self._detector.getDictionary()
        cells: list[Floats] = []
        for number, (x_cm, y_cm) in enumerate(self.centres_cm.tolist()):
            lit = np.asarray(cv2.aruco.generateImageMarker(known, number, _FIDUCIAL_CELLS, borderBits=1)) > 127
            rows, columns = np.nonzero(np.pad(lit, _QUIET_CELLS, constant_values=True))
            x, y = x_cm - self.reach_cm + columns * cell_cm, y_cm + self.reach_cm - rows * cell_cm
            cells.append(np.column_stack([x, y - cell_cm, x + cell_cm, y]))
        # joined on a grid, so that neighbours share their edges to the last bit
        sides = np.concatenate(cells)
        boxes = shapely.box(sides[:, 0], sides[:, 1], sides[:, 2], sides[:, 3])
        joined = shapely.union_all(boxes, grid_size=1e-9)
        return shapely.MultiPolygon([piece for piece in shapely.get_parts(joined) if isinstance(piece, Polygon)])

    def find(self, luma: Image) -> dict[int, Floats]:
        """The markers seen in a camera's picture: number → corners (4, 2) in pixels, clockwise from the top left."""
        found, numbers, _ = self._detector.detectMarkers(np.ascontiguousarray(luma))
        if numbers is None:  # pyright: ignore[reportUnnecessaryComparison]
            return {}
        seen = zip(np.asarray(numbers).ravel().tolist(), found, strict=True)
        return {
            int(number): np.asarray(corners, dtype=float).reshape(4, 2)
            for number, corners in seen
            if number < len(self.centres_cm)
        }


def fiducials(centres_cm: ArrayLike, size_cm: float) -> Fiducials:
    """Markers of ``size_cm`` at places (n, 2) of the arena."""
    return Fiducials(np.asarray(centres_cm, dtype=float).reshape(-1, 2), float(size_cm))


def crosses(image_size: tuple[int, int]) -> tuple[Image, Floats]:
    """Five numbered crosses, four near the corners and the fifth in the middle; the image and their pixels (5, 2)."""
    width, height = image_size
    image = np.zeros((height, width), dtype=np.uint8)
    arm_px = max(8, height // 20)
    places: list[tuple[int, int]] = []
    for number, (across, down) in enumerate(_CROSS_PLACES, 1):
        x, y = round(across * (width - 1)), round(down * (height - 1))
        places.append((x, y))
        # three pixels wide, so that its middle is a pixel's centre
        image[y - 1 : y + 2, x - arm_px : x + arm_px + 1] = 255
        image[y - arm_px : y + arm_px + 1, x - 1 : x + 2] = 255
        corner = (x + arm_px // 3, y - arm_px // 3)
        cv2.putText(image, str(number), corner, cv2.FONT_HERSHEY_SIMPLEX, arm_px / 40, 255, 2)
    return image, np.array(places, dtype=float)
