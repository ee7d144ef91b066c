"""Work spread over processes: each item once, a death costs one item, the same results bit for bit."""

import os
import sys
import time
from functools import partial

import numpy as np
import pytest

from analysis.kernels import available_cores
from analysis.sensor import SensorModel
from analysis.tablestore import TableStore, learn_lines
from lab.base.errors import RequestError
from lab.figures.workbench import Scale, Workbench
from lab.settings.settings import Settings
from lab.spread.spread import ItemFailedError, spread, spreading
from lab.spread.task import Failure
from lab.spread.versions import differences, digest_of_source, versions
from projector.dictionary import load_dictionary
from tests.lab.spreadtasks import cores, deadly, fussy, slow, square


def test_every_item_has_its_result_once_and_errors_are_one_line():
    found = dict(spread(fussy, range(9), workers=2))
    assert {item: found[item] for item in (0, 1, 2, 6, 7, 8)} == {item: item for item in (0, 1, 2, 6, 7, 8)}
    assert found[3] == Failure("ValueError: three is no number")
    assert found[4] == Failure("four: not wanted; give five")
    assert "cannot be sent" in found[5].reason
    assert [item for item, _ in spread(square, range(5), workers=0)] == list(range(5))


def test_a_process_that_dies_costs_its_item_alone(tmp_path):
    once = tmp_path / "once"
    found = list(spread(deadly, ["a", "kill", "b", once, "c"], workers=2))
    assert len(found) == 5
    assert {item: result for item, result in found if item != "kill"} == {
        "a": "a",
        "b": "b",
        "c": "c",
        once: str(once),  # a second try, in a new process, came through
    }
    assert dict(found)["kill"].reason.startswith("its process died 2 times (SIGKILL")


def test_workers_share_the_cores_and_end_when_nobody_listens(tmp_path, monkeypatch):
    monkeypatch.setenv("CHORDLAB_CORES", "1")
    assert available_cores() == 1
    monkeypatch.delenv("CHORDLAB_CORES")
    shares = dict(spread(cores, range(4), workers=2)).values()
    assert {share for share, _ in shares} == {max(1, available_cores() // 2)}
    drawn = []

    def items():
        for number in range(100):
            drawn.append(number)
            yield str(tmp_path), number, 0.01 if number == 0 else 60

    found = spread(slow, items(), workers=2)
    _, first = next(found)
    deadline = time.monotonic() + 30
    while not (tmp_path / "1").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert (tmp_path / "1").exists()
    began_s = time.monotonic()
    found.close()
    assert time.monotonic() - began_s < 20
    assert len(drawn) < 6
    others = {int(text) for number in range(3) for text in _marks(tmp_path / str(number))} | {first}
    assert not [pid for pid in others if _lives(pid)]


def _marks(path):
    return path.read_text().split() if path.exists() else []


def _lives(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_what_cannot_be_spread_is_refused_in_one_line(monkeypatch):
    with pytest.raises(RequestError, match="at least 0"):
        list(spread(square, [1], workers=-1))
    monkeypatch.delitem(sys.modules, "lab.spread.cluster", raising=False)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(RequestError, match=r"pip install 'chordlab\[cluster\]'"):
        list(spread(square, [1], scheduler="tcp://127.0.0.1:1"))
    with pytest.raises(ItemFailedError, match="three is no number"):
        list(spreading(workers=0)(fussy, [1, 3]))
    assert spreading() is None


def test_versions_name_what_differs_and_change_with_the_source(tmp_path):
    ours = versions()
    assert ours["numpy"] == np.__version__
    assert differences(ours, ours | {"numpy": "1.0", "chordlab": "x"}) == [
        "another chordlab",
        f"numpy 1.0 there, {np.__version__} here",
    ]
    (tmp_path / "a.py").write_text("x = 1\n")
    before = digest_of_source({"room": tmp_path})
    (tmp_path / "notes.md").write_text("no source\n")
    assert digest_of_source({"room": tmp_path}) == before
    (tmp_path / "a.py").write_text("x = 2\n")
    changed = digest_of_source({"room": tmp_path})
    (tmp_path / "a.py").rename(tmp_path / "b.py")
    assert len({before, changed, digest_of_source({"room": tmp_path})}) == 3


def test_figures_and_learnt_tables_are_the_same_whoever_works_them_out(tmp_path, monkeypatch):
    shapes = {name: shape for name, shape in load_dictionary().items() if name in ("circle", "square")}
    monkeypatch.setattr(Workbench, "shapes", shapes)
    scale = Scale(lines=60, runs=40, most_lines=300)
    alone, shared = (
        Workbench(Settings(), seed=3, scale=scale, mapper=mapper) for mapper in (None, spreading(workers=2))
    )
    assert list(alone.simulated) == list(shared.simulated) == list(shapes)
    for name, bands in alone.simulated.items():
        assert np.array_equal(bands.area_runs_cm2, shared.simulated[name].area_runs_cm2)
    geometries = {name: shape.geometry for name, shape in shapes.items()}
    sensor = SensorModel(step_cm=0.7, footprint_cm=0.3, margin=0.05, noise=0.01)
    learn = partial(learn_lines, geometries, sensor, lines=2000)
    by_threads, store = learn(), TableStore(tmp_path)
    by_processes = learn(store=store, mapper=spreading(workers=2))
    read = learn(store=store, mapper=_nobody)
    for name, lines in by_threads.items():
        for column in ("k", "l1_cm", "l3_cm3", "excess"):
            for other in (by_processes, read):
                assert np.array_equal(getattr(lines, column), getattr(other[name], column))


def _nobody(_task, items):
    assert not items
    return iter(())
