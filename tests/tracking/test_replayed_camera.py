"""A stored film as a camera: every frame with its stamps, copied without loss."""

import asyncio

import av
import numpy as np
import pandas as pd
import pytest

from lab.base.timeline import Timeline
from lab.clock import run
from tracking.cameras import Camera, CameraError, Frame, pack_i420
from tracking.coded import coded_frames
from tracking.recorder import EncoderSettings, Recorder
from tracking.replayed import ReplayedCamera, StoredSegment
from tracking.segment import SegmentWriter, frames_table

RATE_HZ = 20.0


def film(path, first, count, *, codec="h264", t_host_s=0.0):
    """A film of noise, so that what is encoded again is not the same."""
    rng = np.random.default_rng(first)
    writer = SegmentWriter(path, EncoderSettings(codec=codec), RATE_HZ)
    for number in range(first, first + count):
        luma = rng.integers(0, 255, (48, 64), dtype=np.uint8)
        t_s = number / RATE_HZ
        writer.add(Frame(number, t_s, t_host_s + t_s + 0.004, pack_i420(luma)))
    writer.close()
    return path


def packets(path):
    with av.open(str(path)) as container:
        return [(packet.pts, bytes(packet)) for packet in container.demux(video=0) if packet.size]


@pytest.fixture
def segments(tmp_path):
    (tmp_path / "old").mkdir()
    return [
        StoredSegment(film(tmp_path / "old" / "a.mkv", 0, 30), ("begun", 0)),
        StoredSegment(film(tmp_path / "old" / "b.mkv", 33, 25), ("begun", 1)),
    ]


def copied(segments, out, *, begin=(0.0, 33 / RATE_HZ)):
    """Record a replay of two runs into ``out``; its segments."""

    async def main():
        timeline = Timeline()
        camera = ReplayedCamera("replay:old", segments, RATE_HZ, timeline)
        made = []
        async with Recorder(camera) as recorder:
            assert isinstance(camera, Camera)
            loop = asyncio.get_running_loop()
            await asyncio.sleep(12.0)  # nothing comes before the first run
            assert recorder.latest is None
            for number, t_s in enumerate(begin):
                await recorder.open_segment(out / f"{number}.mkv")
                timeline.begin_s(t_s, loop.time())
                timeline.reach(("begun", number))
                await asyncio.sleep(1.6)
                made.append(await recorder.close_segment())
        return made

    return run(main(), virtual=True)


@pytest.mark.parametrize("codec", ["h264", "mjpeg"])
def test_a_recorder_copies_the_film_bit_for_bit(tmp_path, codec):
    old = [StoredSegment(film(tmp_path / f"old{n}.mkv", 33 * n, 25, codec=codec), ("begun", n)) for n in range(2)]
    made = copied(old, tmp_path)
    for segment, new in zip(old, made, strict=True):
        assert new.codec == codec
        assert packets(new.path) == packets(segment.path)


def test_the_stamps_are_the_stored_ones_on_the_new_clock(segments, tmp_path):
    for segment, new in zip(segments, copied(segments, tmp_path), strict=True):
        before, after = (pd.read_parquet(frames_table(path)) for path in (segment.path, new.path))
        pd.testing.assert_frame_equal(before[["index", "t_camera_s"]], after[["index", "t_camera_s"]])
        shift_s = after["t_host_s"] - before["t_host_s"]
        assert np.ptp(shift_s) < 1e-9
        assert shift_s.iloc[0] >= 12.0


def test_a_gap_in_the_film_is_counted_as_it_was(segments, tmp_path):
    assert [segment.dropped for segment in copied(segments, tmp_path)] == [0, 3]


def test_the_second_piece_waits_for_its_run(segments):
    async def main():
        timeline = Timeline()
        camera = ReplayedCamera("replay:old", segments, RATE_HZ, timeline)
        await camera.start()
        timeline.begin_s(0.0, asyncio.get_running_loop().time())
        timeline.reach(("begun", 0))
        frames = [await camera.next_frame() for _ in range(30)]
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(camera.next_frame(), 100.0)
        return [frame.index for frame in frames]

    assert run(main(), virtual=True) == list(range(30))


def test_it_ends_after_the_last_frame_and_when_it_is_stopped(segments):
    async def main():
        timeline = Timeline()
        camera = ReplayedCamera("replay:old", segments[:1], RATE_HZ, timeline)
        await camera.start()
        assert camera.size == (64, 48)
        waiting = asyncio.create_task(camera.next_frame())
        await asyncio.sleep(1.0)
        await camera.stop()
        assert await waiting is None
        await camera.start()
        timeline.begin_s(0.0, asyncio.get_running_loop().time())
        return [await camera.next_frame() is None for _ in range(31)]

    assert run(main(), virtual=True) == [False] * 30 + [True]


def test_without_a_key_frame_at_its_head_the_film_is_encoded_again(segments, tmp_path):
    """A segment that begins in the middle of a stored one cannot be copied, and is whole all the same."""

    async def main():
        timeline = Timeline()
        async with Recorder(ReplayedCamera("replay:old", segments, RATE_HZ, timeline)) as recorder:
            timeline.begin_s(0.0, asyncio.get_running_loop().time())
            timeline.reach(("begun", 0))
            await asyncio.sleep(5.5 / RATE_HZ)
            await recorder.open_segment(tmp_path / "late.mkv")
            await asyncio.sleep(2.0)
            return await recorder.close_segment()

    made = run(main(), virtual=True)
    assert made.frames == 24
    with av.open(str(made.path)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 24


def test_no_film_and_a_film_that_is_none_are_told(tmp_path):
    with pytest.raises(CameraError, match="set camera to none"):
        ReplayedCamera("replay:x", [], RATE_HZ, Timeline())
    (tmp_path / "x.mkv").write_bytes(b"no film")
    assert coded_frames(tmp_path / "x.mkv") == []
    with pytest.raises(CameraError, match="not started"):
        _ = ReplayedCamera("replay:x", [StoredSegment(tmp_path / "x.mkv", ("begun", 0))], RATE_HZ, Timeline()).size
