import hashlib
import json
import subprocess
from datetime import datetime

import pandas as pd
import pytest

from lab.base.errors import ChordlabError
from lab.store.layout import SessionFolderError
from lab.store.reader import SessionReader
from lab.store.seal import write_checksums
from lab.store.tables import finalize, tables_of
from lab.store.writer import SessionWriter, disk_faults

STARTED = datetime(2026, 11, 23, 10, 42)


def writer(tmp_path, **manifest):
    return SessionWriter.create(tmp_path, "eiffel", {"seed": 3, **manifest}, started=STARTED, tag="ab12")


def line_event(line, **changes):
    event = {
        "line": line, "robot": "SB-7E57", "t_start_s": 1.0 * line, "t_rolling_s": line + 0.05, "t_end_s": line + 0.5,
        "length_cm": 50.0, "end_cm": 49.0, "speed_cm_s": 25.0, "starts_lit": False, "ends_lit": False,
        "ended": "bump", "counts": True, "whole": True, "weight": 1.0, "k": 1, "l1_cm": 10.0, "l3_cm3": 1000.0,
        "crossings": [[line + 0.1, 5.0, True], [line + 0.3, 15.0, False]],
    }  # fmt: skip
    return event | changes


def test_the_folder_is_named_after_time_shape_and_tag(tmp_path):
    made = writer(tmp_path)
    made.close()
    assert made.folder.name == "2026-11-23T1042_eiffel_ab12"
    assert not (made.folder / "writer.lock").exists()


def test_a_shape_that_is_a_path_or_text_makes_a_safe_name(tmp_path):
    made = SessionWriter.create(tmp_path, "../../etc/x:y z", {}, started=STARTED, tag="t")
    made.close()
    assert made.folder.parent == tmp_path
    assert made.folder.name == "2026-11-23T1042_------etc-x-y-z_t"


def test_a_folder_that_is_there_is_not_written_over(tmp_path):
    writer(tmp_path).close()
    with pytest.raises(SessionFolderError, match="already"):
        writer(tmp_path)


def test_events_are_on_disk_as_soon_as_append_returns(tmp_path):
    made = writer(tmp_path)
    made.append("line", **line_event(0))
    assert json.loads((made.folder / "events.jsonl").read_text())["line"] == 0
    made.close()
    made.close()


def test_a_committed_line_reads_back(tmp_path):
    made = writer(tmp_path)
    made.video_path(2).write_bytes(b"film")
    light = pd.DataFrame({"t_host_s": [0.0, 0.05], "light_lux": [20.0, 120.0]})
    made.commit_line(2, light)
    made.finish({"state": "complete"})
    made.close()
    reader = SessionReader(made.folder)
    assert reader.manifest["end"] == {"state": "complete"}
    assert reader.manifest["seed"] == 3
    assert reader.segments() == {2: made.folder / "lines/000002/video.mkv"}
    pd.testing.assert_frame_equal(pd.read_parquet(made.folder / "lines/000002/light.parquet"), light)
    assert not list(made.folder.rglob("*.part"))


def test_nan_never_gets_into_the_log(tmp_path):
    made = writer(tmp_path)
    with pytest.raises(ValueError, match="JSON"):
        made.append("line", l1_cm=float("nan"))
    made.close()


def test_tables_come_from_the_log(tmp_path):
    made = writer(tmp_path)
    made.append("start", t_s=0.0)
    estimate = {
        "n": 1, "area_cm2": 900.0, "perimeter_cm": 300.0, "sigma_area_cm2": None, "sigma_perimeter_cm": None,
        "correlation": None, "leading": "eiffel", "posterior": 0.4,
    }  # fmt: skip
    made.append("line", **line_event(0, k=0, crossings=[]))
    made.append("line", **line_event(1), estimate=estimate)
    made.close()
    tables = finalize(made.folder)
    assert tables.lines["k"].tolist() == [0, 1]
    assert tables.crossings[["line", "order", "s_cm", "entering"]].to_numpy().tolist() == [
        [1, 0, 5.0, True],
        [1, 1, 15.0, False],
    ]
    assert tables.estimates["area_cm2"].tolist() == [900.0]
    assert tables.estimates["sigma_area_cm2"].isna().all()
    stored = SessionReader(made.folder)
    for name in ("lines", "crossings", "estimates"):
        pd.testing.assert_frame_equal(stored.table(name), getattr(tables, name))


def test_an_empty_session_gives_empty_tables_of_the_same_columns(tmp_path):
    made = writer(tmp_path)
    made.close()
    tables = tables_of(SessionReader(made.folder))
    assert len(tables.lines) == len(tables.crossings) == len(tables.estimates) == 0
    assert tables.lines["t_start_s"].dtype == float


def test_a_cut_at_every_byte_of_the_last_record_loses_that_record_alone(tmp_path):
    made = writer(tmp_path)
    made.append("line", **line_event(0))
    made.append("line", **line_event(1))
    made.close()
    log = made.folder / "events.jsonl"
    whole = log.read_bytes()
    first = whole.index(b"\n") + 1
    for cut in range(first, len(whole)):
        log.write_bytes(whole[:cut])
        assert [event["line"] for event in SessionReader(made.folder).events()] == [0]
    log.write_bytes(whole)
    assert [event["line"] for event in SessionReader(made.folder).events()] == [0, 1]


@pytest.mark.parametrize(
    ("manifest", "says"),
    [
        (None, "no session folder"),
        ("{", "cannot be read"),
        ("[]", "schema_version"),
        ('{"schema_version": 99}', "newer"),
    ],
)
def test_what_is_no_session_is_said_to_be_none(tmp_path, manifest, says):
    if manifest is not None:
        (tmp_path / "manifest.json").write_text(manifest)
    with pytest.raises(SessionFolderError, match=says):
        SessionReader(tmp_path)


@pytest.mark.parametrize("record", ["{broken", "[1]", '{"a": 1}', '{"event": "line", "line": 1}'])
def test_a_changed_log_is_named_not_read_over(tmp_path, record):
    made = writer(tmp_path)
    made.close()
    (made.folder / "events.jsonl").write_text(record + "\n")
    with pytest.raises(SessionFolderError):
        tables_of(SessionReader(made.folder))


def test_a_log_of_the_first_schema_reads_as_one_robot_rolling_whole_lines(tmp_path):
    made = writer(tmp_path)
    new = ("robot", "end_cm", "starts_lit", "ends_lit", "whole", "weight")
    for line in (0, 1):
        old = line_event(line, counts=line > 0)
        made.append("line", **{name: value for name, value in old.items() if name not in new})
    made.close()
    manifest = made.folder / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"schema_version": 3', '"schema_version": 1'))
    lines = finalize(made.folder).lines
    assert lines["whole"].tolist() == lines["counts"].tolist() == [False, True]
    assert lines["weight"].tolist() == [1.0, 1.0]
    assert lines["end_cm"].tolist() == lines["length_cm"].tolist()
    assert lines["robot"].nunique() == 1
    # what a log of today lacks is no matter of age
    manifest.write_text(manifest.read_text().replace('"schema_version": 1', '"schema_version": 3'))
    with pytest.raises(SessionFolderError, match="not whole"):
        finalize(made.folder)


def test_a_value_of_the_wrong_kind_is_named(tmp_path):
    made = writer(tmp_path)
    made.append("line", **line_event(0, t_start_s="soon"))
    made.close()
    with pytest.raises(SessionFolderError, match="wrong kind"):
        tables_of(SessionReader(made.folder))


def test_checksums_are_those_of_the_standard_tool(tmp_path):
    made = writer(tmp_path)
    made.append("start", t_s=0.0)
    made.close()
    sums = write_checksums(made.folder)
    rows = dict(reversed(row.split("  ")) for row in sums.read_text().splitlines())
    assert set(rows) == {"manifest.json", "events.jsonl"}
    assert rows["events.jsonl"] == hashlib.sha256((made.folder / "events.jsonl").read_bytes()).hexdigest()
    assert (
        subprocess.run(["sha256sum", "-c", "SHA256SUMS"], cwd=made.folder, capture_output=True, check=False).returncode
        == 0
    )


def test_a_missing_table_names_its_cure(tmp_path):
    made = writer(tmp_path)
    made.close()
    with pytest.raises(SessionFolderError, match="chordlab finalize"):
        SessionReader(made.folder).table("track")


def test_a_full_disk_is_one_line(tmp_path):
    with pytest.raises(ChordlabError, match=r"No space left.*free some space"), disk_faults(tmp_path):
        raise OSError(28, "No space left on device")


def test_a_time_out_is_not_taken_for_the_disk(tmp_path):
    with pytest.raises(TimeoutError), disk_faults(tmp_path):
        raise TimeoutError
