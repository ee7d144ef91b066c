"""Camera and projector calibrated on a virtual bench whose true optics nobody is told, by the whole commands."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from lab.bench.rigcheck import RigError, check_rig, rig_markers, rig_picture
from lab.calibrate.boardviews import CoverageError, stored_views
from lab.calibrate.optics import PlacementError, calibrate_camera, calibrate_projector
from lab.cli.calibrate_optics import camera, person, projector
from lab.settings.load import load_settings
from projector.virtual import VirtualProjector
from tracking.board import Board, print_board
from tracking.boardscene import board_scene, held, laid
from tracking.calibration import load_calibration
from tracking.synthetic import OverheadScene

ARENA = np.stack(np.meshgrid(np.linspace(-60, 60, 13), np.linspace(-45, 45, 10)), axis=-1).reshape(-1, 2)

app = typer.Typer()
app.command("camera")(camera)
app.command("projector")(projector)


@dataclass(frozen=True)
class Truth:
    camera: Pinhole
    projector: Pinhole


def moved(optics: Pinhole, rng: np.random.Generator, *, distortion: float) -> Pinhole:
    """Within 3 cm, 2 degrees, 5 % of focal length of where the settings say; lens and distortion differ too."""
    rotation = optics.rotation @ cv2.Rodrigues(np.radians(rng.uniform(-2, 2, 3)))[0]
    centre = optics.centre_cm + rng.uniform(-3, 3, 3)
    matrix = optics.camera_matrix.copy()
    matrix[[0, 1], [0, 1]] *= 1 + rng.uniform(-0.05, 0.05)
    matrix[:2, 2] += rng.uniform(-20, 20, 2)
    bent = optics.distortion + np.eye(5)[0] * rng.uniform(-distortion, distortion)
    return Pinhole(optics.image_size, matrix, bent, cv2.Rodrigues(rotation)[0].ravel(), -rotation @ centre)


def hide(seed: int) -> Truth:
    settings, rng = load_settings(None), np.random.default_rng(seed)
    return Truth(
        moved(settings.camera_optics.pinhole(), rng, distortion=0.05),
        moved(settings.projector_optics.pinhole(), rng, distortion=0.01),
    )


@pytest.fixture
def bench(monkeypatch, tmp_path):
    """Make a virtual bench with hidden optics; its session file names the camera's calibration."""

    def make(seed: int) -> tuple[Truth, Path]:
        truth = hide(seed)
        monkeypatch.setattr("lab.settings.settings.Settings.true_optics", lambda _: (truth.camera, truth.projector))
        session = tmp_path / "bench.toml"
        session.write_text(f'seed = {seed}\n[camera_optics]\ncalibration = "{tmp_path / "camera.json"}"\n')
        return truth, session

    return make


def turned_deg(one: Pinhole, other: Pinhole) -> float:
    return math.degrees(float(np.linalg.norm(cv2.Rodrigues(one.rotation.T @ other.rotation)[0])))


def run(*words: object) -> dict:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.exception
    return json.loads(result.stdout)


def landing_cm(found: Pinhole, truth: Pinhole, height_cm: float) -> np.ndarray:
    """Where light meant for the arena's grid really falls, cm."""
    return truth.to_plane(found.project(np.column_stack([ARENA, np.full(len(ARENA), height_cm)])), height_cm)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
def test_hidden_optics_are_recovered_by_the_commands(bench, tmp_path: Path, seed: int, full: bool) -> None:
    if seed == 3 and not full:
        pytest.skip("run with --full")
    truth, session = bench(seed)
    print_board(tmp_path / "board.pdf", "A3")
    out = tmp_path / "camera.json"
    told = run("camera", "--board", tmp_path / "board.pdf", "--out", out, "--json")
    eye = load_calibration(out)
    assert eye.led_height_cm == 7.3
    assert told["rms_px"] < 0.3
    assert np.abs(eye.optics.centre_cm - truth.camera.centre_cm).max() < 0.2
    assert turned_deg(eye.optics, truth.camera) < 0.1
    assert len(told["views"]) >= 30
    floor = eye.optics.to_plane(truth.camera.project(np.column_stack([ARENA, np.full(len(ARENA), 7.3)])), 7.3)
    assert np.linalg.norm(floor - ARENA, axis=1).max() < 0.1

    for extra in ([], ["--raised-cm", 10]):
        out = tmp_path / "projector.json"
        told = run("projector", session, "--out", out, "--json", *extra)
        light = load_calibration(out).optics
        assert (told["assumed"] is None) == bool(extra)
        assert told["planes_cm"] == ([0.0, 10.0] if extra else [0.0])
        assert told["verified"]["worst_mm"] < 1.0
        assert told["verified"]["scale"] == pytest.approx(1.0, abs=3e-3)
        for height_cm in (0.0, 6.0):
            off = landing_cm(light, truth.projector, height_cm) - ARENA
            assert np.linalg.norm(off, axis=1).max() < 0.3
            assert abs(np.polyfit(ARENA[:, 0], off[:, 0], 1)[0]) < 3e-3
    assert np.abs(light.centre_cm - truth.projector.centre_cm).max() < 1.0


def test_a_tape_does_where_there_is_no_camera(bench, tmp_path: Path) -> None:
    truth, _ = bench(4)
    out = tmp_path / "projector.json"
    told = run("projector", "--by-hand", "--out", out, "--json")
    assert told["points"] == 4
    assert told["verified"]["markers"] == 1
    off = landing_cm(load_calibration(out).optics, truth.projector, 0.0) - ARENA
    assert np.linalg.norm(off, axis=1).max() < 0.5


@pytest.fixture(scope="module")
def board_pictures() -> tuple[Pinhole, dict[str, np.ndarray]]:
    """Pictures of a small hidden camera: of a held board, at the origin, over the floor."""
    settings, rng, board = load_settings(None), np.random.default_rng(5), Board()
    eye = moved(settings.camera_optics.pinhole(), rng, distortion=0.05)

    def picture(pose: Pinhole) -> np.ndarray:
        return board_scene(eye, pose, board, rng).render()[: eye.image_size[1]]

    poses = {f"view{n:02d}": pose for n, pose in enumerate(itertools.islice(held(eye, board, rng), 24))}
    poses["Origin"] = laid(eye, 0, 0)
    for n, (x, y) in enumerate([(40, 28), (-40, 28), (-40, -28), (40, -28)]):
        poses[f"floor{n}"] = laid(eye, x, y, 0.7 * n)
    return eye, {name: picture(pose) for name, pose in poses.items()}


def test_stored_pictures_calibrate_too(board_pictures, tmp_path: Path) -> None:
    eye, pictures = board_pictures
    for name, picture in pictures.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), picture)
    out = tmp_path / "camera.json"
    told = run("camera", "--from", tmp_path, "--out", out, "--json")
    assert {view["kind"] for view in told["views"]} == {"held", "floor", "origin"}
    found = load_calibration(out).optics
    assert np.abs(found.centre_cm - eye.centre_cm).max() < 0.6  # a board of A4, a single picture of each
    # A ruler of 10.2 cm says that the printer made all larger: the camera hangs higher by as much.
    run("camera", "--from", tmp_path, "--ruler-cm", 10.2, "--out", out, "--json")
    assert load_calibration(out).optics.centre_cm[2] == pytest.approx(1.02 * found.centre_cm[2], rel=1e-4)
    (tmp_path / "Origin.png").unlink()
    with pytest.raises(CoverageError, match="name such pictures"):
        stored_views(tmp_path, Board(), None)
    cv2.imwrite(str(tmp_path / "odd.png"), np.zeros((10, 10), np.uint8))
    with pytest.raises(RequestError, match="pictures of 2 sizes"):
        stored_views(tmp_path, Board(), None)
    (tmp_path / "odd.png").write_bytes(b"nothing")
    with pytest.raises(RequestError, match="is no picture"):
        stored_views(tmp_path, Board(), None)


def test_a_video_is_split_at_the_origin(board_pictures, tmp_path: Path) -> None:
    _, pictures = board_pictures
    path = tmp_path / "board.mkv"
    size = next(iter(pictures.values())).shape[::-1]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, size, False)
    assert writer.isOpened()
    order = [name for name in pictures if name.startswith("view")][:6]
    for name in order:  # each held for 0.5 s
        for _ in range(5):
            writer.write(pictures[name])
    origin_s = len(order) * 0.5 + 1.5
    for _ in range(30):
        writer.write(pictures["Origin"])
    for name in ("floor0", "floor2"):
        for _ in range(5):
            writer.write(pictures[name])
    writer.release()
    views = stored_views(path, Board(), origin_s)
    assert len(views.held) == 6
    assert len(views.floor) == 2
    direct = stored_views(path, Board(), origin_s + 0.3).origin
    assert np.abs(views.origin.pixels - direct.pixels).max() < 0.1
    with pytest.raises(CoverageError, match="--origin-s"):
        stored_views(path, Board(), 100.0)


def test_what_is_missing_is_told(board_pictures, tmp_path: Path) -> None:
    _, pictures = board_pictures
    for name in ("view05", "view06", "Origin"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), pictures[name])
    result = CliRunner().invoke(app, ["camera", "--from", str(tmp_path), "--out", str(tmp_path / "camera.json")])
    assert isinstance(result.exception, CoverageError)
    assert "the board in the picture's" in str(result.exception)
    assert "\n" not in str(result.exception)
    assert not (tmp_path / "camera.json").exists()


def test_a_board_is_made_and_nothing_else(tmp_path: Path) -> None:
    told = run("camera", "--make-board", tmp_path / "board.pdf", "--paper", "A3", "--json")
    assert told["columns"] == 9
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    assert [path.name for path in tmp_path.iterdir()] == ["board.pdf"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["projector", "--by-hand", "--raised-cm", "10"], "leave --raised-cm out"),
        (["projector", "--raised-cm", "1"], "raise it to 10 cm or more"),
        (["camera", "--out", "none/camera.json"], "there is no folder none"),
        (["camera", "--board", "none.pdf"], "cannot read the board"),
        (["camera", "--from", "none.mkv"], "none.mkv"),
    ],
)
def test_wrong_requests_are_one_line(monkeypatch, tmp_path: Path, words: list[str], told: str) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, words)
    assert isinstance(result.exception, RequestError), result.exception
    assert told in str(result.exception)
    assert "\n" not in str(result.exception)


def test_a_camera_is_needed_and_must_be_calibrated() -> None:
    blind = load_settings(None, {"camera": "none"})
    with pytest.raises(RequestError, match="needs a camera"):
        calibrate_camera(blind, Board(), person(), say=print)
    with pytest.raises(RequestError, match="--by-hand"):
        calibrate_projector(blind, person(), say=print)
    real = load_settings(None, {"robot": "ble:SB-1", "projector": "display:1", "camera": "usb:0"})
    with pytest.raises(RequestError, match="run chordlab calibrate camera"):
        calibrate_projector(real, person(), say=print)


def test_a_picture_that_lands_elsewhere_is_refused(bench, monkeypatch) -> None:
    truth, _ = bench(6)
    hits: list[int] = []
    show = VirtualProjector.show

    def slip(self: VirtualProjector, image: np.ndarray) -> None:
        hits.append(1)
        if len(hits) == 2:  # the projector is knocked between the chessboard and the markers that verify it
            self.pinhole = replace(self.pinhole, tvec=self.pinhole.tvec + np.array([1.0, 0.0, 0.0]))
            self._homographies.clear()
        show(self, image)

    monkeypatch.setattr(VirtualProjector, "show", slip)
    monkeypatch.setattr(
        "lab.settings.settings.Settings.true_optics",
        lambda _: (load_settings(None).camera_optics.pinhole(), truth.projector),
    )
    with pytest.raises(PlacementError, match="limit 5") as caught:
        calibrate_projector(load_settings(None), person(), say=lambda _: None)
    assert caught.value.off_mm == pytest.approx(10.0, abs=1.0)


def filmed(settings, eye: Pinhole, light: Pinhole, picture: np.ndarray, seed: int = 0) -> np.ndarray:
    """The picture on the floor as a camera at ``eye`` sees it from a projector at ``light``."""
    thrown = VirtualProjector(light)
    thrown.show(picture)
    return OverheadScene(eye, thrown.light_at, np.random.default_rng(seed)).render()[: eye.image_size[1]]


@pytest.mark.parametrize("kind", ["rectangle", "disc"])
def test_a_rig_that_hangs_still_passes(kind: str) -> None:
    settings = load_settings(None, {"arena.kind": kind, "arena.radius_cm": 44.0})
    truth = hide(7)
    picture = rig_picture(settings.arena, truth.camera, truth.projector)
    markers = rig_markers(settings.arena, truth.camera, truth.projector)
    assert len(markers.centres_cm) == 8
    assert settings.arena.polygon.buffer(0.01).contains(markers.lit)
    check = check_rig(
        filmed(settings, truth.camera, truth.projector, picture), settings.arena, truth.camera, truth.projector
    )
    assert check.seen == check.shown == 8
    assert check.passed
    assert check.shift_mm < 0.6
    check.require()


@pytest.mark.parametrize("device", ["camera", "projector"])
def test_a_shaken_rig_is_refused_with_its_number(device: str) -> None:
    settings, truth = load_settings(None), hide(8)
    picture = rig_picture(settings.arena, truth.camera, truth.projector)
    known = getattr(truth, device)
    # turned by half a degree: some 18 mm on the floor
    knocked = replace(
        known, rvec=cv2.Rodrigues(cv2.Rodrigues(np.array([math.radians(0.5), 0, 0]))[0] @ known.rotation)[0].ravel()
    )
    knocked = replace(knocked, tvec=-knocked.rotation @ known.centre_cm)
    real = replace(truth, **{device: knocked})
    check = check_rig(
        filmed(settings, real.camera, real.projector, picture), settings.arena, truth.camera, truth.projector
    )
    expected_mm = 10 * math.radians(0.5) * known.centre_cm[2]
    assert check.shift_mm == pytest.approx(expected_mm, rel=0.25)
    assert not check.passed
    with pytest.raises(RigError, match="was moved") as caught:
        check.require()
    assert caught.value.shift_mm == check.shift_mm


def test_a_rig_in_the_dark_is_refused() -> None:
    settings, truth = load_settings(None), hide(9)
    dark = filmed(settings, truth.camera, truth.projector, np.zeros((1080, 1920), np.uint8))
    check = check_rig(dark, settings.arena, truth.camera, truth.projector)
    assert not check.passed
    with pytest.raises(RigError, match="only 0 of 8 markers"):
        check.require()
    aside = replace(truth.projector, tvec=truth.projector.tvec + np.array([300.0, 0.0, 0.0]))
    with pytest.raises(RigError, match="share only 0 of 8 places"):
        rig_picture(settings.arena, truth.camera, aside)
