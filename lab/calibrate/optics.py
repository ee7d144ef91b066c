"""Calibrates the bench's camera with a printed board, and its projector with the calibrated camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.base.errors import ChordlabError, RequestError
from lab.base.pinhole import Pinhole
from lab.bench.rigcheck import Landed, look_for, markers_in_view
from lab.calibrate.boardviews import CoverageError, Views, film_board, stored_views
from lab.calibrate.stage import LOOKS, Operator, Stage, Step, open_stage
from lab.clock import run as run_on_clock
from lab.settings.settings import Settings
from projector.calibrate import Beforehand, ProjectorFit, fit_projector
from projector.patterns import chessboard, crosses
from projector.render import render
from tracking.board import Board
from tracking.calibration import Calibration
from tracking.camerafit import CameraFit, fit_camera
from tracking.charuco import BoardDetector, Collector, Coverage, View

Floats = NDArray[np.float64]
Plane = NDArray[np.uint8]
Say = Callable[[str], None]

VIEWS = 25
FARTHEST_OFF_MM = 5.0
_MOVED_PX = 2.0  # a corner of the picture that a raised sheet has shifted
_VERIFY_CM = 6.0
_VERIFY_GRID = (5, 4)
_TAPE_CM = 0.2
_FEWEST_ON_SHEET = 6


class PlacementError(ChordlabError):
    """The calibrated projector misses where it is told to shine. ``off_mm``: by how much."""

    def __init__(self, message: str, off_mm: float) -> None:
        super().__init__(message)
        self.off_mm = off_mm


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibrated:
    """A camera's calibration, how well it fits, and what the views covered."""

    calibration: Calibration
    fit: CameraFit
    coverage: Coverage


@dataclass(frozen=True, slots=True, eq=False)
class ProjectorCalibrated:
    """A projector's calibration.

    Attributes:
        fit: pose and lens.
        landed: markers projected through it that the fit had not seen; None where nobody measured.
        sensor_std_mm: one standard deviation of a place in the sensor's plane, the worst in the arena.
        assumed: what was not measured but taken from the settings.
    """

    fit: ProjectorFit
    landed: Landed | None
    sensor_std_mm: float
    assumed: str | None

    def summary(self) -> dict[str, Any]:
        """The figures for a report or a JSON object."""
        landed = self.landed
        off_mm = None if landed is None else landed.off_mm
        return {
            **self.fit.summary(),
            "sensor_std_mm": self.sensor_std_mm,
            "assumed": self.assumed,
            "verified": None
            if landed is None or off_mm is None
            else {
                "markers": len(off_mm),
                "rms_mm": float(np.sqrt((off_mm**2).mean())),
                "worst_mm": float(off_mm.max()),
                "scale": landed.scale if len(off_mm) > 1 else None,
            },
        }


def calibrate_camera(
    settings: Settings, board: Board, operator: Operator, *, views: int = VIEWS, source: Path | None = None,
    origin_s: float | None = None, say: Say,
) -> CameraCalibrated:  # fmt: skip
    """Calibrate the camera with a board that somebody holds and lays down, live or from pictures.

    Args:
        settings: the bench.
        board: as printed.
        operator: who moves the board.
        views: how many of the held board.
        source: a video, or a folder of pictures, in the place of the bench's camera.
        origin_s: when the board lies at the origin, in a video; None: at its end.
        say: told what is still missing.

    Raises:
        CoverageError: the views do not show enough.
        CameraFitError: they do not fit together.
        ChordlabError: the camera fails.
    """
    if source is not None:
        seen = stored_views(source, board, origin_s)
    else:
        if settings.camera == "none":
            raise RequestError('a calibration needs a camera: set camera = "usb:0" in the settings, or give --from')

        async def on_stage() -> Views:
            async with open_stage(settings, operator, board=board) as stage:
                return await film_board(stage, board, views, say)

        seen = run_on_clock(on_stage(), virtual=settings.is_virtual)
    collector = Collector(board, seen.size)
    collector.take(seen.held)
    missing = collector.coverage.missing
    if missing:
        raise CoverageError(f"the views do not show enough; show also {'; '.join(missing)}", missing)
    fit = fit_camera(board, seen.size, seen.held, seen.origin, seen.floor)
    return CameraCalibrated(Calibration(fit.optics, settings.led.height_cm), fit, collector.coverage)


def calibrate_projector(
    settings: Settings, operator: Operator, *, raised_cm: float | None = None, say: Say
) -> ProjectorCalibrated:
    """Calibrate the projector: it shows a chessboard, and the calibrated camera sees where that falls.

    The chessboard is seen on the floor, and on a sheet ``raised_cm`` above it where there is one: only then is the
    projector's distance measured; else it is taken from the settings, to 10 cm.

    Raises:
        RequestError: no camera that is calibrated, or the sheet is too low to tell.
        ProjectorFitError: too little of the picture is seen.
        PlacementError: a second picture, not used in the fit, does not fall where it should.
        ChordlabError: a device fails.
    """
    if settings.camera == "none" or (not settings.is_virtual and settings.camera_optics.calibration is None):
        raise RequestError(
            "the projector is measured by a calibrated camera: run chordlab calibrate camera and set "
            "camera_optics.calibration, or measure with a tape (--by-hand)"
        )
    camera = settings.camera_optics.pinhole()

    async def on_stage() -> ProjectorCalibrated:
        async with open_stage(settings, operator, projector=True, raised_cm=raised_cm) as stage:
            return await _by_camera(stage, settings, camera, raised_cm, say)

    return run_on_clock(on_stage(), virtual=settings.is_virtual)


async def _by_camera(
    stage: Stage, settings: Settings, camera: Pinhole, raised_cm: float | None, say: Say
) -> ProjectorCalibrated:
    """Chessboard on the sheet and on the floor, the fit, and markers to verify it."""
    pattern = chessboard(stage.image_size)
    detector = BoardDetector(pattern.board)
    on_sheet: View | None = None
    await stage.show(pattern.image)
    if raised_cm is not None:
        await stage.operator.ask(Step.SHEET)
        on_sheet = _seen(detector, await stage.look(LOOKS), camera)
    await stage.operator.ask(Step.CLEAR)
    on_floor = _seen(detector, await stage.look(LOOKS), camera)
    say(f"{len(on_floor.numbers)} of {len(pattern.corners_px)} corners of the projected chessboard on the floor")
    points, pixels = [_raised(camera, on_floor, 0.0)], [pattern.corners_px[on_floor.numbers]]
    if on_sheet is not None and raised_cm is not None:
        shifted = _shifted(on_sheet, on_floor)
        say(f"{len(shifted.numbers)} of them on the sheet, {raised_cm:g} cm above it")
        points.append(_raised(camera, shifted, raised_cm))
        pixels.append(pattern.corners_px[shifted.numbers])
    fit = fit_projector(
        np.concatenate(points), np.concatenate(pixels), stage.image_size, _beforehand(settings, stage.image_size)
    )
    _, _, right, top = settings.arena.lines_within.bounds
    across, down = (np.linspace(-0.85, 0.85, n) * half for n, half in zip(_VERIFY_GRID, (right, top), strict=True))
    markers = markers_in_view(
        np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2), _VERIFY_CM, camera, fit.optics
    )
    await stage.show(render(markers.lit, fit.optics, 0.0))
    landed = look_for(markers, await stage.look(LOOKS), camera)
    if 2 * len(landed.found_cm) < landed.shown:
        raise PlacementError(
            f"only {len(landed.found_cm)} of {landed.shown} markers projected to verify the fit are seen; "
            "clear the floor, darken the room, and calibrate again", math.nan,
        )  # fmt: skip
    return _checked(fit, landed, settings, assumed=raised_cm is None)


def _seen(detector: BoardDetector, luma: Plane, camera: Pinhole) -> View:
    """The projected chessboard in a picture of the camera's calibrated size."""
    if (luma.shape[1], luma.shape[0]) != tuple(camera.image_size):
        raise RequestError(
            f"the camera gives {luma.shape[1]}x{luma.shape[0]} pixels but was calibrated at "
            f"{camera.image_size[0]}x{camera.image_size[1]}; calibrate it at the size that is used"
        )
    view = detector.find(luma)
    if view is None:
        raise RequestError(
            "the camera does not see the projected chessboard: darken the room, fix the exposure, focus both, "
            "and switch off the projector's mirror and rear modes"
        )
    return view


def _raised(camera: Pinhole, view: View, height_cm: float) -> Floats:
    """The arena's points (n, 3) that the camera sees in a plane."""
    return np.column_stack([camera.to_plane(view.pixels, height_cm), np.full(len(view.numbers), height_cm)])


def _shifted(on_sheet: View, on_floor: View) -> View:
    """The corners that the sheet has moved in the camera's picture: the others still fall on the floor beside it.

    Raises:
        RequestError: the sheet moves too few, so that what lies on it cannot be told.
    """
    _, here, there = np.intersect1d(on_sheet.numbers, on_floor.numbers, return_indices=True)
    moved = np.linalg.norm(on_sheet.pixels[here] - on_floor.pixels[there], axis=1) > _MOVED_PX
    keep = np.zeros(len(on_sheet.numbers), dtype=bool)
    keep[here[moved]] = True
    if keep.sum() < _FEWEST_ON_SHEET:
        raise RequestError(
            f"the sheet shifts only {int(keep.sum())} corners of the picture: raise it to 10 cm or more, "
            "take a larger one, or leave --raised-cm out"
        )
    return on_sheet.keeping(keep)


def _beforehand(settings: Settings, image_size: tuple[int, int]) -> Beforehand:
    """What the settings say of the projector, for an image of this size."""
    nominal = settings.projector_optics.pinhole()
    grown = image_size[0] / nominal.image_size[0]
    matrix = np.diag([grown, grown, 1.0]) @ nominal.camera_matrix
    return Beforehand.of(replace(nominal, image_size=image_size, camera_matrix=matrix))


def _checked(fit: ProjectorFit, landed: Landed | None, settings: Settings, *, assumed: bool) -> ProjectorCalibrated:
    """Refuse a fit that misses; else say how well it does in the plane that matters."""
    if landed is not None:
        worst_mm = float(landed.off_mm.max())
        if worst_mm > FARTHEST_OFF_MM:
            raise PlacementError(
                f"markers fall up to {worst_mm:.1f} mm from where they should (limit {FARTHEST_OFF_MM:g}); is the "
                "floor flat, and does nothing move? Switch off the projector's keystone correction and calibrate again",
                worst_mm,
            )
    places = np.asarray(settings.arena.lines_within.exterior.coords, dtype=float)[:, :2]
    sensor_std_cm = fit.spread_cm(places, settings.sensor.height_cm)
    x_cm, y_cm, z_cm = (round(value) for value in settings.projector_optics.pinhole().centre_cm.tolist())
    return ProjectorCalibrated(
        fit=fit,
        landed=landed,
        sensor_std_mm=10.0 * float(sensor_std_cm.max()),
        assumed=f"the lens hangs at ({x_cm}, {y_cm}, {z_cm}) cm to 10 cm each way, as the settings say"
        if assumed
        else None,
    )


def calibrate_by_hand(settings: Settings, operator: Operator, *, say: Say) -> ProjectorCalibrated:
    """Calibrate the projector without a camera: five crosses, measured with a tape; the fifth verifies the others.

    Raises:
        ProjectorFitError: the points lie on one line, or are mirrored.
        PlacementError: the fifth is not where the other four say.
        ChordlabError: the projector fails.
    """

    async def on_stage() -> ProjectorCalibrated:
        async with open_stage(settings, operator, camera=False, projector=True) as stage:
            picture, pixels = crosses(stage.image_size)
            await stage.show(picture)
            await stage.operator.ask(Step.CROSSES)
            places = np.array([await stage.operator.measure(number) for number in range(len(pixels))])
            points = np.column_stack([places, np.zeros(len(places))])
            known = _beforehand(settings, stage.image_size)
            fit = fit_projector(points[:-1], pixels[:-1], stage.image_size, known, error_cm=_TAPE_CM)
            say(f"four crosses fit to {10 * fit.rms_cm:.1f} mm")
            landed = Landed(places[-1:], fit.optics.to_plane(pixels[-1:], 0.0), 1)
            return _checked(fit, landed, settings, assumed=True)

    return run_on_clock(on_stage(), virtual=settings.is_virtual)
