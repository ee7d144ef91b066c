"""What is exported, read back by the formats' own readers and held against the session's tables."""

import hashlib
import itertools
import json
import math
import re
import shutil
import tracemalloc
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader
from shapely import Polygon

from lab.cli.main import main
from lab.export.bag import robot_topics, write_mcap
from lab.export.messages import WorldClock
from lab.export.source import source_of
from lab.store.reader import SessionReader
from lab.store.tables import tables_of
from tests.lab.conftest import STARTED

TEXTS = {"robot": str, "ended": str, "leading": str}
NAMES = ("lines", "crossings", "estimates")


def copy_of(folder: Path, to: Path) -> Path:
    return shutil.copytree(folder, to)


def exported(capsys, folder: Path, out: Path, *more: str) -> dict:
    capsys.readouterr()
    code = main(["export", str(folder), "--out", str(out), "--json", *more])
    said, err = capsys.readouterr()
    assert (code, err) == (0, "")
    (line,) = said.splitlines()
    return json.loads(line)


def bag(path: Path) -> dict[str, list[tuple[int, dict]]]:
    """Every topic's messages as (log time, content), and the whole file in the order of its times."""
    topics: dict[str, list[tuple[int, dict]]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            topics.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
            topics.setdefault("all", []).append((message.log_time, {}))
    return topics


def csv(path: Path) -> pd.DataFrame:
    return pd.read_csv(path, keep_default_na=False, dtype=TEXTS)


def same(found: pd.DataFrame, expected: pd.DataFrame) -> None:
    """Equal to the last digit; CSV has no word for NaN but nothing at all."""
    found = found.copy()
    for name in expected.columns:
        if pd.api.types.is_float_dtype(expected[name]):
            found[name] = pd.to_numeric(found[name].replace("", math.nan), errors="raise")
    expected = expected.reset_index(drop=True)
    pd.testing.assert_frame_equal(found, expected.astype({n: str for n in TEXTS if n in expected}), check_dtype=False)
    numbers = expected.select_dtypes("number").columns
    np.testing.assert_array_equal(found[numbers].to_numpy(float), expected[numbers].to_numpy(float))


def light_of(folder: Path) -> pd.DataFrame:
    """The raw samples, joined here from the runs' own files."""
    parts = []
    for run in tables_of(SessionReader(folder)).lines.itertuples():
        path = folder / f"lines/{run.line:06d}/light.parquet"
        if path.exists():
            parts.append(pd.read_parquet(path).assign(run=run.line, robot=run.robot))
    return pd.concat(parts, ignore_index=True)


def started_ns() -> int:
    """When the sessions of these tests started, by the world's clock."""
    return int(STARTED.replace(tzinfo=UTC).timestamp()) * 10**9


def first_s(folder: Path) -> float:
    return next(event["t_s"] for event in SessionReader(folder).events() if event["event"] == "start")


@pytest.mark.parametrize("which", ["alone_on_film", "pair_on_film", "onboard_session"])
def test_csv_holds_the_tables_to_the_last_digit(which, request, capsys, tmp_path):
    folder = request.getfixturevalue(which)
    exported(capsys, folder, tmp_path, "--to", "csv")
    tables = tables_of(SessionReader(folder))
    for name in NAMES:
        same(csv(tmp_path / f"{name}.csv"), getattr(tables, name))
    light = csv(tmp_path / "light.csv")
    assert list(light.columns) == ["run", "robot", "t_host_s", "light_lux", "x_cm", "y_cm", "speed_cm_s"]
    if which == "onboard_session":
        assert light.empty
        assert not (tmp_path / "track.csv").exists()
    else:
        same(light, light_of(folder)[list(light.columns)])
        track = pd.read_parquet(folder / "track.parquet")
        assert len(track) > 100
        same(csv(tmp_path / "track.csv"), track)


def test_excel_sees_that_the_csv_is_utf8_and_pandas_needs_not_be_told(alone_on_film, capsys, tmp_path):
    exported(capsys, alone_on_film, tmp_path, "--to", "csv")
    assert (tmp_path / "lines.csv").read_bytes().startswith(b"\xef\xbb\xbfline,robot,t_start_s,")
    assert pd.read_csv(tmp_path / "lines.csv").columns[0] == "line"


@pytest.mark.parametrize("which", ["alone_on_film", "pair_on_film", "onboard_session"])
def test_mcap_holds_every_row_of_the_tables_at_its_time(which, request, capsys, tmp_path):
    folder = request.getfixturevalue(which)
    said = exported(capsys, folder, tmp_path, "--to", "mcap")
    found = bag(tmp_path / "session.mcap")
    times = [t_ns for t_ns, _ in found.pop("all")]
    assert times == sorted(times)  # as written, not as sorted by the reader
    assert said["messages"] == {topic: len(messages) for topic, messages in found.items()}

    tables, t0_s, t0_ns = tables_of(SessionReader(folder)), first_s(folder), started_ns()

    def check(messages, expected: pd.DataFrame, t_name: str) -> None:
        expected = expected.sort_values(t_name, kind="stable").drop(columns="robot", errors="ignore")
        assert len(messages) == len(expected)
        for (t_ns, content), row in zip(messages, expected.to_dict("records"), strict=True):
            assert abs(t_ns - (t0_ns + (row[t_name] - t0_s) * 1e9)) < 1000
            assert content.pop("timestamp") == {"sec": t_ns // 10**9, "nsec": t_ns % 10**9}
            assert content == {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in row.items()}

    robots = dict(tuple(tables.lines.groupby("robot", sort=False)))
    for name, lines in robots.items():
        check(found.pop(f"/robots/{name}/line"), lines, "t_end_s")
        crossings = tables.crossings[tables.crossings["line"].isin(lines["line"])]
        check(found.pop(f"/robots/{name}/crossing", []), crossings, "t_s")
        if which != "onboard_session":
            light = light_of(folder)
            light = light[light["robot"] == name].rename(columns={"run": "line", "t_host_s": "t_s"})
            check(found.pop(f"/robots/{name}/light"), light, "t_s")
            track = pd.read_parquet(folder / "track.parquet")
            own = track[track["robot"] == name] if "robot" in track else track
            check_poses(found.pop(f"/robots/{name}/pose"), own, t0_s, t0_ns)
    check(found.pop("/estimate"), tables.estimates, "t_s")
    log = found.pop("/events")
    assert len(log) == len(list(SessionReader(folder).events()))
    assert log[-1][1]["message"].startswith("end: ")
    assert len(found.pop("/scene")) == 1
    found.pop("/film", None)
    assert found == {}


def check_poses(messages, track: pd.DataFrame, t0_s: float, t0_ns: int) -> None:
    seen = track.dropna(subset=["x_smooth_cm", "y_smooth_cm"])
    assert len(messages) == len(seen) > 50
    for (t_ns, content), row in zip(messages, seen.itertuples(), strict=True):
        assert abs(t_ns - (t0_ns + (row.t_s - t0_s) * 1e9)) < 1000
        assert content["frame_id"] == "arena"
        place, turn = content["pose"]["position"], content["pose"]["orientation"]
        assert (100 * place["x"], 100 * place["y"]) == pytest.approx((row.x_smooth_cm, row.y_smooth_cm))
        # the x axis, turned by the quaternion, points along the velocity
        ahead = 1 - 2 * turn["z"] ** 2, 2 * turn["w"] * turn["z"]
        speed = math.hypot(row.vx_cm_s, row.vy_cm_s)
        assert (speed * ahead[0], speed * ahead[1]) == pytest.approx((row.vx_cm_s, row.vy_cm_s), abs=1e-9)


def test_the_scene_is_the_arena_and_the_shape_in_metres(alone_on_film, capsys, tmp_path):
    exported(capsys, alone_on_film, tmp_path, "--to", "mcap")
    ((_, scene),) = bag(tmp_path / "session.mcap")["/scene"]
    area_m2 = {
        entity["id"]: Polygon([(point["x"], point["y"]) for point in entity["lines"][0]["points"]]).area
        for entity in scene["entities"]
    }
    assert area_m2["shape"] == pytest.approx(0.44**2)
    walls = SessionReader(alone_on_film).manifest["settings"]["arena"]
    assert area_m2["arena"] == pytest.approx(walls["width_cm"] * walls["height_cm"] / 1e4)


def test_mcap_bears_foxgloves_names_zstd_chunks_and_the_manifest(alone_on_film, capsys, tmp_path):
    exported(capsys, alone_on_film, tmp_path, "--to", "mcap")
    with (tmp_path / "session.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        (attached,) = reader.iter_attachments()
        (about,) = reader.iter_metadata()
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    assert {channel.message_encoding for channel in summary.channels.values()} == {"json"}
    names = {schema.name: json.loads(schema.data) for schema in summary.schemas.values()}
    assert set(names) == {
        "foxglove.Log",
        "foxglove.PoseInFrame",
        "foxglove.SceneUpdate",
        "foxglove.CompressedImage",
        *(f"chordlab.{kind}" for kind in ("Light", "Line", "Crossing", "Estimate")),
    }
    assert all(schema["type"] == "object" and "properties" in schema for schema in names.values())
    assert json.loads(attached.data) == SessionReader(alone_on_film).manifest
    assert about.metadata["shape"] == "square"


def test_every_field_of_every_message_is_in_its_schema(pair_on_film, capsys, tmp_path):
    exported(capsys, pair_on_film, tmp_path, "--to", "mcap", "--every", "50")

    def check(value, schema, where):
        if "properties" in schema and isinstance(value, dict):
            assert set(value) <= set(schema["properties"]), where
            for name, inner in value.items():
                check(inner, schema["properties"][name], f"{where}.{name}")
        elif schema.get("type") == "array":
            for inner in value:
                check(inner, schema["items"], f"{where}[]")
        else:
            kinds = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
            known = {"number": (int, float), "integer": int, "string": str, "boolean": bool, "null": type(None)}
            assert any(isinstance(value, known[kind]) for kind in kinds), (where, value)

    with (tmp_path / "session.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            check(json.loads(message.data), json.loads(schema.data), channel.topic)


def test_the_session_is_only_read_and_the_export_goes_beside(alone_on_film, capsys, tmp_path, monkeypatch):
    def digest():
        files = sorted(path for path in alone_on_film.rglob("*") if path.is_file())
        return [(path, path.stat().st_mtime_ns, hashlib.sha256(path.read_bytes()).hexdigest()) for path in files]

    before = digest()
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(alone_on_film), "--to", "csv,mcap"]) == 0
    out = tmp_path / f"{alone_on_film.name}_export"
    assert sorted(path.name for path in out.iterdir()) == [
        "crossings.csv", "estimates.csv", "light.csv", "lines.csv", "session.mcap", "track.csv",
    ]  # fmt: skip
    assert digest() == before
    monkeypatch.chdir(alone_on_film)
    assert main(["export", "."]) == 2
    assert "--out" in capsys.readouterr().err
    assert digest() == before


def test_an_export_into_the_session_is_made_when_asked_for(alone_on_film, capsys, tmp_path):
    folder = copy_of(alone_on_film, tmp_path / "copy")
    exported(capsys, folder, folder / "csv", "--to", "csv")
    assert (folder / "csv" / "light.csv").exists()


@pytest.mark.parametrize("asked", [["--to", "xlsx"], ["--to", ","], ["--every", "0"]])
def test_a_wrong_request_is_told_in_one_line(alone_on_film, capsys, tmp_path, asked):
    assert main(["export", str(alone_on_film), "--out", str(tmp_path), *asked]) == 2
    out, err = capsys.readouterr()
    assert (out, len(err.splitlines())) == ("", 1)


def test_a_cut_session_is_exported_as_far_as_it_goes(alone_on_film, capsys, tmp_path):
    folder = copy_of(alone_on_film, tmp_path / "cut")
    manifest = json.loads((folder / "manifest.json").read_text())
    del manifest["end"]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    (folder / "track.parquet").unlink()
    log = (folder / "events.jsonl").read_text().splitlines(keepends=True)
    kept = [record for record in log if json.loads(record)["event"] != "end"]
    (folder / "events.jsonl").write_text("".join(kept) + '{"event": "line", "li')
    last = json.loads(kept[-1])["line"]
    (folder / f"lines/{last:06d}").rename(folder / f"lines/{last:06d}.part")
    said = exported(capsys, folder, tmp_path / "out")
    assert "validate" in said["left_out"][0]
    assert len(csv(tmp_path / "out/lines.csv")) == last + 1
    assert csv(tmp_path / "out/light.csv")["run"].max() == last - 1
    assert len(bag(tmp_path / "out/session.mcap")["/events"]) == len(kept)
    assert (tmp_path / "out/film.mp4").exists()


HOSTILE = ["=cmd|' /C calc'!A0", "../../etc/passwd", 'a,"b"\nc;\td', "NA", "-1+1", "@x", "ü🤖", "", "con/..\\nul\x07"]


def test_hostile_names_stay_names(pair_on_film, capsys, tmp_path):
    folder = copy_of(pair_on_film, tmp_path / "-x %03d 'n \"ü.session")
    log = [json.loads(record) for record in (folder / "events.jsonl").read_text().splitlines()]
    names = itertools.cycle(HOSTILE)
    for event in log:
        if event["event"] == "line":
            event["robot"] = next(names)
            if "estimate" in event:
                event["estimate"]["leading"] = "=1+1"
    (folder / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in log))
    (folder / "track.parquet").unlink()
    out = tmp_path / "out"
    exported(capsys, folder, out, "--every", "200")
    assert {path.parent for path in out.rglob("*")} == {out}
    tables = tables_of(SessionReader(folder))
    guarded = ["'" + name if name[:1] in set("=-@+") else name for name in tables.lines["robot"]]
    same(csv(out / "lines.csv"), tables.lines.assign(robot=guarded))
    assert set(csv(out / "estimates.csv")["leading"]) == {"'=1+1"}
    found = bag(out / "session.mcap")
    lines = {topic: messages for topic, messages in found.items() if topic.endswith("/line")}
    assert len(lines) == tables.lines["robot"].nunique()
    assert sum(map(len, lines.values())) == len(tables.lines)
    assert all(re.fullmatch(r"/robots/[A-Za-z0-9_-]+/line", topic) for topic in lines)
    with (out / "session.mcap").open("rb") as file:
        channels = make_reader(file).get_summary().channels.values()
    told = {channel.metadata["robot"] for channel in channels if channel.topic.endswith("/line") and channel.metadata}
    assert told == set(tables.lines["robot"]) - {""}


def test_robots_whose_names_look_alike_have_topics_of_their_own():
    topics = robot_topics(("a b", "a_b", "a/b", "", "a_b_2"))
    assert topics == {
        "a b": "/robots/a_b",
        "a_b": "/robots/a_b_2",
        "a/b": "/robots/a_b_3",
        "": "/robots/robot",
        "a_b_2": "/robots/a_b_2_2",
    }


def test_a_link_where_the_export_goes_is_replaced_and_not_followed(alone_on_film, capsys, tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("mine")
    out = tmp_path / "out"
    out.mkdir()
    for name in ("session.mcap", "session.mcap.part", "lines.csv"):
        (out / name).symlink_to(victim)
    exported(capsys, alone_on_film, out, "--to", "csv,mcap")
    assert victim.read_text() == "mine"
    assert not (out / "session.mcap").is_symlink()
    assert not (out / "session.mcap.part").exists()


def test_a_failed_export_leaves_no_half_file(alone_on_film, capsys, tmp_path):
    folder = copy_of(alone_on_film, tmp_path / "copy")
    (folder / "lines/000001/light.parquet").write_bytes(b"PAR1 not at all")
    out = tmp_path / "out"
    assert main(["export", str(folder), "--out", str(out), "--to", "mcap"]) == 2
    said = capsys.readouterr().err
    assert "light.parquet cannot be read" in said
    assert len(said.splitlines()) == 1
    assert list(out.iterdir()) == []


def test_each_part_of_a_resumed_session_has_its_own_wall_clock(alone_on_film, tmp_path):
    folder = copy_of(alone_on_film, tmp_path / "copy")
    manifest = json.loads((folder / "manifest.json").read_text())
    t0_s = first_s(folder)
    manifest["parts"] = [
        {"started": "2026-11-24T09:00:00", "t_s": t0_s + 100.0},
        {"started": "2020-01-01T00:00:00", "t_s": t0_s + 200.0},  # the wall clock was set back
    ]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    clock = WorldClock(source_of(SessionReader(folder)))

    def wall(t_s):
        return datetime.fromtimestamp(clock.ns(t_s) / 1e9, tz=UTC).isoformat()

    assert wall(t0_s) == "2026-11-23T10:42:00+00:00"
    assert wall(t0_s + 99) == "2026-11-23T10:43:39+00:00"
    assert wall(t0_s + 101) == "2026-11-24T09:00:01+00:00"
    assert wall(t0_s + 201) == "2026-11-24T09:01:41+00:00"


def test_memory_does_not_grow_with_the_session(alone_on_film, tmp_path):
    """Runs are opened when their time has come: three times as many take no more memory than their events."""
    log = [json.loads(record) for record in (alone_on_film / "events.jsonl").read_text().splitlines()]
    start, run = log[0], next(event for event in log if event["event"] == "line")
    rng = np.random.default_rng(1)

    def peak(runs: int) -> int:
        folder = tmp_path / f"{runs}"
        (folder / "lines").mkdir(parents=True)
        shutil.copy(alone_on_film / "manifest.json", folder)
        events = [start]
        for number in range(runs):
            at_s = 10.0 * number + 10.0
            events.append({**run, "line": number, "t_start_s": at_s, "t_rolling_s": at_s, "t_end_s": at_s + 8.0})
            names = ["t_host_s", "light_lux", "x_cm", "y_cm", "speed_cm_s"]
            light = pd.DataFrame(rng.normal(size=(300, 5)), columns=names)
            light["t_host_s"] = np.linspace(at_s, at_s + 8.0, len(light))
            (folder / f"lines/{number:06d}").mkdir()
            light.to_parquet(folder / f"lines/{number:06d}/light.parquet")
        (folder / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
        source = source_of(SessionReader(folder))
        tracemalloc.start()
        counts = write_mcap(source, folder / "session.mcap", film=False)
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert counts[f"/robots/{run['robot']}/light"] == 300 * runs
        return most

    few, many = peak(20), peak(60)
    # 20 runs fill a chunk; 12 000 more messages of 200 bytes would be 2.4 MB, the events of 40 runs are some kilobytes
    assert many < few + 500_000
