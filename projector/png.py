"""Silhouettes from pictures: PNG or JPEG, dark on light or light on dark, or cut out by transparency."""

from __future__ import annotations

import io
import struct
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
from contourpy import FillType, contour_generator
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError
from shapely.geometry import MultiPolygon, Polygon

from projector.shape import MAX_POINTS, Drawing, ShapeError, Silhouette, count_points

Floats = NDArray[np.float64]

MAX_BYTES = 50_000_000
MAX_PIXELS = 40_000_000
TRACED_PIXELS = 8_000_000  # a pixel of half a millimetre over a metre and a half
MAX_DPI = 100_000
PLACEHOLDER_DPI = 72  # what cameras write for want of a size
CM_PER_INCH = 2.54
_SPECK_PX2 = 9.0  # pieces and holes below 3 x 3 pixels are dirt or JPEG's ringing
_MIN_CONTRAST = 32.0  # between the two classes, of 255
_STAIRS_PX = 1.0  # blur that takes the stairs off a picture without anti-aliasing: they lengthen its outline by 5 %
_SOFT_PX = 0.3  # an anti-aliased picture needs next to none, and keeps its corners
_TOLERANCE_PX = 0.15
_UNREADABLE = (
    Image.DecompressionBombError,
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    LookupError,
    ArithmeticError,
    AttributeError,
    EOFError,
    struct.error,
)  # what Pillow's readers are known to raise on broken files


def read_image(path: Path) -> Drawing:
    """Trace a picture's silhouette, y up: in cm by the resolution that it states, otherwise in pixels.

    The picture is split in two by Otsu's threshold; the colour that prevails along its rim is the
    background. The outline is the level half way between the two classes' means, found between the
    pixels. With transparency, what is opaque is the shape. Raises ShapeError for a file that is too
    large, no picture, all of one colour, or too ragged.
    """
    subject = str(path)
    if path.stat().st_size > MAX_BYTES:
        raise ShapeError(subject, f"is larger than {MAX_BYTES / 1e6:g} MB; reduce the picture")
    picture = _open(path.read_bytes(), subject)
    ink, dpi = _ink(picture, subject), _stated_dpi(picture)
    # a huge picture is averaged down first: the outline is found between the pixels all the same
    shrink = min(1.0, float(np.sqrt(TRACED_PIXELS / ink.size)))
    height, width = ink.shape
    if shrink < 1:
        small = (max(1, round(width * shrink)), max(1, round(height * shrink)))
        ink = np.asarray(cv2.resize(ink, small, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    pixel = np.array([width / ink.shape[1], height / ink.shape[0]])
    traced = trace(ink, subject)
    if dpi is None:
        return Drawing(shapely.transform(traced, lambda xy: xy * pixel))
    in_cm = shapely.transform(traced, lambda xy: xy * pixel * CM_PER_INCH / np.array(dpi))
    return Drawing(in_cm, f"the picture's {dpi[0]:.0f} dpi")


def trace(ink: NDArray[np.uint8], subject: str) -> Silhouette:
    """Trace what is bright in ``ink`` (height, width): sub-pixel outline at the level half way up, y up."""
    threshold, _ = cv2.threshold(ink, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    bright = ink > threshold
    if not bright.any() or bright.all():
        raise ShapeError(subject, "is all of one colour; draw the shape dark on light or light on dark")
    low, high = float(ink[~bright].mean()), float(ink[bright].mean())
    if high - low < _MIN_CONTRAST:
        raise ShapeError(subject, f"has too little contrast ({high - low:.0f} of 255); draw it black on white")
    # a rim of background closes outlines that the picture's edge cuts
    padded = np.pad(ink.astype(np.float32), 4, constant_values=low)
    blur_px = _SOFT_PX if _is_anti_aliased(ink, bright, low, high) else _STAIRS_PX
    smooth = np.asarray(cv2.GaussianBlur(padded, (0, 0), blur_px), dtype=float)
    inside = smooth > (low + high) / 2
    steps = np.count_nonzero(inside[1:] != inside[:-1]) + np.count_nonzero(inside[:, 1:] != inside[:, :-1])
    if steps > MAX_POINTS:
        raise ShapeError(subject, f"has an outline of {steps} pixels, more than {MAX_POINTS}; smooth the picture")
    pieces: list[Polygon] = []
    filled = contour_generator(z=smooth, fill_type=FillType.OuterOffset).filled((low + high) / 2, np.inf)
    for points, offsets in zip(*filled, strict=True):
        xy = np.asarray(points, dtype=float)
        starts = np.asarray(offsets, dtype=np.intp)
        rings = [xy[a:b] for a, b in pairwise(starts)]
        solid = [Polygon(ring) for ring in rings if len(ring) >= 4]
        holes = [ring.exterior for ring in solid[1:] if ring.area >= _SPECK_PX2]
        if solid and solid[0].area >= _SPECK_PX2:
            pieces.append(Polygon(solid[0].exterior, holes))
    # the half-way level may pass through a saddle, where two rings touch: buffer(0) parts them
    joined = shapely.union_all([piece if piece.is_valid else piece.buffer(0) for piece in pieces])
    simple = joined.simplify(_TOLERANCE_PX)
    if not isinstance(simple, Polygon | MultiPolygon) or simple.is_empty:
        raise ShapeError(subject, "holds nothing but specks; draw the shape larger")
    if count_points(simple) > MAX_POINTS:
        raise ShapeError(subject, f"has an outline of more than {MAX_POINTS} vertices; smooth the picture")
    return shapely.transform(simple, lambda xy: xy * (1.0, -1.0))


def _is_anti_aliased(ink: NDArray[np.uint8], bright: NDArray[np.bool_], low: float, high: float) -> bool:
    """Whether a fair part of the pixels along the outline is neither bright nor dark."""
    solid = bright.astype(np.uint8)
    neighbours = np.ones((3, 3), np.uint8)
    along = cv2.dilate(solid, neighbours) != cv2.erode(solid, neighbours)
    tenth = (high - low) / 10
    between = (ink > low + tenth) & (ink < high - tenth) & along
    return bool(np.count_nonzero(between) > 0.1 * np.count_nonzero(along))


def _open(data: bytes, subject: str) -> Image.Image:
    """Open the picture and turn it upright; its size is checked before any pixel is decoded."""
    if not data:
        raise ShapeError(subject, "the file is empty; save the picture again")
    try:
        with warnings.catch_warnings():
            # Pillow warns of large pictures, ours is the tighter limit; and of oddities that it gets over
            warnings.simplefilter("ignore")
            picture = Image.open(io.BytesIO(data), formats=("PNG", "JPEG"))
            if picture.width * picture.height > MAX_PIXELS:
                raise ShapeError(
                    subject,
                    f"has {picture.width} x {picture.height} pixels, more than {MAX_PIXELS / 1e6:g} million; reduce it",
                )
            turned = ImageOps.exif_transpose(picture)
            turned.load()
            # a picture that lies on its side states its resolution for the lying one
            if turned.size != picture.size and "dpi" in turned.info:
                turned.info["dpi"] = turned.info["dpi"][::-1]
            return turned
    except UnidentifiedImageError as error:
        raise ShapeError(subject, "is no PNG or JPEG whatever its name says; save the picture again as PNG") from error
    except _UNREADABLE as error:
        raise ShapeError(subject, f"cannot be read as PNG or JPEG ({error}); save the picture again") from error


def _stated_dpi(picture: Image.Image) -> tuple[float, float] | None:
    """The resolution (x, y) that the picture's author meant, dots per inch, or None."""
    stated: Any = picture.info.get("dpi")
    try:
        x, y = (float(value) for value in stated)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    if not (1 < x < MAX_DPI and 1 < y < MAX_DPI) or round(x) == round(y) == PLACEHOLDER_DPI:
        return None
    return x, y


def _ink(picture: Image.Image, subject: str) -> NDArray[np.uint8]:
    """Make it gray (height, width) with the shape bright."""
    try:
        if picture.mode.startswith("I"):  # 16 bits a pixel, which Pillow would clip at 255
            picture = Image.fromarray((np.asarray(picture) >> 8).astype(np.uint8))
        rgba = np.asarray(picture.convert("RGBA"))
    except _UNREADABLE as error:
        raise ShapeError(subject, f"cannot be read as PNG or JPEG ({error}); save the picture again") from error
    alpha = np.ascontiguousarray(rgba[:, :, 3])
    if alpha.min() < 128:
        return alpha
    gray = np.asarray(cv2.cvtColor(np.ascontiguousarray(rgba[:, :, :3]), cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    threshold, _ = cv2.threshold(gray, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    rim = np.concatenate([gray[0], gray[-1], gray[:, 0], gray[:, -1]])
    return 255 - gray if np.mean(rim > threshold) > 0.5 else gray
