"""A batch: sessions a second here and on a cluster, memory against the number of sessions, a second run."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lab.batch.analyse import analyse
from lab.batch.cache import RowCache
from lab.batch.places import places_below
from tests.lab.cluster import HOME, cluster_at
from tests.lab.conftest import roll

FEW, MANY, MEASURED = 50, 200, 8

# What a batch costs in memory: prints the largest that its own process and its largest worker were seen, in MB.
_PEAK = """
import json, sys
from pathlib import Path
import psutil
from lab.batch.analyse import analyse
from lab.batch.places import places_below
if __name__ == "__main__":
    here, peaks = psutil.Process(), [0, 0]
    def look(done, total):
        workers = [process.memory_info().rss for process in here.children()]
        peaks[:] = max(peaks[0], here.memory_info().rss), max(peaks[1], *workers)
    found = analyse(places_below([Path(sys.argv[1])]), workers=2, progress=look)
    print(json.dumps([len(found.table), int((found.table["error"] != "").sum()), *(peak / 2**20 for peak in peaks)]))
"""


def many(root: Path, count: int, lines: int) -> Path:
    """Small sessions without a video, each of a content of its own, made from one that was rolled."""
    made = roll(root / "rolled", shape="square", stop__lines=lines, seed=1).folder
    manifest = json.loads((made / "manifest.json").read_text())
    for number in range(count):
        folder = shutil.copytree(made, root / f"sessions/{number:04d}")
        (folder / "manifest.json").write_text(json.dumps(manifest | {"note": number}))
    return root / "sessions"


@pytest.fixture(scope="module")
def sessions(tmp_path_factory) -> Path:
    return many(tmp_path_factory.mktemp("batch"), MEASURED, lines=12)


def test_sessions_a_second_here_and_on_a_cluster(benchmark, sessions, tmp_path):
    places = places_below([sessions])

    def rate(**options):
        began_s = time.perf_counter()
        found = analyse(places, **options)
        assert (found.table["error"] == "").all()
        assert found.computed == MEASURED
        return MEASURED / (time.perf_counter() - began_s)

    rates = {f"{workers}_workers": rate(workers=workers) for workers in (1, 2)}
    with cluster_at(tmp_path / "cluster") as cluster:
        rate(scheduler=cluster.address)  # its workers import the program once, not with each batch
        rates["cluster_of_2"] = rate(scheduler=cluster.address)
    # the same without any process: the limit of one core
    began_s = time.perf_counter()
    benchmark.pedantic(analyse, (places,), {"workers": 0}, rounds=1)
    rates["in_this_process"] = MEASURED / (time.perf_counter() - began_s)
    benchmark.extra_info |= {f"sessions_per_s_{name}": found for name, found in rates.items()}
    benchmark.extra_info["two_workers_over_one"] = rates["2_workers"] / rates["1_workers"]
    benchmark.extra_info["cluster_over_two_workers"] = rates["cluster_of_2"] / rates["2_workers"]


def test_a_second_run_is_looked_up(benchmark, sessions, tmp_path):
    places = places_below([sessions])
    for path in sessions.rglob("*"):
        os.utime(path, (1, 1))  # files that were written long ago, as a second run finds them
    began_s = time.perf_counter()
    first = analyse(places, cache=RowCache(tmp_path), workers=2)
    first_s = time.perf_counter() - began_s
    second = benchmark(lambda: analyse(places, cache=RowCache(tmp_path), workers=2))
    assert (first.computed, second.computed) == (MEASURED, 0)
    benchmark.extra_info["first_run_s"] = first_s
    benchmark.extra_info["first_over_second"] = first_s / benchmark.stats.stats.median


def test_memory_is_flat_in_the_number_of_sessions(benchmark, tmp_path):
    root = many(tmp_path / "many", MANY, lines=3)
    few = tmp_path / "few"
    few.mkdir()
    for folder in sorted(root.iterdir())[:FEW]:
        shutil.copytree(folder, few / folder.name)
    script = tmp_path / "peak.py"
    script.write_text(_PEAK)

    def peak(sessions):
        environment = os.environ | {"PYTHONPATH": str(HOME)}
        command = [sys.executable, str(script), str(sessions)]
        told = subprocess.run(command, env=environment, capture_output=True, check=True, timeout=900)
        return json.loads(told.stdout)

    with_few = peak(few)
    with_many = benchmark.pedantic(peak, (root,), rounds=1)
    assert (with_few[:2], with_many[:2]) == ([FEW, 0], [MANY, 0])
    for place, who in enumerate(("asking_process", "largest_worker"), start=2):
        benchmark.extra_info |= {f"{who}_mb_{FEW}": with_few[place], f"{who}_mb_{MANY}": with_many[place]}
        benchmark.extra_info[f"{who}_ratio"] = with_many[place] / with_few[place]
