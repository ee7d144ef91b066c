"""From a silhouette in the arena to the image that a projector must show.

The robot's light sensor does not lie on the floor: at height h it meets the projector's rays before the
floor does. So a shape is rendered for the plane of the sensor, z = h, where it then has its true size.

Coverage is exact: each pixel gets the share of its square that the shape covers, by summing the signed
areas that the boundary's edges leave to their right (the accumulation that font rasterisers use).
"""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely.geometry import box
from shapely.geometry.polygon import orient

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from projector.shape import Silhouette, polygons_of

Floats = NDArray[np.float64]

GAMMA = 2.2  # light ∝ (code / 255) ** GAMMA, what projectors do out of the box
_EDGE_CM = 1.0  # a straight edge is cut this finely, so that a lens's distortion may bend it


class RenderError(RequestError):
    """The shape cannot be shown by this projector. ``outside_share`` is the part of its area beyond the image."""

    def __init__(self, message: str, outside_share: float) -> None:
        self.outside_share = outside_share
        super().__init__(message)


def light_to_code(light: ArrayLike, gamma: float = GAMMA) -> NDArray[np.uint8]:
    """Encode relative light in [0, 1] as pixel codes."""
    share = np.clip(np.asarray(light, dtype=float), 0.0, 1.0)
    return np.asarray(np.rint(255.0 * share ** (1.0 / gamma)), dtype=np.uint8)


def code_to_light(code: ArrayLike, gamma: float = GAMMA) -> Floats:
    """Decode pixel codes to relative light in [0, 1]."""
    table: Floats = (np.arange(256) / 255.0) ** gamma
    return table[np.asarray(code, dtype=np.uint8)]


def render(
    geometry: Silhouette, projector: Pinhole, plane_height_cm: float, *, gamma: float = GAMMA
) -> NDArray[np.uint8]:
    """Render ``geometry`` (arena cm) as the gray image, uint8 (height, width), that ``projector`` must show.

    The light meets the plane z = ``plane_height_cm`` at true size and place. A pixel's *light* is the
    share of it that the shape covers; its code is that share's ``1 / gamma`` power, so that an edge stays
    in place after the projector's gamma. Raises RenderError when the shape reaches beyond the image, or
    when the projector lies at or below the plane.
    """
    if projector.centre_cm[2] <= plane_height_cm:
        raise RenderError(
            f"the projector at {projector.centre_cm[2]:.1f} cm is not above the plane at {plane_height_cm:g} cm;"
            " check its calibration",
            outside_share=1.0,
        )
    width, height = projector.image_size
    # OpenCV's pixel (0, 0) has its centre at (0, 0): move to squares [i, i + 1]
    pixels = to_pixels(geometry, projector, plane_height_cm, shift_px=0.5)
    inside = pixels.intersection(box(0, 0, width, height)).area
    outside_share = 1.0 - inside / pixels.area
    if outside_share > 1e-9:
        raise RenderError(
            f"{100 * outside_share:.3g} % of the shape falls beyond the projector's {width} x {height} image;"
            " make it smaller or move the projector back",
            outside_share,
        )
    return light_to_code(coverage(pixels, (width, height)), gamma)


def to_pixels(geometry: Silhouette, projector: Pinhole, plane_height_cm: float, shift_px: float = 0.0) -> Silhouette:
    """Project a silhouette in the plane z = ``plane_height_cm`` to pixels; edges are cut to 1 cm first."""

    def project(xy: Floats) -> Floats:
        points = np.column_stack([xy, np.full(len(xy), plane_height_cm)])
        return projector.project(points) + shift_px

    return shapely.transform(shapely.segmentize(geometry, _EDGE_CM), project)


def coverage(geometry: Silhouette, image_size: tuple[int, int]) -> Floats:
    """The share of every pixel that ``geometry`` covers, (height, width) in [0, 1], exact to rounding.

    ``geometry`` is in pixels with pixel (column i, row j) the square [i, i + 1] x [j, j + 1], and lies
    within the image.

    >>> from shapely.geometry import box
    >>> coverage(box(0.5, 0, 2, 1), (3, 1))
    array([[0.5, 1. , 0. ]])
    """
    width, height = image_size
    # one spare column takes what an edge on the image's right rim leaves to its right, one spare row its bottom
    sums = np.zeros((height + 1, width + 2))
    start, end = _edges(geometry)
    x, y, dy = _cut_at_grid(start, end)
    column = np.clip(np.floor(x).astype(np.intp), 0, width)
    row = np.clip(np.floor(y).astype(np.intp), 0, height)
    left = x - column
    # an edge that rises by dy inside a pixel covers dy of all to its right, and of its own square dy·(1 − left)
    np.add.at(sums, (row, column), dy * (1.0 - left))
    np.add.at(sums, (row, column + 1), dy * left)
    return np.clip(np.abs(np.cumsum(sums, axis=1))[:height, :width], 0.0, 1.0)


def _edges(geometry: Silhouette) -> tuple[Floats, Floats]:
    """Starts and ends (n, 2) of all edges, outer rings one way round and holes the other."""
    starts: list[Floats] = []
    ends: list[Floats] = []
    for piece in polygons_of(geometry):
        turned = orient(piece)
        for ring in (turned.exterior, *turned.interiors):
            xy = shapely.get_coordinates(ring)
            starts.append(xy[:-1])
            ends.append(xy[1:])
    return np.concatenate(starts), np.concatenate(ends)


def _cut_at_grid(start: Floats, end: Floats) -> tuple[Floats, Floats, Floats]:
    """Cut edges wherever they cross the pixel grid; give each bit's middle x, middle y and rise dy."""
    edge = np.arange(len(start))
    owners, shares = [edge, edge], [np.zeros(len(start)), np.ones(len(start))]
    for axis in (0, 1):
        low = np.minimum(start[:, axis], end[:, axis])
        high = np.maximum(start[:, axis], end[:, axis])
        first = np.floor(low).astype(np.intp) + 1
        count = np.maximum(np.ceil(high).astype(np.intp) - first, 0)
        owner = np.repeat(edge, count)
        # 0, 1, 2, … within each edge
        before: NDArray[np.intp] = np.repeat(np.cumsum(count) - count, count)
        line = first[owner] + np.arange(len(owner)) - before
        owners.append(owner)
        shares.append((line - start[owner, axis]) / (end[owner, axis] - start[owner, axis]))
    owner, share = np.concatenate(owners), np.concatenate(shares)
    order = np.lexsort((share, owner))
    owner, share = owner[order], share[order]
    same = owner[1:] == owner[:-1]
    owner, t0, t1 = owner[1:][same], share[:-1][same], share[1:][same]
    span = end[owner] - start[owner]
    middle = start[owner] + span * ((t0 + t1) / 2)[:, None]
    return middle[:, 0], middle[:, 1], span[:, 1] * (t1 - t0)
