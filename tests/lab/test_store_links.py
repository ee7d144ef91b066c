"""Links, pipes and .. planted in a session's folder: nothing outside of it is read, written or changed."""

import json
import os
import subprocess
from datetime import datetime

import pandas as pd
import pytest

from lab.base.files import make_folder, write_aside
from lab.review.review import review
from lab.store.layout import SessionFolderError
from lab.store.reader import SessionReader
from lab.store.seal import verify_checksums, write_checksums
from lab.store.tables import finalize
from lab.store.writer import SessionWriter
from tests.lab.conftest import roll
from tests.lab.test_store import line_event

STARTED = datetime(2026, 11, 23, 10, 42)
LIGHT = pd.DataFrame({"t_host_s": [0.0], "light_lux": [20.0]})


@pytest.fixture
def folder(tmp_path):
    made = SessionWriter.create(tmp_path / "in", "eiffel", {"seed": 3}, started=STARTED, tag="ab12")
    made.video_path(0).write_bytes(b"film")
    made.commit_line(0, LIGHT)
    made.append("line", **line_event(0))
    made.close()
    return made.folder


@pytest.fixture
def outside(tmp_path):
    """What nobody may touch: a file, and a folder with what would be read from a session."""
    place = tmp_path / "outside"
    (place / "run").mkdir(parents=True)
    (place / "secret").write_text('{"event": "note", "text": "secret"}\n')
    (place / "run/video.mkv").write_bytes(b"secret")
    (place / "run/light.parquet").write_bytes(b"secret")
    before = tree(place)
    yield place
    assert tree(place) == before


def tree(place):
    return {
        path.relative_to(place): (path.stat().st_mtime_ns, path.read_bytes() if path.is_file() else None)
        for path in place.rglob("*")
    }


def plant(path, target):
    """Put a link in the place of whatever is there."""
    if path.is_dir() and not path.is_symlink():
        path.rename(path.with_name("was-here"))
    path.unlink(missing_ok=True)
    path.symlink_to(target)


READS = {
    "manifest.json": SessionReader,
    "events.jsonl": lambda folder: list(SessionReader(folder).events()),
    "lines.parquet": lambda folder: SessionReader(folder).table("lines"),
    "lines": lambda folder: SessionReader(folder).segments(),
    "lines/000000": lambda folder: SessionReader(folder).segments(),
    "lines/000000/video.mkv": lambda folder: SessionReader(folder).segments(),
    "lines/000000/video.frames.parquet": lambda folder: SessionReader(folder).segments(),
    "lines/000000/light.parquet": lambda folder: SessionReader(folder).line_path(0, "light.parquet"),
    "SHA256SUMS": verify_checksums,
}


@pytest.mark.parametrize("name", READS)
@pytest.mark.parametrize("absolute", [True, False])
def test_a_link_that_leads_outside_is_not_read(folder, outside, name, absolute):
    is_folder = name in ("lines", "lines/000000")
    target = outside / "run" if is_folder else outside / "secret"
    plant(folder / name, target if absolute else os.path.relpath(target, (folder / name).parent))
    with pytest.raises(SessionFolderError, match="leads outside") as caught:
        READS[name](folder)
    assert "\n" not in str(caught.value)
    assert "secret" not in str(caught.value).replace(str(outside), "")


@pytest.mark.parametrize("name", ["manifest.json", "events.jsonl", "lines.parquet", "lines/000000/video.mkv"])
def test_a_pipe_is_not_waited_for(folder, name):
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    with pytest.raises(SessionFolderError, match="no plain file"):
        READS[name](folder)


def test_a_ring_of_links_ends(folder):
    plant(folder / "events.jsonl", "ring")
    (folder / "ring").symlink_to("events.jsonl")
    with pytest.raises(SessionFolderError):
        list(SessionReader(folder).events())


@pytest.mark.parametrize("relative", ["../outside/secret", "/etc/passwd", "lines/../../x", "..", "a\0b"])
def test_paths_that_lead_outside_are_refused(folder, relative):
    with pytest.raises(SessionFolderError, match="leads outside"):
        SessionReader(folder).path(relative)


@pytest.mark.parametrize("relative", ["manifest.json", "lines/../events.jsonl", "not/there/yet", "."])
def test_paths_inside_are_given(folder, relative):
    assert SessionReader(folder).path(relative) == folder / relative


def test_a_link_to_the_session_or_within_it_is_followed(folder, tmp_path):
    """Sessions may be kept behind a link; and what is linked within a folder stays within."""
    (tmp_path / "latest").symlink_to(folder)
    (folder / "kept").mkdir()
    (folder / "lines/000000").rename(folder / "kept/000000")
    (folder / "lines/000000").symlink_to("../kept/000000")
    session = SessionReader(tmp_path / "latest")
    assert session.segments()[0].read_bytes() == b"film"
    assert len(list(session.events())) == 1


# --- writing ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lines.parquet", "crossings.parquet", "estimates.parquet", "SHA256SUMS"])
@pytest.mark.parametrize("suffix", ["", ".part"])
def test_a_planted_link_is_replaced_not_followed(folder, outside, name, suffix):
    plant(folder / (name + suffix), outside / "secret")
    finalize(folder)
    write_checksums(folder)
    assert (folder / name).is_file()
    assert not (folder / name).is_symlink()
    assert not (folder / (name + ".part")).exists()
    assert verify_checksums(folder) == []


def test_a_review_replaces_planted_links(tmp_path, outside):
    folder = roll(tmp_path / "out", shape="square", stop__lines=3, seed=5).folder
    names = ["lines.parquet", "report.html", "lines.parquet.part", "report.html.part"]
    for name in names:
        plant(folder / name, outside / "secret")
    review(folder, report=True)
    assert not any((folder / name).is_symlink() for name in names)


@pytest.mark.parametrize("name", ["manifest.json", "manifest.json.part", "events.jsonl", "lines", "writer.lock"])
def test_a_session_with_links_is_not_gone_on_with_outside(folder, outside, name):
    if name == "manifest.json.part":
        plant(folder / name, outside / "secret")
        SessionWriter.reopen(folder, {}).close()
        assert SessionReader(folder).manifest["parts"] == [{}]
        return
    plant(folder / name, outside / ("run" if name == "lines" else "secret"))
    with pytest.raises(SessionFolderError):
        SessionWriter.reopen(folder, {})


def test_a_planted_run_is_not_written_through(folder, outside):
    (folder / "lines/000001.part").symlink_to(outside / "run")
    writer = SessionWriter.reopen(folder, {})
    writer.video_path(1).write_bytes(b"film")
    writer.commit_line(1, LIGHT)
    assert not (folder / "lines/000001").is_symlink()
    pd.testing.assert_frame_equal(pd.read_parquet(folder / "lines/000001/light.parquet"), LIGHT)
    (folder / "lines/000002").symlink_to(outside / "run")
    with pytest.raises(OSError, match="directory"):
        writer.commit_line(2, LIGHT)
    writer.close()


def test_a_lock_file_with_a_second_name_is_not_signed(folder, outside):
    os.link(outside / "secret", folder / "writer.lock")
    with pytest.raises(SessionFolderError, match="no plain file"):
        finalize(folder)


# --- sums ---------------------------------------------------------------------------------------------------------


def test_sums_name_what_is_changed_missing_and_new_as_the_standard_tool_does(folder):
    (folder / "note").write_text("a")
    (folder / "odd\nname\\").write_text("b")
    write_checksums(folder)
    assert verify_checksums(folder) == []
    check = ["sha256sum", "-c", "--quiet", "SHA256SUMS"]
    assert subprocess.run(check, cwd=folder, check=False).returncode == 0
    (folder / "note").write_text("c")
    (folder / "events.jsonl").unlink()
    (folder / "late").write_text("d")
    assert verify_checksums(folder) == ["events.jsonl: missing", "late: new", "note: changed"]
    told = subprocess.run(check, cwd=folder, capture_output=True, text=True, check=False)
    assert told.returncode == 1
    assert "note: FAILED" in told.stdout
    assert "events.jsonl: FAILED open" in told.stdout


def test_sums_that_the_standard_tool_wrote_are_read(folder):
    (folder / "odd\nname\\").write_text("b")
    names = [str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()]
    for flags in ([], ["--binary"]):
        made = subprocess.run(["sha256sum", *flags, "--", *names], cwd=folder, capture_output=True, check=True)
        (folder / "SHA256SUMS").write_bytes(made.stdout)
        assert verify_checksums(folder) == []


def test_sums_are_of_plain_files_alone(folder, outside):
    (folder / "link").symlink_to(outside / "secret")
    (folder / "all").symlink_to(outside)
    os.mkfifo(folder / "pipe")
    text = write_checksums(folder).read_text()
    assert not any(name in text for name in ("link", "all", "pipe", "secret"))
    assert verify_checksums(folder) == [f"{name}: new, and no plain file" for name in ("all", "link", "pipe")]


@pytest.mark.parametrize("rows", ["nonsense\n", "0" * 63 + "  a\n", "g" * 64 + "  a\n"])
def test_sums_that_are_none_are_named(folder, rows):
    (folder / "SHA256SUMS").write_text(rows)
    with pytest.raises(SessionFolderError, match="line 1 is no checksum"):
        verify_checksums(folder)


def test_sums_that_name_what_lies_outside_do_not_open_it(folder, outside):
    write_checksums(folder)
    digest = "0" * 64
    with (folder / "SHA256SUMS").open("a") as file:
        file.write(f"{digest}  ../../outside/secret\n{digest}  /etc/passwd\n")
    assert verify_checksums(folder) == ["../../outside/secret: missing", "/etc/passwd: missing"]


def test_a_session_without_sums_says_how_to_get_them(folder):
    with pytest.raises(SessionFolderError, match="chordlab finalize"):
        verify_checksums(folder)


# --- files --------------------------------------------------------------------------------------------------------


def test_a_write_that_fails_leaves_the_file_before_and_nothing_beside(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    write_aside(path, json.dumps([1]).encode())

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_aside(path, b"[2]")
    assert [found.name for found in tmp_path.iterdir()] == ["a.json"]
    assert path.read_text() == "[1]"


def test_a_file_keeps_the_users_own_mode(tmp_path):
    was = os.umask(0o027)
    try:
        write_aside(tmp_path / "a", b"")
    finally:
        os.umask(was)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


def test_folders_are_made_with_those_above_them(tmp_path):
    make_folder(tmp_path / "a/b/c")
    assert (tmp_path / "a/b/c").is_dir()
    with pytest.raises(FileExistsError):
        make_folder(tmp_path / "a/b/c")
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="directory"):
        make_folder(tmp_path / "file/b")
