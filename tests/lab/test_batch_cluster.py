"""A batch on a real Dask cluster: a scheduler and workers, each a process, over TCP on the loopback."""

import collections
import json
import shutil
import time

import pandas as pd
import pytest

from lab.base.errors import RequestError
from lab.batch.analyse import analyse
from lab.batch.cache import RowCache
from lab.batch.places import places_below
from lab.cli.main import main
from lab.spread.spread import spread
from lab.spread.task import ClusterError, Failure
from tests.lab.cluster import HOME, cluster_at
from tests.lab.conftest import roll
from tests.lab.spreadtasks import deadly, fussy, slow, square

SESSIONS = 9


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """Sessions of different content, two of them broken, and one there twice."""
    root = tmp_path_factory.mktemp("sessions")
    folder = roll(root, shape="square", stop__lines=4, seed=1).folder
    manifest = json.loads((folder / "manifest.json").read_text())
    for number in range(SESSIONS - 1):
        copy = shutil.copytree(folder, root / f"copy{number:02d}")
        (copy / "manifest.json").write_text(json.dumps(manifest | {"note": number}))
    (root / "copy03/events.jsonl").write_text("{torn\n")
    (root / "copy07/manifest.json").write_text("{}")
    shutil.copytree(root / "copy00", root / "same")
    return root


def test_a_worker_killed_half_way_loses_nothing_and_doubles_nothing(sessions, tmp_path):
    places = places_below([sessions])
    assert len(places) == SESSIONS + 1
    with cluster_at(tmp_path / "cluster") as cluster:
        told = []

        def progress(done, total):
            told.append(done)
            if done == total // 2:
                cluster.workers[0].kill()

        far = analyse(places, cache=RowCache(tmp_path / "cache"), scheduler=cluster.address, progress=progress)
        assert cluster.workers[0].wait(30) < 0
        assert cluster.workers[1].poll() is None
    assert far.stopped is None
    assert told == list(range(1, SESSIONS + 2))
    assert far.table["folder"].tolist() == [place.below for place in places]
    assert (far.table["error"] != "").sum() == 2
    near = analyse(places, workers=0)
    pd.testing.assert_frame_equal(*(found.table.drop(columns="seconds") for found in (far, near)), check_exact=True)
    known = analyse(places, cache=RowCache(tmp_path / "cache"), workers=0)
    assert known.computed == 2  # errors are not kept


def test_work_of_a_lost_worker_is_begun_again_and_no_other(tmp_path):
    with cluster_at(tmp_path / "cluster") as cluster:
        marks = tmp_path / "marks"
        marks.mkdir()
        found, killed = [], None
        for (_, number, _), pid in spread(slow, [(marks, n, 0.05) for n in range(60)], scheduler=cluster.address):
            found.append(number)
            if len(found) == 20:
                killed = cluster.workers[0].pid
                cluster.workers[0].kill()
            assert isinstance(pid, int)
        begun = {number: (marks / str(number)).read_text().split() for number in range(60)}
    assert sorted(found) == list(range(60))
    twice = {number: pids for number, pids in begun.items() if len(pids) > 1}
    assert all(str(killed) in pids for pids in twice.values())
    # what it was at, and what it had finished that had not been fetched yet: at most all that was with the cluster
    assert len(twice) <= 6
    assert collections.Counter(pid for pids in begun.values() for pid in pids)[str(killed)] >= 5


def test_a_cluster_tells_in_one_line_what_is_wrong(tmp_path, sessions, capsys, monkeypatch):
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")
    with cluster_at(tmp_path / "cluster", workers=0) as cluster:
        with monkeypatch.context() as patched, pytest.raises(RequestError, match="no workers; start some: dask worker"):
            patched.setattr("lab.spread.cluster._CONNECT_S", 2.0)
            list(spread(square, [1], scheduler=cluster.address))
        for _ in range(2):
            cluster.add_worker()
        found = list(spread(deadly, ["kill"], scheduler=cluster.address))
        assert found == [("kill", Failure("1 workers died while they worked on it"))]
        assert dict(spread(fussy, range(5), scheduler=cluster.address))[3] == Failure("ValueError: three is no number")
        stranger = tmp_path / "other/numpy-0.1.dist-info"
        stranger.mkdir(parents=True)
        (stranger / "METADATA").write_text("Metadata-Version: 2.1\nName: numpy\nVersion: 0.1\n")
        cluster.add_worker(PYTHONPATH=f"{stranger.parent}:{HOME}")
        deadline = time.monotonic() + 60
        with pytest.raises(RequestError, match=r"numpy 0\.1 there, .* install the same versions"):
            while time.monotonic() < deadline:
                list(spread(square, range(20), scheduler=cluster.address))
        address = cluster.address
        cluster.workers[2].kill()
        cluster.workers[2].wait(30)
        under_way = spread(slow, [(tmp_path, n, 0.5) for n in range(20)], scheduler=address)
        next(under_way)
        cluster.scheduler.kill()
        with pytest.raises(ClusterError, match=r"scheduler .*the same command goes on"):
            list(under_way)
    assert main(["batch", str(sessions), "--out", str(tmp_path / "out"), "--scheduler", address]) == 2
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1
    assert "no scheduler answers" in said
