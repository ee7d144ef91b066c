"""Virtual sessions killed at random moments: each is recovered, and held against the one that was not killed."""

import itertools
import json
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lab.reopen.recover import recover
from lab.session.tally import stored_estimate
from lab.store.layout import SessionFolderError
from lab.store.reader import SessionReader
from lab.store.tables import Tables, tables_of
from tests.lab.killing import Nursery, digests

pytestmark = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs fork, SIGKILL and /proc")

PLAIN = {"shape": "square", "seed": 4, "stop__lines": 5}
SEVERAL = {"shape": "square", "seed": 4, "stop__lines": 4, "robot": ["virtual", "virtual"]}
FILMED = {"shape": "square", "seed": 4, "stop__lines": 1, "camera": "virtual"}
SEVERAL_FILMED = {**FILMED, "robot": ["virtual", "virtual"]}


@dataclass
class Counts:
    """What was seen over all kills of one kind of session."""

    kills: int = 0
    before_it_began: int = 0
    outlived: int = 0
    acknowledged: int = 0
    torn: int = 0
    lost: list[int] = field(default_factory=list)

    def __str__(self):
        return (
            f"{self.kills} kills ({self.before_it_began} before the session began, {self.outlived} children outlived "
            f"theirs), {self.acknowledged} events synced and all there, {self.torn} logs torn, at most "
            f"{max(self.lost, default=0)} run lost, {self.kills - self.before_it_began} recovered"
        )


def doom(rng, number, uncut):
    """When to die: every other one after a random time, the rest before a random operation on the file system."""
    return {"after_s": rng.uniform(0, uncut.took_s)} if number % 2 else {"at_operation": rng.integers(uncut.operations)}


def kill(out, keys, kills, most_lost, capsys):
    """Kill and recover sessions of these settings, two at a time; print what was counted."""
    counts = Counts()
    with ExitStack() as held:
        nurseries = [held.enter_context(closing(Nursery(keys, early="camera" in keys))) for _ in range(2)]
        for name in ("cold", "uncut"):  # the second takes as long as those that are killed
            nurseries[0].begin(out / name)
            uncut = nurseries[0].wait()
        log = (uncut.folder / "events.jsonl").read_bytes()
        tables = tables_of(SessionReader(uncut.folder))
        rng = np.random.default_rng(7)
        rolling = {}
        for number, nursery in enumerate(itertools.cycle(nurseries)):
            place = rolling.pop(nursery, None)
            killed = None if place is None else nursery.wait()
            counts.kills += killed is not None and killed.was_killed
            if counts.kills + len(rolling) < kills:
                rolling[nursery] = out / f"{number:04d}"
                nursery.begin(rolling[nursery], **doom(rng, number // 2, uncut))
            if killed is not None and killed.was_killed:
                hold_against(killed, place, log, tables, most_lost, counts)
            elif killed is not None:
                counts.outlived += 1
                assert recover(killed.folder).state == "complete"
            if not rolling:
                break
    with capsys.disabled():
        print(f"\n{keys}: {counts}")
    return counts


def hold_against(killed, place, log, tables, most_lost, counts):
    """One killed session: recovered, compared with the uncut one, recovered again."""
    folder = killed.folder or next(iter(place.iterdir()), None) if place.is_dir() else None
    if folder is None or not list(folder.glob("manifest.json*")):
        counts.before_it_began += 1
        if folder is not None:
            with pytest.raises(SessionFolderError, match="before its session began"):
                recover(folder)
        return
    cut = (folder / "events.jsonl").read_bytes()
    try:
        found = recover(folder)
    except SessionFolderError as error:  # the manifest itself was half written
        assert "before its session began" in str(error)
        assert cut == b""
        counts.before_it_began += 1
        return
    mended = (folder / "events.jsonl").read_bytes()
    kept = mended
    if found.state == "cut":
        *records, told, end, rest = mended.split(b"\n")
        assert rest == b""
        assert json.loads(told)["event"] == "recover"
        assert json.loads(end)["state"] == "cut"
        kept = b"".join(record + b"\n" for record in records)
        counts.torn += json.loads(told)["torn_bytes"] > 0
    # the truth is a prefix of what would have been, and holds all that was synced
    assert log.startswith(kept)
    assert kept.count(b"\n") >= killed.appended
    assert log.startswith(cut)
    counts.acknowledged += killed.appended
    counts.lost.append(len(found.lost_lines))
    assert len(found.lost_lines) <= most_lost
    # the tables are those of the uncut session up to there, the estimates to the last digit
    again = SessionReader(folder)
    for name in Tables.__slots__:
        whole = getattr(tables, name)
        table = again.table(name)
        pd.testing.assert_frame_equal(table, whole[: len(table)], check_exact=True)
    assert found.runs == len(again.table("lines")) == kept.count(b'"event": "line"')
    estimate = stored_estimate(tables.lines[: found.runs], tables.crossings)
    if estimate is None:
        assert found.estimate is None
    else:
        assert found.estimate.area_cm2 == estimate.area_cm2
        assert found.estimate.perimeter_cm == estimate.perimeter_cm
        assert np.array_equal(found.estimate.covariance, estimate.covariance, equal_nan=True)
    # every run has its samples, and nothing else passes for a run
    runs = {int(path.name) for path in (folder / "lines").iterdir() if path.name.isdigit()}
    assert runs == set(again.table("lines")["line"])
    assert not [*folder.glob("*.part"), *(folder / "lines").glob("*.part")]
    assert again.manifest["end"]["state"] == found.state
    before = digests(folder)
    assert recover(folder).done == ()
    assert digests(folder) == before


def test_a_session_killed_at_any_moment_loses_no_synced_event(tmp_path, capsys, full):
    counts = kill(tmp_path, PLAIN, 600 if full else 110, 1, capsys)
    assert counts.kills >= 100
    assert counts.torn > 0
    assert max(counts.lost) == 1


@pytest.mark.parametrize(("keys", "share"), [(SEVERAL, 2), (FILMED, 1), (SEVERAL_FILMED, 1)])
def test_so_do_several_robots_and_filmed_sessions(tmp_path, capsys, full, keys, share):
    kill(tmp_path, keys, (25 if full else 3) * share, len(keys.get("robot", [1])), capsys)
