"""The film of a session in one file: which pictures, at which times."""

import base64
import json
import shutil
from pathlib import Path

import av
import cv2
import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader

from lab.cli.main import main
from tracking.cameras import Frame, pack_i420
from tracking.segment import EncoderSettings, SegmentWriter
from tracking.video import read_frames


def pieces(folder: Path) -> list[Path]:
    """The film's pieces by time, as their own tables of frames tell."""
    videos = sorted(folder.glob("lines/*/video.mkv"))
    return sorted(videos, key=lambda video: pd.read_parquet(video.with_name("video.frames.parquet"))["t_host_s"].min())


def pictures(path: Path) -> list[tuple[float, bytes]]:
    """Every picture's time in s and its planes, by PyAV itself."""
    with av.open(str(path)) as container:
        return [
            (float(f.pts * f.time_base), f.to_ndarray(format="yuv420p").tobytes()) for f in container.decode(video=0)
        ]


def host_times_s(folder: Path) -> np.ndarray:
    parts = [pd.read_parquet(video.with_name("video.frames.parquet"))["t_host_s"] for video in pieces(folder)]
    return pd.concat(parts, ignore_index=True).to_numpy()


def exported(capsys, folder: Path, out: Path, *more: str) -> dict:
    capsys.readouterr()
    code = main(["export", str(folder), "--out", str(out), "--json", *more])
    said, err = capsys.readouterr()
    assert (code, err) == (0, "")
    return json.loads(said)


@pytest.mark.parametrize("which", ["alone_on_film", "pair_on_film"])
def test_mp4_is_the_film_bit_by_bit_at_the_times_of_the_session(which, request, capsys, tmp_path):
    folder = request.getfixturevalue(which)
    said = exported(capsys, folder, tmp_path, "--to", "mp4")
    assert said["copied"] is True
    found = pictures(tmp_path / "film.mp4")
    expected = [planes for video in pieces(folder) for _, planes in pictures(video)]
    assert [planes for _, planes in found] == expected
    times_s, host_s = np.array([t_s for t_s, _ in found]), host_times_s(folder)
    assert (np.diff(times_s) > 0).all()
    # Matroska keeps milliseconds; the camera's clock is read against the host's by the middle one of their differences
    assert np.abs(times_s - (host_s - host_s[0])).max() < 0.002
    with av.open(str(tmp_path / "film.mp4")) as container:
        assert container.format.name.startswith("mov,mp4")
        assert container.streams.video[0].frames == len(expected)
        assert container.duration / 1e6 == pytest.approx(host_s[-1] - host_s[0] + 1 / 30, abs=0.04)
    data = (tmp_path / "film.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # plays while it loads


def test_gaps_between_runs_stay_as_long_as_they_were(alone_on_film, capsys, tmp_path):
    folder = shutil.copytree(alone_on_film, tmp_path / "copy")
    for number, video in enumerate(pieces(folder)):
        table = video.with_name("video.frames.parquet")
        stamps = pd.read_parquet(table)
        stamps.assign(t_host_s=stamps["t_host_s"] + 60.0 * number).to_parquet(table, index=False)
    exported(capsys, folder, tmp_path / "out", "--to", "mp4")
    times_s, host_s = [t_s for t_s, _ in pictures(tmp_path / "out/film.mp4")], host_times_s(folder)
    assert host_s[-1] - host_s[0] > 60
    assert np.abs(times_s - (host_s - host_s[0])).max() < 0.002


def test_motion_jpeg_is_encoded_anew(pair_on_film, capsys, tmp_path):
    folder = shutil.copytree(pair_on_film, tmp_path / "copy")
    first = pieces(folder)[0]
    stamps = pd.read_parquet(first.with_name("video.frames.parquet"))
    with read_frames(first) as reader:
        frames = [pack_i420(frame.luma.copy(), tuple(plane.copy() for plane in frame.chroma())) for frame in reader]
    first.unlink()
    writer = SegmentWriter(first, EncoderSettings(codec="mjpeg"), 30.0)
    for row, planes in zip(stamps.itertuples(), frames, strict=True):
        writer.add(Frame(index=row.index, t_camera_s=row.t_camera_s, t_host_s=row.t_host_s, i420=planes))
    writer.close()
    said = exported(capsys, folder, tmp_path / "out", "--to", "mp4")
    assert said["copied"] is False
    with av.open(str(tmp_path / "out/film.mp4")) as container:
        assert container.streams.video[0].codec_context.name == "h264"
    found, host_s = pictures(tmp_path / "out/film.mp4"), host_times_s(folder)
    assert len(found) == len(host_s)
    assert np.abs(np.array([t_s for t_s, _ in found]) - (host_s - host_s[0])).max() < 0.002
    was = np.frombuffer(pictures(pieces(pair_on_film)[0])[5][1], dtype=np.uint8).astype(float)
    now = np.frombuffer(found[5][1], dtype=np.uint8).astype(float)
    assert np.abs(was - now).mean() < 2.0


@pytest.mark.parametrize("which", ["alone_on_film", "pair_on_film"])
def test_the_overlay_is_drawn_where_the_track_is_and_nowhere_else(which, request, capsys, tmp_path):
    folder = request.getfixturevalue(which)
    said = exported(capsys, folder, tmp_path, "--to", "mp4", "--overlay")
    assert said["copied"] is False
    found, host_s = pictures(tmp_path / "film.mp4"), host_times_s(folder)
    assert len(found) == len(host_s)
    assert np.abs(np.array([t_s for t_s, _ in found]) - (host_s - host_s[0])).max() < 0.002
    track = pd.read_parquet(folder / "track.parquet")
    number = len(pictures(pieces(folder)[0])) + 3  # the fourth picture of the second piece
    plain = [planes for video in pieces(folder)[:2] for _, planes in pictures(video)][number]
    height, width = 720, 1280
    luma = [
        np.frombuffer(p, np.uint8)[: height * width].reshape(height, width).astype(int)
        for p in (plain, found[number][1])
    ]
    drawn = np.abs(luma[0] - luma[1]) > 40
    run = int(pieces(folder)[1].parent.name)
    key = "segment" if "segment" in track else "line"
    here = track[(track[key] == run) & (track["frame"] == 3)]
    assert len(here) == (2 if which == "pair_on_film" else 1)
    for place in here.itertuples():
        x, y = round(place.x_px), round(place.y_px)
        assert drawn[y - 20 : y + 20, x - 20 : x + 20].any()
    assert drawn.mean() < 0.1


def test_an_overlay_without_a_track_says_how_to_make_one(alone_on_film, capsys, tmp_path):
    folder = shutil.copytree(alone_on_film, tmp_path / "copy")
    (folder / "track.parquet").unlink()
    assert main(["export", str(folder), "--out", str(tmp_path / "out"), "--to", "mp4", "--overlay"]) == 2
    assert "chordlab validate" in capsys.readouterr().err


def test_a_session_without_film_has_no_mp4_and_says_so(onboard_session, capsys, tmp_path):
    assert main(["export", str(onboard_session), "--out", str(tmp_path)]) == 0
    assert "no mp4: the session was not filmed\n" in capsys.readouterr().err
    assert not (tmp_path / "film.mp4").exists()


@pytest.mark.parametrize("every", [1, 7])
def test_mcap_shows_every_nth_picture_counted_through_the_whole_film(pair_on_film, capsys, tmp_path, every):
    said = exported(capsys, pair_on_film, tmp_path, "--to", "mcap", "--every", str(every))
    expected = [planes for video in pieces(pair_on_film) for _, planes in pictures(video)][::every]
    assert said["messages"]["/film"] == len(expected)
    times_s = host_times_s(pair_on_film)[::every]
    with (tmp_path / "session.mcap").open("rb") as file:
        messages = [(m.log_time, json.loads(m.data)) for _, _, m in make_reader(file).iter_messages(topics="/film")]
    stamps_s = np.array([t_ns / 1e9 for t_ns, _ in messages])
    assert np.abs((stamps_s - stamps_s[0]) - (times_s - times_s[0])).max() < 0.002
    for number in (0, len(messages) // 2, -1):
        content = messages[number][1]
        assert content["format"] == "jpeg"
        jpeg = np.frombuffer(base64.b64decode(content["data"]), dtype=np.uint8)
        grey = cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE).astype(float)
        assert grey.shape == (720, 1280)
        luma = np.frombuffer(expected[number], np.uint8)[: 720 * 1280].reshape(720, 1280).astype(float)
        # video's luma runs from 16 to 235, the picture's from 0 to 255
        assert np.abs(grey - np.clip((luma - 16) * 255 / 219, 0, 255)).mean() < 3.0
