"""The robot's program, step by step on scripted hardware, and the example hardware on a simulated board."""

import importlib
import itertools
import math
import struct
import sys

import numpy as np
import pytest
from scipy.stats import kstest

from robot.micropython import main, wire
from robot.turning import lambert
from tests.robot.micropython import board

START = struct.pack(wire.START_FORMAT, wire.START, 3, 300, 77, 63.0, 70.0, 77.0)
STOP = struct.pack(wire.STOP_FORMAT, wire.STOP)
DARK, LIT = 20.0, 120.0
NORMAL = 1.0  # heading from the wall that is met


class Script:
    """Hardware and link that go by a script: one (way_cm, light, whether a wall is met) for each step of 20 ms."""

    top_speed_cm_s = 40.0

    def __init__(self, steps, commands=None):
        self.steps, self.commands = steps, {0: START} if commands is None else commands
        self.at, self.headings, self.stops, self.told = 0, [], 0, []
        self.here = True
        self.roamer = main.Roamer(self, self)

    def play(self):
        for at, step in enumerate(self.steps):
            self.at, self.met = at, step[2]
            self.roamer.step()
        return self

    def records(self, uuid, layout):
        return [struct.unpack(layout, record) for told, record in self.told if told == uuid]

    @property
    def lines(self):
        return self.records(wire.LINE_UUID, wire.LINE_FORMAT)

    def clock_ms(self):
        return 20 * self.at

    def way_cm(self):
        return self.steps[self.at][0]

    def light(self):
        return self.steps[self.at][1]

    def bumped(self):
        met, self.met = self.met, False
        return NORMAL if met else None

    def drive(self, heading_rad, speed_cm_s):
        assert speed_cm_s == 30.0
        self.headings.append(heading_rad)

    def tend(self):
        pass

    def stop(self):
        self.stops += 1

    def battery_mv(self):
        return 3900

    def connected(self):
        return self.here

    def command(self):
        return self.commands.pop(self.at, None)

    def notify(self, uuid, record):
        self.told.append((uuid, record))


BEGIN = (0.0, DARK, False)  # the step that takes the command
FROM_INSIDE = [BEGIN, (20.0, DARK, True)]  # a first run, which starts in mid-arena
CHORD = [(0.0, DARK, False), (10.0, DARK, False), (20.0, LIT, False), (40.0, LIT, False), (50.0, DARK, False)]


def test_only_runs_from_wall_to_wall_are_lines():
    played = Script([*FROM_INSIDE, *CHORD, (70.0, DARK, True), (0.0, DARK, False), (30.0, DARK, True)]).play()
    told = [line[:6] for line in played.lines]
    assert told == [(3, 1, 1, 30.0, 27_000.0, 70.0), (3, 2, 0, 0.0, 0.0, 30.0)]
    estimates = played.records(wire.ESTIMATE_UUID, wire.ESTIMATE_FORMAT)
    assert [estimate[:2] + estimate[4:] for estimate in estimates] == [(3, 1, 1), (3, 2, 1)]
    assert estimates[0][2] == estimates[1][2] == pytest.approx(math.pi / 3 * 900)


def test_a_line_that_begins_and_ends_in_the_light_is_closed_at_both_ends():
    played = Script([*FROM_INSIDE, (2.0, LIT, False), (10.0, LIT, False), (32.0, LIT, True)]).play()
    assert [line[:6] for line in played.lines] == [(3, 1, 1, 30.0, 27_000.0, 32.0)]


STILL = [(0.3, DARK, False)] * 120  # 2.4 s


def test_a_run_that_stays_at_the_wall_is_drawn_anew():
    played = Script([*FROM_INSIDE, *STILL, *CHORD, (70.0, DARK, True)]).play()
    assert len(played.headings) == 4  # from inside, the one that stayed, the one that went, the next
    assert [line[1:4] for line in played.lines] == [(1, 1, 30.0)]
    assert played.records(wire.STATUS_UUID, wire.STATUS_FORMAT)[-1][2] == 1  # a status follows each line


def test_a_run_that_stays_in_mid_arena_is_no_line_and_neither_is_the_next():
    held = [(25.0, LIT, False)] * 102  # given up on the last of them, 2.02 s after it last moved
    played = Script([*FROM_INSIDE, *CHORD[:2], *held, *CHORD, (70.0, DARK, True), *CHORD, (60.0, DARK, True)]).play()
    assert len(played.headings) == 5
    assert [line[1:6] for line in played.lines] == [(1, 1, 30.0, 27_000.0, 60.0)]


def test_an_odometer_that_runs_backwards_costs_the_line_alone():
    backwards = [*CHORD, (12.0, LIT, False), (5.0, DARK, False), (70.0, DARK, True)]
    played = Script([*FROM_INSIDE, *backwards, *CHORD, (60.0, DARK, True)]).play()
    assert [line[1:6] for line in played.lines] == [(1, 1, 30.0, 27_000.0, 60.0)]


def test_a_stop_forgets_the_line_in_progress_and_a_start_begins_anew():
    steps = [*FROM_INSIDE, *CHORD, (70.0, DARK, True), *CHORD, *FROM_INSIDE, *CHORD, (65.0, DARK, True)]
    again = struct.pack(wire.START_FORMAT, wire.START, 4, 300, 77, 63.0, 70.0, 77.0)
    played = Script(steps, {0: START, 12: STOP, 13: again}).play()
    assert [line[:6] for line in played.lines] == [(3, 1, 1, 30.0, 27_000.0, 70.0), (4, 1, 1, 30.0, 27_000.0, 65.0)]
    assert played.headings[0] == played.headings[3]  # the same seed
    states = [status[0] for status in played.records(wire.STATUS_UUID, wire.STATUS_FORMAT)]
    assert [state for state, _ in itertools.groupby(states)] == [wire.ROLLING, wire.IDLE, wire.ROLLING]


@pytest.mark.parametrize(
    "nonsense",
    [b"", b"\x07", bytes(20), START[:-1], STOP + STOP, START[:2] + b"\0\0" + START[4:], START[:8] + START[:7:-1]],
)
def test_a_command_that_makes_no_sense_changes_nothing(nonsense):
    played = Script([BEGIN] * 3, {0: nonsense}).play()
    assert (played.roamer.state, played.headings, played.stops) == (wire.IDLE, [], 0)


def test_alone_it_stops_after_a_minute():
    played = Script([((step % 200) / 2.0, DARK, step % 200 == 199) for step in range(3400)])
    played.here = False
    played.play()
    assert played.roamer.state == wire.IDLE
    assert 60_000 < played.records(wire.STATUS_UUID, wire.STATUS_FORMAT)[-2][3] < 68_000 - 20
    assert played.stops > 15


def test_turns_are_lamberts_and_the_first_run_goes_anywhere():
    played = Script([(10.0 * (step % 2), DARK, step % 2 == 1) for step in range(400)]).play()
    dice = main.Dice(77)
    assert played.headings[0] == pytest.approx(dice.draw() * math.tau)
    expected = [(NORMAL + lambert(dice.draw())) % math.tau for _ in played.headings[1:]]
    assert played.headings[1:] == pytest.approx(expected)
    assert (len(played.headings), len(played.lines)) == (201, 199)


def test_the_dice_are_fair_and_exact_in_single_precision():
    dice = main.Dice(5)
    draws = [dice.draw() for _ in range(20_000)]
    assert kstest(draws, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(draws[1:], draws[:-1])[0, 1]) < 0.03
    firsts = [main.Dice(seed).draw() for seed in range(5000)]
    assert kstest(firsts, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(firsts[1:], firsts[:-1])[0, 1]) < 0.05
    assert all(float(np.float32(draw)) == draw and 0 <= draw < 1 for draw in draws)


@pytest.fixture
def example(monkeypatch):
    """The example robot in the simulated world, at the middle."""
    modules = {}
    board.plug_in(modules, 10)
    board.world.host = lambda _: None
    board.world.x_cm = board.world.y_cm = board.world.facing_rad = 0.0
    with monkeypatch.context() as patch:
        for name, module in modules.items():
            patch.setitem(sys.modules, name, module)
        sys.modules.pop("robot.micropython.hardware", None)
        hardware = importlib.import_module("robot.micropython.hardware")
    sys.modules.pop("robot.micropython.hardware", None)
    return hardware.Robot()


def roll(robot, seconds):
    for _ in range(round(seconds / 0.02)):
        robot.tend()
        robot.sleep_until(robot.clock_ms() + 20)


@pytest.mark.parametrize("heading_rad", [0.0, 0.4, 2.0, math.pi - 0.01, math.pi + 0.01, 5.5])
def test_the_example_turns_the_short_way_and_rolls_straight(example, heading_rad):
    world = board.world
    example.drive(heading_rad, 20.0)
    assert world.now_ms < 1500
    # One count of an encoder is 0.055 cm at 4.75 cm from the middle; a millisecond of turning is about two of them.
    assert abs(math.remainder(world.facing_rad - heading_rad, math.tau)) < 0.05
    roll(example, 2.0)
    assert math.hypot(world.x_cm, world.y_cm) == pytest.approx(40.0, abs=1.0)
    assert example.way_cm() == pytest.approx(math.hypot(world.x_cm, world.y_cm), abs=0.2)
    example.stop()
    before = example.way_cm()
    roll(example, 0.2)
    assert example.way_cm() == before


@pytest.mark.parametrize("aside_rad", [-1.2, -0.8, -0.4, 0.0, 0.4, 0.8, 1.2])
def test_the_example_feels_which_side_the_wall_is_on(example, aside_rad):
    """The wall at x = 80 cm, met at an angle: ahead, or an eighth of a turn to one side, as two switches can tell."""
    world = board.world
    world.x_cm = 79.0
    example.drive((math.pi / 2 - aside_rad) % math.tau, 20.0)
    felt = None
    for _ in range(400):
        roll(example, 0.02)
        felt = example.bumped()
        if felt is not None:
            break
    assert felt is not None
    assert abs(math.remainder(felt - 1.5 * math.pi, math.tau)) < 0.45
    assert example.bumped() is None  # once per press


def test_the_example_reads_its_sensors(example):
    assert example.light() == 42000
    board.world.x_cm = 50.0
    assert example.light() == 6000
    assert example.battery_mv() == pytest.approx(3827, abs=2)
