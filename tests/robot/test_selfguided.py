"""The self-guided robot, over the real bleak client: lines arrive one by one, and losses are noticed."""

import asyncio
import contextlib
import math
import struct
from dataclasses import dataclass, field

import numpy as np
import pytest
from shapely.geometry import box

from lab.base.errors import RequestError
from lab.clock import run
from robot.crossings import Levels
from robot.errors import (
    BluetoothUnavailableError,
    DriveError,
    LinkLostError,
    NotConnectedError,
    PayloadError,
    ReplyTimeoutError,
    RobotNotFoundError,
    RobotUnreachableError,
)
from robot.micropython import main, wire
from robot.onboard import Estimator
from robot.selfguided import OnboardLine, SelfGuided
from robot.virtual.body import Body, BodySettings
from robot.virtual.radio import AirSettings, GattCharacteristic, GattService, VirtualRadio
from robot.virtual.selfguided import SERVICES, VirtualSelfGuided, address_of

NAME = "CL-7E57"
LEVELS = Levels(20.0, 120.0, 63.0, 70.0, 77.0)
AREA, PERIMETER = 3600.0, 240.0
SIGMA_AREA, SIGMA_PERIMETER = 0.39278, 0.33730  # relative, of one line across a square, from quadrature


def square(x_cm, y_cm):
    """60 cm, lit."""
    return np.where(np.maximum(np.abs(x_cm), np.abs(y_cm)) < 30, 120.0, 20.0)


@dataclass
class Bench:
    radio: VirtualRadio
    body: Body
    virtual: VirtualSelfGuided
    robot: SelfGuided
    lines: list[OnboardLine] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)

    async def until(self, count):
        async with asyncio.timeout(3000):
            while len(self.lines) < count and not self.lost:  # noqa: ASYNC110 - at virtual time
                await asyncio.sleep(0.5)


@contextlib.asynccontextmanager
async def bench(*, connect=True, air=None, physics=None, light=square, seed=4):
    rng = np.random.default_rng(seed)
    radio = VirtualRadio(air if air is not None else AirSettings(mtu=23), rng=rng)
    await radio.start()
    body = Body(box(-56, -41, 56, 41), light, rng, physics)
    virtual = VirtualSelfGuided(radio, body, NAME)
    await virtual.start()
    robot = SelfGuided(NAME, backend=radio.client_backend, scanner_backend=radio.scanner_backend)
    made = Bench(radio, body, virtual, robot)
    robot.on_line, robot.on_lost = made.lines.append, made.lost.append
    try:
        if connect:
            await robot.connect()
        yield made
    finally:
        await robot.disconnect()
        await virtual.close()
        await radio.close()


def virtually(test):
    """Run an async test at virtual time."""

    def ran(*args, **kwargs):
        run(test(*args, **kwargs), virtual=True)

    ran.__name__ = test.__name__
    return ran


def test_no_record_is_longer_than_any_link_carries():
    layouts = [getattr(wire, name) for name in dir(wire) if name.endswith("_FORMAT")]
    assert len(layouts) == 6
    assert all(layout[0] == "<" and struct.calcsize(layout) <= 20 for layout in layouts)
    with pytest.raises(ValueError, match="a record of 15 bytes came as 3"):
        wire.unpack(wire.ESTIMATE_FORMAT, b"abc")


@virtually
async def test_a_session_arrives_line_by_line():
    async with bench() as made:
        robot = made.robot
        identity = await robot.identity()
        assert (identity.name, identity.address, identity.firmware) == (NAME, address_of(NAME), "1.0.0")
        assert identity.battery_v == pytest.approx(4.1, abs=0.01)
        assert not robot.rolling
        await robot.start(30.0, 11, LEVELS)
        assert robot.rolling
        await made.until(150)
        await robot.stop()
        assert not made.virtual.rolling
        await asyncio.sleep(5)
        assert not made.body.moving
    lines = made.lines
    assert [line.line for line in lines] == list(range(1, len(lines) + 1))
    assert (made.lost, robot.lost_lines, robot.duplicates) == ([], 0, 0)
    host = Estimator()
    for line in lines:
        host.add_line(line.k, line.l1_cm, line.l3_cm3)
        assert line.lines == host.lines
        # What is on the wire is single precision; nothing else differs.
        if host.lines:
            assert line.area_cm2 == pytest.approx(host.area(), rel=1e-6)
            assert line.perimeter_cm == pytest.approx(host.perimeter(), rel=1e-6)
        else:
            assert math.isnan(line.area_cm2)
        assert 0 <= line.l1_cm <= line.length_cm * 1.001
    n = host.lines
    assert n > 90
    assert abs(lines[-1].area_cm2 - AREA) < 4 * SIGMA_AREA * AREA / math.sqrt(n)
    assert abs(lines[-1].perimeter_cm - PERIMETER) < 4 * SIGMA_PERIMETER * PERIMETER / math.sqrt(n)
    # Lines over the reachable rectangle: their mean length is pi A/P, Cauchy's, if the turns are Lambert's.
    lengths = np.array([line.length_cm for line in lines])
    mean = math.pi * 112 * 82 / (2 * (112 + 82))
    assert abs(lengths.mean() - mean) < 4 * lengths.std() / math.sqrt(len(lengths))
    robot_s, host_s = (np.array([getattr(line, name) for line in lines]) for name in ("t_robot_s", "t_host_s"))
    assert np.all(np.diff(robot_s) > 0)
    assert np.ptp(host_s - robot_s) < 0.05


@virtually
async def test_the_same_seed_is_the_same_session():
    sessions = []
    for seed in (3, 3, 4):
        async with bench(physics=BodySettings(light_noise_lux=0.0)) as made:
            await made.robot.start(30.0, seed, LEVELS)
            await made.until(6)
            sessions.append([line.l1_cm for line in made.lines[:6]])
    assert sessions[0] == sessions[1] != sessions[2]


@virtually
async def test_a_second_session_starts_at_line_one():
    async with bench() as made:
        await made.robot.start(30.0, 1, LEVELS)
        await made.until(3)
        await made.robot.start(40.0, 2, LEVELS)
        before = len(made.lines)
        await made.until(before + 2)
        assert [line.line for line in made.lines[before : before + 2]] == [1, 2]
        assert made.lines[before].lines <= 1
        assert made.robot.lost_lines == 0


@virtually
async def test_light_is_fresh_and_in_lux():
    async with bench(connect=False, light=lambda x, y: np.full_like(x, 77.0)) as made:
        await made.robot.connect()
        await made.robot.connect()  # connected already: harmless
        readings = [await made.robot.light() for _ in range(20)]
        assert np.mean(readings) == pytest.approx(77.0, abs=1.0)
        assert len(set(readings)) == 20


@virtually
async def test_lost_notifications_are_counted_and_change_no_estimate():
    async with bench(air=AirSettings(lost_share=0.15)) as made:
        for _ in range(20):  # any word of a start or stop may be lost as well; it is then told again
            with contextlib.suppress(ReplyTimeoutError):
                await made.robot.start(30.0, 11, LEVELS)
                break
        await made.until(80)
        numbers = [line.line for line in made.lines]
        assert numbers == sorted(set(numbers))
        missing = numbers[-1] - len(numbers)
        assert 10 < missing < 60
        assert made.robot.lost_lines == missing
        assert made.robot.duplicates == 0
        last = made.lines[-1]
        assert len(numbers) > 60
        assert abs(last.area_cm2 - AREA) < 4 * SIGMA_AREA * AREA / math.sqrt(last.lines)


def line_record(session, number, k=1):
    return struct.pack(wire.LINE_FORMAT, session, number, k, 5.0, 125.0, 80.0, 1000 * number)


def estimate_record(session, number):
    return struct.pack(wire.ESTIMATE_FORMAT, session, number, 26.2, 16.4, number)


def status_record(session, runs, state=wire.ROLLING):
    return struct.pack(wire.STATUS_FORMAT, state, session, runs, 0, 20.0, 4000)


@contextlib.asynccontextmanager
async def puppet(identity=None):
    """A robot that says what the test makes it say, once it has been started."""
    rng = np.random.default_rng(1)
    radio = VirtualRadio(AirSettings(mtu=23), rng=rng)
    await radio.start()
    peripheral = await radio.add_peripheral(NAME, address_of(NAME), SERVICES)
    plain = struct.pack(wire.IDENTITY_FORMAT, wire.VERSION, *main.PROGRAM, main.SAMPLE_MS, 400)
    peripheral.on_read = lambda _: plain if identity is None else identity
    robot = SelfGuided(NAME, backend=radio.client_backend, scanner_backend=radio.scanner_backend)
    lines, lost, told = [], [], []
    robot.on_line, robot.on_lost = lines.append, lost.append
    peripheral.on_write = lambda _, value: told.append(value)
    await peripheral.start()

    async def say(*records):
        for uuid, record in records:
            peripheral.notify(uuid, record)
        await asyncio.sleep(0.1)

    async def begin():
        """Start session 8, line by line under the test's control."""
        starting = asyncio.create_task(robot.start(30.0, 1, LEVELS))
        await asyncio.sleep(0.1)
        await say((wire.STATUS_UUID, status_record(7, 0, wire.IDLE)))
        await say((wire.STATUS_UUID, status_record(8, 0)))
        await starting

    try:
        yield robot, lines, lost, told, say, begin
    finally:
        stopping = asyncio.create_task(robot.disconnect())
        await asyncio.sleep(0.1)
        await say((wire.STATUS_UUID, status_record(8, 0, wire.IDLE)))
        await stopping
        await peripheral.close()
        await radio.close()


def both(number, session=8):
    return (wire.LINE_UUID, line_record(session, number)), (wire.ESTIMATE_UUID, estimate_record(session, number))


@virtually
async def test_gaps_repeats_and_strangers():
    async with puppet() as (robot, lines, lost, told, say, begin):
        await robot.connect()
        await begin()
        assert struct.unpack(wire.START_FORMAT, told[0])[:4] == (wire.START, 8, 300, 1)
        await say(*both(1), *both(2))
        await say(*both(2), *both(1))
        assert ([line.line for line in lines], robot.lost_lines, robot.duplicates) == ([1, 2], 0, 2)
        await say(*both(5))
        assert (lines[-1].line, robot.lost_lines) == (5, 2)
        await say(both(6)[0], *both(7))  # half a line is none
        await say(both(8)[1])
        assert (lines[-1].line, robot.lost_lines) == (7, 3)
        await say((wire.STATUS_UUID, status_record(8, 10)))  # it took 8, 9 and 10 unheard
        assert robot.lost_lines == 6
        await say(*both(9), *both(11, session=7))
        assert (lines[-1].line, robot.duplicates) == (7, 3)
        await say((wire.LINE_UUID, b"short"), *both(11))
        assert [line.line for line in lines] == [1, 2, 5, 7, 11]
        assert lines[-1] == OnboardLine(
            11, 1, 5.0, 125.0, 80.0, 11.0, pytest.approx(26.2), pytest.approx(16.4), 11, lines[-1].t_host_s
        )
        assert lost == []


@virtually
async def test_numbers_wrap():
    async with puppet() as (robot, lines, _, _, say, begin):
        await robot.connect()
        await begin()
        for number in (30_000, 60_000, 65_535, 0, 1):
            await say(*both(number))
        assert [line.line for line in lines] == [30_000, 60_000, 65_535, 65_536, 65_537]
        assert robot.lost_lines == 65_537 - 5


@virtually
async def test_silence_is_noticed():
    async with puppet() as (robot, _, lost, _, _, begin):
        await robot.connect()
        await begin()
        waiting = asyncio.create_task(robot.light())
        await asyncio.sleep(2.5)
        assert lost == []
        await asyncio.sleep(1.0)
        assert lost == ["no word for 3 s"]
        with pytest.raises(LinkLostError, match="no word for 3 s"):
            await waiting
        with pytest.raises(NotConnectedError):
            await robot.stop()


@virtually
async def test_a_robot_that_stops_by_itself_is_lost():
    async with puppet() as (robot, _, lost, _, say, begin):
        await robot.connect()
        await begin()
        await say((wire.STATUS_UUID, status_record(8, 4, wire.IDLE)))
        assert lost == ["it stopped by itself"]
        assert not robot.rolling


@virtually
async def test_a_broken_link_is_noticed_and_the_session_taken_up_again():
    async with bench() as made:
        await made.robot.start(30.0, 11, LEVELS)
        await made.until(5)
        made.virtual.drop_link()
        await asyncio.sleep(20)
        assert made.lost == ["it disconnected"]
        assert made.virtual.rolling  # it needs nobody
        heard = len(made.lines)
        await made.robot.connect()
        made.lost.clear()
        await made.until(heard + 5)
        numbers = [line.line for line in made.lines]
        assert numbers[heard - 1 :][:2] != [5, 6]
        assert made.robot.lost_lines == numbers[-1] - len(numbers) > 0
        assert made.lines[-1].lines >= len([line for line in made.lines if line.k])
        await made.robot.stop()
        assert not made.virtual.rolling


@virtually
async def test_a_robot_left_alone_stops_after_a_minute():
    async with bench() as made:
        await made.robot.start(30.0, 11, LEVELS)
        made.virtual.drop_link()
        await asyncio.sleep(55)
        assert made.virtual.rolling
        await asyncio.sleep(10)
        assert not made.virtual.rolling
        assert not made.body.moving


@virtually
async def test_a_robot_that_is_held_gives_the_run_up_and_goes_on():
    async with bench() as made:
        await made.robot.start(30.0, 11, LEVELS)
        await made.until(4)
        held = len(made.lines)
        made.body.held = True
        await asyncio.sleep(10)
        assert len(made.lines) <= held + 1
        made.body.held = False
        await made.until(held + 30)
        assert made.robot.lost_lines == 0
        # What it stood still in the middle of is no line: none is longer than the arena's diagonal.
        assert max(line.length_cm for line in made.lines) < math.hypot(112, 82) * 1.03


@virtually
async def test_what_cannot_be_asked_is_refused():
    async with bench() as made:
        robot = made.robot
        for speed in (0.0, -3.0, math.nan, 151.0):
            with pytest.raises(DriveError, match="cannot roll at"):
                await robot.start(speed, 1, LEVELS)
        for seed in (-1, 2**32):
            with pytest.raises(RequestError, match="seed"):
                await robot.start(30.0, seed, LEVELS)
        client = robot._client
        for nonsense in (b"", b"\x07", bytes(20), struct.pack(wire.START_FORMAT, wire.START, 1, 0, 1, 1.0, 2.0, 3.0)):
            await client.write_gatt_char(wire.CONTROL_UUID, nonsense, response=True)
        await robot.light()
        assert not made.virtual.rolling
    with pytest.raises(RequestError, match="CL- and four hexadecimal digits"):
        address_of("SB-1234")


@virtually
async def test_who_cannot_be_reached():
    async with bench(connect=False) as made:
        backends = {"backend": made.radio.client_backend, "scanner_backend": made.radio.scanner_backend}
        with pytest.raises(RobotNotFoundError, match=f"heard only {NAME}"):
            await SelfGuided("CL-0000", **backends).connect()
        with pytest.raises(NotConnectedError):
            await made.robot.light()
        await made.robot.disconnect()
        other = GattService(wire.SERVICE_UUID, (GattCharacteristic(wire.STATUS_UUID, notify=True),))
        stranger = await made.radio.add_peripheral("CL-0BAD", address_of("CL-0BAD"), (other,))
        await stranger.start()
        with pytest.raises(RobotUnreachableError, match="CL-0BAD"):
            await SelfGuided("CL-0BAD", **backends).connect()
        await asyncio.sleep(0.1)
        assert not stranger.is_connected
        await stranger.close()
    with pytest.raises(BluetoothUnavailableError):
        await SelfGuided(NAME, **backends).connect()


@virtually
async def test_another_version_of_the_records_is_refused():
    async with puppet(identity=bytes((wire.VERSION + 1, 1, 0, 0))) as (robot, *_):
        with pytest.raises(PayloadError, match="version 1 of the records"):
            await robot.connect()
