"""The sample sessions of data/sessions: sealed, small, virtual, and what every command that reads one can work with."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lab.cli.main import main
from lab.reopen.stored import stored_settings, stored_shape
from lab.review.runcheck import check_runs
from lab.settings.load import load_settings
from lab.store.layout import SCHEMA_VERSION
from lab.store.reader import SessionReader
from lab.store.seal import verify_checksums
from lab.store.tables import tables_of

HOME = Path(__file__).parents[2]
SAMPLES = HOME / "data/sessions"
NAMES = ("eiffel", "square-filmed", "triangle-uniform")


def files_below(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_there_is_a_folder_and_a_line_of_the_page_for_each_recipe():
    page = (SAMPLES / "README.md").read_text(encoding="utf-8")
    assert {path.stem for path in SAMPLES.glob("*.toml")} == set(NAMES)
    assert {path.name for path in SAMPLES.iterdir() if path.is_dir() and path.name != "__pycache__"} == set(NAMES)
    for name in NAMES:
        tables = tables_of(SessionReader(SAMPLES / name))
        row = next(line for line in page.splitlines() if line.startswith(f"| `{name}`"))
        assert f"{len(tables.crossed)} lines of {len(tables.lines)} runs" in row
        assert f"[{name}.toml]({name}.toml) | {load_settings(SAMPLES / f'{name}.toml').seed} |" in row


def test_the_pages_name_samples_that_are_there():
    pages = [
        HOME / "README.md",
        SAMPLES / "README.md",
        *(HOME / "docs").rglob("*.md"),
        *(HOME / "docs").rglob("*.ipynb"),
    ]
    named = {
        found for page in pages for found in re.findall(r"data/sessions/([\w-]+)", page.read_text(encoding="utf-8"))
    }
    assert "eiffel" in named
    assert named - {"README"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_sample_is_sealed_virtual_and_of_today(name):
    session = SessionReader(SAMPLES / name)
    assert verify_checksums(session.folder) == []
    assert session.schema_version == SCHEMA_VERSION
    assert session.manifest["virtual"] is True
    assert session.manifest["end"]["state"] == "complete"
    asked = load_settings(SAMPLES / f"{name}.toml")
    assert session.manifest["settings"] == json.loads(asked.model_dump_json(exclude={"out"}))


def test_they_are_small():
    sizes = [len(content) for content in files_below(SAMPLES).values()]
    assert max(sizes) < 1_000_000
    assert sum(sizes) < 4_000_000


@pytest.mark.parametrize("name", NAMES)
def test_nothing_of_the_machine_that_rolled_it_is_in_a_sample(name):
    """No path, no host, no user: every text of manifest and log is one of the virtual bench's."""
    texts: set[str] = set()

    def gather(value: object) -> None:
        if isinstance(value, str):
            texts.add(value)
        elif isinstance(value, dict):
            for key, inner in value.items():
                gather(key)
                gather(inner)
        elif isinstance(value, list):
            for inner in value:
                gather(inner)

    session = SessionReader(SAMPLES / name)
    gather(session.manifest)
    for event in session.events():
        gather(event)
    assert not [text for text in texts if re.search(r"[/\\~@]", text)]
    for path, content in files_below(SAMPLES / name).items():
        assert not re.search(rb"/(home|Users|root|tmp|work)/|[A-Z]:\\\\", content), path


def test_a_clone_has_them_byte_for_byte():
    """They are not ignored as other sessions are, and no line ending is changed on the way."""
    if not (HOME / ".git").exists() or shutil.which("git") is None:
        pytest.skip("no checkout by git")
    log = "data/sessions/eiffel/events.jsonl"

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=HOME, capture_output=True, text=True, check=True).stdout.strip()

    assert git("check-ignore", log, "sessions/x/events.jsonl") == "sessions/x/events.jsonl"
    assert git("check-attr", "text", log) == f"{log}: text: unset"


def test_the_filmed_one_is_validated_and_left_as_it_is(tmp_path, capsys):
    folder, out = SAMPLES / "square-filmed", tmp_path / "out"
    before = files_below(folder)
    assert main(["validate", str(folder), "--out", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["truth"] == {"area_cm2": pytest.approx(44**2), "perimeter_cm": pytest.approx(4 * 44)}
    for who in ("robot", "camera"):
        assert abs(found[who]["area_cm2"] - 44**2) < 3 * found[who]["sigma_area_cm2"]
        assert abs(found[who]["perimeter_cm"] - 4 * 44) < 3 * found[who]["sigma_perimeter_cm"]
    assert (found["chords"]["matched"], found["chords"]["missed"], found["chords"]["extra"]) == (16, 0, 0)
    assert found["chords"]["rms_cm"] < 1.5
    assert found["recognised"]["name"] == "square"
    assert found["report"] == str(out / "report.html")
    assert {path.name for path in out.iterdir()} == {
        "report.html", "lines.parquet", "crossings.parquet", "estimates.parquet", "track.parquet",
    }  # fmt: skip
    for name in ("lines", "crossings", "estimates"):
        pd.testing.assert_frame_equal(pd.read_parquet(out / f"{name}.parquet"), SessionReader(folder).table(name))
    track, stored = pd.read_parquet(out / "track.parquet"), SessionReader(folder).table("track")
    assert list(track.columns) == list(stored.columns)
    assert len(track) == len(stored)
    assert files_below(folder) == before


def test_what_is_kept_apart_does_not_go_into_the_session_nor_where_nothing_can_be_written(tmp_path, capsys):
    folder = SAMPLES / "square-filmed"
    assert main(["validate", str(folder), "--out", str(folder / "out")]) == 2
    assert "choose another --out" in capsys.readouterr().err
    (tmp_path / "file").touch()
    assert main(["validate", str(SAMPLES / "eiffel"), "--out", str(tmp_path / "file")]) == 2
    assert "choose another --out" in capsys.readouterr().err


def test_the_wrong_turning_is_found():
    p_values = {}
    for name in ("eiffel", "triangle-uniform"):
        session = SessionReader(SAMPLES / name)
        lines, shape, settings = tables_of(session).lines, stored_shape(session), stored_settings(session)
        p_values[name] = check_runs(lines, shape.geometry, settings, np.random.default_rng(1)).lengths.p_value
    assert p_values["triangle-uniform"] < 0.01 < p_values["eiffel"]


def test_all_are_analysed_as_a_batch(tmp_path, capsys):
    before = files_below(SAMPLES)
    assert main(["batch", str(SAMPLES), "--out", str(tmp_path), "--workers", "0", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["sessions"], found["broken"]) == (3, [])
    assert {row["shape"] for row in found["shapes"]} == {"eiffel", "square", "triangle"}
    assert all(row["right_share"] == 1 for row in found["shapes"])
    assert files_below(SAMPLES) == before
