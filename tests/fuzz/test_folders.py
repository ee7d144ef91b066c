"""A stored session whose folder was tampered with: tables, links, paths. Nothing outside of it is read or written."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lab.base.errors import RequestError
from lab.calibrate.robot import profile_then
from lab.reopen.reread import reread
from lab.reopen.stored import stored_settings
from lab.review.review import examine, recognition_of
from lab.review.watched import readings_of
from lab.store.layout import SessionFolderError
from lab.store.reader import SessionReader
from lab.store.tables import finalize, tables_of
from tests.fuzz.harness import fuzz, is_refused
from tests.fuzz.mutate import NUMBERS, TEXTS, mangled, pick
from tests.lab.conftest import roll


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return roll(tmp_path_factory.mktemp("whole"), shape="square", stop__lines=8, seed=5).folder


@pytest.fixture
def folder(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "arena" / "session"))


def broken_table(rng, good):
    """A table with a column dropped, renamed, retyped or filled with nonsense; or rows lost, doubled or shuffled."""
    table = good.copy()
    for _ in range(int(rng.integers(1, 3))):
        column = pick(rng, list(table.columns) or ["none"])
        match int(rng.integers(8)):
            case 0:
                table = table.drop(columns=column, errors="ignore")
            case 1:
                table = table.rename(columns={column: pick(rng, ("x", "", "t_host_s", "light_lux"))})
                table = table.loc[:, ~table.columns.duplicated()]
            case 2:
                table[column] = [str(pick(rng, TEXTS[:6])) for _ in range(len(table))]
            case 3:
                table[column] = [float(pick(rng, NUMBERS[:18])) for _ in range(len(table))]
            case 4:
                table = table.iloc[: int(rng.integers(len(table) + 1))]
            case 5:
                table = table.sample(frac=1.0, random_state=int(rng.integers(1 << 31)))
            case 6:
                table = pd.concat([table] * int(rng.integers(2, 5)), ignore_index=True)
            case _:
                table[column] = [[1.0, 2.0]] * len(table)
    return table


def test_tables_of_light(share, folder, tmp_path):
    path = folder / "lines" / "000001" / "light.parquet"
    good, whole_bytes, aside = pd.read_parquet(path), path.read_bytes(), tmp_path / "aside.parquet"
    levels = {"dark_lux": 10.0, "bright_lux": 100.0}

    def make(rng):
        if rng.random() < 0.4:
            return mangled(whole_bytes, rng)
        broken_table(rng, good).to_parquet(aside, index=False)
        return aside.read_bytes()

    def read(data):
        path.write_bytes(data)
        readings_of(SessionReader(folder), 1, levels)

    fuzz("light.parquet", share(600, 80), make, read)


def test_tables_of_light_read_again(share, folder, tmp_path):
    path = folder / "lines" / "000001" / "light.parquet"
    good, aside = pd.read_parquet(path), tmp_path / "aside.parquet"

    def make(rng):
        broken_table(rng, good).to_parquet(aside, index=False)
        return aside.read_bytes()

    def read(data):
        path.write_bytes(data)
        reread(folder)

    fuzz("light.parquet, read again", share(100, 5), make, read)


@pytest.mark.parametrize("name", ["lines", "crossings", "estimates"])
def test_derived_tables(share, folder, name, tmp_path):
    good, aside = getattr(finalize(folder), name), tmp_path / "aside.parquet"

    def make(rng):
        broken_table(rng, good).to_parquet(aside, index=False)
        data = aside.read_bytes()
        return mangled(data, rng) if rng.random() < 0.5 else data

    def read(data):
        (folder / f"{name}.parquet").write_bytes(data)
        SessionReader(folder).table(name)

    fuzz(f"{name}.parquet", share(200, 30), make, read)


LINKS = ("manifest.json", "events.jsonl", "lines", "lines/000001", "lines/000001/light.parquet")


@pytest.mark.parametrize("name", LINKS)
@pytest.mark.parametrize("target", ["copy", "zero", "missing", "itself"])
def test_links_out_of_the_folder(name, target, folder, tmp_path):
    """What is reached through a link that leads outside is refused, even where it would do."""
    victim = tmp_path / "elsewhere"
    shutil.move(folder / name, victim)
    where = {"copy": victim, "zero": Path("/dev/zero"), "missing": tmp_path / "nothing", "itself": folder / name}[
        target
    ]
    (folder / name).symlink_to(where)

    def read(folder):
        session = SessionReader(folder)
        list(session.events())
        session.segments()
        readings_of(session, 1, None)

    if name.startswith("lines") and target == "missing":  # an absent run is an empty one
        is_refused(read, folder)
        return
    with pytest.raises(SessionFolderError):
        read(folder)


@pytest.mark.parametrize(
    "name", ["lines.parquet", "crossings.parquet", "SHA256SUMS", "writer.lock", "lines.parquet.part"]
)
def test_a_planted_link_is_not_written_through(name, folder, tmp_path):
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(victim)
    is_refused(finalize, folder)
    assert victim.read_bytes() == b"precious"


HOSTILE_PATHS = ("/dev/zero", "../../../secret.json", "/etc/passwd", "missing.toml", "~/x", "a\0b")


@pytest.mark.parametrize("path", HOSTILE_PATHS)
def test_files_that_the_settings_name(path, folder, full):
    """A session goes by what its manifest holds: the files that its settings name are neither read nor missed."""
    file = folder / "manifest.json"
    manifest = json.loads(file.read_text())
    truth = stored_settings(SessionReader(folder))
    settings = manifest["settings"]
    settings |= {"robot_profile": path, "font": path, "shape": path, "camera": "none"}
    settings["camera_optics"]["calibration"] = settings["projector_optics"]["calibration"] = path
    settings["virtual"] |= {"camera_optics": path, "projector_optics": path, "robot_profile": path}
    file.write_text(json.dumps(manifest))
    found = stored_settings(SessionReader(folder))
    assert found.profile() == truth.profile()
    assert found.projector_optics.pinhole().to_dict() == truth.projector_optics.pinhole().to_dict()
    assert np.allclose(found.true_optics()[0].tvec, truth.camera_optics.pinhole().tvec)
    assert found.font is None
    if full or path == HOSTILE_PATHS[0]:
        assert examine(folder).recognition.ranking
    assert profile_then(SessionReader(folder), found).cm_s_per_unit == truth.profile().cm_s_per_unit


@pytest.mark.parametrize("name", ["../../secret", "/etc/passwd", "..", "a/b/../../..", "text:\0"])
def test_names_with_ways_out(name, folder):
    file = folder / "manifest.json"
    manifest = json.loads(file.read_text())
    manifest["shape"]["name"] = manifest["devices"]["robots"][0]["name"] = name
    file.write_text(json.dumps(manifest))
    before = listing(folder.parent.parent)
    is_refused(lambda one: recognition_of(SessionReader(one), tables_of(SessionReader(one))), folder)
    is_refused(finalize, folder)
    assert {path for path in listing(folder.parent.parent) if path not in before} <= {
        str(folder / f"{table}.parquet") for table in ("lines", "crossings", "estimates")
    }


def test_a_shape_that_the_manifest_does_not_hold(folder):
    file = folder / "manifest.json"
    manifest = json.loads(file.read_text())
    for geometry in (
        {"type": "pol", "coordinates": []},
        {"type": "Point", "coordinates": [1, 2]},
        [],
        None,
        {"type": "Polygon", "coordinates": [[[10**400, 0], [1, 0], [1, 1], [10**400, 0]]]},
    ):
        manifest["shape"]["geometry"] = geometry
        file.write_text(json.dumps(manifest))
        assert is_refused(examine, folder)


def listing(root):
    """Every file below, with what a change of it would change."""
    return {
        str(path): (path.lstat().st_size, path.lstat().st_mtime_ns)
        for path in sorted(root.rglob("*"))
        if not path.is_dir()
    }


WATCHED = """
import json, os, sys
from pathlib import Path

sys.path.insert(0, {root!r})
folder, seen = Path(sys.argv[1]), []
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


def hook(event, args):
    # open, and the ways to make, move and take away
    if event == "open":
        path, mode, flags = args
        if isinstance(path, int) or not ((flags or 0) & WRITING or (mode and set(mode) & set("wxa+"))):
            return
        seen.append(os.fspath(path))
    elif event in {{f"os.{{way}}" for way in "rename remove mkdir rmdir link symlink truncate chmod".split()}}:
        seen.extend(os.fspath(part) for part in args[:2] if isinstance(part, (str, bytes, os.PathLike)))
    elif event in ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "socket.connect"):
        seen.append(f"{{event}} {{args}}")


sys.addaudithook(hook)
from lab.base.errors import ChordlabError
from lab.batch.rows import row_of
from lab.reopen.reread import reread
from lab.review.review import examine, review
from lab.store.tables import finalize

for read in (finalize, lambda one: review(one, report=True), reread, row_of):
    try:
        read(folder)
    except ChordlabError:
        pass
print(json.dumps([os.fsdecode(path) for path in seen]))
"""


def planted(folder, outside, *, log):
    """Break a folder in every way that tempts a reader to leave it; with ``log`` its log is a link out of it."""
    shutil.rmtree(outside, ignore_errors=True)
    outside.mkdir()
    victim = outside / "victim.json"
    victim.write_text("{}")
    file = folder / "manifest.json"
    manifest = json.loads(file.read_text())
    manifest["shape"]["name"] = "../outside/victim.json"
    manifest["settings"] |= {key: str(victim) for key in ("robot_profile", "font", "shape")}
    for name in ("report.html", "lines.parquet", "estimates.parquet", "track.parquet", "SHA256SUMS"):
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(victim)
    if log:
        shutil.move(folder / "events.jsonl", outside)
        (folder / "events.jsonl").symlink_to(outside / "events.jsonl")
    file.write_text(json.dumps(manifest))


@pytest.mark.timeout(900)
def test_nothing_outside_is_opened_for_writing(share, folder, tmp_path):
    """By the interpreter's own audit: what readers open for writing, make, move or take away lies in the folder."""
    outside, root = tmp_path / "arena" / "outside", Path(__file__).parents[2]
    for log in share((False, True), (False,)):
        planted(folder, outside, log=log)
        before = listing(outside)
        run = subprocess.run(
            [sys.executable, "-c", WATCHED.format(root=str(root)), str(folder)],
            capture_output=True,
            text=True,
            timeout=400,
            check=False,
            cwd=outside,
            env={**os.environ, "TMPDIR": str(tmp_path / "arena")},
        )
        assert run.returncode == 0, run.stderr
        assert "Traceback" not in run.stderr
        assert listing(outside) == before
        caches = (os.environ["CHORDLAB_CACHE"], *(str(path) for path in root.glob("*/**/__pycache__")), "/dev/null")
        fonts = (str(Path.home() / ".cache"), str(Path.home() / ".config" / "matplotlib"))
        allowed = (str(folder), *caches, *fonts)
        touched = json.loads(run.stdout)
        # matplotlib asks fc-list, which writes nothing, for the system's fonts
        assert not [path for path in touched if not path.startswith(allowed) and "fc-list" not in path]
        assert any(path.startswith(str(folder)) for path in touched), "the watch sees nothing"


def test_a_request_is_one_line(tmp_path):
    (tmp_path / "manifest.json").write_text(json.dumps({"schema_version": 1, "settings": {"a\nb\x1b[31m": 1}}))
    with pytest.raises(RequestError) as refused:
        stored_settings(SessionReader(tmp_path))
    assert str(refused.value).isprintable()
