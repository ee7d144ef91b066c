"""Settings, robot profiles and calibrations by a stranger's hand: read whole, or refused in one line."""

import json
from dataclasses import asdict

import numpy as np
import pytest

from lab.base.errors import RequestError
from lab.recognise.recognisers import sensor_model
from lab.settings.load import load_settings
from lab.settings.settings import Settings
from lab.store.layout import to_json
from robot.profile import RobotProfile, load_profile, save_profile
from tests.fuzz.harness import fuzz
from tests.fuzz.mutate import BYTES, hostile, mangled, mutated, pick, scaled, to_toml
from tests.fuzz.mutate import to_json as broken_json
from tracking.board import read_board
from tracking.calibration import Calibration, load_calibration


def known(value):
    """Without what TOML has no word for."""
    if isinstance(value, dict):
        return {key: known(item) for key, item in value.items() if item is not None}
    return value


DEFAULTS = known(Settings().model_dump(mode="json"))
REAL = {"robot": ["ble:SB-1234", "ble:SB-5678"], "projector": "display:1", "camera": "usb:0", "out": "elsewhere"}
FAULTS = {"faults": [{"kind": "loss", "at_s": 3.0, "share": 0.4}, {"kind": "vanish", "at_s": 8, "robot": 1}]}
DISC = {"arena": {"kind": "disc", "edge": "dark_ring", "ring_cm": 12.0}, "motion": {"turning": "uniform"}}
TREES = (
    DEFAULTS,
    DEFAULTS | REAL,
    {"shape": "text:WORD", "virtual": FAULTS, "stop": {"until": 0.9}},
    {**DISC, "robot": "onboard:virtual", "camera": "none", "led": {"colours": ["red"]}},
)


def sectioned(rng):
    """A document of valid keys alone, some of whose values are hostile: it comes far."""
    tree = {key: dict(value) if isinstance(value, dict) else value for key, value in pick(rng, TREES).items()}
    for _ in range(int(rng.integers(1, 4))):
        section = pick(rng, [tree, *(value for value in tree.values() if isinstance(value, dict) and value)])
        key = pick(rng, list(section))
        value = section[key]
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        section[key] = (
            scaled(value, 10.0 ** float(rng.integers(-12, 13))) if number and rng.random() < 0.5 else hostile(rng)
        )
    return tree


def toml_of(trees):
    seeds = [to_toml(tree) for tree in trees]

    def make(rng):
        way = rng.random()
        if way < 0.3:
            return mangled(pick(rng, seeds), rng, seeds)
        if way < 0.65:
            return to_toml(mutated(pick(rng, trees), rng))
        return to_toml(sectioned(rng)) if trees is TREES else to_toml(mutated(pick(rng, trees), rng, most=1))

    return make


@pytest.fixture
def file(tmp_path):
    return tmp_path / "given.toml"


def test_session_toml(share, file):
    def read(data):
        file.write_bytes(data)
        settings = load_settings(file, {"stop.lines": 9}, simulate=data[:1] > b"c")
        # what every session does with its settings before a robot is called
        to_json(settings.model_dump(mode="json"))
        settings.seeds()
        settings.profile()
        settings.true_optics()
        settings.camera_calibration()
        arena = settings.arena
        assert np.isfinite([arena.longest_line_cm, arena.reachable.area, arena.ring.area if arena.ring else 0.0]).all()
        sensor_model(settings)

    fuzz("session.toml", share(20_000, 600), toml_of(TREES), read)


PROFILES = (
    {name: value for name, value in asdict(RobotProfile()).items() if value is not None}
    | {"collision_axes": ["right", "forward"], "dark_lux": 5.0, "bright_lux": 50.0},
    {"cm_s_per_unit": 0.61},
)


def test_robot_profile(share, file, tmp_path):
    def read(data):
        file.write_bytes(data)
        profile = load_profile(file)
        assert profile.max_speed_cm_s > 0
        # what is read can be written, and is the same
        save_profile(profile, tmp_path / "again.toml")
        assert load_profile(tmp_path / "again.toml") == profile

    fuzz("robot-profile.toml", share(10_000, 200), toml_of(PROFILES), read)


CALIBRATION = Settings().camera_calibration().to_dict()


def calibration(rng):
    if rng.random() < 0.3:
        return mangled(json.dumps(CALIBRATION).encode(), rng)
    return broken_json(mutated(CALIBRATION, rng, most=2), rng)


def test_calibration(share, tmp_path):
    file = tmp_path / "calibration.json"
    pixels = np.array([[0.0, 0.0], [640.0, 360.0], [1280.0, np.nan]])

    def read(data):
        file.write_bytes(data)
        found = load_calibration(file)
        assert np.isfinite(found.optics.centre_cm).all()
        with np.errstate(all="ignore"):
            found.to_arena(pixels)
            found.cm_per_px(pixels)
            found.optics.project(np.array([[1.0, 2.0, 3.0]]))
        assert Calibration.from_dict(json.loads(to_json(found.to_dict()))).to_dict() == found.to_dict()

    fuzz("calibration.json", share(10_000, 500), calibration, read)


BOARD = b"%PDF-1.4 /Subject (chordlab-board columns=7 rows=5 square_cm=3.4) /Title (chordlab board)\n%%EOF"


def board(rng):
    number = pick(rng, (b"7", b"0", b"3", b"99999", b"9" * 5000, b"-1", b"", b"1e9"))
    data = BOARD.replace(pick(rng, (b"7", b"5", b"3.4")), number + pick(rng, (b"", b".", b"..", b".5")))
    return mangled(data, rng) if rng.random() < 0.5 else data


def test_board_pdf(share, tmp_path):
    file = tmp_path / "board.pdf"

    def read(data):
        file.write_bytes(data)
        assert np.isfinite(read_board(file).corners_cm).all()

    fuzz("board PDF", share(10_000, 500), board, read)


DEEP = {".toml": b"shape = " + b"[" * 100_000, ".json": b"[" * 100_000}


@pytest.mark.parametrize(
    ("load", "data"),
    [
        (load_settings, b"seed = " + b"9" * 5000),
        (load_settings, b"shape = " + b"[" * 100_000),
        (load_settings, b"[arena]\nwidth_cm = 1e300\nheight_cm = 1e300"),
        (load_settings, b"[virtual]\nlight_noise_lux = inf"),
        (load_settings, b"stop = 3"),
        (load_settings, b'"a\\u2028b" = 1'),
        (load_profile, b"cm_s_per_unit = " + b"9" * 5000),
        (load_profile, b"cm_s_per_unit = " + b"[" * 100_000),
        (load_profile, b"collision_axes = [[1], {}]"),
        (load_calibration, b"[" * 100_000),
        (load_calibration, json.dumps(CALIBRATION | {"led_height_cm": 10**400}).encode()),
        (load_calibration, json.dumps(CALIBRATION | {"tvec": [0, 0, 10**400]}).encode()),
        (load_calibration, json.dumps(CALIBRATION | {"image_size": [float("inf"), 3]}).encode()),
        (load_calibration, b'{"led_height_cm": ' + b"9" * 5000 + b"}"),
    ],
    ids=lambda value: getattr(value, "__name__", None) or value[:24].decode().replace("[", ""),
)
def test_faults_found(load, data, file):
    file.write_bytes(data)
    with pytest.raises(RequestError) as refused:
        load(file, *([{"stop.lines": 9}] if load is load_settings else []))
    assert len(str(refused.value).splitlines()) == 1
    assert len(str(refused.value)) < 400


@pytest.mark.parametrize("load", [load_settings, load_profile, load_calibration, read_board])
@pytest.mark.parametrize("name", ["a\x00b", "\ud800", "x" * 5000, "", "/dev/null/x"])
def test_names_that_no_file_has(load, name, tmp_path):
    from pathlib import Path

    with pytest.raises(RequestError):
        load(Path(name))


assert BYTES
