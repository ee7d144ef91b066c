"""One writer at a time, whatever becomes of the one before."""

import multiprocessing
import os
import signal
import subprocess
import sys
from datetime import datetime

import pytest

from lab.store.layout import SessionFolderError
from lab.store.lock import is_being_written, writing
from lab.store.reader import SessionReader
from lab.store.seal import verify_checksums, write_checksums
from lab.store.tables import finalize
from lab.store.writer import SessionWriter
from tests.lab.test_store import line_event

STARTED = datetime(2026, 11, 23, 10, 42)
PART = {"started": "2026-11-24T09:00:00", "t_s": 12.5, "lines": 40}

HOLD = """
import sys, time
from pathlib import Path
from lab.store.lock import writing
with writing(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def folder(tmp_path):
    made = SessionWriter.create(tmp_path, "eiffel", {"seed": 3}, started=STARTED, tag="ab12")
    made.append("line", **line_event(0))
    made.finish({"state": "interrupted"})
    made.close()
    return made.folder


@pytest.fixture
def other(folder):
    """Another process that holds the folder's lock."""
    with subprocess.Popen([sys.executable, "-c", HOLD, folder], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


WRITERS = [
    lambda folder: writing(folder).__enter__(),
    lambda folder: SessionWriter.reopen(folder, PART),
    finalize,
    write_checksums,
]


@pytest.mark.parametrize("write", WRITERS, ids=["writing", "reopen", "finalize", "checksums"])
def test_whoever_comes_second_is_told_who_writes(folder, other, write):
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    with pytest.raises(SessionFolderError, match=rf"another chordlab \(process {other.pid}\); wait") as caught:
        write(folder)
    assert "\n" not in str(caught.value)
    assert caught.value.folder == folder
    assert is_being_written(folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == before
    assert len(list(SessionReader(folder).events())) == 1  # who only reads may


def test_the_lock_of_a_killed_process_is_free(folder, other):
    other.send_signal(signal.SIGKILL)
    other.wait()
    assert (folder / "writer.lock").exists()
    assert not is_being_written(folder)
    finalize(folder)
    assert not (folder / "writer.lock").exists()


def test_a_lock_file_that_something_else_left_locks_nothing(folder):
    (folder / "writer.lock").write_text(f"{os.getpid()}\n")
    with writing(folder):
        assert (folder / "writer.lock").read_text() == f"{os.getpid()}\n"
    assert not is_being_written(folder)


def test_within_one_process_it_may_be_taken_again(folder):
    with writing(folder), writing(folder.parent / ".." / folder.parent.name / folder.name):
        finalize(folder)
        write_checksums(folder)
        assert (folder / "writer.lock").exists()
    assert not (folder / "writer.lock").exists()


def test_a_child_does_not_inherit_the_lock(folder, tmp_path):
    """A worker that outlives its killed parent must not keep the folder locked."""
    context = multiprocessing.get_context("fork")
    go = context.Event()
    with writing(folder):
        child = context.Process(target=go.wait, args=(30,))
        child.start()
    try:
        code = (
            "import sys; from pathlib import Path; from lab.store.tables import finalize; finalize(Path(sys.argv[1]))"
        )
        assert subprocess.run([sys.executable, "-c", code, folder], check=False).returncode == 0
    finally:
        go.set()
        child.join()


def test_processes_that_race_for_it_hold_it_one_at_a_time(folder, tmp_path):
    """Each adds one to a number, many times, with no other guard; the lock file comes and goes meanwhile."""
    number = tmp_path / "number"
    number.write_text("0")
    race = (
        "import sys\nfrom pathlib import Path\nfrom lab.store.layout import SessionFolderError\n"
        "from lab.store.lock import writing\nfolder, number = map(Path, sys.argv[1:])\nleft = 60\n"
        "while left:\n    try:\n        with writing(folder):\n"
        "            number.write_text(str(int(number.read_text()) + 1))\n        left -= 1\n"
        "    except SessionFolderError:\n        pass\n"
    )
    racing = [subprocess.Popen([sys.executable, "-c", race, folder, number]) for _ in range(3)]
    assert [process.wait(60) for process in racing] == [0, 0, 0]
    assert number.read_text() == "180"


def test_a_folder_that_is_none_is_said_to_be_none(tmp_path):
    with pytest.raises(SessionFolderError, match="no folder"), writing(tmp_path / "gone"):
        pass


# --- going on -----------------------------------------------------------------------------------------------------


def test_a_session_that_goes_on_has_not_ended_and_one_more_part(folder):
    write_checksums(folder)
    again = SessionWriter.reopen(folder, PART)
    assert is_being_written(folder) is False  # by another
    again.append("start", t_s=12.5, resumed=True, part=1)
    session = SessionReader(folder)
    assert "end" not in session.manifest
    assert session.manifest["parts"] == [PART]
    assert [event["event"] for event in session.events()] == ["line", "start"]
    assert not (folder / "SHA256SUMS").exists()
    again.finish({"state": "complete"})
    again.close()
    third = SessionWriter.reopen(folder, PART | {"t_s": 99.0})
    third.close()
    assert [part["t_s"] for part in SessionReader(folder).manifest["parts"]] == [12.5, 99.0]
    write_checksums(folder)
    assert verify_checksums(folder) == []


def test_a_torn_log_is_not_gone_on_with(folder):
    log = folder / "events.jsonl"
    for torn in (b'{"event": "li', b"\0" * 30 + b'"}\n'):
        whole = log.read_bytes()
        log.write_bytes(whole + torn)
        with pytest.raises(SessionFolderError, match="chordlab recover"):
            SessionWriter.reopen(folder, PART)
        assert SessionReader(folder).manifest["end"] == {"state": "interrupted"}  # nothing was touched
        log.write_bytes(whole)
    assert not (folder / "writer.lock").exists()


def test_a_session_of_an_older_schema_is_never_written_to(folder):
    manifest = folder / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"schema_version": 3', '"schema_version": 2'))
    with pytest.raises(SessionFolderError, match="older schema 2"):
        SessionWriter.reopen(folder, PART)


def test_what_is_no_session_is_not_gone_on_with(tmp_path):
    with pytest.raises(SessionFolderError, match="no session folder"):
        SessionWriter.reopen(tmp_path, PART)
    assert not list(tmp_path.iterdir())
