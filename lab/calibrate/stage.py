"""The bench while it is calibrated: camera, projector, and somebody who moves things when asked.

On the virtual bench the somebody is virtual too: the same steps put a printed board or a raised sheet before
the virtual camera.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from lab.bench.devices import SETTLE_S, keep_alive
from lab.settings.settings import Settings
from projector.device import ProjectorDevice
from projector.opening import open_projector
from projector.patterns import crosses
from projector.virtual import LightSettings, VirtualProjector
from tracking.board import Board
from tracking.boardscene import StagedCamera, board_scene, held, laid
from tracking.cameras import Camera, CameraError, Frame
from tracking.opening import open_camera
from tracking.synthetic import CameraSettings, LightAt, OverheadScene

Floats = NDArray[np.float64]
Plane = NDArray[np.uint8]

LOOKS = 8  # pictures that are averaged where nothing moves
_PUMP_EVERY_S = 0.5
_SHEET_CM = (100.0, 70.0)
_TAPE_ERROR_CM = 0.1


class Step(StrEnum):
    """What the operator is asked to do, as it is told."""

    HOLD = "Hold the board before the camera: here and there, near and far, tilted every way, each time still."
    ORIGIN = "Lay the board flat on the floor: its centre on the arena's centre, its x arrow to the arena's right."
    FLOOR = "Slide the board over the floor, flat; stop in each of the arena's corners, and between them."
    SHEET = "Lay the raised sheet on the floor: flat, level, in the middle of the arena."
    CLEAR = "Clear the floor, and step back."
    CROSSES = "Measure where the five crosses fall, with a tape from the arena's centre: x to the right, y up, in cm."


Ask = Callable[[Step], Awaitable[None]]
Measure = Callable[[int], Awaitable[tuple[float, float]]]


@dataclass(frozen=True, slots=True)
class Operator:
    """The somebody: ``ask`` returns when a step is done, ``measure`` tells where the numbered cross falls, cm."""

    ask: Ask
    measure: Measure


@dataclass(frozen=True, slots=True)
class Stage:
    """Open devices and the operator."""

    camera: Camera | None
    projector: ProjectorDevice | None
    operator: Operator

    async def look(self, frames: int) -> Plane:
        """The mean of the next so many pictures (h, w), to have less noise.

        Raises:
            CameraError: the camera ends before.
        """
        since_s = asyncio.get_running_loop().time()
        luma: list[Plane] = []
        while len(luma) < frames:
            frame = await self._next_frame()
            if frame.t_host_s >= since_s:  # others waited in the camera's queue while the operator was busy
                luma.append(frame.luma)
        return np.rint(np.mean(luma, axis=0)).astype(np.uint8)

    async def next_luma(self) -> Plane:
        """The next picture. Raises CameraError when there is none."""
        return (await self._next_frame()).luma

    async def _next_frame(self) -> Frame:
        if self.camera is None:
            raise RequestError('there is no camera on this bench; set camera = "usb:0" in the settings')
        frame = await self.camera.next_frame()
        if frame is None:
            raise CameraError(self.camera.name, f"{self.camera.name}: no more frames; start the camera again")
        return frame

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) of the projector's image."""
        return self._light.image_size

    @property
    def _light(self) -> ProjectorDevice:
        if self.projector is None:
            raise RequestError('there is no projector on this bench; set projector = "display:1" in the settings')
        return self.projector

    async def show(self, picture: Plane) -> None:
        """Show a picture and wait until the camera sees it."""
        self._light.show(picture)
        changed = getattr(self.camera, "scene_changed", None)
        if changed is not None:
            changed()
        if self.camera is None:
            return
        loop = asyncio.get_running_loop()
        until_s = loop.time() + SETTLE_S
        while loop.time() < until_s:  # frames that were under way show the picture before
            await self.next_luma()


@asynccontextmanager
async def open_stage(
    settings: Settings,
    operator: Operator,
    *,
    camera: bool = True,
    projector: bool = False,
    board: Board | None = None,
    raised_cm: float | None = None,
) -> AsyncGenerator[Stage]:
    """Open what a calibration needs of the bench that the settings name; the robots are left alone.

    ``operator`` is asked on a real bench; ``board`` and ``raised_cm`` are what the virtual one moves about.

    Raises:
        ChordlabError: a device cannot be opened.
    """
    async with AsyncExitStack() as stack:
        if settings.is_virtual:
            virtual = _VirtualStage(settings, board or Board(), raised_cm)
            eye = virtual.camera if camera and settings.camera != "none" else None
            light = virtual.projector if projector else None
            operator = virtual.operator
        else:
            eye = open_camera(settings.camera) if camera and settings.camera != "none" else None
            size = settings.projector_optics.pinhole().image_size
            light = open_projector(settings.projector, image_size=size) if projector else None
        if light is not None:
            stack.callback(light.close)
            window = asyncio.create_task(keep_alive(light))
            stack.callback(window.cancel)
        if eye is not None:
            await eye.start()
            stack.push_async_callback(eye.stop)
        yield Stage(eye, light, operator)


class _VirtualStage:
    """A virtual camera and projector, and the hands that move board and sheet."""

    def __init__(self, settings: Settings, board: Board, raised_cm: float | None) -> None:
        physics = settings.virtual
        self._truth, projector_truth = settings.true_optics()
        self._board = board
        self._raised_cm = raised_cm
        _, _, right, top = settings.arena.polygon.bounds
        self._reach_cm = np.array([right, top])
        self._rng = np.random.default_rng(settings.seeds()[0])
        self._sees = CameraSettings(noise_sigma=physics.camera_noise, ambient_lux=physics.ambient_lux)
        light = LightSettings(
            ambient_lux=physics.ambient_lux,
            black_lux=physics.black_lux,
            white_lux=physics.white_lux,
            blur_px=physics.blur_px,
        )
        self.projector = VirtualProjector(projector_truth, light)
        self.camera = StagedCamera(self._truth.image_size, physics.camera_rate_hz)
        self.operator = Operator(self._do, self._measure)
        self.camera.film([self._floor()])

    async def _do(self, step: Step) -> None:
        if step is Step.HOLD:
            poses = held(self._truth, self._board, self._rng)
            self.camera.film((self._with_board(pose) for pose in poses), frames_each=2)
        elif step is Step.ORIGIN:
            self.camera.film([self._with_board(laid(self._truth, 0.0, 0.0))])
        elif step is Step.FLOOR:
            self.camera.film((self._with_board(pose) for pose in self._corners()), frames_each=2)
        elif step is Step.SHEET:
            self.camera.film([self._sheet(self._raised_cm or 0.0)])
        else:
            self.camera.film([self._floor()])

    async def _measure(self, number: int) -> tuple[float, float]:
        _, pixels = crosses(self.projector.image_size)
        x_cm, y_cm = self.projector.pinhole.to_plane(pixels[number : number + 1], 0.0)[0]
        x_error, y_error = self._rng.normal(0.0, _TAPE_ERROR_CM, 2)
        return float(x_cm + x_error), float(y_cm + y_error)

    def _corners(self) -> list[Pinhole]:
        """The board laid in each of the arena's corners and between them, turned anyhow."""
        poses: list[Pinhole] = []
        for x, y in ((-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0)):
            place = np.array([x, y]) * self._reach_cm * self._rng.uniform(0.6, 0.7, 2)
            poses.append(laid(self._truth, float(place[0]), float(place[1]), float(self._rng.uniform(-0.5, 0.5))))
        return poses

    def _with_board(self, pose: Pinhole) -> OverheadScene:
        return board_scene(self._truth, pose, self._board, self._rng, self._sees)

    def _floor(self) -> OverheadScene:
        return OverheadScene(self._truth, self.projector.light_at, self._rng, self._sees)

    def _sheet(self, height_cm: float) -> OverheadScene:
        """A sheet over the floor, drawn in its own plane; what is seen past its edge lies on the floor below."""
        raised = replace(self._truth, tvec=self._truth.tvec + self._truth.rotation @ np.array([0.0, 0.0, height_cm]))
        eye = self._truth.centre_cm
        onward = eye[2] / (eye[2] - height_cm)
        half_x, half_y = (side / 2 for side in _SHEET_CM)

        def light_at(x_cm: Floats, y_cm: Floats, _height_cm: float) -> Floats:
            on = (np.abs(x_cm) < half_x) & (np.abs(y_cm) < half_y)
            floor_x, floor_y = eye[0] + (x_cm - eye[0]) * onward, eye[1] + (y_cm - eye[1]) * onward
            return np.where(
                on, self.projector.light_at(x_cm, y_cm, height_cm), self.projector.light_at(floor_x, floor_y, 0.0)
            )

        light: LightAt = light_at
        return OverheadScene(raised, light, self._rng, self._sees)
