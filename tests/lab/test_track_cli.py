"""`chordlab track` on films whose truth is known: tables, messages, previews, interruptions."""

import json
from pathlib import Path

import av
import numpy as np
import pandas as pd
import pytest
import shapely

from lab import filmtrack
from lab.cli.main import main
from tracking.calibration import save_calibration
from tracking.film import FilmFaults, blink_in, default_optics, light_of, make_film, rolling
from tracking.video import read_frames

OPTICS = default_optics((320, 240))
SHAPE = shapely.box(-8, -6, 8, 6)


def roll(path, points, *, seed=1, faults=None, duration_s=2.0, optics=OPTICS):
    robots = rolling(points, 30.0, blink_in(SHAPE)) if points else lambda _: []
    rng = np.random.default_rng(seed)
    return make_film(path, robots, rng, light_at=light_of(SHAPE), optics=optics, faults=faults, duration_s=duration_s)


@pytest.fixture(scope="module")
def films(tmp_path_factory):
    folder = tmp_path_factory.mktemp("films")
    one = roll(folder / "one.mkv", [(-30, -4), (30, 6)], faults=FilmFaults(dropped=0.06, duplicated=0.04))
    two = roll(folder / "two.mkv", [(30, 6), (-30, 10)])
    save_calibration(one.calibration, folder / "calibration.json")
    (folder / "cut.mkv").write_bytes(two.path.read_bytes()[: two.path.stat().st_size // 2])
    (folder / "cut.mp4").write_bytes(roll(folder / "whole.mp4", [(-30, 0), (30, 0)]).path.read_bytes()[:40_000])
    (folder / "empty.mkv").touch()
    (folder / "words.mkv").write_text("no video at all " * 100)
    roll(folder / "dark.mkv", [])
    with av.open(str(folder / "sound.mkv"), "w") as sound:
        stream = sound.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 8000), dtype=np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        sound.mux(stream.encode(frame))
        sound.mux(stream.encode(None))
    return folder, one, two


def call(capsys, *words):
    code = main(["track", *(str(word) for word in words)])
    return code, *capsys.readouterr()


def test_a_table_of_one_video_and_its_figures(films, tmp_path, capsys):
    folder, one, _ = films
    out = tmp_path / "deep" / "t.parquet"
    code, said, _ = call(
        capsys, one.path, "--calibration", folder / "calibration.json", "--out", out, "--preview", tmp_path / "p.mkv",
        "--json",
    )  # fmt: skip
    assert code == 0
    figures, table = json.loads(said), pd.read_parquet(out)
    assert len(table) == figures["frames"] == len(one.frames)
    assert figures["dropped"] == len(one.dropped)
    assert figures["rate_hz"] == pytest.approx(30.0, rel=5e-3)
    assert figures["lit_share"] == pytest.approx(one.of()["led_on"].mean(), abs=0.03)
    assert (figures["truncated"], figures["frames_lost"], figures["duplicated"]) == (False, 0, 0)
    error_cm = np.hypot(table["x_cm"] - one.of()["x_cm"], table["y_cm"] - one.of()["y_cm"])
    assert error_cm[~one.frames["duplicate"]].median() < 0.1
    with read_frames(tmp_path / "p.mkv") as reader:
        shown = np.array([frame.t_s for frame in reader])
    assert np.allclose(shown - shown[0], table["t_s"] - table["t_s"][0], atol=1e-3)
    assert not list(tmp_path.rglob("*.part"))


def test_segments_share_a_table_with_a_column_that_names_them(films, tmp_path, capsys):
    _, one, two = films
    code, said, _ = call(capsys, one.path, two.path, "--out", tmp_path / "t.csv", "--preview", tmp_path / "p.mp4")
    assert code == 0
    table = pd.read_csv(tmp_path / "t.csv")
    assert table.columns[0] == "video"
    for film in (one, two):
        mine = table[table["video"] == str(film.path)]
        assert list(mine["frame"]) == list(range(len(film.frames)))
        assert np.allclose(mine["t_s"], film.frames["t_s"])
    frames = len(one.frames) + len(two.frames)
    assert f"{frames} frames at 30.0 Hz" in said and f"{len(one.dropped)} dropped" in said
    with read_frames(tmp_path / "p.mp4") as reader:
        assert len(list(reader)) == frames


def test_a_file_cut_short_is_tracked_to_its_end_and_said_to_be(films, tmp_path, capsys):
    folder, _, two = films
    code, said, _ = call(capsys, folder / "cut.mkv", "--out", tmp_path / "t.csv", "--json")
    assert code == 0
    figures, table = json.loads(said), pd.read_csv(tmp_path / "t.csv")
    assert figures["truncated"] is True
    assert 5 < len(table) < len(two.frames)
    assert figures["frames_lost"] == len(two.frames) - len(table)
    code, said, _ = call(capsys, folder / "cut.mkv", "--out", tmp_path / "t.csv")
    assert f"cut short, {figures['frames_lost']} lost" in said


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("missing.mkv", "no such video file; check the path"),
        ("empty.mkv", "the file is empty; record it again"),
        ("words.mkv", "cannot be read as a video"),
        ("cut.mp4", "film in .mkv"),
        ("sound.mkv", "no video stream (sound only?); give the file with the picture"),
        ("dark.mkv", "no LED in any of 60 frames; switch it on"),
    ],
)
def test_what_cannot_be_tracked_is_told_in_one_line(films, tmp_path, capsys, name, says):
    code, said, told = call(capsys, films[0] / name, "--out", tmp_path / "t.parquet")
    assert code == 2 and not said
    assert told.count("\n") == 1 and told.startswith("error: ") and says in told
    assert not list(tmp_path.iterdir())


def test_wrong_wishes_are_told_before_the_work(films, tmp_path, capsys):
    folder, one, _ = films
    small = roll(tmp_path / "small.mkv", [(-9, 0), (9, 0)], optics=default_optics((160, 120)))
    calibrated = ("--calibration", folder / "calibration.json")
    for words, says in (
        ((small.path, *calibrated), "the calibration is for 320x240 pixels but the video has 160x120"),
        ((one.path, one.path), "given twice"),
        ((one.path, "--out", tmp_path / "t.xlsx"), "name it so"),
        ((one.path, "--preview", tmp_path / "p.gif"), "name it so"),
        ((one.path, "--out", Path(one.path) / "t.csv"), "no folder can be made"),
    ):
        code, said, told = call(capsys, *words)
        assert (code, said) == (2, "")
        assert says in told and told.count("\n") == 1


def test_an_interrupted_preview_leaves_no_half_file(films, tmp_path, capsys, monkeypatch):
    _, one, _ = films

    def interrupted(videos, table, out, progress):
        def stop(done, total):
            raise KeyboardInterrupt

        return whole(videos, table, out, stop)

    whole = filmtrack.preview_films
    monkeypatch.setattr(filmtrack, "preview_films", interrupted)
    code, _, _ = call(capsys, one.path, "--out", tmp_path / "t.csv", "--preview", tmp_path / "p.mkv")
    assert code == 1
    assert [file.name for file in tmp_path.iterdir()] == ["t.csv"]


def test_balls_without_leds_are_followed_when_asked_for(tmp_path, capsys):
    """Two films of a white ball on a dark floor."""

    def white_on_dark(x_cm, y_cm, height_cm):
        return np.full(np.shape(x_cm), 30.0) + 90.0 * (np.asarray(height_cm) > 0.0)

    names = [tmp_path / f"{number}.mkv" for number in range(2)]
    for number, name in enumerate(names):
        robots = rolling([(-30, -8 + 6 * number), (30, 4)], 30.0, lambda *_: 0.0)
        rng = np.random.default_rng(number)
        truth = make_film(name, robots, rng, light_at=white_on_dark, optics=OPTICS, duration_s=2.0)
    save_calibration(truth.calibration, tmp_path / "calibration.json")
    out = tmp_path / "t.csv"
    code, said, _ = call(
        capsys, *names, "--balls", "--calibration", tmp_path / "calibration.json", "--out", out, "--json"
    )
    assert code == 0
    assert [film["frames"] for film in json.loads(said)["videos"]] == [60, 60]
    table = pd.read_csv(out)
    assert table["video"].tolist() == [str(name) for name in names for _ in range(60)]
    second = table[table["video"] == str(names[1])].reset_index(drop=True)
    error_px = np.hypot(second["x_px"] - truth.of()["x_px"], second["y_px"] - truth.of()["y_px"])
    assert error_px.notna().mean() > 0.8
    assert error_px.median() < 8.0  # the ball's middle is not where its LED is
    assert not table["led_on"].any()
