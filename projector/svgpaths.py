"""What an SVG paints, as rings of points: the one place that meets svgelements, which carries no types."""
# svgelements is untyped: what it returns is turned into plain floats and arrays before it leaves this module
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingTypeStubs=false

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import svgelements
from numpy.typing import NDArray

from projector.fill import FillRule

Floats = NDArray[np.float64]

PIXELS_PER_INCH = 96.0  # CSS's reference pixel
CURVE_POINTS = 64
_SHARE: Floats = np.arange(1, CURVE_POINTS + 1) / CURVE_POINTS
_STRAIGHT = (svgelements.Move, svgelements.Line, svgelements.Close)
_WHITE = re.compile(r"^(white|#fff|#ffffff|rgb\(\s*255\s*,\s*255\s*,\s*255\s*\))$", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Painted:
    """One filled element: its rings (n, 2) in CSS pixels, y down; ``white`` is the colour of the paper.

    ``open_rings`` of them end elsewhere than they start; a fill closes them.
    """

    rings: list[Floats]
    rule: FillRule
    white: bool
    open_rings: int


def painted(data: bytes) -> list[Painted]:
    """All filled elements in the order of painting, transforms applied.

    Raises ValueError where a path or a length cannot be read.
    """
    document: Any = svgelements.SVG.parse(io.BytesIO(data), ppi=PIXELS_PER_INCH, reify=False, on_error="raise")
    if not isinstance(document, svgelements.SVG):
        raise ValueError("no svg element at the root")
    found: list[Painted] = []
    for element in document.elements():
        if isinstance(element, svgelements.Shape) and _is_filled(values := _values(element)):
            colour = str(values.get("fill", "black"))
            rule: FillRule = "evenodd" if values.get("fill-rule") == "evenodd" else "nonzero"
            # abs applies the transform that a rotated or skewed element still carries
            rings = _rings(abs(svgelements.Path(element)))
            if rings:
                open_rings = sum(not np.allclose(ring[0], ring[-1], rtol=1e-6, atol=1e-6) for ring in rings)
                found.append(Painted(rings, rule, bool(_WHITE.match(colour.strip())), open_rings))
    return found


def _values(element: Any) -> dict[str, Any]:
    """The element's properties, inherited ones included."""
    return dict(element.values or {})


def _is_filled(values: dict[str, Any]) -> bool:
    """Whether the element's fill is seen: it has one, and neither it nor the element is transparent."""
    if str(values.get("fill", "black")).strip().lower() in ("none", "transparent"):
        return False
    if values.get("visibility") in ("hidden", "collapse"):
        return False
    return all(_opacity(values.get(key)) > 0 for key in ("opacity", "fill-opacity"))


def _opacity(value: Any) -> float:
    try:
        return float(str(value).rstrip("%")) if value is not None else 1.0
    except ValueError:
        return 1.0


def _rings(path: Any) -> list[Floats]:
    """Every subpath as a ring: filling closes what is open."""
    rings: list[Floats] = []
    for subpath in path.as_subpaths():
        points: list[Floats] = []
        for segment in subpath:
            if isinstance(segment, _STRAIGHT):
                if segment.end is not None:
                    points.append(np.array([[segment.end.x, segment.end.y]], dtype=float))
            else:
                points.append(np.asarray(segment.npoint(_SHARE), dtype=float).reshape(-1, 2))
        ring = np.vstack(points) if points else np.empty((0, 2))
        if len(ring) >= 3:
            rings.append(ring)
    return rings
