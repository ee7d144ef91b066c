"""The recorder: what was filmed is what can be read, frame by frame, whatever goes wrong meanwhile."""

import asyncio
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pandas as pd
import pytest

from lab.base.pinhole import Pinhole
from lab.clock import run
from tests.tracking.filming import SIZE, LiveCamera, film, read, until, virtual_camera
from tracking.cameras import Frame
from tracking.recorder import EncoderSettings, Recorder
from tracking.segment import SegmentWriter, frames_table, late_frames, part_of
from tracking.synthetic import RobotView
from tracking.virtual import VirtualCamera


@pytest.mark.parametrize("codec", ["h264", "mjpeg"])
@pytest.mark.parametrize("bit_rate", [None, 4_000_000])
def test_rows_are_frames_and_pts_is_the_cameras_clock(tmp_path, codec, bit_rate):
    settings = EncoderSettings(codec=codec, max_bit_rate=bit_rate)
    camera = virtual_camera(drop_probability=0.05, clock_drift_ppm=300.0)
    closed, given = run(film(camera, tmp_path, [2.0, 1.5, 3.0], settings), virtual=True)
    assert sum(info.frames for info in closed) == len(given)
    at = 0
    for number, info in enumerate(closed):
        frames, damage = read(info.path)
        table = pd.read_parquet(frames_table(info.path))
        mine = given[at : at + info.frames]
        at += info.frames
        assert damage is None
        assert info.path == tmp_path / f"{number}.mkv"
        assert info.codec == codec
        assert len(frames) == len(table) == info.frames
        assert list(table.columns) == ["frame", "index", "t_camera_s", "t_host_s", "dropped_before"]
        assert table["frame"].tolist() == list(range(len(frames)))
        assert table["index"].tolist() == [frame.index for frame in mine]
        assert table["t_camera_s"].tolist() == [frame.t_camera_s for frame in mine]
        assert table["t_host_s"].tolist() == [frame.t_host_s for frame in mine]
        assert np.abs([f.t_s - m.t_camera_s for f, m in zip(frames, mine, strict=True)]).max() <= 0.001
        assert (info.t_first_s, info.t_last_s) == (mine[0].t_camera_s, mine[-1].t_camera_s)
        assert info.dropped == table["dropped_before"].sum()
        for decoded, filmed in zip(frames, mine, strict=True):
            assert np.abs(decoded.luma.astype(int) - filmed.luma).mean() < 4
    # Nothing is lost between segments: every number is there, or counted as dropped.
    assert sum(info.dropped for info in closed) == camera.dropped - given[0].index
    assert given[-1].index + 1 == len(given) + camera.dropped


def test_frames_lost_between_two_segments_are_counted_in_the_second(tmp_path):
    class Skips(LiveCamera):
        live = False

        async def next_frame(self):
            await asyncio.sleep(0.1)
            self.at += 1
            picture = np.full((SIZE[1] * 3 // 2, SIZE[0]), 100, dtype=np.uint8)
            index = self.at if self.at <= 3 else self.at + 5
            return Frame(index, index / 10.0, asyncio.get_running_loop().time(), picture)

    (first, second), _ = run(film(Skips(100), tmp_path, [0.35, 0.3]), virtual=True)
    assert (first.frames, first.dropped) == (3, 0)
    assert (second.frames, second.dropped) == (3, 5)
    assert pd.read_parquet(frames_table(second.path))["dropped_before"].tolist() == [5, 0, 0]


def test_the_led_survives_the_encoder(tmp_path):
    def truth(t_s):
        return 40 * np.sin(t_s), 25 * np.cos(t_s)

    optics = Pinhole.looking_down((640, 360), height_cm=205.0, field_width_cm=165.0)
    camera = VirtualCamera(
        optics,
        lambda x, y, h: np.full(np.shape(x), 20.0),
        lambda t_s: [RobotView(*truth(t_s), 1.0)],
        np.random.default_rng(4),
    )
    [info], given = run(film(camera, tmp_path, [2.0]), virtual=True)
    errors = []
    for decoded, filmed in zip(read(info.path)[0], given, strict=True):
        u, v = optics.project([(*truth(filmed.t_host_s), 7.3)])[0]
        left, top = int(u) - 8, int(v) - 8
        patch = decoded.luma[top : top + 17, left : left + 17].astype(float)
        weight = np.clip(patch - 45.0, 0, None)
        columns, rows = np.arange(left, left + 17), np.arange(top, top + 17)
        errors.append([(weight.sum(0) @ columns) / weight.sum() - u, (weight.sum(1) @ rows) / weight.sum() - v])
    assert np.sqrt(np.mean(np.square(errors))) < 0.25


def test_a_file_has_its_name_only_when_it_is_whole(tmp_path):
    async def main():
        first, second = tmp_path / "a.mkv", tmp_path / "b.mkv"
        async with Recorder(virtual_camera()) as recorder:
            await recorder.open_segment(first)
            assert recorder.segment == first
            await asyncio.sleep(1.0)
            assert not first.exists()
            assert part_of(first).exists()
            await recorder.open_segment(second)
            assert first.exists()
            assert frames_table(first).exists()
            assert not part_of(first).exists()
            await asyncio.sleep(1.0)
            info = await recorder.stop()
            assert info.path == second
            assert info.frames > 25
        assert sorted(path.name for path in tmp_path.iterdir()) == [
            "a.frames.parquet",
            "a.mkv",
            "b.frames.parquet",
            "b.mkv",
        ]

    run(main(), virtual=True)


def test_two_runs_of_one_seed_are_the_same_files(tmp_path):
    def once(name):
        folder = tmp_path / name
        folder.mkdir()
        closed, _ = run(film(virtual_camera(7, drop_probability=0.1), folder, [1.0, 1.0]), virtual=True)
        pictures = [frame.luma.tobytes() for info in closed for frame in read(info.path)[0]]
        return pictures, [(info.frames, info.dropped, info.t_first_s) for info in closed]

    assert once("a") == once("b")


def test_a_killed_recorder_leaves_a_part_that_can_be_read(tmp_path):
    script = textwrap.dedent("""
        import os, signal, sys
        from pathlib import Path
        import numpy as np
        from tracking.cameras import Frame
        from tracking.segment import EncoderSettings, SegmentWriter

        still = np.full((135, 160), 90, dtype=np.uint8)  # a few bytes a frame: nothing fills a buffer by itself
        writer = SegmentWriter(Path(sys.argv[1]), EncoderSettings(), 30.0)
        for number in range(150):
            writer.add(Frame(number, number / 30.0, number / 30.0, still))
        os.kill(os.getpid(), signal.SIGKILL)
    """)
    path = tmp_path / "v.mkv"
    search = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    ended = subprocess.run([sys.executable, "-c", script, str(path)], env=search, timeout=60, check=False)
    assert ended.returncode == -signal.SIGKILL
    assert not path.exists()
    frames, damage = read(part_of(path))
    # At most the last second and the cluster before it are lost.
    assert len(frames) >= 90
    assert [frame.index for frame in frames] == list(range(len(frames)))
    assert frames[-1].t_s == pytest.approx((len(frames) - 1) / 30.0, abs=0.001)
    assert "never closed" in damage


def test_a_segment_cut_short_still_gives_most_of_its_frames(tmp_path):
    [info], _ = run(film(virtual_camera(drop_probability=0.0), tmp_path, [10.0]), virtual=True)
    data = info.path.read_bytes()
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(data[: int(len(data) * 0.8)])
    frames, damage = read(cut)
    assert 200 < len(frames) < 260
    assert damage is not None


def test_a_live_camera_drops_and_counts_when_the_encoder_is_behind(tmp_path, monkeypatch):
    gate = threading.Event()
    add = SegmentWriter.add

    def slow(self, frame):
        gate.wait(10.0)
        add(self, frame)

    monkeypatch.setattr(SegmentWriter, "add", slow)
    camera = LiveCamera(40)

    async def main():
        async with Recorder(camera, queue_frames=4) as recorder:
            await recorder.open_segment(tmp_path / "v.mkv")
            await until(lambda: camera.at >= 35)
            gate.set()
            await until(lambda: camera.at >= 40)
            await asyncio.sleep(0.05)
            return await recorder.close_segment(), recorder.dropped

    info, dropped = run(main(), virtual=False)
    table = pd.read_parquet(frames_table(info.path))
    assert dropped >= 25
    # Frames lost after the last one that was written cannot stand before any.
    assert info.frames + dropped == 40
    assert table["dropped_before"].sum() == table["index"].iloc[-1] + 1 - info.frames == info.dropped
    assert len(read(info.path)[0]) == info.frames


def test_orders_wait_for_room_even_when_frames_do_not(tmp_path, monkeypatch):
    add = SegmentWriter.add

    def slow(self, frame):
        time.sleep(0.03)
        add(self, frame)

    monkeypatch.setattr(SegmentWriter, "add", slow)

    async def main():
        async with Recorder(LiveCamera(30), queue_frames=1) as recorder:
            await recorder.open_segment(tmp_path / "a.mkv")
            await asyncio.sleep(0.03)
            first = await recorder.open_segment(tmp_path / "b.mkv")
            await asyncio.sleep(0.03)
            return first, await recorder.close_segment()

    first, second = run(main(), virtual=False)
    assert first.frames > 0
    assert (tmp_path / "a.mkv").exists()
    assert second.path == tmp_path / "b.mkv"


def test_a_virtual_camera_waits_for_a_slow_encoder(tmp_path, monkeypatch):
    add = SegmentWriter.add

    def slow(self, frame):
        time.sleep(0.004)
        add(self, frame)

    monkeypatch.setattr(SegmentWriter, "add", slow)
    camera = virtual_camera(drop_probability=0.0)
    [info], given = run(film(camera, tmp_path, [3.0], queue_frames=2), virtual=True)
    assert info.frames == len(given) in range(88, 91)
    assert info.dropped == camera.dropped == 0


def test_late_is_more_than_half_a_period_after_the_shortest_way():
    camera = np.arange(6) / 30.0
    way = np.array([0.080, 0.050, 0.066, 0.068, 0.050, 0.200])
    assert late_frames(camera, 1000.0 + camera + way, 30.0) == 3
    assert late_frames(camera, 1000.0 + camera + way, 5.0) == 1
    assert late_frames([], [], 30.0) == 0
