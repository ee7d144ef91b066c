"""The commands as a user meets them: exit codes, one-line errors, JSON alone on stdout."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lab.cli.main import main
from lab.cli.output import show_table
from lab.store.reader import SessionReader
from lab.store.seal import verify_checksums, write_checksums

SAMPLES = Path(__file__).parents[2] / "data" / "sessions"


@pytest.fixture
def say(capsys):
    """Run a command; give its exit code, stdout and stderr."""

    def run(*argv):
        code = main([str(word) for word in argv])
        out, err = capsys.readouterr()
        return code, out, err

    return run


def as_json(out: str):
    (line,) = out.splitlines()
    return json.loads(line)


def commands():
    from typer.main import get_command

    from lab.cli.main import app

    def walk(command, words):
        children = getattr(command, "commands", {})
        if not children:
            yield words, command
        for name, child in children.items():
            yield from walk(child, [*words, name])

    return list(walk(get_command(app), []))


@pytest.mark.parametrize("words", [words for words, _ in commands()], ids=" ".join)
def test_every_command_has_help_with_an_example(say, words):
    code, out, _ = say(*words, "--help")
    assert code == 0
    assert f"Example: chordlab {' '.join(words)}" in out
    assert "--json" in out
    assert ("--quiet" in out) == (" ".join(words) not in NOTHING_BUT_RESULTS)


NOTHING_BUT_RESULTS = {  # no progress, no remarks, and no table beside a file
    "watch", "moments", "project", "shapes list", "robot scan", "robot info", "robot drive", "robot virtual",
}  # fmt: skip


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["shapes", "show", "eifel"], "eiffel"),
        (["moments", "nowhere.svg"], "nowhere.svg"),
        (["moments", "text:"], "text"),
        (["run", "--simulate", "--lines", "0"], "lines"),
        (["run", "none.toml"], "No such file"),
        (["run", "--simulate", "--shape", "nessie"], "nessie"),
        (["run", "--robot", "onboard:virtual", "--robot", "virtual", "--no-video"], "rolls alone"),
        (["run", "--robot", "SB-1234"], "no device"),
        (["validate", "/tmp"], "no session folder"),
        (["recognize", "/tmp"], "no session folder"),
        (["finalize", "/tmp"], "no session folder"),
        (["batch", "/nowhere"], "no such folder"),
        (["track", "nothing.mkv"], "nothing.mkv"),
        (["track", "nothing.mkv", "--out", "x.xls"], ".parquet or .csv"),
        (["simulate", "square", "--lines", "-1"], "--lines"),
        (["frobnicate"], "frobnicate"),
        (["run", "--frob"], "--frob"),
        (["robot", "drive", "virtual", "--speed", "1000"], "--speed"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_wrong_request_is_one_line_and_exit_2(say, argv, says):
    code, out, err = say(*argv)
    assert code == 2
    assert out == ""
    assert says in err
    assert len(err.strip().splitlines()) == 1
    assert "Traceback" not in err


def test_moments_of_the_square_by_json(say):
    code, out, _ = say("moments", "square", "--json")
    assert code == 0
    found = as_json(out)
    assert found["sigma_area_rel"] == pytest.approx(0.39278, abs=1e-4)
    assert found["sigma_perimeter_rel"] == pytest.approx(0.33730, abs=1e-4)
    assert found["covariance_rel"] == pytest.approx(0.03153, abs=1e-4)
    assert found["chords_per_line"] == pytest.approx(1)
    assert found["area_cm2"] == pytest.approx(44**2)


def test_simulate_gives_one_value_a_run(say):
    code, out, _ = say("simulate", "square", "--lines", "200", "--runs", "500", "--seed", "3", "--json")
    assert code == 0
    found = as_json(out)
    assert len(found["area_cm2"]) == len(found["perimeter_cm"]) == 500
    assert np.std(found["area_cm2"]) / 44**2 == pytest.approx(0.39278 / np.sqrt(200), rel=0.12)
    again = as_json(say("simulate", "square", "--lines", "200", "--runs", "500", "--seed", "3", "--json")[1])
    assert again["area_cm2"] == found["area_cm2"]
    assert found["lines_per_second"] > 0


def test_shapes_are_listed_and_drawn(say, tmp_path):
    code, out, _ = say("shapes", "list", "--json")
    assert code == 0
    names = {entry["name"] for entry in as_json(out)["shapes"]}
    assert {"circle", "square", "triangle", "chichen_itza", "eiffel", "liberty"} <= names
    picture = tmp_path / "eiffel.png"
    code, out, _ = say("shapes", "show", "eiffel", "--out", picture)
    assert code == 0
    assert str(picture) in out.replace("\n", "")
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert as_json(say("shapes", "show", "text:HI", "--out", tmp_path / "hi.svg", "--json")[1])["pieces"] == 2


@pytest.mark.parametrize("columns", [40, 60, 80, 140])
def test_no_figure_of_a_table_is_cut_however_narrow_it_is(capsys, monkeypatch, columns):
    """Texts fold between words; where there is no room for that, a row is a line."""
    monkeypatch.setenv("COLUMNS", str(columns))
    figures = ["1 234.5 ± 12.3", "10 min (12 min)", "−0.07 ± 0.08"]
    show_table("Budget", ("term", "A, cm²", "time", "P, %", "what it is"), [
        ("speed scale", *figures, "how far the robot rolls in a second"),
        ("latency", *figures, "what the Bluetooth link adds"),
    ])  # fmt: skip
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= columns
    for figure in figures:
        assert out.count(figure) == 2
    told = set(re.findall(r"\w+", out))
    assert {"speed", "scale", "robot", "rolls", "Bluetooth", "latency"} <= told


def test_tables_for_people_come_out_whole(say, square_session):
    for argv in (
        ["moments", "circle"],
        ["simulate", "circle", "--lines", "50", "--runs", "20"],
        ["shapes", "list"],
        ["recognize", square_session.folder],
    ):
        code, out, err = say(*argv)
        assert (code, err) == (0, "")
        assert len(out.splitlines()) > 3


def test_validate_a_filmed_session(say, filmed_session):
    code, out, err = say("validate", filmed_session.folder, "--json")
    assert (code, err) == (0, "")
    found = as_json(out)
    for who in ("robot", "camera", "truth"):
        assert {"area_cm2", "perimeter_cm"} <= set(found[who])
    assert {"matched", "missed", "extra", "bias_cm", "rms_cm"} <= set(found["chords"])
    assert found["truth"] == {"area_cm2": pytest.approx(1936), "perimeter_cm": pytest.approx(176)}
    # twelve lines, the same for robot and camera: they agree far better with each other than with the truth
    assert found["robot"]["area_cm2"] == pytest.approx(found["camera"]["area_cm2"], rel=0.08)
    assert found["chords"]["matched"] >= 11
    assert abs(found["chords"]["bias_cm"]) < 1
    assert found["chords"]["rms_cm"] < 2
    assert 0 < found["isotropy"]["p_value"] <= 1
    assert 0 < found["homogeneity"]["p_value"] <= 1
    assert isinstance(found["verdict"], str)
    assert (filmed_session.folder / "report.html").stat().st_size > 100_000
    assert "report.html" in (filmed_session.folder / "SHA256SUMS").read_text()
    track = pd.read_parquet(filmed_session.folder / "track.parquet")
    films = pd.concat(
        pd.read_parquet(path.with_suffix(".frames.parquet"))
        for path in SessionReader(filmed_session.folder).segments().values()
    )
    assert len(track) == len(films)


def test_validate_seals_what_it_found_without_a_report_too(say, tmp_path):
    folder = Path(shutil.copytree(SAMPLES / "square-filmed", tmp_path / "copy"))
    (folder / "track.parquet").unlink()
    write_checksums(folder)
    code, out, err = say("validate", folder, "--no-report")
    assert (code, err) == (0, "")
    assert "chords: 16 matched" in out
    assert not (folder / "report.html").exists()
    assert " track.parquet" in (folder / "SHA256SUMS").read_text()
    assert verify_checksums(folder) == []


def test_validate_without_video_says_so(say, square_session):
    code, out, _ = say("validate", square_session.folder, "--json")
    assert code == 0
    found = as_json(out)
    assert found["camera"] is found["chords"] is found["isotropy"] is None
    assert found["recognised"]["name"] == "square"


def test_recognize_follows_the_posterior(say, square_session):
    code, out, _ = say("recognize", square_session.folder, "--json")
    assert code == 0
    found = as_json(out)
    assert found["n"] == list(range(1, 151))
    assert found["ranking"][0][0] == "square"
    sums = np.sum(list(found["posterior"].values()), axis=0)
    assert sums == pytest.approx(np.ones(150))


def test_track_a_segment_with_and_without_calibration(say, filmed_session, tmp_path):
    video = next(iter(SessionReader(filmed_session.folder).segments().values()))
    code, out, _ = say("track", video, "--out", tmp_path / "px.csv", "--json")
    assert code == 0
    table = pd.read_csv(tmp_path / "px.csv")
    assert as_json(out)["frames"] == len(table)
    assert {"frame", "t_s", "x_px", "y_px", "led_on", "quality"} <= set(table)
    assert "x_cm" not in table
    calibration = tmp_path / "calibration.json"
    calibration.write_text(json.dumps(SessionReader(filmed_session.folder).manifest["calibration"]["camera"]))
    preview = tmp_path / "preview.mkv"
    code, out, _ = say(
        "track", video, "--calibration", calibration, "--out", tmp_path / "cm.parquet", "--preview", preview
    )
    assert code == 0
    table = pd.read_parquet(tmp_path / "cm.parquet")
    assert table["x_cm"].abs().max() < 60
    assert preview.stat().st_size > 1000
    assert "seen in" in out


def test_batch_has_a_row_for_every_session_broken_ones_too(say, square_session, tmp_path):
    root = tmp_path / "sessions"
    shutil.copytree(square_session.folder, root / "whole")
    shutil.copytree(square_session.folder, root / "torn")
    (root / "torn/events.jsonl").write_text("{broken\n")
    code, out, _ = say("batch", root, "--out", tmp_path / "out", "--workers", "0", "--json")
    assert code == 0
    found = as_json(out)
    assert found["sessions"] == 2
    assert [row["session"] for row in found["broken"]] == ["torn"]
    assert "no JSON" in found["broken"][0]["error"]
    (shape,) = found["shapes"]
    assert (shape["shape"], shape["sessions"], shape["right_share"]) == ("square", 1, 1.0)
    table = pd.read_parquet(tmp_path / "out/batch.parquet")
    whole = table[table["session"] == "whole"].iloc[0]
    assert whole["robot_area_cm2"] == pytest.approx(square_session.steps[-1].area_cm2)
    assert len(pd.read_csv(tmp_path / "out/batch.csv")) == 2
    code, out, _ = say("batch", root, "--out", tmp_path / "out", "--workers", "2")
    assert code == 0
    assert "torn" in out


def test_batch_of_broken_sessions_alone_fails(say, tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a/manifest.json").write_text("{}")
    code, _, _ = say("batch", tmp_path, "--out", tmp_path / "out", "--json")
    assert code == 1
    assert say("batch", tmp_path / "out")[0] == 2


def test_finalize_rebuilds_the_tables(say, square_session, tmp_path):
    folder = shutil.copytree(square_session.folder, tmp_path / "copy")
    for table in folder.glob("*.parquet"):
        table.unlink()
    code, out, _ = say("finalize", folder)
    assert code == 0
    assert "150 estimates" in out
    assert len(pd.read_parquet(folder / "estimates.parquet")) == 150


def test_run_ends_in_a_report_and_prints_both_ratios(say, tmp_path):
    code, out, err = say("run", "--simulate", "--shape", "circle", "--lines", "6", "--no-video", "--out", tmp_path)
    assert (code, err.count("Traceback")) == (0, 0)
    assert "times real time without video" in out
    last = out.splitlines()[-1]
    assert last.endswith("report.html")
    assert "<html" in Path(last).read_text(encoding="utf-8")
    code, out, err = say(
        "run", "--simulate", "--shape", "circle", "--lines", "3", "--seed", "9", "--out", tmp_path, "--json"
    )
    assert (code, err) == (0, "")
    found = as_json(out)
    assert found["times_real_time_with_video"] > 0
    assert found["lines"] == 3
    assert found["peak_memory_mb"] > 50
