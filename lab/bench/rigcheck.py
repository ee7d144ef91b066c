"""Whether camera and projector still hang where they were calibrated: markers projected, and looked for."""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import Point

from lab.base.errors import ChordlabError
from lab.base.pinhole import Pinhole
from lab.bench.devices import SETTLE_S, Bench
from lab.settings.sections import ArenaSettings
from lab.settings.settings import Settings
from projector.patterns import Fiducials, fiducials
from projector.render import render

Floats = NDArray[np.float64]
Plane = NDArray[np.uint8]

MARKER_CM = 7.0
LIMIT_MM = 5.0
FEWEST_MARKERS = 3
_INWARD = (1.0, 0.95, 0.9, 0.85, 0.8, 0.75, 0.7)  # a corner that is not seen gives way to a place nearer the middle
_EDGE_PX = 4  # a marker nearer to the picture's edge may be cut


class RigError(ChordlabError):
    """Camera or projector was moved, or the markers cannot be seen. ``shift_mm``: by how much, NaN where unknown."""

    def __init__(self, message: str, shift_mm: float = math.nan) -> None:
        super().__init__(message)
        self.shift_mm = shift_mm


@dataclass(frozen=True, slots=True, eq=False)
class Landed:
    """Where projected markers were seen: meant and found, each (n, 2) in cm on the floor, and how many were shown."""

    meant_cm: Floats
    found_cm: Floats
    shown: int

    @property
    def off_mm(self) -> Floats:
        """How far each lies from where it was meant to."""
        return 10.0 * np.linalg.norm(self.found_cm - self.meant_cm, axis=1)

    @property
    def scale(self) -> float:
        """The size of what was seen by the size that was meant, of the best similarity (least squares)."""
        meant = self.meant_cm - self.meant_cm.mean(axis=0)
        found = self.found_cm - self.found_cm.mean(axis=0)
        along = float((meant * found).sum())
        across = float((meant[:, 0] * found[:, 1] - meant[:, 1] * found[:, 0]).sum())
        return math.hypot(along, across) / float((meant**2).sum())


@dataclass(frozen=True, slots=True)
class RigCheck:
    """How far the markers lie from where they should: ``shift_mm`` the farthest, of ``seen`` among ``shown``."""

    shift_mm: float
    rms_mm: float
    seen: int
    shown: int
    limit_mm: float

    @property
    def passed(self) -> bool:
        """Whether the rig still is as calibrated."""
        return self.seen >= FEWEST_MARKERS and self.shift_mm <= self.limit_mm

    def require(self) -> None:
        """Raise RigError, with the number that was seen, unless the check passed."""
        if self.seen < FEWEST_MARKERS:
            raise RigError(
                f"only {self.seen} of {self.shown} markers are seen on the floor: clear it, darken the room, "
                "or calibrate camera and projector again"
            )
        if not self.passed:
            raise RigError(
                f"projected markers lie up to {self.shift_mm:.1f} mm (limit {self.limit_mm:g}) from where they "
                "should: camera or projector was moved; run chordlab calibrate projector again",
                self.shift_mm,
            )


def rig_markers(arena: ArenaSettings, camera: Pinhole, projector: Pinhole) -> Fiducials:
    """Markers at the arena's corners and between them, or as near to there as both devices reach.

    Raises:
        RigError: fewer than three places that the projector lights and the camera sees.
    """
    # a marker with its rim fits, whichever way the wall runs
    inner = arena.polygon.buffer(-math.sqrt(2.0) * fiducials([(0.0, 0.0)], MARKER_CM).reach_cm, join_style="mitre")
    _, _, right, top = inner.bounds
    places: list[Floats] = []
    for x, y in ((-1, -1), (1, -1), (-1, 1), (1, 1), (0, -1), (0, 1), (-1, 0), (1, 0)):
        edge = inner.exterior.interpolate(inner.exterior.project(Point(x * right, y * top)))
        inward = (share * np.array([edge.x, edge.y]) for share in _INWARD)
        place = next((place for place in inward if _in_view(place, MARKER_CM, (camera, projector))), None)
        if place is not None:
            places.append(place)
    return _enough(places, 8, MARKER_CM)


def markers_in_view(places_cm: Floats, size_cm: float, camera: Pinhole, projector: Pinhole) -> Fiducials:
    """Markers at those of the places where the projector reaches and the camera sees all of them.

    Raises:
        RigError: fewer than three.
    """
    kept = [place for place in places_cm if _in_view(place, size_cm, (camera, projector))]
    return _enough(kept, len(places_cm), size_cm)


def _enough(kept: list[Floats], wanted: int, size_cm: float) -> Fiducials:
    if len(kept) < FEWEST_MARKERS:
        raise RigError(
            f"camera and projector share only {len(kept)} of {wanted} places on the arena's floor: "
            "aim both at all of it, then calibrate again"
        )
    return fiducials(kept, size_cm)


def _in_view(place_cm: Floats, size_cm: float, devices: tuple[Pinhole, ...]) -> bool:
    """Whether all devices reach all of a marker on the floor."""
    reach_cm = fiducials(place_cm, size_cm).reach_cm
    corners = place_cm + reach_cm * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    points = np.column_stack([corners, np.zeros(4)])
    return all(_inside(device.project(points), device.image_size) for device in devices)


def _inside(pixels: Floats, size: tuple[int, int]) -> bool:
    return bool(((pixels >= _EDGE_PX) & (pixels <= np.array(size) - 1 - _EDGE_PX)).all())


def look_for(markers: Fiducials, luma: Plane, camera: Pinhole) -> Landed:
    """Find projected markers in a camera's picture and carry their middles to the floor."""
    seen = markers.find(luma)
    numbers = sorted(seen)
    found = [camera.to_plane(seen[number], 0.0).mean(axis=0) for number in numbers]
    return Landed(markers.centres_cm[numbers], np.array(found).reshape(-1, 2), len(markers.centres_cm))


def rig_picture(arena: ArenaSettings, camera: Pinhole, projector: Pinhole) -> Plane:
    """What the projector must show for `check_rig`. Raises RigError where too few markers can be seen."""
    return render(rig_markers(arena, camera, projector).lit, projector, 0.0)


def check_rig(
    luma: Plane, arena: ArenaSettings, camera: Pinhole, projector: Pinhole, *, limit_mm: float = LIMIT_MM
) -> RigCheck:
    """Compare a camera's picture of `rig_picture` with where the calibrations say the markers are.

    Args:
        luma: the camera's picture (h, w) while the projector shows `rig_picture`.
        arena: the floor.
        camera: as calibrated.
        projector: as calibrated.
        limit_mm: how far a marker may be off.

    Raises:
        RigError: too few markers can be seen by these calibrations.
    """
    landed = look_for(rig_markers(arena, camera, projector), luma, camera)
    off_mm = landed.off_mm if len(landed.off_mm) else np.array([np.nan])
    return RigCheck(
        shift_mm=float(off_mm.max()),
        rms_mm=float(np.sqrt((off_mm**2).mean())),
        seen=len(landed.found_cm),
        shown=landed.shown,
        limit_mm=limit_mm,
    )


async def check_bench(bench: Bench, settings: Settings) -> RigCheck | None:
    """Look, on a session's open bench, whether the rig still hangs as calibrated; None where no camera watches.

    Raises:
        RigError: it does not, or the markers cannot be seen.
    """
    recorder = bench.recorder
    if recorder is None or settings.camera.startswith(("file:", "replay:")) or settings.rig_limit_mm == 0:
        return None
    camera, projector = settings.camera_optics.pinhole(), settings.projector_optics.pinhole()
    bench.show(rig_picture(settings.arena, camera, projector))
    await asyncio.sleep(2 * SETTLE_S)
    if recorder.latest is None:
        raise RigError("the camera gives no picture: check that no other program holds it, and its cable")
    found = check_rig(recorder.latest.luma, settings.arena, camera, projector, limit_mm=settings.rig_limit_mm)
    found.require()
    return found
