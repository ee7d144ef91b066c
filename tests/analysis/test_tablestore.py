import os
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapely import affinity
from shapely.geometry import Polygon, box

from analysis.boundary import BoundaryError
from analysis.sensor import SensorModel
from analysis.tablestore import TableStore, cache_folder, learn_lines
from lab.base.errors import RequestError

SENSOR = SensorModel(1.0, 0.3, margin=0.06, noise=0.01, speed_sigma=0.02)
ARRAYS = {"k": np.arange(5, dtype=np.uint16), "lengths": np.linspace(0, 1, 7).reshape(7, 1)}


@pytest.fixture
def store(tmp_path):
    return TableStore(tmp_path / "kept")


@pytest.fixture
def few(shapes):
    return {name: shapes[name] for name in ("square", "ell", "tower")}


def files(store):
    return sorted(store.folder.glob("*"))


def same(one, two):
    assert one.keys() == two.keys()
    for name, lines in one.items():
        other = two[name]
        for a, b in zip(lines.invariants(), other.invariants(), strict=True):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(lines.excess, other.excess)
        assert lines.measure_per_line_cm == other.measure_per_line_cm


def test_the_folder_is_the_users_choice_or_the_systems(monkeypatch):
    assert cache_folder({"CHORDLAB_CACHE": "/somewhere/else", "XDG_CACHE_HOME": "/x"}) == Path("/somewhere/else")
    monkeypatch.setattr("sys.platform", "linux")
    assert cache_folder({"XDG_CACHE_HOME": "/x"}) == Path("/x/chordlab")
    home = Path.home()
    assert cache_folder({}) == cache_folder({"XDG_CACHE_HOME": "not/absolute"}) == home / ".cache/chordlab"
    assert cache_folder({"CHORDLAB_CACHE": ""}) == home / ".cache/chordlab"
    monkeypatch.setattr("sys.platform", "darwin")
    assert cache_folder({}) == home / "Library/Caches/chordlab"
    monkeypatch.setattr("sys.platform", "win32")
    assert cache_folder({"LOCALAPPDATA": "/local"}) == Path("/local/chordlab")
    monkeypatch.setenv("CHORDLAB_CACHE", "/mine")
    assert TableStore().folder == Path("/mine/sensed")


def test_what_is_saved_is_loaded(store):
    assert store.load("key") is None
    store.save("key", ARRAYS)
    loaded = store.load("key")
    assert loaded.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(loaded[name], array)
        assert loaded[name].dtype == array.dtype
    assert [path.name for path in files(store)] == ["key.lines"]


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "foreign"])
def test_a_damaged_file_is_as_good_as_none(store, damage):
    store.save("key", ARRAYS)
    (path,) = files(store)
    data = bytearray(path.read_bytes())
    match damage:
        case "cut":
            del data[-20:]
        case "flip":
            data[len(data) // 2] ^= 1
        case "empty":
            data.clear()
        case "foreign":
            data[:] = b"something else altogether, and longer than a digest"
    path.write_bytes(data)
    assert store.load("key") is None
    assert files(store) == []
    store.save("key", ARRAYS)
    assert store.load("key") is not None


def test_a_folder_that_cannot_be_written_keeps_nothing_and_says_nothing(tmp_path, few):
    (tmp_path / "file").write_text("in the way")
    store = TableStore(tmp_path / "file" / "kept")
    store.save("key", ARRAYS)
    assert store.load("key") is None
    store.tidy()
    same(learn_lines(few, SENSOR, lines=500, store=store), learn_lines(few, SENSOR, lines=500))


def test_what_was_used_last_is_kept(tmp_path):
    store = TableStore(tmp_path)
    for age, key in enumerate(("new", "old", "older", "oldest")):
        store.save(key, ARRAYS)
        os.utime(tmp_path / f"{key}.lines", (1e9 - age, 1e9 - age))
    (tmp_path / "crashed.lines.part").write_bytes(bytes(100))
    os.utime(tmp_path / "crashed.lines.part", (0, 0))
    size = (tmp_path / "new.lines").stat().st_size
    assert store.load("oldest") is not None  # which makes it the newest
    TableStore(tmp_path, limit_bytes=2 * size).tidy()
    assert {path.name for path in tmp_path.iterdir()} == {"new.lines", "oldest.lines"}
    TableStore(tmp_path, limit_bytes=0).tidy()
    assert list(tmp_path.iterdir()) == []


def test_learnt_read_and_learnt_again_are_the_same_to_the_last_bit(store, few):
    fresh = learn_lines(few, SENSOR, lines=3000)
    same(fresh, learn_lines(few, SENSOR, lines=3000, store=store))
    assert len(files(store)) == 3
    same(fresh, learn_lines(few, SENSOR, lines=3000, store=store))
    files(store)[0].write_bytes(b"damaged")
    same(fresh, learn_lines(few, SENSOR, lines=3000, store=store))


def test_what_is_kept_is_read_and_not_learnt(store, few):
    learn_lines(few, SENSOR, lines=500, store=store)
    for path in files(store):
        kept = store.load(path.stem)
        store.save(path.stem, {**kept, "k": kept["k"] * 0 + 9})
    assert all((lines.k == 9).all() for lines in learn_lines(few, SENSOR, lines=500, store=store).values())


def test_files_of_another_make_are_learnt_anew(store, few):
    fresh = learn_lines(few, SENSOR, lines=500, store=store)
    for path in files(store):
        store.save(path.stem, {"k": np.arange(3)})
    same(fresh, learn_lines(few, SENSOR, lines=500, store=store))


def test_an_entry_does_not_depend_on_the_others_nor_on_the_workers(few):
    together = learn_lines(few, SENSOR, lines=2000, workers=3)
    alone = learn_lines({"tower": few["tower"]}, SENSOR, lines=2000, workers=1)
    turned_round = learn_lines(dict(reversed(few.items())), SENSOR, lines=2000, workers=2)
    same(alone, {"tower": together["tower"]})
    same(together, {name: turned_round[name] for name in few})
    assert list(turned_round) == ["tower", "ell", "square"]


def test_every_ingredient_makes_a_file_of_its_own(store, few):
    square = {"square": few["square"]}
    learn_lines(square, SENSOR, lines=200, store=store)
    others = [replace(SENSOR, **{name: getattr(SENSOR, name) + 1e-9}) for name in SensorModel.__slots__]
    for sensor in others:
        learn_lines(square, sensor, lines=200, store=store)
    learn_lines(square, SENSOR, lines=201, store=store)
    learn_lines(square, SENSOR, lines=200, seed=1, store=store)
    learn_lines({"square": affinity.translate(few["square"], 0.01)}, SENSOR, lines=200, store=store)
    assert len(files(store)) == 1 + len(others) + 3
    same_outline = {"other name": affinity.translate(few["square"], 1e-9)}
    learn_lines(same_outline, SENSOR, lines=200, store=store)
    assert len(files(store)) == 1 + len(others) + 3


def test_a_change_of_the_code_makes_all_files_stale(store, few, monkeypatch):
    learn_lines(few, SENSOR, lines=200, store=store)
    monkeypatch.setattr("analysis.tablestore._code_digest", lambda: "another version")
    learn_lines(few, SENSOR, lines=200, store=store)
    assert len(files(store)) == 6


def test_learning_tells_how_far_it_is(store, few):
    steps, threads = [], set()

    def progress(done, total):
        steps.append((done, total))
        threads.add(threading.get_ident())

    learn_lines(few, SENSOR, lines=200, store=store, progress=progress)
    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert threads == {threading.get_ident()}


def test_bad_requests_are_refused():
    with pytest.raises(RequestError, match="empty"):
        learn_lines({}, SENSOR)
    with pytest.raises(RequestError, match="lines"):
        learn_lines({"box": box(0, 0, 1, 1)}, SENSOR, lines=0)
    with pytest.raises(BoundaryError):
        learn_lines({"bow": Polygon([(0, 0), (1, 1), (1, 0), (0, 1)])}, SENSOR, lines=10)
