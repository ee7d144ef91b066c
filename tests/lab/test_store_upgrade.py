"""Folders of every schema that was ever written, read in today's words."""

import json

import pandas as pd
import pytest

from lab.store.layout import SCHEMA_VERSION, SessionFolderError
from lab.store.reader import SessionReader
from lab.store.tables import tables_of
from lab.store.upgrade import upgrade_event, upgrade_manifest
from tests.lab.conftest import roll

LEVELS = {"dark_lux": 20.0, "bright_lux": 120.0, "noise_lux": 1.0}
ROBOT = {"name": "SB-7E57", "address": "virtual", "firmware": "4.1", "battery_v": 3.9}
MANIFEST_1 = {
    "schema_version": 1, "seed": 3, "levels": LEVELS, "end": {"state": "complete"},
    "devices": {"robot": ROBOT, "camera": None},
}  # fmt: skip
LINE_1 = {
    "event": "line", "line": 1, "t_start_s": 1.0, "t_rolling_s": 1.1, "t_end_s": 3.0, "length_cm": 50.0,
    "speed_cm_s": 25.0, "k": 1, "l1_cm": 10.0, "l3_cm3": 1000.0, "ended": "bump", "counts": True,
    "crossings": [[1.5, 10.0, True], [1.9, 20.0, False]],
    "estimate": {
        "n": 1, "area_cm2": 900.0, "perimeter_cm": 300.0, "sigma_area_cm2": None, "sigma_perimeter_cm": None,
        "correlation": None, "leading": "eiffel", "posterior": 0.4,
    },
}  # fmt: skip
LOG_1 = [
    {"event": "start", "t_s": 0.5, "levels": LEVELS},
    LINE_1 | {"line": 0, "counts": False, "k": 0, "crossings": []},
    LINE_1,
    {"event": "end", "t_s": 4.0, "state": "complete", "runs": 2, "n": 1, "rolling_s": 3.5},
]
LOG_1[1].pop("estimate")

# The same session as schema 2 tells it.
MANIFEST_2 = MANIFEST_1 | {
    "schema_version": 2,
    "devices": MANIFEST_1["devices"]
    | {"robots": [ROBOT | {"levels": {"shape": LEVELS, "edge": None}, "led": None}]},
}  # fmt: skip
LOG_2 = [
    {"event": "start", "t_s": 0.5, "levels": [{"shape": LEVELS, "edge": None}]},
    *(
        line | {
            "robot": "", "end_cm": 50.0, "whole": line["counts"], "weight": 1.0, "starts_lit": False, "ends_lit": False
        }
        for line in LOG_1[1:3]
    ),
    LOG_1[3],
]  # fmt: skip


def folder_of(tmp_path, name, manifest, log):
    folder = tmp_path / name
    (folder / "lines").mkdir(parents=True)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    (folder / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in log))
    return folder


def test_one_session_told_in_either_older_schema_reads_the_same(tmp_path):
    first = SessionReader(folder_of(tmp_path, "1", MANIFEST_1, LOG_1))
    second = SessionReader(folder_of(tmp_path, "2", MANIFEST_2, LOG_2))
    assert (first.schema_version, second.schema_version) == (1, 2)
    assert first.manifest == second.manifest
    assert list(first.events()) == list(second.events())
    for name in ("lines", "crossings", "estimates"):
        pd.testing.assert_frame_equal(getattr(tables_of(first), name), getattr(tables_of(second), name))


def test_a_session_of_schema_1_is_of_one_robot_in_one_part(tmp_path):
    session = SessionReader(folder_of(tmp_path, "1", MANIFEST_1, LOG_1))
    assert session.manifest["schema_version"] == SCHEMA_VERSION == 3
    assert session.manifest["parts"] == []
    (robot,) = session.manifest["devices"]["robots"]
    assert robot["name"] == "SB-7E57"
    assert robot["levels"] == {"shape": LEVELS, "edge": None}
    start = next(session.events())
    assert start["levels"] == [{"shape": LEVELS, "edge": None}]
    assert start["light"] == [None]  # the samples were not kept
    lines = tables_of(session).lines
    assert lines["whole"].tolist() == lines["counts"].tolist() == [False, True]
    assert lines["weight"].tolist() == [1.0, 1.0]
    assert lines["end_cm"].tolist() == lines["length_cm"].tolist()
    assert lines["robot"].unique().tolist() == [""]


def test_reading_rewrites_nothing(tmp_path):
    folder = folder_of(tmp_path, "1", MANIFEST_1, LOG_1)
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.rglob("*") if path.is_file()}
    tables_of(SessionReader(folder))
    assert {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.rglob("*") if p.is_file()} == before


def test_a_newer_version_is_refused_by_its_number(tmp_path):
    folder = folder_of(tmp_path, "4", MANIFEST_2 | {"schema_version": SCHEMA_VERSION + 1}, [])
    with pytest.raises(
        SessionFolderError, match=rf"schema {SCHEMA_VERSION + 1}, this one reads up to {SCHEMA_VERSION}"
    ):
        SessionReader(folder)


def test_the_first_sessions_of_all_do_not_say_when_a_run_was_up_to_speed(tmp_path):
    log = [{name: value for name, value in event.items() if name != "t_rolling_s"} for event in LOG_1]
    lines = tables_of(SessionReader(folder_of(tmp_path, "0", MANIFEST_1, log))).lines
    assert lines["t_rolling_s"].isna().all()
    assert lines["t_end_s"].tolist() == [3.0, 3.0]


@pytest.mark.parametrize("version", [0, -1, True, "2", 2.0, None])
def test_a_version_that_is_no_number_is_none(tmp_path, version):
    with pytest.raises(SessionFolderError, match="no schema_version"):
        SessionReader(folder_of(tmp_path, "odd", MANIFEST_2 | {"schema_version": version}, []))


def test_what_is_of_today_is_not_touched():
    for record in LOG_2:
        assert upgrade_event(record, SCHEMA_VERSION) == record
    today = MANIFEST_2 | {"schema_version": SCHEMA_VERSION}
    assert upgrade_manifest(today, SCHEMA_VERSION) == today


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    "record", [{}, {"event": "start"}, {"event": "start", "levels": None}, {"event": "start", "levels": 3},
               {"event": "line"}, {"event": ["line"]}, {"event": "new", "levels": {}}],
)  # fmt: skip
def test_events_that_are_not_whole_stay_so(version, record):
    """What is missing is for the one to say who needs it."""
    assert record.items() <= {**upgrade_event(record, version), **record}.items()
    assert "k" not in upgrade_event(record, version)


@pytest.mark.parametrize("devices", [None, [], "x", {}, {"robot": None}, {"robot": "SB-1"}])
def test_a_manifest_that_is_not_whole_stays_so(devices):
    assert upgrade_manifest({"devices": devices}, 1)["devices"] == devices


def test_a_session_of_today_told_as_schema_2_reads_to_the_same_tables(tmp_path):
    """Schema 3 added to the log of schema 2 and changed nothing in it."""
    folder = roll(tmp_path, shape="square", stop__lines=10, seed=5).folder
    today = tables_of(SessionReader(folder))
    manifest = json.loads((folder / "manifest.json").read_text())
    events = [json.loads(record) for record in (folder / "events.jsonl").read_text().splitlines()]
    for event in events:
        event.pop("light", None)
    manifest.pop("parts", None)
    old = folder_of(tmp_path, "old", manifest | {"schema_version": 2}, events)
    then = tables_of(SessionReader(old))
    for name in ("lines", "crossings", "estimates"):
        pd.testing.assert_frame_equal(getattr(today, name), getattr(then, name))
