"""Reading videos: planes and times against what was drawn, turned pictures against OpenCV, damaged files."""

import logging
import wave
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from tracking.video import FrameReader, VideoError, probe, read_frames, sample_frames

W, H = 96, 64


def drawn(number: int, width: int = W, height: int = H) -> np.ndarray:
    """A picture that differs in every corner and in every frame, packed I420."""
    rng = np.random.default_rng(number)
    luma = np.add.outer(np.arange(height), np.arange(width)) * 255 // (width + height)
    packed = np.full((height * 3 // 2, width), 128, dtype=np.uint8)
    packed[:height] = luma
    packed[5:15, 5 + number % 40 : 15 + number % 40] = 250
    packed[height:] = rng.integers(90, 160, size=(height // 2, width))
    return packed


def write(path, n=30, *, times_ms=None, codec="ffv1", pix_fmt="yuv420p", size=(W, H), turn=0, gop=12, copy_to=None):
    times = list(range(0, 40 * n, 40)) if times_ms is None else times_ms
    options = {} if copy_to is None else {"cluster_time_limit": "200", "flush_packets": "1"}
    container = av.open(str(path), "w", options=options)
    stream = container.add_stream(codec, rate=25)
    stream.width, stream.height = size
    stream.pix_fmt = pix_fmt
    stream.gop_size = gop
    stream.codec_context.time_base = Fraction(1, 1000)
    if turn:
        stream.set_display_rotation(turn)
    for number, t_ms in enumerate(times):
        frame = av.VideoFrame.from_ndarray(drawn(number, *size), format="yuv420p")
        if pix_fmt not in {"yuv420p", "yuvj420p"}:
            frame = frame.reformat(format=pix_fmt)
        frame.pts, frame.time_base = t_ms, Fraction(1, 1000)
        container.mux(stream.encode(frame))
    if copy_to is not None:
        copy_to.write_bytes(path.read_bytes())  # before the file is closed: what a killed process leaves
    container.mux(stream.encode(None))
    container.close()
    return path


def test_planes_and_times_are_those_that_were_written(tmp_path):
    times_ms = [1000, 1033, 1070, 1071, 1200, 1300, 1700]
    path = write(tmp_path / "v.mkv", times_ms=times_ms)
    with read_frames(path) as reader:
        frames = list(reader)
    assert reader.damage is None
    assert [frame.index for frame in frames] == list(range(7))
    assert [round(frame.t_s * 1000) for frame in frames] == times_ms
    for number, frame in enumerate(frames):
        truth = drawn(number)
        assert frame.luma.dtype == np.uint8
        assert np.array_equal(frame.luma, truth[:H])
        u, v = frame.chroma()
        assert np.array_equal(np.concatenate([u.ravel(), v.ravel()]), truth[H:].ravel())


def test_lines_with_padding_are_cut(tmp_path):
    path = write(tmp_path / "v.mkv", 3, size=(90, 50))
    for number, frame in enumerate(read_frames(path)):
        assert np.array_equal(frame.luma, drawn(number, 90, 50)[:50])


@pytest.mark.parametrize(
    ("codec", "pix_fmt"),
    [("ffv1", "yuv422p"), ("ffv1", "yuv444p"), ("ffv1", "yuv420p10le"), ("ffv1", "bgra"), ("mjpeg", "yuvj420p")],
)
def test_other_layouts_give_8_bit_luma_and_quarter_size_colour(tmp_path, codec, pix_fmt):
    path = write(tmp_path / "v.mkv", 4, codec=codec, pix_fmt=pix_fmt)
    frames = list(read_frames(path))
    assert len(frames) == 4
    for number, frame in enumerate(frames):
        assert frame.luma.dtype == np.uint8
        # 10-bit, RGB and Motion JPEG lose a little; none may lose the picture.
        assert np.abs(frame.luma.astype(int) - drawn(number)[:H]).mean() < 8
        u, v = frame.chroma()
        assert u.shape == v.shape == (H // 2, W // 2)
        assert abs(float(u.mean()) - 125) < 6
        assert round(frame.t_s * 1000) == 40 * number


def test_a_grey_video_has_no_colour(tmp_path):
    path = write(tmp_path / "v.mkv", 3, pix_fmt="gray")
    frame = next(read_frames(path))
    assert frame.chroma() is None
    assert frame.luma.shape == (H, W)


@pytest.mark.parametrize("turn", [90, -90, 180])
def test_turned_pictures_come_upright_as_in_opencv(tmp_path, turn):
    path = write(tmp_path / "v.mp4", 5, codec="libx264", turn=turn)
    capture = cv2.VideoCapture(str(path))
    _, bgr = capture.read()
    capture.release()
    theirs = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY).astype(int)
    frame = next(read_frames(path))
    assert frame.luma.shape == theirs.shape
    assert probe(path).size == (theirs.shape[1], theirs.shape[0])
    assert frame.luma.flags.c_contiguous
    u, _ = frame.chroma()
    assert u.shape == (theirs.shape[0] // 2, theirs.shape[1] // 2)
    # Limited-range luma against full-range grey: same picture, another scale.
    assert np.corrcoef(frame.luma.ravel(), theirs.ravel())[0, 1] > 0.98


def test_probe_tells_size_count_and_length(tmp_path):
    info = probe(write(tmp_path / "v.mkv", 50, times_ms=[5000 + 40 * k for k in range(50)]))
    assert info.size == (W, H)
    assert abs(info.n_frames - 50) <= 1
    assert info.duration_s == pytest.approx(2.0, abs=0.05)
    assert info.start_s == pytest.approx(5.0)
    assert info.rate_hz == pytest.approx(25.0, rel=0.02)
    assert info.rotation_deg == 0
    assert info.codec == "ffv1"


def test_what_is_no_video_is_told_in_one_line(tmp_path):
    (tmp_path / "empty.mkv").touch()
    (tmp_path / "text.mp4").write_text("not a video, only words\n" * 50)
    with wave.open(str(tmp_path / "sound.wav"), "wb") as sound:
        sound.setnchannels(1)
        sound.setsampwidth(2)
        sound.setframerate(8000)
        sound.writeframes(bytes(8000))
    cases = {
        "missing.mkv": "no such",
        "empty.mkv": "empty",
        "text.mp4": "mp4 cut short",
        "sound.wav": "no video stream",
    }
    for name, says in cases.items():
        for opener in (read_frames, probe, sample_frames):
            with pytest.raises(VideoError, match=says) as caught:
                opener(tmp_path / name)
            assert "\n" not in str(caught.value)
            assert caught.value.path == tmp_path / name
            assert caught.value.exit_code == 2


@pytest.mark.parametrize("keep", [0.3, 0.6, 0.95])
def test_a_file_cut_short_gives_its_good_frames_and_says_so(tmp_path, caplog, keep):
    whole = write(tmp_path / "whole.mkv", 60)
    cut = tmp_path / "cut.mkv"
    data = whole.read_bytes()
    cut.write_bytes(data[: int(len(data) * keep)])
    with caplog.at_level(logging.WARNING, "tracking.video"), read_frames(cut) as reader:
        frames = list(reader)
    assert 60 * keep - 4 < len(frames) <= 60 * keep + 1
    assert np.array_equal(frames[-1].luma, drawn(len(frames) - 1)[:H])
    assert "frames are good" in reader.damage
    assert str(cut) in caplog.text


def test_a_file_that_was_never_closed_is_read(tmp_path):
    copy = tmp_path / "copy.mkv"
    write(tmp_path / "v.mkv", 40, copy_to=copy)
    with read_frames(copy) as reader:
        frames = list(reader)
    assert len(frames) > 10
    assert reader.info.n_frames == 0
    assert "never closed" in reader.damage
    assert len(sample_frames(copy, 5)) == 5


def packets_of(path):
    with av.open(str(path)) as container:
        return [(packet.pos, packet.size) for packet in container.demux() if packet.size]


def test_damaged_frames_in_the_middle_are_left_out_and_told(tmp_path, caplog):
    path = write(tmp_path / "v.mkv", 40, codec="mjpeg", pix_fmt="yuvj420p")
    data = bytearray(path.read_bytes())
    for place, size in packets_of(path)[20:23]:
        # Inside the packet, past Matroska's block header: the file's structure stays whole.
        data[place + 10 : place + size] = b"\xab" * (size - 10)
    path.write_bytes(data)
    with read_frames(path) as reader:
        numbers = [round(frame.t_s * 25) for frame in reader]
    assert [number for number in numbers if number not in {20, 21, 22}] == [*range(20), *range(23, 40)]
    assert "could not be decoded" in reader.damage
    assert "could not be decoded" in caplog.text


def test_frames_without_a_time_stamp_follow_at_the_stated_rate(tmp_path):
    whole = write(tmp_path / "v.mkv", 20, codec="libx264")
    raw = tmp_path / "v.h264"
    with av.open(str(whole)) as source, av.open(str(raw), "w", format="h264") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                packet.stream = stream
                target.mux(packet)
    with read_frames(raw) as reader:
        times = [frame.t_s for frame in reader]
    assert reader.damage is None
    assert len(times) == 20
    assert np.allclose(np.diff(times), 1 / probe(raw).rate_hz)


def test_headers_without_frames_are_an_error(tmp_path):
    whole = write(tmp_path / "whole.mkv", 30)
    place, _ = packets_of(whole)[0]
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(whole.read_bytes()[: place + 5])
    with pytest.raises(VideoError, match=r"not one frame|cannot be read"):
        list(read_frames(cut))


@pytest.mark.parametrize(("n", "gop"), [(10, 5), (45, 12), (700, 50)])
def test_sampled_frames_are_spread_over_the_video(tmp_path, n, gop):
    path = write(tmp_path / "v.mkv", n, codec="libx264", gop=gop)
    frames = sample_frames(path, 15)
    times = np.array([frame.t_s for frame in frames])
    assert len(times) == min(15, n)
    assert (np.diff(times) > 0).all()
    assert times[0] < 0.12 * n * 0.04
    assert times[-1] > 0.85 * n * 0.04
    assert np.diff(times).max() < 3 * n * 0.04 / min(15, n)
    for frame in frames:
        # The moving square tells which frame it is: a seek must not hand out another one under its time.
        truth = drawn(round(frame.t_s * 25))[:H]
        assert np.abs(frame.luma.astype(int) - truth).mean() < 6


def test_a_reader_can_seek_and_go_on(tmp_path):
    path = write(tmp_path / "v.mkv", 50, gop=10)
    with FrameReader(path, threads=1) as reader:
        reader.seek(1.0)
        frame = next(reader)
        assert frame.t_s <= 1.0
        assert frame.t_s > 0.5
        assert np.array_equal(frame.luma, drawn(round(frame.t_s * 25))[:H])
