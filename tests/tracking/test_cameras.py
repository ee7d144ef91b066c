"""Cameras: what a device string opens, a file played at its own times, a USB camera and its faults."""

import asyncio
import itertools
import logging
import threading
import time
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.base.errors import RequestError
from lab.clock import run
from tracking.cameras import (
    Camera,
    CameraError,
    CameraRequestError,
    Frame,
    chroma_planes,
    pack_i420,
)
from tracking.opening import open_camera
from tracking.playback import FileCamera
from tracking.usb import UsbCamera, UsbSettings
from tracking.video import VideoError

TIMES_MS = [500, 533, 600, 700, 701, 1500]


@pytest.fixture
def clip(tmp_path):
    path = tmp_path / "clip.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 36, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for number, t_ms in enumerate(TIMES_MS):
            picture = np.full((54, 64), 100 + number, dtype=np.uint8)
            picture[36:45] = 90
            frame = av.VideoFrame.from_ndarray(picture, format="yuv420p")
            frame.pts, frame.time_base = t_ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@given(st.integers(1, 20), st.integers(1, 20), st.integers(0, 2**32 - 1))
def test_packing_is_the_layout_that_opencv_and_ffmpeg_use(half_w, half_h, seed):
    rng = np.random.default_rng(seed)
    luma = rng.integers(0, 256, (2 * half_h, 2 * half_w), dtype=np.uint8)
    u, v = rng.integers(0, 256, (2, half_h, half_w), dtype=np.uint8)
    packed = pack_i420(luma, (u, v))
    frame = av.VideoFrame.from_ndarray(packed, format="yuv420p")
    for number, plane in enumerate((luma, u, v)):
        held = frame.planes[number]
        rows = np.frombuffer(held, np.uint8).reshape(-1, held.line_size)[: held.height, : held.width]
        assert np.array_equal(rows, plane)
    ours = Frame(0, 0.0, 0.0, packed)
    assert np.array_equal(ours.luma, luma)
    assert all(np.array_equal(a, b) for a, b in zip(ours.chroma, (u, v), strict=True))
    assert ours.size == (2 * half_w, 2 * half_h)


def test_grey_is_packed_without_colour_and_odd_sizes_are_refused():
    packed = pack_i420(np.full((4, 6), 50))
    bgr = cv2.cvtColor(packed, cv2.COLOR_YUV2BGR_I420)
    assert np.ptp(bgr) == 0
    assert all((plane == 128).all() for plane in chroma_planes(packed))
    with pytest.raises(CameraRequestError, match="7x4"):
        pack_i420(np.zeros((4, 7)))


@pytest.mark.parametrize("device", ["virtual", "usb", "usb:", "usb:front", "webcam:0", "", "file:"])
def test_device_strings_that_name_no_camera(device):
    with pytest.raises(CameraRequestError) as caught:
        open_camera(device)
    assert caught.value.device == device
    assert caught.value.exit_code == 2
    assert "\n" not in str(caught.value)


def test_device_strings_that_do(clip):
    usb = open_camera("usb:2", rate_hz=60.0, size=(640, 480))
    assert isinstance(usb, Camera)
    assert (usb.name, usb.rate_hz, usb.size, usb.live) == ("usb:2", 60.0, (640, 480), True)
    assert open_camera("usb:0").size == (1280, 720)
    file = open_camera(f"file:{clip}")
    assert file.name == f"file:{clip}"
    assert file.live is False


def test_a_file_plays_at_its_own_times_on_the_loops_clock(clip):
    async def main():
        camera = FileCamera(clip)
        with pytest.raises(CameraError, match="not started"):
            _ = camera.size
        await asyncio.sleep(3.0)
        await camera.start()
        assert isinstance(camera, Camera)
        frames = []
        while (frame := await camera.next_frame()) is not None:
            frames.append(frame)
        size = camera.size
        await camera.stop()
        assert await camera.next_frame() is None
        return frames, size

    frames, size = run(main(), virtual=True)
    assert size == (64, 36)
    assert [round(frame.t_camera_s * 1000) for frame in frames] == TIMES_MS
    assert np.allclose([frame.t_host_s for frame in frames], 3.0 + (np.array(TIMES_MS) - 500) / 1000)
    assert [frame.index for frame in frames] == list(range(6))
    assert [int(frame.luma[3, 3]) for frame in frames] == [100 + number for number in range(6)]
    assert all((frame.chroma[0] == 90).all() for frame in frames)


def test_a_file_that_cannot_be_played(tmp_path):
    with pytest.raises(VideoError, match="no such"):
        run(FileCamera(tmp_path / "none.mkv").start(), virtual=True)


def test_a_file_camera_stopped_while_it_waits(clip):
    async def main():
        camera = FileCamera(clip)
        await camera.start()
        await camera.next_frame()
        waiting = asyncio.create_task(camera.next_frame())
        await asyncio.sleep(0.001)
        await camera.stop()
        return await waiting

    assert run(main(), virtual=True) is None


class Device:
    """Stands for cv2.VideoCapture: gives frames with the stamps of a script, then blocks or fails."""

    def __init__(
        self, stamps_ms, *, opened=True, refuses=(), size=(64, 48), then_fails=False, bad=(), wait_s=0.001, keeps=()
    ):
        self.stamps = list(stamps_ms)
        self.opened, self.refuses, self.size, self.then_fails, self.bad = opened, refuses, size, then_fails, bad
        self.wait_s, self.at, self.released, self.asked = wait_s, -2, False, {}
        self.keeps = dict(keeps)
        self.more = threading.Event()

    def isOpened(self):
        return self.opened

    def set(self, prop, value):
        self.asked[prop] = value
        return prop not in self.refuses

    def get(self, prop):
        if prop == cv2.CAP_PROP_FPS:
            return 30.0
        if prop in self.asked and prop != cv2.CAP_PROP_POS_MSEC:
            return self.keeps.get(prop, self.asked[prop])
        return float(self.stamps[min(max(self.at, 0), len(self.stamps) - 1)])

    def grab(self):
        time.sleep(self.wait_s)
        self.at += 1  # the first grab is the trial at opening
        if self.at < len(self.stamps):
            return True
        if not self.then_fails:
            self.more.wait(5.0)
        return False

    def retrieve(self):
        picture = np.full((self.size[1], self.size[0], 3), 60 + max(self.at, 0), dtype=np.uint8)
        return self.at not in self.bad, picture

    def release(self):
        self.released = True
        self.more.set()


SETTINGS = UsbSettings(size=(64, 48), timeout_s=2.0, waiting_frames=100)


def film(device, count, settings=SETTINGS):
    async def main():
        camera = UsbCamera(0, settings, opener=lambda number: device)
        await camera.start()
        try:
            return camera, [await camera.next_frame() for _ in range(count)]
        finally:
            device.more.set()
            await camera.stop()
            assert await camera.next_frame() is None

    return run(main(), virtual=False)


def test_a_usb_camera_gives_frames_with_two_clocks():
    stamps = [5000.0 + 33.3 * k for k in range(8)]
    device = Device(stamps)
    before_s = time.monotonic()
    camera, frames = film(device, 8)
    assert device.released
    assert camera.dropped == 0
    assert camera.not_held == ()
    assert [frame.index for frame in frames] == list(range(8))
    assert np.allclose([frame.t_camera_s for frame in frames], (np.array(stamps) - 5000.0) / 1000.0)
    host = [frame.t_host_s for frame in frames]
    assert host == sorted(host)
    assert before_s <= host[0] <= host[-1] <= time.monotonic()
    # BT.601, limited range: grey g has luma 16 + 219 g / 255.
    assert [int(frame.luma[0, 0]) for frame in frames] == [round(16 + 219 * (60 + k) / 255) for k in range(8)]
    assert device.asked[cv2.CAP_PROP_AUTO_EXPOSURE] == 1.0
    assert device.asked[cv2.CAP_PROP_AUTOFOCUS] == 0.0
    assert cv2.CAP_PROP_EXPOSURE not in device.asked


def test_gaps_in_the_stamps_are_dropped_frames():
    numbers = [0, 1, 2, 3, 6, 7, 8, 10, 11]
    camera, frames = film(Device([1000.0 + 33.3 * k for k in numbers]), len(numbers))
    assert [frame.index for frame in frames] == numbers
    assert camera.dropped == 3


def test_a_camera_that_slows_down_in_the_dark_drops_nothing_in_the_end():
    at_30_hz = [33.3 * k for k in range(1, 31)]
    at_15_hz = [at_30_hz[-1] + 66.7 * k for k in range(1, 61)]
    camera, frames = film(Device(at_30_hz + at_15_hz), 90)
    # Until half of the last 30 intervals are long ones they pass for losses, after that no more.
    assert camera.dropped <= 16
    assert [b.index - a.index for a, b in itertools.pairwise(frames[50:])] == [1] * 39


def test_without_a_driver_stamp_the_hosts_clock_serves():
    camera, frames = film(Device([0.0] * 5, wait_s=0.034), 5)
    first = frames[0].t_host_s
    assert np.allclose([frame.t_camera_s for frame in frames], [frame.t_host_s - first for frame in frames])
    standing, frames = film(Device([7.0] * 5, wait_s=0.034), 5)
    assert frames[-1].t_camera_s > 0.09
    assert camera.name == standing.name == "usb:0"


def test_what_the_driver_will_not_hold_is_warned_of(caplog):
    settings = UsbSettings(size=(32, 24), exposure=-6.0, focus=10.0, timeout_s=2.0)
    with caplog.at_level(logging.WARNING, "tracking.usb"):
        camera, _ = film(Device([1.0, 34.0], refuses={cv2.CAP_PROP_AUTOFOCUS, cv2.CAP_PROP_EXPOSURE}), 2, settings)
    assert camera.not_held == ("focus", "exposure time")
    assert "does not hold focus, exposure time" in caplog.text
    assert "64x48 pixels instead of 32x24" in caplog.text
    assert camera.size == (64, 48)


def test_a_driver_that_says_yes_and_does_nothing_is_found_out():
    """Read back: aperture priority (3) is automatic exposure, shutter priority (2) is not; a focus that stays away."""
    settings = UsbSettings(size=(64, 48), focus=10.0, timeout_s=2.0)
    lying = {cv2.CAP_PROP_AUTO_EXPOSURE: 3.0, cv2.CAP_PROP_AUTOFOCUS: 1.0, cv2.CAP_PROP_FOCUS: 250.0}
    camera, _ = film(Device([1.0, 34.0], keeps=lying), 2, settings)
    assert camera.not_held == ("exposure", "focus", "focus distance")
    honest = {cv2.CAP_PROP_AUTO_EXPOSURE: 2.0, cv2.CAP_PROP_FOCUS: 10.5}
    camera, _ = film(Device([1.0, 34.0], keeps=honest), 2, settings)
    assert camera.not_held == ()


def test_a_frame_that_cannot_be_decoded_is_counted():
    camera, frames = film(Device([33.0 * k for k in range(1, 7)], bad={2}), 5)
    assert [frame.index for frame in frames] == [0, 1, 3, 4, 5]
    assert camera.dropped == 1


def test_frames_that_nobody_takes_are_dropped_and_counted():
    async def main():
        device = Device([33.0 * k for k in range(1, 21)])
        camera = UsbCamera(0, UsbSettings(size=(64, 48), timeout_s=2.0, waiting_frames=4), opener=lambda n: device)
        await camera.start()
        for _ in range(2000):
            if device.at >= 20:
                break
            await asyncio.sleep(0.002)
        await asyncio.sleep(0.01)
        taken = [await camera.next_frame() for _ in range(4)]
        device.more.set()
        await camera.stop()
        return camera, taken

    camera, taken = run(main(), virtual=False)
    assert [frame.index for frame in taken] == [0, 1, 2, 3]
    assert camera.dropped >= 16


@pytest.mark.parametrize(
    ("device", "settings", "says"),
    [
        (Device([], opened=False), SETTINGS, "no camera there"),
        (Device([33.0, 66.0], then_fails=True), SETTINGS, "stopped giving frames"),
        (Device([33.0]), UsbSettings(size=(64, 48), timeout_s=0.1), "no frame for 0.1 s"),
    ],
)
def test_a_camera_that_fails_says_so(device, settings, says):
    with pytest.raises(CameraError, match=says) as caught:
        film(device, 5, settings)
    assert caught.value.device == "usb:0"
    assert caught.value.exit_code == 1


def test_a_camera_that_gives_nothing_at_opening():
    device = Device([33.0])
    device.grab = lambda: False
    with pytest.raises(CameraError, match="gives no picture"):
        film(device, 1)
    assert device.released


def test_a_failure_is_told_even_when_frames_are_waiting():
    async def main():
        device = Device([33.0 * k for k in range(1, 6)], then_fails=True)
        camera = UsbCamera(0, UsbSettings(size=(64, 48), timeout_s=2.0, waiting_frames=3), opener=lambda n: device)
        await camera.start()
        for _ in range(2000):
            if device.released:
                break
            await asyncio.sleep(0.002)
        await asyncio.sleep(0.01)
        with pytest.raises(CameraError, match="stopped giving"):
            for _ in range(4):
                await camera.next_frame()
        await camera.stop()

    run(main(), virtual=False)


def test_an_odd_picture_is_refused():
    with pytest.raises(RequestError, match="even"):
        film(Device([33.0], size=(63, 48)), 1)


def test_opencv_says_when_there_is_no_camera():
    async def main():
        camera = UsbCamera(97, UsbSettings(timeout_s=5.0))
        await camera.start()

    with pytest.raises(CameraError, match="usb:97"):
        run(main(), virtual=False)
