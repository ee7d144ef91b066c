"""A disk that is full: injected at every call that needs room, and real ones."""

import errno
import json
import os
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import pandas as pd
import pytest

from lab.base.errors import ChordlabError
from lab.store.layout import SessionFolderError
from lab.store.reader import SessionReader
from lab.store.tables import tables_of
from lab.store.writer import SessionWriter, disk_faults
from tests.lab.conftest import roll
from tests.lab.test_store import line_event

STARTED = datetime(2026, 11, 23, 10, 42)
CALLS = ("write", "fsync", "mkdir", "rename", "replace")


class FullDisk:
    """At the ``at``-th call that needs room below ``root`` there is none: once, for good, or with no way to mend."""

    def __init__(self, patch, root, at, mode):
        self.calls = 0
        self._root, self._at, self._mode = str(root), at, mode
        for name in CALLS:
            self._break(patch, name)
        if mode == "beyond mending":
            self._break(patch, "ftruncate", counts=False)

    def _break(self, patch, name, *, counts=True):
        real = getattr(os, name)

        def call(*args, **kwargs):
            place = str(Path(f"/proc/self/fd/{args[0]}").readlink()) if isinstance(args[0], int) else str(args[0])
            if not place.startswith(self._root) or (name == "mkdir" and Path(place).is_dir()):  # which needs no room
                return real(*args, **kwargs)
            self.calls += counts
            fails = self.calls == self._at if self._mode == "once" else self.calls >= self._at
            if not fails:
                return real(*args, **kwargs)
            if name == "write":
                descriptor, data = args
                real(descriptor, data[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        patch.setattr(os, name, call)


def session(root, acknowledged):
    """What a session does with its writer, ending as one does."""
    with disk_faults(root):
        writer = SessionWriter.create(root, "square", {"seed": 1}, started=STARTED, tag="t")
        acknowledged.append(None)
        try:
            try:
                for line in range(3):
                    writer.video_path(line).write_bytes(b"film" * 100)
                    writer.commit_line(line, pd.DataFrame({"t_host_s": [0.0], "light_lux": [20.0]}))
                    writer.append("line", **line_event(line))
                    acknowledged.append(line)
            finally:
                writer.append("end", state="failed")
                writer.finish({"state": "failed"})
        finally:
            writer.close()


def reads_whole(folder, acknowledged):
    """It reads, nothing acknowledged is lost, and no record is glued to a torn one."""
    reader = SessionReader(folder)
    lines = tables_of(reader).lines["line"].tolist()
    assert lines == list(range(len(lines)))
    assert len(lines) >= len(acknowledged) - 1
    for line in lines:
        assert len(pd.read_parquet(folder / f"lines/{line:06d}/light.parquet")) == 1
        assert (folder / f"lines/{line:06d}/video.mkv").read_bytes() == b"film" * 100
    for record in (folder / "events.jsonl").read_bytes().split(b"\n")[:-1]:
        json.loads(record)
    assert not (folder / "writer.lock").exists()


@pytest.mark.parametrize("mode", ["once", "for good", "beyond mending"])
def test_a_disk_that_fills_at_any_call_ends_the_session_in_one_line(tmp_path, mode, capsys):
    with pytest.MonkeyPatch.context() as patch:
        free = FullDisk(patch, tmp_path, at=1 << 30, mode=mode)
        session(tmp_path / "out", [])
    for at in range(1, free.calls + 1):
        disk, acknowledged = tmp_path / str(at), []
        disk.mkdir()
        with pytest.MonkeyPatch.context() as patch:
            FullDisk(patch, disk, at, mode)
            with pytest.raises(ChordlabError) as caught:
                session(disk / "out", acknowledged)
        assert "\n" not in str(caught.value)
        assert "No space left" in str(caught.value)
        if acknowledged:
            (folder,) = disk.glob("out/*")
            reads_whole(folder, acknowledged)
        else:
            assert isinstance(caught.value, SessionFolderError)
            assert not list(disk.glob("out/*"))  # nothing half made is left
    with capsys.disabled():
        print(f"\nfull disk, {mode}: {free.calls} calls tried")


def test_a_virtual_session_on_a_disk_that_fills(tmp_path, full, capsys):
    """The whole program, robots stopped and all, at every call of a short session, or at every few."""
    with pytest.MonkeyPatch.context() as patch:
        free = FullDisk(patch, tmp_path, at=1 << 30, mode="once")
        roll(tmp_path / "out", shape="square", stop__lines=2, seed=5)
    tried = range(free.calls, 0, -1 if full else -13)
    for at in tried:
        disk = tmp_path / str(at)
        disk.mkdir()
        with pytest.MonkeyPatch.context() as patch:
            FullDisk(patch, disk, at, "for good" if at % 2 else "once")
            with pytest.raises(ChordlabError) as caught:
                roll(disk / "out", shape="square", stop__lines=2, seed=5)
        assert "\n" not in str(caught.value)
        for folder in disk.glob("out/*"):
            tables_of(SessionReader(folder))
            assert not (folder / "writer.lock").exists()
    with capsys.disabled():
        print(f"\nfull disk under a virtual session: {len(tried)} of {free.calls} calls tried")


def test_after_a_log_that_cannot_be_cut_back_nothing_is_appended(tmp_path):
    writer = SessionWriter.create(tmp_path, "square", {}, started=STARTED, tag="t")
    writer.append("note", text="a")
    with pytest.MonkeyPatch.context() as patch:
        FullDisk(patch, tmp_path, 1, "beyond mending")
        with pytest.raises(OSError, match="No space"):
            writer.append("note", text="b" * 1000)
    torn = (writer.folder / "events.jsonl").read_bytes()
    assert b"bbb" in torn
    with pytest.raises(OSError, match="No space"):  # room or not
        writer.append("note", text="c")
    assert (writer.folder / "events.jsonl").read_bytes() == torn
    assert [event["text"] for event in SessionReader(writer.folder).events()] == ["a"]
    writer.close()


def test_an_interrupt_in_the_midst_of_a_record_takes_it_out_again(tmp_path, monkeypatch):
    writer = SessionWriter.create(tmp_path, "square", {}, started=STARTED, tag="t")

    def interrupted(descriptor):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", interrupted)
        with pytest.raises(KeyboardInterrupt):
            writer.append("note", text="a")
        assert (writer.folder / "events.jsonl").stat().st_size == 0
    with pytest.raises(OSError, match="could not be mended"):  # the cut itself was not synced
        writer.append("note", text="b")
    writer.close()


RUN = """
import resource, sys
from lab.cli.main import main
limit = int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
what = ["--simulate", "--no-video", "--quiet", "--shape", "square", "--lines", "60"]
sys.exit(main(["run", *what, "--out", sys.argv[2]]))
"""


def test_a_file_that_may_not_grow_ends_the_command_in_one_line(tmp_path):
    """The kernel itself refuses, half way through a record."""
    limit_bytes = 16_001
    out = tmp_path / "out"
    ended = subprocess.run(
        [sys.executable, "-c", RUN, str(limit_bytes), str(out)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 1, ended.stderr
    assert ended.stderr.count("\n") == 1
    assert "File too large" in ended.stderr
    (folder,) = out.iterdir()
    events = list(SessionReader(folder).events())
    log = (folder / "events.jsonl").read_bytes()
    assert len(log) <= limit_bytes
    assert log.count(b"\n") == len(events)
    assert log.endswith(b"\n")  # cut back, and free for what fits
    assert len(tables_of(SessionReader(folder)).lines) > 3


def test_a_really_full_disk(tmp_path):
    """A file system of 300 kB, where one may be mounted."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", disk], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("no file system may be mounted here")
    try:
        with pytest.raises(ChordlabError, match="No space left") as caught:
            roll(disk / "out", shape="square", stop__lines=150, seed=5)
        assert "\n" not in str(caught.value)
        (folder,) = Path(disk / "out").iterdir()
        lines = tables_of(SessionReader(folder)).lines["line"].tolist()
        assert lines == list(range(len(lines)))
        assert len(lines) > 3
        assert not (folder / "writer.lock").exists()
    finally:
        subprocess.run(["umount", disk], check=True, capture_output=True)
