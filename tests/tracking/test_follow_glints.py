"""What the follower must not be taken in by: glints, other lights, a robot at rest."""

import math

import cv2
import numpy as np
import pytest

from tests.tracking.test_follow import Picture
from tracking.background import background_from
from tracking.follow import LedFollower
from tracking.sighting import places

SIZE = (240, 400)
RED, GREEN = (-24.0, 60.0), (-40.0, -45.0)


def _spot(x, y, sigma=3.0):
    rows, columns = np.indices(SIZE)
    return np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))


def picture(rng, lights, *, colour=True):
    """A dim floor with lights on it: (x, y, height, (step of U, step of V))."""
    texture = cv2.resize(np.random.default_rng(0).normal(60, 4, (30, 50)), SIZE[::-1], interpolation=cv2.INTER_CUBIC)
    luma, u, v = texture.copy(), np.full((120, 200), 128.0), np.full((120, 200), 128.0)
    for x, y, height, (step_u, step_v) in lights:
        ball = np.hypot(*(np.indices(SIZE) - np.array([y, x])[:, None, None])) < 14
        if (step_u, step_v) != (0.0, 0.0) or not colour:
            luma[ball] = 45.0
        spot = _spot(x, y)
        small = 0.25 * (spot[::2, ::2] + spot[1::2, ::2] + spot[::2, 1::2] + spot[1::2, 1::2])
        luma += height * spot
        u += height / 100.0 * step_u * small
        v += height / 100.0 * step_v * small
    planes = [np.clip(np.rint(p + rng.normal(0, 0.8, p.shape)), 0, 255).astype(np.uint8) for p in (u, v)]
    luma = np.clip(np.rint(luma + rng.normal(0, 1.5, SIZE)), 0, 255).astype(np.uint8)
    return Picture(luma, tuple(planes) if colour else None)


def follow(pictures, **options):
    floor = background_from(pictures[:: max(1, len(pictures) // 21)])
    follower = LedFollower(floor, **options)
    for number, frame in enumerate(pictures):
        follower.step(number / 30.0, frame.luma, frame.chroma)
    return places(follower.finish())


def way(n, x=30.0, y=60.0, vx=3.0, vy=0.8):
    return np.column_stack([x + vx * np.arange(n), y + vy * np.arange(n)])


def off(found, truth):
    return np.hypot(*(found[:, :2] - truth).T)


@pytest.mark.parametrize("colour", [True, False])
def test_a_reflection_that_appears_and_stays_is_not_the_led(colour):
    rng, truth = np.random.default_rng(1), way(110)
    pictures = []
    for number, (x, y) in enumerate(truth):
        glints = [(200.0, 200.0, 150.0, (0.0, 0.0))] if number >= 30 else []
        led = [] if 60 <= number < 85 else [(x, y, 90.0, RED)]
        pictures.append(picture(rng, led + glints, colour=colour))
    found = follow(pictures)
    seen = np.isfinite(found[:, 0])
    assert off(found, truth)[seen].max() < 1.0
    assert not seen[60:85].any()
    assert seen[:60].all()
    assert seen[90:].all()


@pytest.mark.parametrize(("colour", "miss_px"), [(True, 1.0), (False, 1.0), (False, 6.0), (False, 25.0)])
def test_a_light_that_crosses_its_way_does_not_take_the_led_along(colour, miss_px):
    # Without colour it is a second ball, as it were, which hides the LED where they meet.
    rng, truth = np.random.default_rng(2), way(100)
    meeting = truth[50]
    pictures = []
    for number, (x, y) in enumerate(truth):
        glint = meeting + (number - 50) * np.array([0.0, -3.0]) + (miss_px, 0.0)
        pictures.append(picture(rng, [(x, y, 90.0, RED), (*glint, 80.0, (0.0, 0.0))], colour=colour))
    found = follow(pictures)
    away = np.abs(np.arange(100) - 50) > 8
    error = off(found, truth)
    assert np.nanmax(error[away]) < 0.5
    assert np.isfinite(error[away]).all()
    assert np.nanmax(error) < 5.0


@pytest.mark.parametrize(("miss_px", "sigma_px"), [(0.0, 3.0), (1.0, 3.0), (3.0, 3.0), (6.0, 4.0), (12.0, 2.2)])
def test_a_reflex_that_runs_over_the_ball_is_parted_from_the_led(miss_px, sigma_px):
    # The two add up, at relative heights of 90 and 80: where they meet, the position is less certain, and says so.
    rng, truth = np.random.default_rng(3), way(100)
    pictures = []
    for number, (x, y) in enumerate(truth):
        frame = picture(rng, [(x, y, 90.0, RED)], colour=False)
        glint_x, glint_y = truth[50] + (number - 50) * np.array([0.0, -3.0]) + (miss_px, 0.0)
        frame.luma = cv2.add(frame.luma, np.rint(80.0 * _spot(glint_x, glint_y, sigma_px)).astype(np.uint8))
        pictures.append(frame)
    found = follow(pictures)
    error = off(found, truth)
    near = np.abs(np.arange(100) - 50) <= 8
    assert np.isfinite(error).mean() > 0.98
    assert np.nanmax(error) < 2.0
    assert np.nanmax(error[~near]) < 0.2
    assert np.nanmean((found[:, :2] - truth)[near] ** 2 / found[near, 2:]) < 2.0


def test_a_picture_shown_twice_as_the_led_brightens_does_not_lose_it():
    # A camera that has no picture in time gives the one before once more: the LED seems to halt, and then to leap.
    rng, truth = np.random.default_rng(7), way(100, vx=3.5)
    pictures = [picture(rng, [(x, y, 100.0 if number >= 60 else 25.0, RED)]) for number, (x, y) in enumerate(truth)]
    for number in (58, 66, 80):
        pictures[number], truth[number] = pictures[number - 1], truth[number - 1]
    found = follow(pictures)
    assert np.isfinite(found[:, 0]).all()
    assert off(found, truth).max() < 0.5


def test_a_second_robot_of_another_colour_is_left_alone():
    rng, mine, other = np.random.default_rng(3), way(90), way(90, x=300.0, y=63.0, vx=-3.0)
    pictures = [picture(rng, [(*a, 80.0, RED), (*b, 110.0, GREEN)]) for a, b in zip(mine, other, strict=True)]
    for hue, truth, foreign in ((math.atan2(*RED[::-1]), mine, other), (math.atan2(*GREEN[::-1]), other, mine)):
        found = follow(pictures, hue_rad=hue)
        error = off(found, truth)
        apart = np.hypot(*(mine - other).T) > 30
        assert np.nanmax(error[apart]) < 0.5
        assert np.isfinite(error[apart]).mean() > 0.97
        assert np.nanmin(off(found, foreign)[apart]) > 20


def test_a_place_given_by_somebody_else_is_taken_and_refined():
    rng, mine, other = np.random.default_rng(4), way(60), way(60, y=110.0)
    pictures = [
        picture(rng, [(*a, 80.0, RED), (*b, 80.0, RED)], colour=False) for a, b in zip(mine, other, strict=True)
    ]
    floor = background_from(pictures[::4])
    follower = LedFollower(floor)
    for number, frame in enumerate(pictures):
        rough = other[number] + rng.uniform(-1.5, 1.5, 2)
        follower.step(number / 30.0, frame.luma, frame.chroma, at=tuple(rough))
    assert off(places(follower.finish()), other).max() < 0.3


@pytest.mark.parametrize("colour", [True, False])
def test_a_robot_that_rests_most_of_the_time_is_followed_at_rest(colour):
    # 20 % of the film it rolls, then it rests, and blinks between its two levels.
    rng = np.random.default_rng(5)
    truth = np.vstack([way(40), np.repeat(way(41)[40:], 160, axis=0)])
    pictures = [
        picture(rng, [(x, y, 90.0 if number % 40 < 25 else 40.0, RED)], colour=colour)
        for number, (x, y) in enumerate(truth)
    ]
    found = follow(pictures)
    assert np.isfinite(found[:, 0]).all()
    assert off(found, truth).max() < 0.5


def test_a_light_that_never_moves_nor_blinks_is_a_lamp_of_the_room():
    rng = np.random.default_rng(6)
    found = follow([picture(rng, [(200.0, 120.0, 90.0, RED)]) for _ in range(40)])
    assert not np.isfinite(found).any()
