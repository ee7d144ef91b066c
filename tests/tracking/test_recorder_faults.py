"""The recorder when something fails: encoders that are late, break or hang, cameras that fail, empty segments."""

import asyncio
import threading

import numpy as np
import pytest
from av.codec.codec import UnknownCodecError

from lab.base.errors import RequestError
from lab.clock import run
from tests.tracking.filming import LiveCamera, read, until, virtual_camera
from tracking import segment
from tracking.recorder import EncoderSettings, Recorder, RecorderError
from tracking.segment import SegmentWriter, part_of


def test_a_broken_segment_is_told_at_its_close_and_the_next_one_works(tmp_path, monkeypatch):
    add = SegmentWriter.add

    def full(self, frame):
        if self.path.name == "0.mkv" and frame.index > 10:
            raise OSError(28, "No space left on device")
        add(self, frame)

    monkeypatch.setattr(SegmentWriter, "add", full)

    async def main():
        async with Recorder(virtual_camera()) as recorder:
            await recorder.open_segment(tmp_path / "0.mkv")
            await asyncio.sleep(1.0)
            with pytest.raises(RecorderError, match="No space left") as caught:
                await recorder.open_segment(tmp_path / "1.mkv")
            assert caught.value.path == tmp_path / "0.mkv"
            assert caught.value.exit_code == 1
            await asyncio.sleep(1.0)
            return await recorder.close_segment()

    info = run(main(), virtual=True)
    assert info.path == tmp_path / "1.mkv"
    assert len(read(info.path)[0]) == info.frames > 25
    # What was written of the broken one is kept for `recover`.
    assert part_of(tmp_path / "0.mkv").exists()
    assert not (tmp_path / "0.mkv").exists()


def test_a_close_that_fails_is_told(tmp_path, monkeypatch):
    async def main():
        async with Recorder(virtual_camera()) as recorder:
            await recorder.open_segment(tmp_path / "v.mkv")
            await asyncio.sleep(0.5)
            monkeypatch.setattr(segment, "_publish", lambda *paths: (_ for _ in ()).throw(OSError(5, "I/O error")))
            with pytest.raises(RecorderError, match="I/O error"):
                await recorder.close_segment()

    run(main(), virtual=True)
    assert not (tmp_path / "v.mkv").exists()
    assert part_of(tmp_path / "v.mkv").exists()


def test_a_camera_that_fails_is_told_and_its_frames_are_kept(tmp_path):
    async def main():
        async with Recorder(LiveCamera(20, fails=True)) as recorder:
            await recorder.open_segment(tmp_path / "v.mkv")
            await until(lambda: recorder.failure is not None)
            info = await recorder.close_segment()
            assert info.frames == 20
            with pytest.raises(RecorderError, match="cable is out"):
                await recorder.open_segment(tmp_path / "w.mkv")

    run(main(), virtual=False)
    assert len(read(tmp_path / "v.mkv")[0]) == 20


def test_an_error_in_whoever_listens_is_not_lost(tmp_path):
    def listen(frame):
        raise ValueError("the live page fell over")

    async def main():
        async with Recorder(virtual_camera(), on_frame=listen) as recorder:
            await asyncio.sleep(0.5)
            with pytest.raises(RecorderError, match="fell over"):
                await recorder.open_segment(tmp_path / "v.mkv")

    run(main(), virtual=True)


def test_a_segment_without_frames_leaves_no_file(tmp_path):
    async def main():
        async with Recorder(virtual_camera()) as recorder:
            await recorder.open_segment(tmp_path / "v.mkv")
            info = await recorder.close_segment()
            assert recorder.latest is None
            await asyncio.sleep(0.2)
            assert recorder.latest.index > 3
            return info

    info = run(main(), virtual=True)
    assert info.frames == info.dropped == 0
    assert np.isnan(info.t_first_s)
    assert list(tmp_path.iterdir()) == []


def test_wrong_requests_are_told(tmp_path):
    (tmp_path / "there.mkv").touch()

    async def main():
        recorder = Recorder(virtual_camera())
        assert await recorder.stop() is None
        with pytest.raises(RecorderError, match="start it first"):
            await recorder.open_segment(tmp_path / "v.mkv")
        async with recorder:
            with pytest.raises(RequestError, match="no such folder"):
                await recorder.open_segment(tmp_path / "none" / "v.mkv")
            with pytest.raises(RequestError, match="there already"):
                await recorder.open_segment(tmp_path / "there.mkv")
            with pytest.raises(RecorderError, match="no video segment is open"):
                await recorder.close_segment()

    run(main(), virtual=True)
    with pytest.raises(RequestError, match="not known"):
        EncoderSettings(codec="av1")


def test_an_encoder_that_hangs_is_given_up(tmp_path, monkeypatch):
    gate = threading.Event()
    monkeypatch.setattr(SegmentWriter, "add", lambda self, frame: gate.wait(10.0))

    async def main():
        recorder = Recorder(virtual_camera(), queue_frames=1, timeout_s=0.1)
        await recorder.start()
        await recorder.open_segment(tmp_path / "v.mkv")
        await asyncio.sleep(1.0)
        assert "took nothing" in str(recorder.failure)
        with pytest.raises(RecorderError, match="encoder"):
            await recorder.close_segment()
        gate.set()
        assert (await recorder.stop()).path == tmp_path / "v.mkv"

    run(main(), virtual=True)


def test_without_h264_auto_takes_motion_jpeg(monkeypatch):
    assert EncoderSettings().encoder() == "h264"

    def missing(name, mode):
        raise UnknownCodecError(name)

    monkeypatch.setattr(segment.av, "Codec", missing)
    assert EncoderSettings().encoder() == "mjpeg"
    with pytest.raises(RequestError, match="no H"):
        EncoderSettings(codec="h264").encoder()
