"""Power cuts at every moment of a virtual session: what the disk may hold then reads, and lacks no finished run."""

import json
import shutil

import pytest

from lab.store.layout import SessionFolderError
from lab.store.reader import SessionReader
from lab.store.writer import SessionWriter
from tests.lab.conftest import roll
from tests.lab.powercut import Disk, Recorder, key_of, lay_out


def record(root, monkeypatch, **settings):
    """Roll a session and note its steps, and when each call of its writer returned."""
    recorder = Recorder(root)
    create, append, finish = SessionWriter.create, SessionWriter.append, SessionWriter.finish

    def created(*args, **kwargs):
        writer = create(*args, **kwargs)
        recorder.promise("folder")
        return writer

    def appended(self, kind, **data):
        append(self, kind, **data)
        recorder.promise("event")

    def finished(self, state):
        finish(self, state)
        recorder.promise("end")

    with monkeypatch.context() as patch:
        patch.setattr(SessionWriter, "create", created)
        patch.setattr(SessionWriter, "append", appended)
        patch.setattr(SessionWriter, "finish", finished)
        with recorder.recording(monkeypatch):
            rolled = roll(root / "sessions", **settings)
    assert rolled.finished.failure is None
    return recorder, rolled.folder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        return record(tmp_path_factory.mktemp("disk"), patch, shape="square", stop__lines=5, seed=5)


def try_every_cut(recorder, folder, tmp_path):
    """Cut after every step; the number of different states tried."""
    whole = list(SessionReader(folder).events())
    files = {path.relative_to(folder): path.read_bytes() for path in folder.glob("lines/*/*")}
    relative = folder.relative_to(recorder.root)
    pool = tmp_path / "pool"
    pool.mkdir()
    disk = Disk(recorder.root.stat().st_ino)
    promised, tried = [], {}
    for step in recorder.steps:
        disk.take(step)
        if step[0] == "promise":
            promised.append(step[1])
        for state in disk.states():
            key = key_of(state)
            needs = (promised.count("event"), "folder" in promised, "end" in promised)
            if tried.get(key, (-1,)) >= needs:  # as much was asked of it already
                continue
            tried[key] = needs
            place = tmp_path / "cut"
            lay_out(state, place, pool)
            check(place / relative, whole, files, needs)
            shutil.rmtree(place)
    return len(tried)


def check(folder, whole, files, needs):
    events, has_folder, has_ended = needs
    try:
        session = SessionReader(folder)
        found = list(session.events())
    except SessionFolderError as error:
        assert not has_folder, error
        assert "no session folder" in str(error)  # never half a session
        return
    assert found == whole[: len(found)]
    assert len(found) >= events
    if has_ended:
        assert session.manifest["end"]["state"] == "complete"
    for event in found:
        if event["event"] == "line":
            own = {name: data for name, data in files.items() if int(name.parts[1]) == event["line"]}
            assert own
            for name, data in own.items():
                assert (folder / name).read_bytes() == data, name
    session.segments()


def test_a_power_cut_at_any_moment_takes_the_run_in_progress_at_most(recorded, tmp_path, capsys):
    recorder, folder = recorded
    runs = sum(event["event"] == "line" for event in SessionReader(folder).events())
    tried = try_every_cut(recorder, folder, tmp_path)
    with capsys.disabled():
        print(f"\npower cuts: {len(recorder.steps)} moments of {runs} runs, {tried} states of the disk")
    assert tried > 30 * runs


@pytest.mark.slow
def test_a_power_cut_takes_no_film_of_a_finished_run(tmp_path, monkeypatch, capsys, full):
    disk = tmp_path / "disk"
    disk.mkdir()
    lines = 4 if full else 1
    recorder, folder = record(disk, monkeypatch, shape="square", stop__lines=lines, seed=2, camera="virtual")
    assert SessionReader(folder).segments()
    tried = try_every_cut(recorder, folder, tmp_path)
    with capsys.disabled():
        print(f"\npower cuts while filming: {len(recorder.steps)} moments, {tried} states of the disk")


@pytest.mark.parametrize(
    "unsynced", ["events.jsonl", "manifest.json", "lines", "lines/*", "lines/*/light.parquet", ".", ".."]
)
def test_the_proof_sees_a_sync_that_is_left_out(recorded, tmp_path, unsynced):
    """The syncs of some files or folders are dropped from the record, as a program that forgot them would."""
    recorder, folder = recorded
    inodes = {path.stat().st_ino for path in (folder.glob(unsynced) if "*" in unsynced else [folder / unsynced])}
    kept = [step for step in recorder.steps if not (step[0] == "fsync" and step[1] in inodes)]
    assert len(kept) < len(recorder.steps)
    with pytest.raises((AssertionError, FileNotFoundError)):
        try_every_cut(Recorder(recorder.root, kept), folder, tmp_path)


def test_a_record_whose_first_block_never_came_is_torn(tmp_path):
    """A record of several blocks may reach the disk from its end."""
    (tmp_path / "manifest.json").write_text('{"schema_version": 3}')
    record = json.dumps({"event": "note", "text": "x" * 100}).encode() + b"\n"
    log = tmp_path / "events.jsonl"
    log.write_bytes(record + bytes(40) + record[40:])
    assert len(list(SessionReader(tmp_path).events())) == 1
    log.write_bytes(record + bytes(40) + record[40:] + record)  # what is followed by more was changed later
    with pytest.raises(SessionFolderError, match="line 2"):
        list(SessionReader(tmp_path).events())
