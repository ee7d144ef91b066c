"""What it costs to have a run on the disk for good: against the bare syncs of the same bytes on the same disk."""

import itertools
import json
import os
import statistics
import time
from datetime import datetime

import numpy as np
import pandas as pd
import pytest

from lab.store.reader import SessionReader
from lab.store.writer import SessionWriter
from tests.lab.test_store import line_event

RUNS = 60
SAMPLES = 80  # of light, on a run of 4 s


@pytest.fixture(scope="module")
def run():
    """One run's raw samples and its event."""
    rng = np.random.default_rng(1)
    columns = ["t_host_s", "light_lux", "x_cm", "y_cm", "speed_cm_s"]
    light = pd.DataFrame(rng.normal(50, 20, (SAMPLES, len(columns))), columns=columns)
    estimate = {
        "n": 1, "area_cm2": 912.345678, "perimeter_cm": 301.234567, "sigma_area_cm2": 31.234567,
        "sigma_perimeter_cm": 12.345678, "correlation": 0.512345, "leading": "eiffel", "posterior": 0.412345,
    }  # fmt: skip
    return light, line_event(0, estimate=estimate)


def bare_s(folder, light_bytes, event_bytes):
    """Seconds to write and sync a run's bytes: two files, no names, no order. The least that any store must pay."""
    log = os.open(folder / "bare.log", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    taken = []
    for number in range(RUNS):
        began = time.perf_counter()
        own = os.open(folder / f"bare{number}", os.O_WRONLY | os.O_CREAT)
        os.write(own, light_bytes)
        os.fsync(own)
        os.close(own)
        os.write(log, event_bytes)
        os.fsync(log)
        taken.append(time.perf_counter() - began)
    os.close(log)
    return statistics.median(taken)


def test_line_synced(benchmark, tmp_path, run):
    """`commit_line` and `append`: 4 syncs that keep the order, and the Parquet file; the bare peer has 2 syncs."""
    light, event = run
    writer = SessionWriter.create(tmp_path, "square", {}, started=datetime(2026, 11, 23), tag="t")
    lines = itertools.count()

    def one_line():
        line = next(lines)
        writer.commit_line(line, light)
        writer.append("line", **(event | {"line": line}))

    benchmark.pedantic(one_line, rounds=RUNS, warmup_rounds=3)
    syncs = count_syncs(one_line)
    writer.close()
    size = (writer.folder / "lines/000000/light.parquet").read_bytes()
    bare = bare_s(tmp_path, size, (writer.folder / "events.jsonl").read_bytes().splitlines(keepends=True)[0])
    began = time.perf_counter()
    for _ in range(RUNS):
        light.to_parquet(index=False)
    parquet = (time.perf_counter() - began) / RUNS
    median = benchmark.stats.stats.median
    benchmark.extra_info.update(
        bare_syncs_ms=1e3 * bare, parquet_ms=1e3 * parquet, syncs=syncs, ratio_to_bare_syncs=median / bare,
        bytes_a_line=len(size),
    )  # fmt: skip


def count_syncs(call):
    """How many times a call waits for the disk."""
    with pytest.MonkeyPatch.context() as patch:
        waits, real = [], os.fsync
        patch.setattr(os, "fsync", lambda descriptor: (waits.append(descriptor), real(descriptor)))
        call()
    return len(waits)


def test_log_read(benchmark, tmp_path, run):
    """A log of 10 000 lines, read and upgraded; ``ratio`` against `json.loads` of the same records."""
    writer = SessionWriter.create(tmp_path, "square", {}, started=datetime(2026, 11, 23), tag="t")
    writer.append("line", **run[1])
    writer.close()
    log = writer.folder / "events.jsonl"
    log.write_bytes(log.read_bytes() * 10_000)
    events = benchmark.pedantic(lambda: list(SessionReader(writer.folder).events()), rounds=5)
    assert len(events) == 10_000
    began = time.perf_counter()
    for record in log.read_bytes().splitlines():
        json.loads(record)
    benchmark.extra_info["ratio_to_json_loads"] = benchmark.stats.stats.median / (time.perf_counter() - began)
