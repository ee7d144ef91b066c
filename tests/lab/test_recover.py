"""A session's folder after a cut: what is whole stays, what is torn is set aside, nothing is deleted."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from lab.cli.main import main
from lab.reopen.recover import recover
from lab.session.tally import stored_estimate
from lab.store.layout import SessionFolderError
from lab.store.lock import writing
from lab.store.reader import SessionReader
from lab.store.salvage import salvage
from lab.store.seal import write_checksums
from lab.store.tables import finalize
from lab.store.writer import SessionWriter
from tests.lab.conftest import STARTED, roll
from tests.lab.killing import digests, mend_dying
from tests.lab.test_store import line_event

LOG = "events.jsonl"
LIGHT = pd.DataFrame({"t_host_s": [0.0, 0.05], "light_lux": [20.0, 120.0]})


@pytest.fixture(scope="module")
def rolled(tmp_path_factory):
    """A session of one robot that ended well; copied, never written to."""
    return roll(tmp_path_factory.mktemp("rolled"), shape="square", stop__lines=4, seed=3).folder


@pytest.fixture
def whole(rolled, tmp_path):
    """A copy of it, with tables and sums."""
    folder = copied(rolled, tmp_path / "whole")
    finalize(folder)
    write_checksums(folder)
    return folder


@pytest.fixture
def running(tmp_path):
    """A small session that was killed after three runs."""
    return killed(tmp_path / "running")


def killed(root, runs=3):
    made = SessionWriter.create(root, "square", {"seed": 3}, started=STARTED, tag="ab12")
    made.append("start", t_s=0.0, levels=[])
    for line in range(runs):
        made.commit_line(line, LIGHT)
        made.append("line", **line_event(line))
    made.close()
    return made.folder


def copied(folder, to):
    shutil.copytree(folder, to)
    return to


def records(folder):
    return [json.loads(record) for record in (folder / LOG).read_bytes().splitlines()]


def unended(folder):
    """Take the end of a session away, as if it had been killed."""
    log = (folder / LOG).read_bytes().splitlines(keepends=True)
    assert b'"end"' in log.pop()
    (folder / LOG).write_bytes(b"".join(log))
    manifest = json.loads((folder / "manifest.json").read_text())
    del manifest["end"]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


def is_still_there(before: Path, after: Path) -> bool:
    """Whether every byte of a folder is still somewhere in the mended one; tables are made, not kept."""
    found = set(digests(after).values())
    made = {LOG, "manifest.json", "lines.parquet", "crossings.parquet", "estimates.parquet", "writer.lock"}
    if not {digest for name, digest in digests(before).items() if name not in made} <= found:
        return False
    old, new = (json.loads((folder / "manifest.json").read_text()) for folder in (before, after))
    if {**old, "end": None} != {**new, "end": None}:
        return False
    held = sorted(after.glob(f"{LOG}*"))
    rest = (before / LOG).read_bytes()
    pieces = [piece for path in held for piece in path.read_bytes().splitlines(keepends=True)]
    return all(any(record in piece for piece in pieces) for record in rest.splitlines(keepends=True))


def test_a_whole_session_is_left_as_it_is(whole):
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in whole.rglob("*") if path.is_file()}
    found = recover(whole)
    assert found.done == found.changed == found.lost_lines == ()
    assert found.state == "complete"
    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in whole.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("state", ["failed", "interrupted"])
def test_one_that_was_broken_off_had_ended_too(running, state):
    """It lacks its tables and sums, no more; the film of the run that it broke off stays where it is."""
    with (running / LOG).open("a") as log:
        log.write(json.dumps({"event": "end", "t_s": 9.0, "state": state, "runs": 3, "n": 3, "rolling_s": 9.0}) + "\n")
    (running / "lines/000003.part").mkdir()
    (running / "lines/000003.part/video.mkv").write_bytes(b"film")
    log = (running / LOG).read_bytes()
    assert recover(running).state == state
    assert (running / LOG).read_bytes() == log
    assert (running / "lines/000003.part/video.mkv").read_bytes() == b"film"
    assert SessionReader(running).manifest["end"] == {"state": state, "runs": 3, "n": 3, "rolling_s": 9.0}
    before = digests(running)
    assert recover(running).done == ()
    assert digests(running) == before


def test_a_killed_session_gets_its_end_and_its_tables(running):
    found = recover(running)
    assert [record["event"] for record in records(running)[-2:]] == ["recover", "end"]
    assert records(running)[-1] == {"event": "end", "t_s": 2.5, "state": "cut", "runs": 3, "n": 3, "rolling_s": 2.5}
    assert SessionReader(running).manifest["end"] == {"state": "cut", "runs": 3, "n": 3, "rolling_s": 2.5}
    tables = SessionReader(running)
    assert tables.table("lines")["line"].tolist() == [0, 1, 2]
    assert found.estimate.area_cm2 == stored_estimate(tables.table("lines"), tables.table("crossings")).area_cm2
    assert (found.runs, found.lines, found.state) == (3, 3, "cut")
    checked = subprocess.run(["sha256sum", "-c", "SHA256SUMS"], cwd=running, capture_output=True, check=False)
    assert checked.returncode == 0


def test_records_in_the_middle_are_set_aside_and_their_runs_named(running, tmp_path):
    lines = (running / LOG).read_bytes().splitlines(keepends=True)
    lines[2] = b"\0" * 40 + b"\n"
    (running / LOG).write_bytes(b"".join(lines) + b'{"crossings": [[')
    before = copied(running, tmp_path / "before")
    found = recover(running)
    assert found.lost_lines == (1, 3)
    assert (running / f"{LOG}.3.torn").read_bytes() == lines[2]
    assert (running / f"{LOG}.torn").read_bytes() == b'{"crossings": [['
    assert [record.get("line") for record in records(running)] == [None, 0, 2, None, None]
    told = records(running)[-2]
    assert told["lost_lines"] == [1, 3]
    assert told["torn_bytes"] == 41 + 16
    assert told["torn_file"] == f"{LOG}.torn"
    assert told["set_aside"] == [f"{LOG}.3.torn", f"{LOG}.torn", "lines/000001.cut"]
    assert (running / "lines/000001.cut/light.parquet").is_file()
    assert is_still_there(before, running)
    assert recover(running).done == ()
    assert recover(running).lost_lines == (1, 3)


@pytest.mark.parametrize(
    "record",
    [
        b"[1]",
        json.dumps({"event": "line", **line_event(0)}).encode(),
        b'{"a": 1}',
        b'{"event": "line", "line": 1}',
        b'{"event": 3}',
        b"",
        b"\xff\xfe",
        b"[" * 100_000,
    ],
)
def test_what_no_table_can_take_is_no_record(running, record):
    lines = (running / LOG).read_bytes().splitlines(keepends=True)
    lines[2] = record + b"\n"
    (running / LOG).write_bytes(b"".join(lines))
    assert 1 in recover(running).lost_lines
    assert (running / f"{LOG}.3.torn").read_bytes() == record + b"\n"
    assert SessionReader(running).table("lines")["line"].tolist() == [0, 2]


def test_a_second_tear_has_a_file_of_its_own(running):
    for name, torn in ((f"{LOG}.torn", b'{"torn'), (f"{LOG}.torn.2", b"\0\0\0")):
        with (running / LOG).open("ab") as log:
            log.write(torn)
        recover(running)
        assert (running / name).read_bytes() == torn
    assert (running / f"{LOG}.torn").read_bytes() == b'{"torn'
    assert [record["event"] for record in records(running)[-4:]] == ["recover", "end"] * 2


def test_what_was_being_written_is_no_run(running, tmp_path):
    for name in ("000003.part", "film-000004.part", "000005"):
        (running / "lines" / name).mkdir()
        (running / "lines" / name / "video.mkv").write_bytes(name.encode())
    (running / "lines/000003.cut").mkdir()
    (running / "lines.parquet.part").write_bytes(b"half a table")
    before = copied(running, tmp_path / "before")
    found = recover(running)
    assert found.lost_lines == (3, 5)
    assert (running / "lines/000003.cut.2/video.mkv").read_bytes() == b"000003.part"
    assert (running / "lines/film-000004.cut/video.mkv").read_bytes() == b"film-000004.part"
    assert (running / "lines/000005.cut/video.mkv").read_bytes() == b"000005"
    assert (running / "lines.parquet.cut").read_bytes() == b"half a table"
    assert SessionReader(running).segments() == {}
    assert is_still_there(before, running)


def test_a_session_that_was_resumed_and_cut_again(running):
    recover(running)
    with (running / LOG).open("a") as log:
        log.write(json.dumps({"event": "start", "t_s": 10.0, "levels": [], "resumed": True, "part": 1}) + "\n")
        log.write(json.dumps({"event": "line", **line_event(5), "t_end_s": 14.0}) + "\n")
    (running / "lines/000005").mkdir()
    (running / "lines/000006.part").mkdir()
    found = recover(running)
    assert found.lost_lines == (3, 4, 6)  # the numbers before the first part's end are not asked for again
    assert records(running)[-1]["rolling_s"] == 2.5 + 4.0
    assert records(running)[-1]["runs"] == 4
    assert recover(running).done == ()


def test_a_manifest_that_was_being_written_is_put_in_its_place(running):
    (running / "manifest.json").rename(running / "manifest.json.part")
    wanted = recover(running, dry_run=True)
    assert wanted.done == ("manifest.json.part is renamed to manifest.json",)
    assert wanted.state == ""
    found = recover(running)
    assert found.done[0] == wanted.done[0]
    assert found.state == "cut"
    (running / "manifest.json").rename(running / "manifest.json.part")
    (running / "manifest.json").write_bytes(b"\0" * 100)
    recover(running)
    assert (running / "manifest.json.cut").read_bytes() == b"\0" * 100
    assert recover(running).done == ()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda folder: (folder / "manifest.json").unlink(), "same settings"),
        (lambda folder: (folder / LOG).unlink(), "put it back"),
        (shutil.rmtree, "no folder"),
        (lambda folder: (folder / "manifest.json").write_text('{"schema_version": 99}'), "newer"),
        (lambda folder: [path.unlink() for path in (folder / LOG, folder / "manifest.json")], "is no session"),
    ],
)
def test_what_cannot_be_mended_is_one_line(running, change, says, capsys):
    change(running)
    before = digests(running) if running.is_dir() else {}
    assert main(["recover", str(running)]) == 2
    told = capsys.readouterr().err
    assert says in told
    assert told.count("\n") == 1
    assert (digests(running) if running.is_dir() else {}) == before


def test_a_folder_that_is_being_written_is_refused(running):
    held = subprocess.Popen(
        [sys.executable, "-c", f"from lab.store.lock import writing; from pathlib import Path\n"
         f"with writing(Path({str(running)!r})): print(flush=True); input()"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    held.stdout.readline()
    try:
        before = digests(running)
        with pytest.raises(SessionFolderError, match=f"process {held.pid}"):
            recover(running)
        assert digests(running) == before
    finally:
        held.communicate(b"\n", timeout=20)
    assert recover(running).state == "cut"
    with writing(running):  # and within one process the lock is shared
        assert recover(running).done == ()


def test_a_dry_run_says_it_all_and_does_nothing(running):
    (running / "lines/000003.part").mkdir()
    before = digests(running)
    wanted = recover(running, dry_run=True)
    assert digests(running) == before
    assert recover(running).done == wanted.done


def test_changed_files_are_named_and_left(whole):
    light = sorted(whole.glob("lines/*/light.parquet"))[0]
    light.write_bytes(b"changed")
    before = digests(whole)
    found = recover(whole)
    assert found.changed == (f"{light.relative_to(whole).as_posix()}: changed",)
    assert found.done == ()
    assert digests(whole) == before
    # when something is to be mended the old sums, which are the evidence, are kept
    (whole / "lines.parquet").unlink()
    sums = (whole / "SHA256SUMS").read_bytes()
    assert f"{light.relative_to(whole).as_posix()}: changed" in recover(whole).changed
    assert (whole / "SHA256SUMS.cut").read_bytes() == sums
    (whole / "SHA256SUMS").write_bytes(b"\0" * 50)
    assert recover(whole).changed == ("SHA256SUMS: torn",)
    assert recover(whole).done == recover(whole).changed == ()


def test_the_command_says_what_was_lost_and_what_is_whole(rolled, tmp_path, capsys):
    folder = unended(copied(rolled, tmp_path / "cut"))
    with (folder / LOG).open("ab") as log:
        log.write(b'{"counts": tr')
    assert main(["recover", str(folder)]) == 0
    told = capsys.readouterr().out
    assert f"13 bytes of {LOG}" in told
    assert "±" in told
    assert main(["recover", str(folder), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["done"] == []
    assert found["state"] == "cut"
    assert found["lines"] == 4
    assert found["estimate"]["area_cm2"] > 0
    assert main(["recover", str(folder)]) == 0
    assert "nothing to mend" in capsys.readouterr().out
    assert main(["validate", str(folder), "--no-report"]) == 0


def kept_and_torn(log, cut, nuls):
    """What is whole, and what is not, of a log of good records that was cut; a record may lack its newline."""
    kept = log[: cut + 1] if log[cut : cut + 1] == b"\n" else log[: log.rfind(b"\n", 0, cut) + 1]
    return kept, log[len(kept) : cut] + b"\0" * nuls


@pytest.mark.parametrize("nuls", [0, 64])
def test_a_log_cut_at_every_byte_of_its_last_records(tmp_path, full, capsys, monkeypatch, nuls):
    """And, as some file systems leave it, with NUL bytes up to its old length."""
    source = killed(tmp_path / "source", runs=2)
    log = (source / LOG).read_bytes()
    one, two = (len(b"".join(log.splitlines(keepends=True)[:-back])) for back in (1, 2))
    for cut in range(two, len(log) + 1):  # at every byte: nothing is lost, nothing is kept that is not whole
        saved = salvage(log[:cut] + b"\0" * nuls)
        kept, torn = kept_and_torn(log, cut, nuls)
        assert (saved.kept, b"".join(stretch.data for stretch in saved.torn)) == (kept, torn)
    monkeypatch.setattr(os, "fsync", lambda _: None)  # a thousand recoveries; what is synced is shown elsewhere
    cuts = range(two, len(log)) if full else [*range(two, one, 40), *range(one, len(log), 40 if nuls else 6)]
    for cut in cuts:
        folder = copied(source, tmp_path / "cut")
        (folder / LOG).write_bytes(log[:cut] + b"\0" * nuls)
        recover(folder)
        kept, torn = kept_and_torn(log, cut, nuls)
        mended = (folder / LOG).read_bytes()
        assert mended.startswith(kept)
        assert [json.loads(record)["event"] for record in mended[len(kept) :].splitlines()] == ["recover", "end"]
        if torn:
            assert (folder / f"{LOG}.torn").read_bytes() == torn
        assert len(SessionReader(folder).table("lines")) == kept.count(b"\n") - 1
        before = digests(folder)
        assert recover(folder).done == ()
        assert digests(folder) == before
        shutil.rmtree(folder)
    with capsys.disabled():
        places = len(log) + 1 - two
        print(f"\nlog cut at each of {places} bytes of its last two records, {nuls} NUL bytes after: sorted aright")
        print(f"folders of {len(cuts)} of them recovered")


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs fork, SIGKILL and /proc")
def test_recovery_may_itself_be_killed_before_any_of_its_operations(running, tmp_path, full, capsys):
    write_checksums(running)
    lines = (running / LOG).read_bytes().splitlines(keepends=True)
    lines[2] = b"{torn}\n"
    (running / LOG).write_bytes(b"".join(lines) + b'{"torn": ')
    for name in ("000003.part", "film-000004.part", "000005"):
        (running / "lines" / name).mkdir()
        (running / "lines" / name / "video.mkv").write_bytes(name.encode())
    (running / "manifest.json").rename(running / "manifest.json.part")
    (running / "lines.parquet.part").write_bytes(b"half a table")
    uncut = copied(running, tmp_path / "uncut")
    operations = mend_dying(uncut, None)
    before = copied(running, tmp_path / "before")
    (before / "manifest.json.part").rename(before / "manifest.json")
    cuts = range(0, operations, 1 if full else 4)
    for operation in cuts:
        folder = copied(running, tmp_path / "cut")
        assert mend_dying(folder, operation) is None
        recover(folder)
        assert is_still_there(before, folder)
        kept = [record for record in records(folder) if record["event"] not in {"recover", "end"}]
        assert kept == [record for record in records(uncut) if record["event"] not in {"recover", "end"}]
        lost = {line for record in records(folder) for line in record.get("lost_lines", [])}
        assert lost == {1, 3, 5}
        assert not [*folder.glob("*.part"), *(folder / "lines").glob("*.part")]
        assert SessionReader(folder).table("lines")["line"].tolist() == [0, 2]
        known = digests(folder)
        assert recover(folder).done == ()
        assert digests(folder) == known
        shutil.rmtree(folder)
    with capsys.disabled():
        print(f"\nrecovery killed before {len(cuts)} of its {operations} operations, and recovered each time")
