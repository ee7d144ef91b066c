"""A shape: named silhouette in arena centimetres, and the checks that every silhouette passes."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.affinity import scale as enlarge
from shapely.affinity import translate
from shapely.geometry import LinearRing, MultiPolygon, Polygon
from shapely.validation import explain_validity

from lab.base.errors import RequestError
from lab.base.given import one_line

Silhouette = Polygon | MultiPolygon
Floats = NDArray[np.float64]

DIGEST_STEP_CM = 1e-4  # a micrometre: far below what a projector draws, far above rounding between machines
MAX_POINTS = 200_000  # of one silhouette: far above any drawing, and still quick to intersect
FIT_WIDTH_CM = 100.0
FIT_HEIGHT_CM = 70.0
MAX_COORDINATE = 1e9  # of a file, in its unit: ten thousand kilometres of cm
SMALLEST_CM = 1.0  # of the longer side: a robot that reads every centimetre or two meets nothing smaller
THINNEST = 1e-5  # cm of area per perimeter: such slivers are drawn by rounding alone
LARGEST_CM = 1000.0  # no floor under a projector is larger
_AGREEMENT_CM = 1e-9  # slack for the rounding of a boundary that touches another


class ShapeError(RequestError):
    """A shape cannot be had as asked: unknown, unreadable, invalid or too large.

    ``subject`` is what was asked for: a name, a text or a path.
    """

    def __init__(self, subject: str, problem: str) -> None:
        self.subject = subject
        # a text or a file's name may hold line breaks, and what steers a terminal
        super().__init__(f"{one_line(subject, 400)}: {one_line(problem)}")


@dataclass(frozen=True, slots=True)
class Drawing:
    """What a file draws, before it has a name.

    ``size_from`` says where its size comes from; then ``geometry`` is in cm. It is empty where the file states none,
    and ``geometry`` in the file's own unit. ``notes`` say in a line each what was done that its author should know.
    """

    geometry: Silhouette
    size_from: str = ""
    notes: tuple[str, ...] = ()

    @property
    def in_cm(self) -> bool:
        """Whether the file says its size."""
        return bool(self.size_from)


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


def rings_of(geometries: Iterable[Silhouette]) -> list[LinearRing]:
    """All rings of some silhouettes, outer ones and holes."""
    pieces = [piece for geometry in geometries for piece in polygons_of(geometry)]
    return [ring for piece in pieces for ring in (piece.exterior, *piece.interiors)]


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
        raise ShapeError(
            subject,
            f"the outline crosses or touches itself ({reason}); untangle it there, or mend it by"
            " chordlab shapes import --mend",
        )
    if not 0 < geometry.area < np.inf:
        raise ShapeError(subject, "the shape has no area; draw an outline that encloses some")


def fit(
    geometry: Silhouette,
    subject: str,
    *,
    width_cm: float | None = None,
    height_cm: float | None = None,
    area_cm2: float | None = None,
    scale: float | None = None,
    keep_size: bool = False,
) -> Silhouette:
    """Scale a silhouette, proportions kept, and centre its bounding box on the arena's origin.

    Given one of ``width_cm`` and ``height_cm`` the box gets that side; given both it is made as large as
    both allow. ``area_cm2`` gives it that area, ``scale`` multiplies its lengths. Given none of them,
    ``keep_size`` leaves a silhouette that is in cm already, otherwise it is made as large as 100 cm in width
    and 70 cm in height allow (inside the default arena of 120 x 90 cm). Raises ShapeError for a size that is
    not above 0, or sizes that contradict each other.
    """
    given = {"width": width_cm, "height": height_cm, "area": area_cm2, "scale": scale}
    for name, value in given.items():
        if value is not None and not (np.isfinite(value) and value > 0):
            unit = {"area": " cm²", "scale": ""}.get(name, " cm")
            raise ShapeError(subject, f"the {name} must be above 0{unit}, got {value:g}")
    chosen = [name for name, value in given.items() if value is not None]
    if len(chosen) > 1 and chosen != ["width", "height"]:
        raise ShapeError(subject, f"{' and '.join(chosen)} contradict each other; give one of them")
    x_low, y_low, x_high, y_high = geometry.bounds
    width, height = size_of(geometry)
    # centred first: map coordinates lie far off, and would lose digits
    centred = translate(geometry, -(x_low + x_high) / 2, -(y_low + y_high) / 2)
    if scale is not None:
        factor = scale
    elif area_cm2 is not None:
        factor = float(np.sqrt(area_cm2 / centred.area))
    elif chosen:
        factor = min((width_cm or np.inf) / width, (height_cm or np.inf) / height)
    else:
        factor = 1.0 if keep_size else min(FIT_WIDTH_CM / width, FIT_HEIGHT_CM / height)
    scaled = enlarge(centred, factor, factor, origin=(0.0, 0.0))
    return unrounded(scaled, subject) if geometry.is_valid else scaled


def unrounded(geometry: Silhouette, subject: str) -> Silhouette:
    """Part edges again that rounding has laid on each other, in a silhouette that was valid before it was scaled."""
    if geometry.is_valid:
        return geometry
    parted = geometry.buffer(0)
    _check_thickness(parted, subject)
    return parted


def check_sane(geometry: Silhouette, subject: str) -> None:
    """Raise ShapeError for a size that is hardly meant: drawn in metres, degrees or micrometres, say."""
    _check_thickness(geometry, subject)
    width, height = size_of(geometry)
    if SMALLEST_CM <= max(width, height) <= LARGEST_CM:
        return
    problem = "too small for a robot to meet" if max(width, height) < SMALLEST_CM else "larger than any arena"
    raise ShapeError(
        subject,
        f"is {width:.3g} x {height:.3g} cm, {problem}; give its true size by chordlab shapes import with --width,"
        " --height, --area or --scale",
    )


def _check_thickness(geometry: Silhouette, subject: str) -> None:
    if geometry.area <= THINNEST * geometry.length:  # nothing left at all counts too
        raise ShapeError(subject, "is so thin that it encloses next to nothing; draw it thicker")


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
