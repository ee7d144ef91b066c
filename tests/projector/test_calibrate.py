"""The projector's pose from points: against projectors that only the test knows."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.base.pinhole import Pinhole
from projector.calibrate import Beforehand, ProjectorFitError, fit_projector

SIZE = (1920, 1080)
NOMINAL = Pinhole.looking_down(SIZE, height_cm=250, field_width_cm=200)
ARENA = np.stack(np.meshgrid(np.linspace(-60, 60, 9), np.linspace(-45, 45, 7)), axis=-1).reshape(-1, 2)
GRID_PX = np.stack(np.meshgrid(np.linspace(119, 1799, 15), np.linspace(119, 959, 8)), axis=-1).reshape(-1, 2)


def hidden_projector(rng: np.random.Generator, *, turned: float = 0.0) -> Pinhole:
    """A few cm, degrees and per cent from nominal; the lens is shifted, the image may be upside down."""
    turn = cv2.Rodrigues(np.array([*rng.uniform(-0.05, 0.05, 2), turned]))[0]
    rotation = NOMINAL.rotation @ turn
    centre = NOMINAL.centre_cm + rng.uniform(-4, 4, 3)
    matrix = NOMINAL.camera_matrix.copy()
    matrix[:2] *= 1 + rng.uniform(-0.05, 0.05)
    matrix[0, 2] += rng.uniform(-15, 15)
    matrix[1, 2] += rng.uniform(-100, 100)
    return replace(
        NOMINAL,
        camera_matrix=matrix,
        distortion=np.array([rng.uniform(-0.02, 0.02), 0, 0, 0, 0]),
        rvec=cv2.Rodrigues(rotation)[0].ravel(),
        tvec=-rotation @ centre,
    )


def seen(projector: Pinhole, height_cm: float, rng: np.random.Generator, noise_cm: float = 0.01):
    """Points where the pattern's corners fall in a plane, as a camera finds them, and the corners."""
    places = projector.to_plane(GRID_PX, height_cm)
    near = (np.abs(places) < (85, 50)).all(axis=1)
    found = places[near] + rng.normal(0, noise_cm, (int(near.sum()), 2))
    return np.column_stack([found, np.full(len(found), height_cm)]), GRID_PX[near]


def missed_cm(fit: Pinhole, truth: Pinhole, height_cm: float) -> np.ndarray:
    """How far light lands from where it was meant to, over the arena."""
    pixels = fit.project(np.column_stack([ARENA, np.full(len(ARENA), height_cm)]))
    return np.linalg.norm(truth.to_plane(pixels, height_cm) - ARENA, axis=1)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, np.pi]))
def test_two_planes_recover_the_projector(seed: int, turned: float) -> None:
    rng = np.random.default_rng(seed)
    truth = hidden_projector(rng, turned=turned)
    floor, raised = seen(truth, 0.0, rng), seen(truth, 10.0, rng)
    points, pixels = (np.concatenate(parts) for parts in zip(floor, raised, strict=True))
    fit = fit_projector(points, pixels, SIZE, Beforehand.of(NOMINAL))
    assert fit.planes_cm == (0.0, 10.0)
    assert fit.rms_cm == pytest.approx(0.01 * np.sqrt(2), rel=0.2)
    for height_cm in (0.0, 6.0, 10.0):
        assert missed_cm(fit.optics, truth, height_cm).max() < 0.05
    off = fit.optics.centre_cm - truth.centre_cm
    assert np.abs(off / fit.centre_std_cm).max() < 5
    assert np.abs(off).max() < 1.5


def test_the_floor_alone_leaves_the_distance_to_the_tape() -> None:
    pulls = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        truth = hidden_projector(rng)
        told = truth.centre_cm + rng.normal(0, 10.0, 3)
        known = replace(Beforehand.of(NOMINAL), centre_cm=tuple(told))
        fit = fit_projector(*seen(truth, 0.0, rng), SIZE, known)
        assert missed_cm(fit.optics, truth, 0.0).max() < 0.05
        spread = fit.spread_cm(ARENA, 6.0)
        off = missed_cm(fit.optics, truth, 6.0)
        assert spread.max() > 3 * fit.spread_cm(ARENA, 0.0).max()
        pulls.append(float(np.sqrt((off**2).mean() / (spread**2).mean())))
    # what the fit says of its error in the sensor's plane is what it errs by
    assert 0.6 < float(np.sqrt(np.mean(np.square(pulls)))) < 1.4


def test_wrong_points_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    truth = hidden_projector(rng)
    points, pixels = seen(truth, 0.0, rng)
    points[[4, 20, 33], :2] += rng.uniform(5, 20, (3, 2))
    fit = fit_projector(points, pixels, SIZE, Beforehand.of(NOMINAL))
    assert fit.points == len(points) - 3
    assert missed_cm(fit.optics, truth, 0.0).max() < 0.05


def test_four_points_by_tape_are_enough_for_the_floor() -> None:
    rng = np.random.default_rng(4)
    truth = hidden_projector(rng)
    pixels = np.array([(230.0, 160.0), (1690.0, 160.0), (230.0, 920.0), (1690.0, 920.0)])
    places = np.column_stack([truth.to_plane(pixels, 0.0), np.zeros(4)])
    fit = fit_projector(places, pixels, SIZE, Beforehand.of(NOMINAL), error_cm=0.2)
    assert fit.points == 4
    assert missed_cm(fit.optics, truth, 0.0).max() < 0.8
    assert (missed_cm(fit.optics, truth, 0.0) < 4 * fit.spread_cm(ARENA, 0.0)).all()


def test_what_makes_no_pose_is_refused() -> None:
    rng = np.random.default_rng(5)
    points, pixels = seen(hidden_projector(rng), 0.0, rng)
    known = Beforehand.of(NOMINAL)
    with pytest.raises(ProjectorFitError, match="3 points"):
        fit_projector(points[:3], pixels[:3], SIZE, known)
    line = points[:, 1].argsort()[:8]
    flat = points[line] * (1, 0, 1)
    with pytest.raises(ProjectorFitError, match="not on one line"):
        fit_projector(flat, pixels[line], SIZE, known)
    with pytest.raises(ProjectorFitError, match="mirror"):
        fit_projector(points * (-1, 1, 1), pixels, SIZE, known)
