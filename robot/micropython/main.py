"""The program of a robot that measures by itself: roll, watch the light, turn at the wall, estimate, tell.

``Roamer`` is the whole of it, pure: it is handed the hardware and the link and does one turn of its loop per
``step``, so that the same file runs on the robot, on the virtual robot and in the tests. On the robot this file
is also ``/main.py``, what MicroPython starts by itself.

Headings are radians, clockwise, in the robot's own frame; lengths cm; times whole milliseconds of its clock.
"""

import math
import struct

from robot.micropython import wire
from robot.micropython.detector import Detector
from robot.onboard import Estimator

PROGRAM = (1, 0, 0)
SAMPLE_MS = 20
STALL_MS = 2000  # longer than any turn on the spot
STALL_CM = 0.5
ALONE_MS = 60000  # rolled on without a host for this long, it stops
IDLE_STATUS_MS, ROLLING_STATUS_MS = 100, 500
_TURN = 2.0 * math.pi

TYPE_CHECKING = False  # MicroPython has no typing; type checkers take this for True
if TYPE_CHECKING:
    from robot.micropython.parts import Hardware, Link


class Dice:
    """Uniform numbers from a seed, the same on every build: SplitMix on 32 bits with MurmurHash3's finaliser.

    (Steele, Lea and Flood 2014; Appleby.) MicroPython's own ``random`` differs from CPython's.
    """

    def __init__(self, seed: int):
        """Begin the sequence of ``seed``."""
        self._state = seed & 0xFFFFFFFF

    def draw(self) -> float:
        """The next number in [0, 1), a multiple of 2^-24: exact in single precision too."""
        self._state = (self._state + 0x9E3779B9) & 0xFFFFFFFF
        mixed = self._state
        mixed = ((mixed ^ (mixed >> 16)) * 0x85EBCA6B) & 0xFFFFFFFF
        mixed = ((mixed ^ (mixed >> 13)) * 0xC2B2AE35) & 0xFFFFFFFF
        return ((mixed ^ (mixed >> 16)) >> 8) / 16777216.0


def identity(hardware: "Hardware") -> bytes:
    """The record that tells a host who it talks to."""
    top_mm_s = min(65535, int(10.0 * hardware.top_speed_cm_s))
    return struct.pack(wire.IDENTITY_FORMAT, wire.VERSION, *PROGRAM, SAMPLE_MS, top_mm_s)


class Roamer:
    """One robot that rolls from wall to wall and estimates the shape that it crosses.

    A run counts as a line when it began and ended at a wall; after each that counts, LINE and ESTIMATE go out.
    At the wall it turns by Lambert's law, about the normal that the hardware felt. A run that does not get on
    for two seconds is given up: at the wall where it began the heading is drawn anew, in mid-arena anywhere.

    Attributes:
        state: ``wire.IDLE`` or ``wire.ROLLING``.
        session: The number that the host gave to the session.
    """

    def __init__(self, hardware: "Hardware", link: "Link"):
        """Stand idle until a START arrives."""
        self._hardware = hardware
        self._link = link
        self.state = wire.IDLE
        self.session = 0
        self._estimator = Estimator(False)
        self._detector = Detector(0.0, 0.0, 0.0)
        self._dice = Dice(0)
        self._speed_cm_s = 0.0
        self._normal_rad: float | None = None
        self._counts = False
        self._run_ms = 0
        self._moved_ms = 0
        self._moved_cm = 0.0
        self._heard_ms = 0
        self._next_status_ms = hardware.clock_ms()

    def step(self) -> None:
        """One turn of the loop: obey the host, take a sample, end the run at a wall, tell how it stands."""
        hardware, link = self._hardware, self._link
        hardware.tend()
        command = link.command()
        while command is not None:
            self._obey(command)
            command = link.command()
        now_ms = hardware.clock_ms()
        light = hardware.light()
        if self.state == wire.ROLLING:
            self._sample(now_ms, light)
        if link.connected():
            self._heard_ms = now_ms
        elif self.state == wire.ROLLING and now_ms - self._heard_ms > ALONE_MS:
            self._stop()
        if now_ms >= self._next_status_ms:
            self._tell(now_ms, light)

    def _obey(self, command: bytes) -> None:
        """Take a command of the host; one that makes no sense is passed over, and the host finds no change."""
        if command[:1] == bytes((wire.STOP,)) and len(command) == struct.calcsize(wire.STOP_FORMAT):
            self._stop()
        elif command[:1] == bytes((wire.START,)) and len(command) == struct.calcsize(wire.START_FORMAT):
            _, session, speed_mm_s, seed, low, mid, high = struct.unpack(wire.START_FORMAT, command)
            if speed_mm_s > 0 and low < mid < high:
                self._start(session, speed_mm_s / 10.0, seed, Detector(low, mid, high))

    def _start(self, session: int, speed_cm_s: float, seed: int, detector: Detector) -> None:
        self._stop()
        self.state = wire.ROLLING
        self.session = session
        self._estimator = Estimator(False)
        self._detector = detector
        self._dice = Dice(seed)
        self._speed_cm_s = speed_cm_s
        self._normal_rad = None
        self._heard_ms = self._hardware.clock_ms()
        self._set_off()

    def _stop(self) -> None:
        """Come to rest; the line in progress has never been."""
        self._hardware.stop()
        self._estimator.drop_line()
        self.state = wire.IDLE
        self._next_status_ms = self._hardware.clock_ms()

    def _set_off(self) -> None:
        """Begin a run: from the wall by Lambert's law (as ``robot.turning``), from anywhere else in any direction."""
        draw = self._dice.draw()
        heading_rad = _TURN * draw if self._normal_rad is None else self._normal_rad + math.asin(2.0 * draw - 1.0)
        self._counts = self._normal_rad is not None
        self._estimator.start_line()
        self._hardware.bumped()  # one that was felt before the run is none of its own
        self._hardware.drive(heading_rad % _TURN, self._speed_cm_s)
        self._run_ms = self._moved_ms = self._hardware.clock_ms()
        self._moved_cm = 0.0
        self._next_status_ms = min(self._next_status_ms, self._run_ms)

    def _sample(self, now_ms: int, light: float) -> None:
        way_cm = self._hardware.way_cm()
        normal_rad = self._hardware.bumped()
        self._take(self._detector.feed((now_ms - self._run_ms) / 1000.0, way_cm, light))
        if normal_rad is not None:
            self._end(now_ms, way_cm, normal_rad)
        elif way_cm > self._moved_cm + STALL_CM:
            self._moved_ms, self._moved_cm = now_ms, way_cm
        elif now_ms - self._moved_ms > STALL_MS:
            self._give_up(way_cm)

    def _take(self, crossing: tuple[float, float, bool] | None) -> None:
        if crossing is None or not self._counts:
            return
        try:
            self._estimator.crossing(crossing[1], crossing[2])
        except ValueError:  # the odometer ran backwards: no line, but no reason to halt in the arena either
            self._counts = False

    def _end(self, now_ms: int, way_cm: float, normal_rad: float) -> None:
        """The run is over, at a wall."""
        self._hardware.stop()
        self._take(self._detector.finish((now_ms - self._run_ms) / 1000.0, way_cm))
        if self._counts:
            k, l1_cm, l3_cm3 = self._estimator.end_line()
            self._report(now_ms, way_cm, k, l1_cm, l3_cm3)
        else:
            self._estimator.drop_line()
        self._normal_rad = normal_rad
        self._set_off()

    def _give_up(self, way_cm: float) -> None:
        """The run does not get on: no line."""
        self._hardware.stop()
        self._detector.finish(0.0, way_cm)
        self._estimator.drop_line()
        if way_cm > STALL_CM:
            self._normal_rad = None
        self._set_off()

    def _report(self, now_ms: int, length_cm: float, k: int, l1_cm: float, l3_cm3: float) -> None:
        estimator = self._estimator
        number = estimator.runs % wire.LINE_NUMBERS
        told = min(k, wire.MOST_CHORDS)
        line = struct.pack(wire.LINE_FORMAT, self.session, number, told, l1_cm, l3_cm3, length_cm, now_ms & 0xFFFFFFFF)
        self._link.notify(wire.LINE_UUID, line)
        estimate = struct.pack(
            wire.ESTIMATE_FORMAT, self.session, number, estimator.area(), estimator.perimeter(), estimator.lines
        )
        self._link.notify(wire.ESTIMATE_UUID, estimate)

    def _tell(self, now_ms: int, light: float) -> None:
        self._next_status_ms = now_ms + (ROLLING_STATUS_MS if self.state == wire.ROLLING else IDLE_STATUS_MS)
        status = struct.pack(
            wire.STATUS_FORMAT,
            self.state,
            self.session,
            self._estimator.runs % wire.LINE_NUMBERS,
            now_ms & 0xFFFFFFFF,
            light,
            self._hardware.battery_mv(),
        )
        self._link.notify(wire.STATUS_UUID, status)


def run(hardware: "Hardware", link: "Link") -> None:
    """Roam for ever; on any error, or Ctrl-C on the robot's console, come to rest first."""
    roamer = Roamer(hardware, link)
    try:
        while True:
            began_ms = hardware.clock_ms()
            roamer.step()
            hardware.sleep_until(began_ms + SAMPLE_MS)
    finally:
        hardware.stop()


if __name__ == "__main__":
    from robot.micropython.ble import Ble
    from robot.micropython.hardware import Robot

    _robot = Robot()
    run(_robot, Ble(identity(_robot)))
