"""The virtual overhead camera: frames of a drawn scene, taken on the event loop's timers."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence

import numpy as np

from lab.base.pinhole import Pinhole
from tracking.cameras import Frame
from tracking.synthetic import CameraSettings, LightAt, OverheadScene, RobotView

__all__ = ["CameraSettings", "RobotView", "VirtualCamera"]


class VirtualCamera:
    """A camera that draws what it sees; speaks the ``Camera`` protocol.

    It never runs ahead of whoever takes its frames, so on a clock of jumping time nothing is lost but
    the frames that ``drop_probability`` asks for, and a run repeats from its seed. Where time is real
    and the taker is late, it drops frames as a real camera would.

    Args:
        optics: the camera's true pose and lens.
        light_at: (x_cm, y_cm, height_cm) -> lux, the projected light.
        robots: t_s on the loop's clock -> what there is to see of each robot at that moment.
        rng: noise and drops are drawn from it.
        settings: how the camera sees, its rate and its faults.
        light_from_cm: the projector's optical centre where the ball is to throw a shadow, else None.
    """

    name = "virtual"
    live = False

    def __init__(
        self,
        optics: Pinhole,
        light_at: LightAt,
        robots: Callable[[float], Sequence[RobotView]],
        rng: np.random.Generator,
        settings: CameraSettings | None = None,
        *,
        light_from_cm: Sequence[float] | None = None,
    ) -> None:
        self.settings = settings or CameraSettings()
        scene_rng, self._drop_rng = rng.spawn(2)
        self.scene = OverheadScene(optics, light_at, scene_rng, self.settings, light_from_cm=light_from_cm)
        self._robots = robots
        self._dropped = 0
        self._next_index = 0
        self._start_s: float | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.scene.optics.image_size

    @property
    def rate_hz(self) -> float:
        """Frames a second."""
        return self.settings.rate_hz

    @property
    def dropped(self) -> int:
        """Frames lost so far."""
        return self._dropped

    def scene_changed(self) -> None:
        """Say that the projector shows another image."""
        self.scene.scene_changed()

    async def start(self) -> None:
        """Start the camera's clock; the first frame is one period away."""
        self._start_s = asyncio.get_running_loop().time()
        self._next_index = 0

    async def next_frame(self) -> Frame | None:
        """Wait for the next frame's moment and draw it; None when the camera is stopped."""
        loop = asyncio.get_running_loop()
        while (start_s := self._start_s) is not None:
            index = self._next_index
            due_s = start_s + (index + 1) / self.rate_hz
            late = math.floor((loop.time() - due_s) * self.rate_hz)
            if late >= 1:
                self._next_index += late
                self._dropped += late
                continue
            self._next_index += 1
            # The wait is at most one period long; a stop in the meantime is seen after it.
            await asyncio.sleep(due_s - loop.time())
            if self._start_s != start_s:
                continue
            if self._drop_rng.random() < self.settings.drop_probability:
                self._dropped += 1
                continue
            now_s = loop.time()
            picture = self.scene.render(self._robots(now_s))
            t_camera_s = (now_s - start_s) * (1.0 + 1e-6 * self.settings.clock_drift_ppm)
            return Frame(index=index, t_camera_s=t_camera_s, t_host_s=now_s, i420=picture)
        return None

    async def stop(self) -> None:
        """Stop; a frame that is being waited for comes back as None."""
        self._start_s = None
