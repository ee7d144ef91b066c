"""Cameras to film with, and what they and the recorder gave."""

import asyncio

import numpy as np

from lab.base.pinhole import Pinhole
from tracking.cameras import CameraError, Frame
from tracking.recorder import Recorder
from tracking.synthetic import CameraSettings, RobotView
from tracking.video import read_frames
from tracking.virtual import VirtualCamera

SIZE = (160, 90)
OPTICS = Pinhole.looking_down(SIZE, height_cm=205.0, field_width_cm=165.0)


def floor(x_cm, y_cm, height_cm):
    return np.where(np.hypot(x_cm, y_cm) < 20, 120.0, 20.0)


def virtual_camera(seed=1, **more) -> VirtualCamera:
    def robots(t_s):
        return [RobotView(40 * np.sin(t_s), 25 * np.cos(t_s), 1.0)]

    return VirtualCamera(OPTICS, floor, robots, np.random.default_rng(seed), CameraSettings(**more))


class LiveCamera:
    """A camera that gives frames whether or not anyone can take them."""

    name, size, rate_hz, dropped, live = "fake", SIZE, 30.0, 0, True

    def __init__(self, frames, fails=False):
        self.frames, self.fails, self.at = frames, fails, 0

    async def start(self):
        self.at = 0

    async def next_frame(self):
        await asyncio.sleep(0.002)
        if self.at >= self.frames:
            if self.fails:
                raise CameraError("fake", "fake: the cable is out")
            return None
        self.at += 1
        picture = np.full((SIZE[1] * 3 // 2, SIZE[0]), 40 + self.at, dtype=np.uint8)
        return Frame(self.at - 1, self.at / 30.0, asyncio.get_running_loop().time(), picture)

    async def stop(self):
        self.at = self.frames


async def until(condition):
    """Wait on the real clock, at most 10 s."""
    for _ in range(5000):
        if condition():
            return
        await asyncio.sleep(0.002)
    raise TimeoutError


async def film(camera, folder, seconds, settings=None, **more):
    """Film one segment after the other; their records, and every frame that the camera gave."""
    given, closed = [], []
    async with Recorder(camera, settings, on_frame=given.append, **more) as recorder:
        for number, length_s in enumerate(seconds):
            before = await recorder.open_segment(folder / f"{number}.mkv")
            closed += [before] if before else []
            await asyncio.sleep(length_s)
        closed.append(await recorder.close_segment())
    return closed, given


def read(path):
    with read_frames(path) as reader:
        frames = list(reader)
    return frames, reader.damage
