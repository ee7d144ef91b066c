"""`chordlab run --resume`: what it refuses, says and leaves; and how a session is ended from outside."""

import asyncio
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from lab.base.errors import RequestError
from lab.cli.main import main
from lab.clock import run as run_on_clock
from lab.reopen.resume import pick_up, resume
from lab.session.experiment import run_experiment
from lab.store.layout import SessionFolderError
from lab.store.seal import write_checksums
from tests.lab.conftest import roll
from tests.lab.cutting import RESUMED, Log, cut_after, estimates_of_one_robot, estimates_told, go_on


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Eight lines over the square."""
    return roll(tmp_path_factory.mktemp("short"), shape="square", stop__lines=8, seed=11).folder


# --- what is refused ----------------------------------------------------------------------------------------------


def edited(folder, change):
    """A session whose log was edited, its tables and sums thrown away."""
    lines = (folder / "events.jsonl").read_text().splitlines()
    events = [json.loads(line) for line in lines]
    change(events)
    (folder / "events.jsonl").write_text("".join(json.dumps(event, sort_keys=True) + "\n" for event in events))
    (folder / "SHA256SUMS").unlink(missing_ok=True)
    return folder


def run_number(events, number):
    return next(event for event in events if event["event"] == "line" and event["line"] == number)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("crossing", lambda run: run["crossings"][0].__setitem__(1, run["crossings"][0][1] - 0.25)),
        ("invariant", lambda run: run.update(l3_cm3=run["l3_cm3"] * 1.001)),
        ("estimate", lambda run: run["estimate"].update(area_cm2=run["estimate"]["area_cm2"] + 0.01)),
        ("left out", lambda run: run.update(counts=False)),
        ("weight", lambda run: run.update(weight=2.0)),
    ],
)
def test_a_log_that_does_not_add_up_is_refused_in_one_line(short, tmp_path, name, change):
    folder = cut_after(short, 12, tmp_path / "session")
    crossing = [run["line"] for run in Log(folder).runs if "estimate" in run][2]
    edited(folder, lambda events: change(run_number(events, crossing)))
    with pytest.raises(SessionFolderError, match=rf"run {crossing} does not add up") as refused:
        go_on(folder, 20)
    assert "\n" not in str(refused.value)
    assert not Log(folder).told("start")[1:]


def test_a_complete_session_that_was_edited_is_refused(short, tmp_path):
    folder = tmp_path / "session"
    shutil.copytree(short, folder)
    write_checksums(folder)
    manifest = (folder / "manifest.json").read_text()
    (folder / "manifest.json").write_text(manifest.replace('"seed": 11', '"seed": 12'))
    with pytest.raises(SessionFolderError, match=r"manifest\.json: changed since SHA256SUMS"):
        pick_up(folder, lines=20)


def test_a_bench_that_is_no_longer_the_same_is_refused(short, tmp_path):
    folder = cut_after(short, 5, tmp_path / "session")
    for key, what in (("profile", "robot profile"), ("calibration", "calibration"), ("dictionary", "dictionary")):
        manifest = Log(folder).manifest
        kept = json.dumps(manifest)
        place = manifest["devices"]["profile"] if key == "profile" else manifest[key]
        name = sorted(place)[0]
        place[name] = "other"
        (folder / "manifest.json").write_text(json.dumps(manifest))
        (folder / "SHA256SUMS").unlink(missing_ok=True)  # what recovery sealed
        with pytest.raises(RequestError, match=rf"{what}.* is not what the session began with"):
            pick_up(folder)
        (folder / "manifest.json").write_text(kept)


def test_a_robot_that_adds_up_by_itself_is_refused_with_what_to_do(tmp_path):
    begun = roll(tmp_path, robot="onboard:virtual", shape="square", stop__lines=3).folder
    before = (begun / "events.jsonl").read_bytes()
    with pytest.raises(SessionFolderError, match="run a new session, and read both with chordlab batch"):
        pick_up(begun, lines=9)
    assert (begun / "events.jsonl").read_bytes() == before


def test_a_session_of_an_older_schema_is_refused(short, tmp_path):
    folder = cut_after(short, 5, tmp_path / "session")
    (folder / "manifest.json").write_text(json.dumps({**Log(folder).manifest, "schema_version": 2}))
    with pytest.raises(SessionFolderError, match="older schema 2"):
        pick_up(folder)


def test_a_session_that_is_being_written_is_refused(short, tmp_path, capfd):
    import subprocess
    import sys

    folder = cut_after(short, 5, tmp_path / "session")
    held = "import sys\nfrom pathlib import Path\nfrom lab.store.lock import writing\n"
    held += "with writing(Path(sys.argv[1])):\n    print('held', flush=True)\n    sys.stdin.read()\n"
    with subprocess.Popen(
        [sys.executable, "-c", held, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as holder:
        assert holder.stdout.readline() == b"held\n"
        assert main(["run", "--resume", str(folder)]) == 2
        holder.stdin.close()
        holder.wait(20)
    assert "is being written by another chordlab" in capfd.readouterr().err


@pytest.mark.parametrize(
    "more",
    [["--seed", "3"], ["--shape", "disc"], ["--no-video"], ["--simulate"], ["--out", "x"], ["SESSION.toml"],
     ["--letters"], ["--robot", "virtual"], ["--dictionary", "all"], ["--replay", "x"]],
)  # fmt: skip
def test_what_a_session_was_begun_with_cannot_be_changed(tmp_path, capfd, more):
    assert main(["run", *more, "--resume", str(tmp_path)]) == 2
    told = capfd.readouterr().err
    assert f"{more[0]} is not for --resume" in " ".join(told.split())
    assert told.count("error:") == 1


# --- the command --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_goes_on_reports_and_seals(short, tmp_path, capsys):
    folder = cut_after(short, 6, tmp_path / "session")
    assert main(["run", "--resume", str(folder), "--lines", "10", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["lines"] == 10
    assert told["runs"] == len(Log(folder).runs)
    report = (folder / "report.html").read_text(encoding="utf-8")
    assert "ended early" not in report
    for row in (folder / "SHA256SUMS").read_text().splitlines():
        digest, name = row.split("  ", 1)
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    # complete now: it says so, and reports again
    events = (folder / "events.jsonl").read_bytes()
    (folder / "report.html").unlink()
    assert main(["run", "--resume", str(folder)]) == 0
    said = capsys.readouterr()
    assert "complete already: 10 of 10 lines" in said.err
    assert said.out.strip().endswith("report.html")
    assert (folder / "report.html").is_file()
    assert (folder / "events.jsonl").read_bytes() == events


def test_an_interrupt_names_the_command_that_goes_on(tmp_path, capfd, monkeypatch):
    def interrupted(settings, *, watch, **more):
        def stop(step):
            if step.n == 3:
                signal.raise_signal(signal.SIGINT)

        return run_experiment(settings, watch=stop, **more)

    monkeypatch.setattr("lab.session.experiment.run_experiment", interrupted)
    arguments = ["--simulate", "--shape", "square", "--no-video", "--lines", "6", "--out", str(tmp_path)]
    assert main(["run", *arguments, "--quiet"]) == 1
    (folder,) = tmp_path.iterdir()
    assert f"go on: chordlab run --resume {folder}" in " ".join(capfd.readouterr().err.split())
    go_on(folder)
    log = Log(folder)
    assert [event["state"] for event in log.told("end")] == ["interrupted", "complete"]
    assert log.manifest["end"]["n"] == 6
    assert estimates_told(log.runs) == estimates_of_one_robot(log.runs)


def test_a_session_that_was_recognised_goes_on_when_more_is_asked_for(tmp_path):
    begun = roll(tmp_path, shape="square", stop__lines=60, stop__until=0.9, stop__at_least=5, seed=4)
    assert begun.finished.outcome.state == "recognised"
    n = begun.finished.outcome.n
    assert "recognised already" in pick_up(begun.folder).complete
    assert "recognised already" in pick_up(begun.folder, until=0.8).complete
    assert pick_up(begun.folder, until=0.999999).complete == ""
    unfinished = pick_up(begun.folder, lines=n + 4)
    assert resume(unfinished, started=RESUMED).outcome.n == n + 4


# --- clock and signals --------------------------------------------------------------------------------------------


async def _clock(wait_s=0.5):
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    await asyncio.sleep(wait_s)
    return began_s, loop.time()


def test_virtual_time_goes_on_where_it_stood():
    began_s, ended_s = run_on_clock(_clock(1000.0), virtual=True, not_before_s=5000.0)
    assert began_s == 5000.0
    assert ended_s == pytest.approx(6000.0)


def test_real_time_is_shifted_only_where_the_clock_stands_below(monkeypatch):
    ahead_s = time.monotonic() + 10_000.0
    began_s, ended_s = run_on_clock(_clock(0.05), virtual=False, not_before_s=ahead_s)
    assert ahead_s <= began_s < ahead_s + 5
    assert ended_s - began_s >= 0.049
    before_s = time.monotonic()
    began_s, _ = run_on_clock(_clock(0.0), virtual=False, not_before_s=before_s - 1.0)
    assert before_s <= began_s <= time.monotonic()


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("virtual", [True, False])
def test_a_request_to_terminate_is_an_interrupt(virtual):
    rested = []

    async def rolling():
        asyncio.get_running_loop().call_later(0.05, signal.raise_signal, signal.SIGTERM)
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0.02)  # a robot is stopped
            rested.append(True)

    with pytest.raises(KeyboardInterrupt):
        run_on_clock(rolling(), virtual=virtual)
    assert rested == [True]
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_terminated_session_ends_cleanly_and_goes_on(tmp_path):
    arguments = ["run", "--simulate", "--shape", "square", "--no-video", "--lines", "100000", "--quiet"]
    program = [sys.executable, "-c", "import sys; from lab.cli.main import main; sys.exit(main(sys.argv[1:]))"]
    with subprocess.Popen([*program, *arguments, "--out", str(tmp_path)], stderr=subprocess.PIPE, text=True) as process:
        give_up_s = time.monotonic() + 100
        while len(list(tmp_path.glob("*/lines/0*"))) < 5:
            assert process.poll() is None
            assert time.monotonic() < give_up_s
            time.sleep(0.05)
        process.terminate()
        told = process.communicate(timeout=60)[1]
    (folder,) = tmp_path.iterdir()
    assert process.returncode == 1
    assert f"chordlab run --resume {folder}" in " ".join(told.split())
    log = Log(folder)
    assert log.manifest["end"]["state"] == "interrupted"
    n = log.manifest["end"]["n"]
    go_on(folder, n + 2)
    assert estimates_told(Log(folder).runs) == estimates_of_one_robot(Log(folder).runs)
    assert Log(folder).manifest["end"]["n"] == n + 2
