"""Board, its detection, and the camera's calibration: against poses that only the test knows."""

from __future__ import annotations

import itertools
import math
import re
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from tracking.board import Board, BoardError, board_for, print_board, read_board
from tracking.boardscene import board_scene, held, laid
from tracking.camerafit import CameraFitError, _Bundle, _fit_lens, fit_camera
from tracking.charuco import BoardDetector, Collector, View

SIZE = (1280, 720)
BOARD = board_for("A4")


def hidden_camera(rng: np.random.Generator) -> Pinhole:
    camera = Pinhole.looking_down(
        SIZE,
        height_cm=205 + rng.uniform(-4, 4),
        field_width_cm=175 * (1 + rng.uniform(-0.05, 0.05)),
        centre_cm=tuple(rng.uniform(-3, 3, 2)),
        tilt_rad=tuple(rng.uniform(-0.05, 0.05, 2)),
        distortion=(rng.uniform(-0.2, -0.05), 0.03, 0.001, -0.0005, 0.0),
    )
    matrix = camera.camera_matrix.copy()
    matrix[:2, 2] += rng.uniform(-15, 15, 2)
    return replace(camera, camera_matrix=matrix)


def paper_view(pose: Pinhole, rng: np.random.Generator, name: str, noise_px: float = 0.05) -> View:
    """What a perfect detector would see, with noise; no picture is drawn."""
    pixels = pose.project(BOARD.corners_cm) + rng.normal(0, noise_px, (len(BOARD.corners_cm), 2))
    inside = ((pixels > 0) & (pixels < SIZE)).all(axis=1)
    return View(name, np.flatnonzero(inside), pixels[inside])


def paper_views(camera: Pinhole, rng: np.random.Generator, count: int = 25) -> tuple[list[View], View, list[View]]:
    views = (paper_view(pose, rng, f"held {n}") for n, pose in enumerate(held(camera, BOARD, rng)))
    airborne = list(itertools.islice((view for view in views if len(view.numbers) >= 8), count))
    floor = [
        paper_view(laid(camera, x, y, turn), rng, f"floor {n}")
        for n, (x, y, turn) in enumerate([(45, 25, 0.3), (-45, 25, -1.0), (-45, -25, 2.0), (45, -25, 0.0)])
    ]
    return airborne, paper_view(laid(camera, 0, 0), rng, "origin"), floor


def turned_deg(one: Pinhole, other: Pinhole) -> float:
    return math.degrees(float(np.linalg.norm(cv2.Rodrigues(one.rotation.T @ other.rotation)[0])))


def test_corners_lie_where_black_meets_white_crosswise() -> None:
    cells = BOARD.cells
    rows, columns = cells.shape
    width_cm, height_cm = BOARD.size_cm
    for x_cm, y_cm, z_cm in BOARD.corners_cm:
        column = round((x_cm + width_cm / 2) / width_cm * columns)
        row = round((height_cm / 2 - y_cm) / height_cm * rows)
        around = cells[row - 1 : row + 1, column - 1 : column + 1]
        assert around[0, 0] == around[1, 1]
        assert around[0, 1] == around[1, 0] != around[0, 0]
        assert z_cm == 0
    assert BOARD.corners_cm[:, :2].mean(axis=0) == pytest.approx([0, 0], abs=1e-6)
    assert BOARD.corners_cm[0, 1] > BOARD.corners_cm[-1, 1]  # numbered from the top, y up


@pytest.mark.parametrize(("paper", "wide_mm", "high_mm"), [("A4", 297, 210), ("A3", 420, 297)])
def test_the_printed_board_has_its_true_size(tmp_path: Path, paper: str, wide_mm: float, high_mm: float) -> None:
    path = tmp_path / "board.pdf"
    board = print_board(path, paper)
    data = path.read_bytes()
    box = [float(word) for word in re.search(rb"/MediaBox \[([^\]]*)\]", data)[1].split()]
    assert box[2:] == pytest.approx([wide_mm / 25.4 * 72, high_mm / 25.4 * 72], abs=0.5)
    # The largest filled path of the page is the board: its vertices, in points, span it.
    starts = [found.end() for found in re.finditer(rb"stream\r?\n(?=x)", data)]
    streams = [zlib.decompressobj().decompress(data[start:]) for start in starts]
    page = max(streams, key=lambda text: text.count(b" l\n"))
    board_path = max(re.split(rb"\n[fB]\*?\n", page), key=lambda text: text.count(b" l\n"))
    vertices = np.array([[float(x) for x in words] for words in re.findall(rb"([-\d.]+) ([-\d.]+) [ml]\n", board_path)])
    size_cm = np.ptp(vertices, axis=0) / 72 * 2.54
    assert size_cm == pytest.approx(board.size_cm, abs=0.01)
    assert b"/Subtype /Image" not in data  # vector, not pixels


def test_a_board_is_known_by_its_file(tmp_path: Path) -> None:
    for paper in ("A4", "A3"):
        printed = print_board(tmp_path / "boards" / f"{paper}.pdf", paper)
        found = read_board(tmp_path / "boards" / f"{paper}.pdf")
        assert (found.columns, found.rows, found.square_cm) == (printed.columns, printed.rows, printed.square_cm)
    (tmp_path / "other.pdf").write_bytes(b"%PDF-1.4 nothing")
    with pytest.raises(BoardError, match="--make-board"):
        read_board(tmp_path / "other.pdf")
    with pytest.raises(BoardError, match="cannot read"):
        read_board(tmp_path / "none.pdf")
    with pytest.raises(BoardError, match="A4 or A3"):
        print_board(tmp_path / "b.pdf", "A5")
    with pytest.raises(RequestError, match="cannot be written"):
        print_board(tmp_path / "other.pdf" / "b.pdf")


@pytest.mark.parametrize(
    "wrong", [{"columns": 2}, {"columns": 40, "rows": 40}, {"square_cm": 0.0}, {"square_cm": math.nan}]
)
def test_impossible_boards_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(BoardError):
        Board(**wrong)


def test_corners_are_found_to_a_twentieth_of_a_pixel() -> None:
    rng = np.random.default_rng(1)
    camera = hidden_camera(rng)
    detector = BoardDetector(BOARD.charuco)
    errors = []
    for pose in itertools.islice(held(camera, BOARD, rng), 8):
        view = detector.find(board_scene(camera, pose, BOARD, rng).render()[: SIZE[1]])
        if view is not None:
            errors.append(view.pixels - pose.project(BOARD.corners_cm[view.numbers]))
    error = np.concatenate(errors)
    assert len(error) > 80
    assert np.sqrt((error**2).mean()) < 0.07
    assert np.abs(error.mean(axis=0)).max() < 0.02


def test_nothing_is_found_where_there_is_no_board() -> None:
    rng = np.random.default_rng(2)
    assert BoardDetector(BOARD.charuco).find(rng.integers(0, 255, (720, 1280), dtype=np.uint8)) is None


def test_coverage_says_what_is_missing() -> None:
    rng = np.random.default_rng(3)
    camera = hidden_camera(rng)
    collector = Collector(BOARD, SIZE)
    assert len(collector.coverage.missing) == 3
    flat = paper_view(laid(camera, 0, 0), rng, "flat")
    assert collector.offer(flat)
    assert not collector.offer(flat)  # nothing new
    text = "; ".join(collector.coverage.missing)
    assert "top far left" in text
    assert "left, right, top, bottom edge nearer" in text
    assert "farther away" in text
    for pose in itertools.islice(held(camera, BOARD, rng), 30):
        view = paper_view(pose, rng, "held")
        if len(view.numbers) >= 6:
            collector.offer(view)
    assert collector.coverage.missing == ()


@pytest.mark.parametrize(("edge", "axis", "sign"), [("left", 1, 1), ("right", 1, -1), ("top", 0, 1), ("bottom", 0, -1)])
def test_a_tilt_is_told_by_the_nearer_edge(edge: str, axis: int, sign: int) -> None:
    camera = replace(hidden_camera(np.random.default_rng(4)), distortion=np.zeros(5))
    turn = np.zeros(3)
    turn[axis] = sign * 0.5
    facing = np.diag([1.0, -1.0, -1.0]) @ cv2.Rodrigues(turn)[0]
    pose = replace(camera, rvec=cv2.Rodrigues(facing)[0].ravel(), tvec=np.array([0.0, 0.0, 70.0]))
    # The edge's own distance says whether it is nearer, whatever a rotation's sign means.
    middle = {"left": (-10.0, 0), "right": (10.0, 0), "top": (0, 8.0), "bottom": (0, -8.0)}[edge]
    assert (facing @ (*middle, 0.0))[2] < 0
    collector = Collector(BOARD, SIZE)
    collector.take([paper_view(pose, np.random.default_rng(5), "tilted", 0.0)])
    tilts = dict(zip(("left", "right", "top", "bottom"), collector.coverage.tilts_rad, strict=True))
    assert max(tilts, key=tilts.get) == edge
    assert tilts[edge] == pytest.approx(0.5, abs=0.1)


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_camera_is_recovered_from_its_views(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = hidden_camera(rng)
    fit = fit_camera(BOARD, SIZE, *paper_views(camera, rng))
    off = fit.optics.centre_cm - camera.centre_cm
    assert np.abs(off / fit.position_std_cm).max() < 5
    assert np.linalg.norm(off) < 0.5
    assert turned_deg(camera, fit.optics) < 0.25
    assert fit.rms_px == pytest.approx(0.05 * math.sqrt(2), rel=0.15)


def test_standard_errors_cover_the_truth() -> None:
    pulls = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        camera = hidden_camera(rng)
        fit = fit_camera(BOARD, SIZE, *paper_views(camera, rng, 20))
        pulls.extend((fit.optics.centre_cm - camera.centre_cm) / fit.position_std_cm)
        pulls.append((fit.optics.camera_matrix[0, 0] - camera.camera_matrix[0, 0]) / fit.lens_std["fx"])
    assert 0.6 < float(np.sqrt(np.mean(np.square(pulls)))) < 1.5


def test_derivatives_are_those_of_the_residuals() -> None:
    rng = np.random.default_rng(8)
    airborne, origin, floor = paper_views(hidden_camera(rng), rng, 10)
    _, lens = _fit_lens(BOARD, SIZE, airborne)
    bundle = _Bundle(BOARD, SIZE, lens, airborne, origin, floor)
    x = bundle._x
    _, by = bundle._evaluate(x)
    step = 1e-6 * np.maximum(np.abs(x), 0.1)
    numeric = np.column_stack(
        [(bundle._evaluate(x + move)[0] - bundle._evaluate(x - move)[0]) / (2 * move.sum()) for move in np.diag(step)]
    )
    scale = np.abs(numeric).max(axis=0)
    assert np.abs((by - numeric) / scale).max() < 1e-4


def test_bad_views_are_thrown_out() -> None:
    rng = np.random.default_rng(6)
    camera = hidden_camera(rng)
    airborne, origin, floor = paper_views(camera, rng)
    smeared = replace(airborne[3], pixels=airborne[3].pixels + rng.normal(0, 3, airborne[3].pixels.shape))
    lifted = laid(camera, 45, 25, 0.3)
    lifted = replace(lifted, tvec=lifted.tvec + camera.rotation @ (0, 0, 6.0), rvec=lifted.rvec + 0.04)
    spoiled = [*airborne[:3], smeared, *airborne[4:]]
    fit = fit_camera(BOARD, SIZE, spoiled, origin, [paper_view(lifted, rng, "floor 0"), *floor[1:]])
    assert {view.name for view in fit.views if not view.kept} == {"held 3", "floor 0"}
    assert np.linalg.norm(fit.optics.centre_cm - camera.centre_cm) < 0.5
    one = replace(origin, pixels=origin.pixels.copy())
    one.pixels[4] += 20.0  # a finger over one corner
    fit = fit_camera(BOARD, SIZE, airborne, replace(one), floor)
    assert np.linalg.norm(fit.optics.centre_cm - camera.centre_cm) < 0.5


def test_a_calibration_that_cannot_be_good_is_refused() -> None:
    rng = np.random.default_rng(7)
    camera = hidden_camera(rng)
    airborne, origin, floor = paper_views(camera, rng)
    with pytest.raises(CameraFitError, match="5 of 5 views"):
        fit_camera(BOARD, SIZE, airborne[:5], origin, floor)
    with pytest.raises(CameraFitError, match="lay the board flat in the arena's corners too"):
        fit_camera(BOARD, SIZE, airborne, origin)
    rough = [replace(view, pixels=view.pixels + rng.normal(0, 2.0, view.pixels.shape)) for view in (*airborne, *floor)]
    with pytest.raises(CameraFitError, match="is the board flat"):
        fit_camera(
            BOARD, SIZE, rough[:25], replace(origin, pixels=origin.pixels + rng.normal(0, 2, (24, 2))), rough[25:]
        )
