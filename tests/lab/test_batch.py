"""Many stored sessions: one row each, whatever is wrong with them, nothing done twice, nothing written in them."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from analysis.quadrature import exact_moments
from lab.base.errors import RequestError
from lab.batch import analyse as analysis_of_many
from lab.batch.analyse import analyse
from lab.batch.cache import RowCache, key_of
from lab.batch.digests import Digests
from lab.batch.places import places_below
from lab.batch.rows import COLUMNS, row_of
from lab.batch.shapes import per_shape
from lab.recognise.recognisers import Recognition
from lab.store.lock import writing
from lab.store.seal import write_checksums
from projector.dictionary import load_dictionary
from tests.lab.conftest import roll

HOME = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def rolled(tmp_path_factory) -> Path:
    """Three short sessions, of two shapes."""
    root = tmp_path_factory.mktemp("rolled")
    for seed, shape in ((1, "square"), (2, "square"), (3, "circle")):
        roll(root, shape=shape, stop__lines=5, seed=seed)
    return root


@pytest.fixture(scope="module")
def told(rolled) -> pd.DataFrame:
    """Their table; the first of them has checksums."""
    write_checksums(first_of(rolled))
    before = state_of(rolled)
    table = here(rolled).table
    assert state_of(rolled) == before  # nothing is written in the sessions
    return table


@pytest.fixture
def sessions(rolled, tmp_path) -> Path:
    """A copy that a test may spoil."""
    return shutil.copytree(rolled, tmp_path / "sessions")


@pytest.fixture
def quick(monkeypatch):
    """Rows that cost nothing, and of which sessions they were asked."""
    asked = []

    def row(folder):
        asked.append(folder.name)
        return {"error": "", "shape": "square", "lines": len(asked), "seconds": 0.25}

    monkeypatch.setattr(analysis_of_many, "row_of", row)
    return asked


def here(root, cache=None, **options):
    return analyse(places_below([root]), cache=cache, workers=0, **options)


def first_of(root) -> Path:
    return places_below([root])[0].folder


def state_of(folder: Path) -> dict:
    found = {path.relative_to(folder): path.stat() for path in [folder, *folder.rglob("*")]}
    return {path: (now.st_mtime_ns, now.st_ino, now.st_size) for path, now in found.items()}


def test_a_row_holds_what_the_session_says(rolled, told):
    table = told
    assert list(table.columns) == list(COLUMNS)
    assert (table["error"] == "").all()
    row, place = table.iloc[0], places_below([rolled])[0]
    events = [json.loads(text) for text in (place.folder / "events.jsonl").read_text().splitlines()]
    manifest = json.loads((place.folder / "manifest.json").read_text())
    lines = [event for event in events if event["event"] == "line"]
    crossed = [line for line in lines if line["counts"] and line["k"]]
    assert (row["lines"], row["runs"]) == (len(crossed), len(lines))
    # Eq. 1 and Cauchy's theorem, from the log
    k, l1, l3 = (np.mean([line[name] for line in crossed]) for name in ("k", "l1_cm", "l3_cm3"))
    area = np.pi / 3 * l3 / l1
    assert row["robot_area_cm2"] == pytest.approx(area)
    assert row["robot_perimeter_cm"] == pytest.approx(np.pi * area * k / l1)
    outline = load_dictionary()[row["shape"]].geometry
    assert row["area_error_rel"] == pytest.approx(area / outline.area - 1)
    assert row["area_z"] == pytest.approx((area - outline.area) / row["robot_sigma_area_cm2"])
    sigma = exact_moments(outline).sigma_area_rel * outline.area / np.sqrt(len(crossed))
    assert row["exact_sigma_area_cm2"] == pytest.approx(sigma)
    assert row["area_z_exact"] == pytest.approx((area - outline.area) / sigma)
    assert row["simulated_sigma_area_cm2"] == pytest.approx(sigma, rel=0.2)
    assert row["seed"] == str(manifest["seed"])
    assert row["robots"] == manifest["devices"]["robots"][0]["name"]
    assert (row["end_state"], row["parts"], row["link_losses"]) == ("complete", 1, 0)
    assert row["checksums_ok"]
    assert pd.isna(table["checksums_ok"][1])
    assert pd.isna(row["camera_area_cm2"])
    assert table["settings_digest"].nunique() == 2  # the seed is none of the settings
    assert not pd.isna(row["verdict"])


def test_a_film_fills_what_a_camera_knows(filmed_session, tmp_path):
    root = shutil.copytree(filmed_session.folder, tmp_path / "filmed")
    for derived in root.glob("*.parquet"):
        derived.unlink()
    before = state_of(root)
    row = row_of(root)
    assert state_of(root) == before
    assert row["error"] == ""
    assert row["chords_matched"] > 8
    assert abs(row["latency_entering_s"]) < 0.02
    assert row["camera_area_error_rel"] == pytest.approx(row["camera_area_cm2"] / row["truth_area_cm2"] - 1)
    assert row["frames"] > 1000
    assert isinstance(row["filter_honest"], bool)
    budget = [row[f"budget_area_{term}_percent"] for term in ("counting", "latency", "rest")]
    assert np.isfinite(budget).all()


def test_broken_sessions_are_rows_with_their_reason(sessions, tmp_path, monkeypatch, quick):
    whole = analysis_of_many.row_of
    monkeypatch.setattr(
        analysis_of_many, "row_of", lambda folder: (row_of if folder.name in ("torn", "empty") else whole)(folder)
    )
    torn, empty, busy = sessions / "torn", sessions / "empty", sessions / "busy"
    for name in (torn, busy):
        shutil.copytree(first_of(sessions), name)
    (torn / "events.jsonl").write_text("{broken\n")
    empty.mkdir()
    (empty / "manifest.json").write_text('{"schema_version": 999}')
    with writing(busy):
        table = here(sessions).table.set_index("session")
        assert len(table) == 6
    reasons = table["error"]
    assert "no JSON" in reasons["torn"]
    assert "newer chordlab" in reasons["empty"]
    assert "is being written by" in reasons["busy"]
    assert (reasons == "").sum() == 3
    assert not reasons.str.contains("\n").any()
    assert not (busy / "writer.lock").exists()

    def faulty(*_, **__):
        raise ZeroDivisionError("a slip\nof the pen")

    monkeypatch.setattr("lab.batch.rows.examine", faulty)
    assert row_of(first_of(sessions)) == {"error": "ZeroDivisionError: a slip of the pen"}
    assert "cluster" in row_of(tmp_path / "nowhere")["error"]


def test_what_is_known_is_not_worked_out_again(sessions, tmp_path, monkeypatch, quick):
    cache = RowCache(tmp_path / "cache")
    first = here(sessions, cache)
    assert first.computed == 3
    second = here(sessions, RowCache(tmp_path / "cache"))
    assert second.computed == 0
    pd.testing.assert_frame_equal(first.table, second.table)
    log = first_of(sessions) / "events.jsonl"
    log.write_bytes(log.read_bytes() + b'{"event": "pause", "robot": "x", "battery_v": 3.4, "t_s": 1.0}\n')
    quick.clear()
    third = here(sessions, cache)
    assert third.computed == 1
    assert quick == [log.parent.name]
    assert (third.table["content_digest"] == first.table["content_digest"]).tolist() == [False, True, True]
    assert here(sessions, cache, again=True).computed == 3
    assert here(sessions).computed == 3
    os.utime(first_of(sessions) / "manifest.json")  # another time, the same content
    assert here(sessions, cache).computed == 0
    with monkeypatch.context() as patched:
        patched.setattr(analysis_of_many, "versions", lambda: {"chordlab": "another"})
        assert here(sessions, cache).computed == 3
    with monkeypatch.context() as patched:
        patched.setattr(analysis_of_many, "_SETTINGS", {"columns": ["other"]})
        assert here(sessions, cache).computed == 3
    with monkeypatch.context() as patched:
        another = replace(analysis_of_many.find_font(), sha256="of another font")
        patched.setattr(analysis_of_many, "find_font", lambda: another)
        assert here(sessions, cache).computed == 3
    damaged = sorted((tmp_path / "cache/rows").rglob("*.json"))
    for path in damaged:
        path.write_bytes(path.read_bytes().replace(b'"error": ""', b'"error": "?"'))
    assert here(sessions, cache).computed == 3
    assert here(sessions, cache).computed == 0


def test_errors_are_not_kept_and_copies_are_worked_out_once(sessions, tmp_path, monkeypatch, quick):
    cache = RowCache(tmp_path / "cache")
    with monkeypatch.context() as patched:
        patched.setattr(analysis_of_many, "row_of", lambda _folder: {"error": "out of luck"})
        assert (here(sessions, cache).table["error"] == "out of luck").all()
    shutil.copytree(first_of(sessions), sessions / "copy")
    quick.clear()

    def all_at_once(task, items, **_options):
        yield from [(item, task(item)) for item in list(items)]

    monkeypatch.setattr(analysis_of_many, "spread", all_at_once)
    found = here(sessions, cache)
    assert (len(found.table), found.computed, len(quick)) == (4, 3, 3)
    assert found.table["content_digest"].nunique() == 3
    assert (found.table["error"] == "").all()


def test_digests_are_read_again_only_where_a_file_changed(tmp_path):
    folder, memory = tmp_path / "s", tmp_path / "m.json"
    (folder / "lines/000001").mkdir(parents=True)
    for name in ("manifest.json", "events.jsonl", "lines/000001/light.parquet"):
        (folder / name).write_text(name)
        os.utime(folder / name, (1, 1))

    def content():
        digests = Digests(folder, memory)
        found = digests.content()
        digests.keep()
        return found

    before = content()
    assert set(json.loads(memory.read_text())) == {"manifest.json", "events.jsonl", "lines/000001/light.parquet"}
    kept = json.loads(memory.read_text())
    kept["events.jsonl"][-1] = "f" * 64
    memory.write_text(json.dumps(kept))
    assert content() != before  # what was remembered is what is used
    (folder / "events.jsonl").write_text("other words.")  # as long as before
    after = content()
    assert "events.jsonl" not in json.loads(memory.read_text())  # too young to be told from its next change
    memory.write_text("[no json")
    assert content() == after
    (folder / "lines/000001/light.parquet").rename(folder / "lines/000001/other.parquet")
    assert len({before, after, content()}) == 3
    (folder / "report.html").write_text("derived")
    assert content() == Digests(folder).content()
    assert key_of("a", {}, {}) != key_of("a", {"x": 1}, {}) != key_of("a", {}, {"numpy": "2"})


def test_roots_are_looked_through_once(sessions, tmp_path):
    places = places_below([sessions, sessions.parent, sessions])
    assert len(places) == 3
    assert [place.below for place in places] == sorted(place.below for place in places)
    assert [place.below for place in places_below([first_of(sessions)])] == ["."]
    (tmp_path / "none").mkdir()
    with pytest.raises(RequestError, match=r"no session below .*none"):
        places_below([sessions, tmp_path / "none"])
    with pytest.raises(RequestError, match="no such folder"):
        places_below([tmp_path / "nowhere"])


def test_shapes_sum_up_their_sessions(told):
    table = told
    shapes = per_shape(table).set_index("shape")
    square = table[table["shape"] == "square"]
    assert shapes["sessions"].to_dict() == {"circle": 1, "square": 2}
    found = shapes.loc["square"]
    assert found["area_error_rel"] == pytest.approx(square["area_error_rel"].mean())
    assert found["area_error_sigma_rel"] == pytest.approx(square["area_error_rel"].sem())
    assert found["perimeter_z_sd"] == pytest.approx(square["perimeter_z"].std())
    assert found["exact_sigma_area_rel"] == pytest.approx(
        exact_moments(load_dictionary()["square"].geometry).sigma_area_rel / np.sqrt(5)
    )
    assert found["right_share"] == square["recognised_right"].mean()
    assert pd.isna(shapes.loc["circle", "area_z_sd"])
    assert per_shape(table.iloc[:0]).empty
    assert list(per_shape(table.iloc[:0]).columns) == list(per_shape(table).columns)


def test_a_twins_name_is_right_and_none_of_these_is_not():
    def answer(name, unknown):
        return Recognition([(name, 0.9)], pd.DataFrame(), np.array([unknown]), (("n", "u"),)).answer

    assert "n" in answer("u", 0.1)
    assert "n" in answer("n", 0.1)
    assert "n" not in answer("z", 0.1)
    assert "n" not in answer("n", 0.9)


def test_the_guide_names_every_column():
    text = (HOME / "docs/batch.md").read_text(encoding="utf-8")
    rows, shapes = text.split("## One row a shape")
    named = [
        re.findall(r"`(\w+)`", "".join(re.findall(r"^\|([^|]+)\|", part, re.MULTILINE))) for part in (rows, shapes)
    ]
    assert set(named[0]) >= set(COLUMNS)
    known = set(per_shape(pd.DataFrame(columns=list(COLUMNS)).astype(COLUMNS)).columns)
    assert known <= set(named[1]) | {"shape"}
    assert set(named[1]) <= known


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
def test_an_interrupt_keeps_what_is_done(sessions, tmp_path, number, quick):
    out, held = tmp_path / "out", first_of(sessions)
    for copy in range(37):
        folder = shutil.copytree(held, sessions / f"more{copy}")
        manifest = json.loads((folder / "manifest.json").read_text())
        (folder / "manifest.json").write_text(json.dumps(manifest | {"note": copy}))
    code = "import sys; from lab.cli.main import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "batch", str(sessions), "--out", str(out), "--workers", "1"]
    process = subprocess.Popen(command, cwd=HOME, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not list((out / "cache/rows").rglob("*.json")) and time.monotonic() < deadline:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    process.send_signal(getattr(signal, number))
    _, said = process.communicate(timeout=60)
    assert process.returncode == 1, said
    assert len(said.strip().splitlines()) == 1
    assert "the same command goes on" in said
    done = len(pd.read_parquet(out / "batch.parquet"))
    assert 1 <= done < 40
    again = analyse(places_below([sessions]), cache=RowCache(out / "cache"), workers=0)
    assert len(again.table) == 40
    assert again.computed <= 41 - done
    assert len(quick) == again.computed
