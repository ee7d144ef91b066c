"""Which of several lights is the LED, from trails made up by hand."""

import numpy as np
import pytest

from tracking.hueplane import SpotRadius
from tracking.motion import PixelMotion
from tracking.shell import ShellField
from tracking.sighting import Sighting
from tracking.trail import Trail, choose

WIDTH = 640
TIMES_S = np.arange(400) / 30.0


def trail(first, last, *, start=(100.0, 100.0), step=(3.0, 0.0), height=100.0, hidden=0.0, lit=0.0):
    """A light seen in the frames ``first`` to ``last`` (without); ``height`` and ``lit`` may differ by frame."""
    made = Trail(PixelMotion(*start), SpotRadius(3.0), SpotRadius(1.5), ShellField((640, 360)), 0.0)
    heights, lits = (np.broadcast_to(values, last - first) for values in (height, lit))
    for number in range(first, last):
        x, y = np.asarray(start) + (number - first) * np.asarray(step)
        bright = float(heights[number - first])
        seen = Sighting((x, y, 0.01, 0.01), None, bright, 1.0, 0.9, True, hidden)
        made.add(number, TIMES_S[number], seen, float(lits[number - first]))
    return made


def chosen(*trails):
    return [(piece.trail, piece.starts, piece.ends) for piece in choose(trails, TIMES_S, WIDTH)]


def test_a_light_on_a_ball_is_believed_before_a_longer_one_on_the_bare_floor():
    led, glint = trail(0, 100, hidden=0.4), trail(0, 180, start=(300.0, 50.0), hidden=0.01)
    assert chosen(glint, led) == [(led, 0, 99)]


def test_a_light_that_blinks_with_the_shape_is_believed_before_one_that_does_not():
    lit = np.arange(120) % 40 < 20
    led = trail(0, 120, height=np.where(lit, 100.0, 30.0), lit=lit)
    constant = trail(0, 200, start=(300.0, 50.0), lit=np.arange(200) % 40 < 20)
    against = trail(0, 120, start=(300.0, 50.0), height=np.where(lit, 30.0, 100.0), lit=lit)
    assert chosen(constant, led) == [(led, 0, 119)]
    assert chosen(against, led) == [(led, 0, 119)]


def test_a_light_that_never_moves_is_not_what_the_led_became():
    led, again = trail(0, 60, hidden=0.4), trail(90, 130, start=(280.0, 100.0), hidden=0.4)
    lamp = trail(30, 130, start=(200.0, 200.0), step=(0.0, 0.0), hidden=0.4)
    assert chosen(led, lamp, again) == [(led, 0, 59), (again, 90, 129)]


def test_a_robot_does_not_leap_from_one_place_to_another():
    led, far = trail(0, 100, hidden=0.4), trail(103, 140, start=(20.0, 350.0), hidden=0.4)
    later = trail(150, 200, start=(390.0, 100.0), hidden=0.4)
    assert chosen(led, far, later) == [(led, 0, 99), (later, 150, 199)]


def test_noise_while_the_led_is_dark_is_left_out():
    led, again = trail(0, 60, hidden=0.4), trail(90, 130, start=(280.0, 100.0), hidden=0.4)
    noise = trail(70, 75, start=(281.0, 120.0), step=(0.1, 0.0), hidden=0.1)
    assert chosen(led, noise, again) == [(led, 0, 59), (again, 90, 129)]


@pytest.mark.parametrize("swapped", [False, True])
def test_where_two_lights_part_it_is_asked_anew_which_is_which(swapped):
    # Up to frame 50 one is on a ball, the other is not; they meet, and their trails may have been exchanged.
    one, other = trail(0, 120, start=(100.0, 100.0)), trail(0, 120, start=(100.0, 101.0))
    for light, ball in ((one, (0.4, 0.0)), (other, (0.0, 0.4))):
        hidden = ball if swapped else (ball[0], ball[0])
        light.seen[:] = [
            Sighting(s.luma, None, s.amplitude, 1.0, 0.9, True, hidden[number >= 50])
            for number, s in enumerate(light.seen)
        ]
        light.cuts.append(50)
    second = other if swapped else one
    assert chosen(one, other) == [(one, 0, 49), (second, 50, 119)]


def test_a_light_of_the_leds_colour_is_it_again_after_each_short_dark():
    # Twenty frames at a time, and no floor that could be hidden: the colour is enough.
    led = [trail(first, first + 20, start=(100.0 + 3 * first, 100.0)) for first in (0, 40, 80)]
    for light in led:
        light.seen[:] = [Sighting(None, s.luma, s.amplitude, 1.0, 0.9, False) for s in light.seen]
    assert [one for one, _, _ in chosen(*led)] == led


def test_nothing_seen_is_nothing_chosen():
    assert chosen() == []
