"""What the doctor finds, and what a bundle for a bug report must not tell."""

import importlib.machinery
import importlib.metadata
import importlib.util
import json
import platform
import shutil
import socket
import threading
import time
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.cli.main import main
from lab.doctor import hardware, machine, software
from lab.doctor.bundle import write_bundle
from lab.doctor.examine import examine
from lab.doctor.finding import Finding
from lab.doctor.scrub import Scrubber
from projector.device import ProjectorError
from tests.lab.conftest import roll

USER, FULL_NAME, HOST = "Zaphod.Beeblebrox", "Zaphod Beeblebröx", "heart-of-gold"


@pytest.fixture
def say(capsys, monkeypatch):
    """Run a command without waiting for Bluetooth; give its exit code, stdout and stderr."""
    monkeypatch.setattr(hardware, "_SCAN_S", 0.05)

    def run(*argv):
        capsys.readouterr()
        code = main([str(word) for word in argv])
        out, err = capsys.readouterr()
        return code, out, err

    return run


def by_check(findings) -> dict[str, Finding]:
    return {finding.check: finding for finding in findings}


def test_doctor_says_what_is_missing_and_the_cure(say, tmp_path):
    code, out, err = say("doctor", "--out", tmp_path, "--json")
    assert (code, err) == (0, "")
    (line,) = out.splitlines()
    found = {finding["check"]: finding for finding in json.loads(line)["findings"]}
    assert found["python"]["state"] == "ok"
    assert found["numpy"]["found"] == np.__version__
    assert all(finding["cure"] for finding in found.values() if finding["state"] != "ok")
    assert {"disk space", "disk speed", "font", "bluetooth", "camera", "display", "clock"} <= set(found)
    assert {"time of day", "timer", "cores", "kernel cache", "encoder", "extra live", "our packages"} <= set(found)
    code, out, _ = say("doctor", "--out", tmp_path)
    assert "virtual bench runs here" in out or "All is here" in out
    assert "as required" in out
    assert "numpy" not in out  # packages that are as they should be share a row


def test_what_stops_a_virtual_session_is_exit_1(say, tmp_path, monkeypatch):
    real = importlib.metadata.version
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.1" if name == "numpy" else real(name))
    code, out, _ = say("doctor", "--out", tmp_path, "--json")
    assert code == 1
    (broken,) = [f for f in json.loads(out)["findings"] if f["state"] == "broken"]
    assert broken["check"] == "numpy"
    assert broken["cure"] == "pip install 'numpy>=2'"
    code, out, _ = say("doctor", "--out", tmp_path)
    assert code == 1
    assert "A session cannot run here: 1 broken." in out


def test_another_robot_package_in_the_way_is_found(monkeypatch, tmp_path):
    real = importlib.util.find_spec
    elsewhere = importlib.machinery.ModuleSpec("robot", None, origin=str(tmp_path / "robot/__init__.py"))
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: elsewhere if name == "robot" else real(name, *rest)
    )
    (clash,) = software.clashes()
    assert (clash.check, clash.state) == ("package robot", "broken")
    assert "virtual environment" in clash.cure


def test_an_extra_that_is_not_installed_is_missing_with_its_cure(monkeypatch):
    real = importlib.metadata.version

    def version(name):
        if name == "nicegui":
            raise importlib.metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    live = by_check(software.extras())["extra live"]
    assert (live.state, live.found) == ("missing", "nicegui not installed")
    assert "pip install 'chordlab[live]'" in live.cure
    assert by_check(software.packages())["numpy"].state == "ok"


class Camera:
    """A camera of a size; it is none without, and hangs where asked to."""

    def __init__(self, size=None, hangs=None):
        self.size, self.hangs, self.released = size, hangs, False

    def isOpened(self):
        if self.hangs is not None:
            self.hangs.wait(20)
        return self.size is not None

    def grab(self):
        return True

    def retrieve(self):
        return True, np.zeros((self.size[1], self.size[0], 3), np.uint8)

    def release(self):
        self.released = True


def test_each_camera_gives_a_picture_or_is_left_behind():
    let_go = threading.Event()
    cameras = {0: Camera((640, 480)), 1: Camera(), 2: Camera((1, 1), hangs=let_go), 3: Camera((1280, 720))}
    started = time.monotonic()
    found = hardware.look_through(list(cameras), cameras.__getitem__, timeout_s=0.2)
    assert time.monotonic() - started < 10
    let_go.set()
    assert (found.state, found.found) == ("ok", "usb:0 (640 x 480), usb:3 (1280 x 720)")
    assert cameras[0].released
    assert cameras[1].released
    none = hardware.look_through([], cameras.__getitem__)
    assert (none.state, none.cure) == ("missing", "plug in a webcam")
    silent = hardware.look_through([1], cameras.__getitem__)
    assert silent.state == "missing"
    assert silent.cure


@pytest.mark.parametrize(
    ("sizes", "state", "says"),
    [
        ([(1920, 1080), (1280, 800)], "ok", "display:1 (1280 x 800)"),
        ([(1920, 1080)], "missing", "only display:0 (1920 x 1080)"),
        (ProjectorError("pygame-ce is missing; pip install it"), "missing", "pygame-ce is missing"),
    ],
)
def test_displays_are_listed_with_their_sizes(monkeypatch, sizes, state, says):
    def listed():
        if isinstance(sizes, Exception):
            raise sizes
        return sizes

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(hardware, "display_sizes", listed)
    (found,) = hardware.displays()
    assert found.state == state
    assert says in found.found
    assert bool(found.cure) == (state != "ok")


@pytest.mark.parametrize(("said", "state"), [("yes\n", "ok"), ("no\n", "missing"), ("", "ok")])
def test_a_clock_that_follows_no_time_server_is_told(monkeypatch, said, state):
    monkeypatch.setattr(machine.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(machine.subprocess, "run", lambda *_, **__: SimpleNamespace(stdout=said))
    (found,) = machine.wall_clock()
    assert found.state == state


def test_a_folder_that_cannot_be_written_is_broken(tmp_path):
    (tmp_path / "file").write_text("")
    checks = by_check(machine.disk(tmp_path / "not/yet/there"))
    assert checks["disk space"].state == "ok"
    assert (tmp_path / "not").exists() is False


def test_progress_counts_the_checks(tmp_path, monkeypatch):
    monkeypatch.setattr(hardware, "_SCAN_S", 0.05)
    steps = []
    findings = examine(tmp_path, lambda done, total: steps.append((done, total)))
    assert [done for done, _ in steps] == list(range(1, steps[-1][1] + 1))
    assert len({finding.check for finding in findings}) == len(findings)


@pytest.fixture(scope="module")
def small_session(tmp_path_factory) -> Path:
    """Five lines over the square, no video."""
    return roll(tmp_path_factory.mktemp("small"), shape="square", stop__lines=5).folder


@pytest.fixture
def at_zaphods(monkeypatch, tmp_path) -> Path:
    """A home, a user and a machine that are easily told; gives the home."""
    home = tmp_path / "Galaxy" / USER
    home.mkdir(parents=True)
    for name in ("HOME", "USERPROFILE"):
        monkeypatch.setenv(name, str(home))
    for name in ("USER", "LOGNAME", "USERNAME"):
        monkeypatch.setenv(name, USER)
    monkeypatch.setenv("HOSTNAME", f"{HOST}.example.org")
    monkeypatch.setenv("CHORDLAB_CACHE", str(home / "cache of mine"))
    monkeypatch.setattr(socket, "gethostname", lambda: HOST)
    monkeypatch.setattr(platform, "node", HOST.upper)
    pwd = pytest.importorskip("pwd")
    account = SimpleNamespace(pw_name=USER, pw_gecos=f"{FULL_NAME},,,", pw_dir=str(home))
    monkeypatch.setattr(pwd, "getpwuid", lambda _: account)
    return home


ADDRESS = "C0:FF:EE:12:34:56"


def personal_session(source: Path, home: Path) -> Path:
    """A session that knows all about Zaphod, with a log whose last record is torn."""
    folder = shutil.copytree(source, home / "my sessions" / source.name)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["settings"]["font"] = str(home / "Fonts of mine" / "Heart.ttf")
    manifest["settings"]["camera"] = f"file:{home}/films/Trillian party.mkv"
    manifest["settings"]["robot_profile"] = f"C:\\Users\\{USER}\\profile.toml"
    manifest["devices"]["robots"][0]["address"] = ADDRESS
    manifest["devices"]["robot"]["address"] = ADDRESS.lower()
    (folder / "manifest.json").write_text(json.dumps(manifest))  # ASCII: the ö becomes \u00f6
    with (folder / "events.jsonl").open("a", encoding="utf-8") as log:
        said = f"{home}/x.mkv: cannot be written by {USER.upper()} on {HOST.title()}, /mnt/Magrathea/disk.img is full"
        log.write(json.dumps({"event": "lost", "t_s": 1.0, "robot": "SB-7E57", "reason": said}) + "\n")
        log.write(json.dumps({"event": "note", "text": FULL_NAME, "to": ADDRESS.replace(":", "_")}) + "\n")
        log.write(f'{{"event": "lost", "reason": "\\/home\\/{USER} {json.dumps(FULL_NAME)} {ADDRESS.replace(":", "-")}')
    (folder / f"{USER}.txt").write_text("a note beside")
    return folder


def contents(archive: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(archive) as file:
        assert file.testzip() is None
        return {name: file.read(name) for name in file.namelist()}


@pytest.mark.parametrize("light", [False, True])
def test_a_bundle_tells_nothing_of_who_made_it_and_where(small_session, at_zaphods, say, tmp_path, light):
    folder = personal_session(small_session, at_zaphods)
    target = tmp_path / "out.zip"
    more = ["--with-light"] if light else []
    code, _, err = say("doctor", "--bundle", target, "--session", folder, "--out", at_zaphods, "--json", *more)
    assert (code, err) == (0, "")
    found = contents(target)
    every_byte = target.read_bytes() + b"".join(name.encode() + data for name, data in found.items())
    told = every_byte.decode("utf-8", errors="replace").lower()
    forms = [USER, FULL_NAME, HOST, str(at_zaphods), "Beeblebr", "Zaphod", "Trillian", "Magrathea", "Fonts of mine"]
    forms += ["C0FFEE123456", *(ADDRESS.replace(":", mark) for mark in ":-_"), str(Path.cwd()), str(tmp_path)]
    for form in forms:
        for spelt in (form, json.dumps(form)[1:-1], form.replace("/", "\\/"), form.replace("/", "\\\\")):
            assert spelt.lower() not in told, spelt
    # and yet it is of use
    manifest = json.loads(found["session/manifest.json"])
    was = json.loads((folder / "manifest.json").read_text())
    assert manifest["settings"]["stop"] == was["settings"]["stop"]
    assert manifest["shape"]["name"] == "square"
    assert manifest["settings"]["font"].endswith(".ttf")
    assert manifest["devices"]["robots"][0]["address"] == manifest["devices"]["robot"]["address"] == "<address 1>"
    assert manifest["devices"]["robot"]["name"] == was["devices"]["robot"]["name"]
    log, mine = found["session/events.jsonl"].decode().splitlines(), (folder / "events.jsonl").read_text().splitlines()
    assert len(log) == len(mine)
    assert [json.loads(line) for line in log[:-3]] == [json.loads(line) for line in mine[:-3]]
    assert json.loads(log[-2])["to"] == "<address 1>"
    assert "<address 1>" in log[-1]
    versions = json.loads(found["versions.json"])
    assert versions["numpy"] == np.__version__
    assert {"events.jsonl", "manifest.json"} <= {
        line.split()[-1] for line in found["session/files.txt"].decode().splitlines()
    }
    assert ("session/light.csv" in found) is light
    assert not any(name.endswith((".parquet", ".mkv")) for name in found)


def test_the_raw_light_of_a_bundle_is_that_of_the_session(small_session, tmp_path):
    found = contents(write_bundle(tmp_path / "b.zip", [], session=small_session, with_light=True))
    (tmp_path / "light.csv").write_bytes(found["session/light.csv"])
    light = pd.read_csv(tmp_path / "light.csv")
    expected = pd.concat([pd.read_parquet(path) for path in sorted(small_session.glob("lines/*/light.parquet"))])
    np.testing.assert_array_equal(light[expected.columns], expected)


@pytest.mark.parametrize("spoil", ["manifest", "log", "both"])
def test_a_broken_session_goes_into_a_bundle_as_it_is(small_session, tmp_path, spoil):
    folder = shutil.copytree(small_session, tmp_path / "copy")
    if spoil in {"manifest", "both"}:
        (folder / "manifest.json").write_bytes(b'{"schema_version": 2, "se\xff\x00')
    if spoil in {"log", "both"}:
        (folder / "events.jsonl").write_bytes(b"\xfe\xfe no log at all\n{}")
    found = contents(write_bundle(tmp_path / "b.zip", [], session=folder, with_light=True))
    assert "session/manifest.json" in found
    assert b"no log at all" in found["session/events.jsonl"] or spoil == "manifest"


def test_links_out_of_the_session_lead_nothing_into_a_bundle(small_session, tmp_path):
    folder = shutil.copytree(small_session, tmp_path / "copy")
    (tmp_path / "secret").write_text("secret words")
    (folder / "manifest.json").unlink()
    (folder / "manifest.json").symlink_to(tmp_path / "secret")
    found = contents(write_bundle(tmp_path / "b.zip", [], session=folder))
    assert "session/manifest.json" not in found
    assert not any(b"secret words" in data for data in found.values())


WRONG = ("x.zip", "--session x", "--with-light", "--bundle x.tar", "--bundle x.zip --session no")


@pytest.mark.parametrize("asked", WRONG)
def test_a_wrong_request_for_a_bundle_is_told_in_one_line(say, tmp_path, monkeypatch, asked):
    monkeypatch.chdir(tmp_path)
    code, out, err = say("doctor", *asked.split())
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert list(tmp_path.iterdir()) == []


def test_short_names_are_masked_as_words_only():
    scrub = Scrubber(homes=["/home/pi"], users=["pi"], hosts=["lab"])
    assert scrub.text("pixels of pi at lab, label") == "pixels of <user> at <host>, label"
    assert "pi" not in scrub.text("/home/pi/film.mkv")


def test_what_is_no_path_stays_and_the_same_path_bears_the_same_mask():
    scrub = Scrubber(homes=[], users=[], hosts=[])
    for text in (
        "30 cm/s, A/P",
        "https://foxglove.dev/docs",
        "2026-11-23T10:42:00",
        "lines/000001",
        "</a>",
        "1/2",
        "file: x",
    ):
        assert scrub.text(text) == text
    assert scrub.text("/a/b.mkv") == "<path 1>.mkv"
    assert scrub.text("at /c/d: gone, /a/b.mkv too") == "at <path 2>: gone, <path 1>.mkv too"
    assert scrub.text("file:/a/b c.mkv") == "file:<path 3>.mkv"
    assert scrub.text(r"C:\Users\A B\c.toml") == "<path 4>.toml"


NAMES = st.text(min_size=5, max_size=20).filter(
    lambda name: name.isprintable() and name.strip(" /\\") == name and not set(name) & set("<>")
)


@given(NAMES, st.booleans())
def test_a_name_is_found_in_every_way_of_writing_it(name, ascii_only):
    scrub = Scrubber(homes=[], users=[name], hosts=[])
    text = json.dumps({"a": f"x{name}y", name: [name]}, ensure_ascii=ascii_only)
    for masked in (scrub.text(text), scrub.json(text), scrub.lines(text + "\n" + text[:-1])):
        assert json.dumps(name, ensure_ascii=ascii_only)[1:-1] not in masked
