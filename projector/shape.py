"""A shape: named silhouette in arena centimetres, and the checks that every silhouette passes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.affinity import scale, translate
from shapely.geometry import MultiPolygon, Polygon
from shapely.validation import explain_validity

from lab.base.errors import RequestError

Silhouette = Polygon | MultiPolygon
Floats = NDArray[np.float64]

DIGEST_STEP_CM = 1e-4  # a micrometre: far below what a projector draws, far above rounding between machines
MAX_POINTS = 200_000  # of one silhouette: far above any drawing, and still quick to intersect
FIT_WIDTH_CM = 100.0
FIT_HEIGHT_CM = 70.0
_AGREEMENT_CM = 1e-9  # slack for the rounding of a boundary that touches another


class ShapeError(RequestError):
    """A shape cannot be had as asked: unknown, unreadable, invalid or too large.

    ``subject`` is what was asked for: a name, a text or a path.
    """

    def __init__(self, subject: str, problem: str) -> None:
        self.subject = subject
        # a text or a file's name may hold line breaks; a message is one line
        super().__init__(" ".join(f"{subject}: {problem}".splitlines()))


@dataclass(frozen=True, slots=True)
class Font:
    """The font that drew a text: it decides which letters are confusable, so a session records it.

    ``fallback`` tells that none of the Helvetica family was found and DejaVu Sans stood in.
    """

    name: str
    path: Path
    sha256: str
    fallback: bool = False


@dataclass(frozen=True, slots=True)
class Shape:
    """A silhouette to be found by touch of light: valid, non-empty, in arena cm (x right, y up).

    ``source`` says where the proportions come from. ``font`` is set for texts only. Raises ShapeError
    when the geometry is empty, not finite or not valid (self-crossing).

    >>> from shapely.geometry import box
    >>> shape = Shape("slab", "Slab", box(-2, -1, 2, 1), "by hand")
    >>> shape.area_cm2, shape.perimeter_cm, shape.pieces, shape.holes
    (8.0, 12.0, 1, 0)
    """

    name: str
    title: str
    geometry: Silhouette
    source: str
    font: Font | None = None

    def __post_init__(self) -> None:
        check_silhouette(self.geometry, self.name)

    @property
    def area_cm2(self) -> float:
        """The lit area, holes taken out."""
        return float(self.geometry.area)

    @property
    def perimeter_cm(self) -> float:
        """The length of the whole boundary, the holes' rims included."""
        return float(self.geometry.length)

    @property
    def pieces(self) -> int:
        """How many connected pieces."""
        return len(polygons_of(self.geometry))

    @property
    def holes(self) -> int:
        """How many holes, over all pieces."""
        return sum(len(piece.interiors) for piece in polygons_of(self.geometry))

    @property
    def size_cm(self) -> tuple[float, float]:
        """Width and height of the bounding box."""
        return size_of(self.geometry)

    @property
    def digest(self) -> str:
        """SHA-256 of the silhouette, rounded to 1e-4 cm: the same for the same shape, whatever its file."""
        # + 0.0 turns -0.0 into 0.0, which would otherwise differ in its bytes
        rounded = shapely.transform(self.geometry, lambda xy: np.round(xy / DIGEST_STEP_CM) * DIGEST_STEP_CM + 0.0)
        return hashlib.sha256(shapely.to_wkb(rounded.normalize(), byte_order=1)).hexdigest()


def polygons_of(geometry: Silhouette) -> list[Polygon]:
    """The connected pieces of a silhouette."""
    return [geometry] if isinstance(geometry, Polygon) else list(geometry.geoms)


def count_points(geometry: Silhouette) -> int:
    """How many vertices a silhouette has."""
    return len(shapely.get_coordinates(geometry))


def size_of(geometry: Silhouette) -> tuple[float, float]:
    """Width and height of the bounding box, in the geometry's unit."""
    x_low, y_low, x_high, y_high = geometry.bounds
    return float(x_high - x_low), float(y_high - y_low)


def check_silhouette(geometry: Silhouette, subject: str) -> None:
    """Raise ShapeError unless ``geometry`` is non-empty, finite, valid and has an area."""
    if geometry.is_empty:
        raise ShapeError(subject, "the shape is empty; draw at least one closed outline")
    if not np.isfinite(shapely.get_coordinates(geometry)).all():
        raise ShapeError(subject, "a coordinate is not a finite number; every vertex needs finite x and y")
    if not geometry.is_valid:
        reason = " ".join(explain_validity(geometry).split())
        raise ShapeError(subject, f"the outline crosses or touches itself ({reason}); untangle it there")
    if geometry.area <= 0:
        raise ShapeError(subject, "the shape has no area; draw an outline that encloses some")


def fit(
    geometry: Silhouette,
    subject: str,
    *,
    width_cm: float | None = None,
    height_cm: float | None = None,
    keep_size: bool = False,
) -> Silhouette:
    """Scale a silhouette, proportions kept, and centre its bounding box on the arena's origin.

    Given one of ``width_cm`` and ``height_cm`` the box gets that side; given both it is made as large as
    both allow. Given neither, ``keep_size`` leaves a silhouette that is in cm already, otherwise it is
    made as large as 100 cm in width and 70 cm in height allow (inside the default arena of 120 x 90 cm).
    Raises ShapeError for a size that is not above 0.
    """
    for name, value in (("width", width_cm), ("height", height_cm)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ShapeError(subject, f"the {name} must be above 0 cm, got {value:g}")
    width, height = size_of(geometry)
    if width_cm is None and height_cm is None:
        factor = 1.0 if keep_size else min(FIT_WIDTH_CM / width, FIT_HEIGHT_CM / height)
    else:
        factor = min((width_cm or np.inf) / width, (height_cm or np.inf) / height)
    scaled = scale(geometry, factor, factor, origin=(0.0, 0.0))
    x_low, y_low, x_high, y_high = scaled.bounds
    return translate(scaled, -(x_low + x_high) / 2, -(y_low + y_high) / 2)


def check_fits(shape: Shape, arena: Polygon, margin_cm: float = 0.0) -> None:
    """Raise ShapeError unless ``shape`` lies in the convex ``arena`` with ``margin_cm`` to spare all round.

    The message names the height at which it would fit.
    """
    ring = shapely.get_coordinates(arena.exterior)
    along = np.diff(ring, axis=0)
    sign = 1.0 if arena.exterior.is_ccw else -1.0
    lengths = np.hypot(along[:, 0], along[:, 1])
    along, start, lengths = along[lengths > 0], ring[:-1][lengths > 0], lengths[lengths > 0]
    outward: Floats = sign * np.column_stack([along[:, 1], -along[:, 0]]) / lengths[:, None]
    # each wall allows x·n <= room; a convex arena is where all of them do
    room: Floats = (outward * start).sum(axis=1) - margin_cm
    reach: Floats = (shapely.get_coordinates(shape.geometry) @ outward.T).max(axis=0)
    if (reach <= room + _AGREEMENT_CM).all():
        return
    width, height = shape.size_cm
    arena_width, arena_height = size_of(arena)
    pressing = reach > 0
    factor = float((room[pressing] / reach[pressing]).min())
    cure = (
        f"make it at most {np.floor(10 * height * factor) / 10:g} cm high"
        if factor > 0 and (reach[~pressing] <= room[~pressing]).all()
        else "make the arena larger or the margin smaller"
    )
    raise ShapeError(
        shape.name,
        f"{width:.1f} x {height:.1f} cm does not fit in the {arena_width:g} x {arena_height:g} cm arena"
        f" with {margin_cm:g} cm to spare; {cure}",
    )
