"""A Dask cluster of processes on this machine, over TCP on the loopback."""

import os
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

HOME = Path(__file__).parents[2]
START_S = 90.0


class Cluster:
    """A scheduler and workers of one thread, each a process."""

    def __init__(self, place: Path) -> None:
        self.workers = []
        self._place = place
        place.mkdir(parents=True, exist_ok=True)
        self._environment = os.environ | {"PYTHONPATH": str(HOME), "DASK_DISTRIBUTED__ADMIN__EVENT_LOOP": "asyncio"}
        told = place / "scheduler.json"
        self.scheduler = self._run(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(told)
        )
        self.address = _address(told, self.scheduler)

    def add_worker(self, **environment: str) -> subprocess.Popen:
        number = len(self.workers)
        options = [
            "--host",
            "127.0.0.1",
            "--nthreads",
            "1",
            "--no-nanny",
            "--no-dashboard",
            "--memory-limit",
            "0",
            "--death-timeout",
            "20",
        ]
        place = ["--local-directory", str(self._place / f"worker{number}"), "--name", f"w{number}"]
        self.workers.append(self._run("worker", self.address, *options, *place, **environment))
        return self.workers[-1]

    def _run(self, kind: str, *arguments: str, **environment: str) -> subprocess.Popen:
        log = (self._place / f"{kind}{len(self.workers)}.log").open("wb")
        with log:
            return subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments],
                env=self._environment | environment,
                cwd=self._place,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def close(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
        for process in (*self.workers, self.scheduler):
            process.wait(30)


@contextmanager
def cluster_at(place: Path, workers: int = 2):
    cluster = Cluster(place)
    try:
        for _ in range(workers):
            cluster.add_worker()
        yield cluster
    finally:
        cluster.close()


def _address(told: Path, scheduler: subprocess.Popen) -> str:
    import json

    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and scheduler.poll() is None:
        try:
            return json.loads(told.read_text())["address"]
        except (OSError, ValueError):
            time.sleep(0.05)
    raise RuntimeError("the scheduler did not start")
