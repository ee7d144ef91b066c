"""spherov2, an independent client, finds, connects to, drives and reads the virtual BOLT. In real time: it sleeps."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from shapely.geometry import box
from spherov2 import scanner
from spherov2.commands.power import BatteryVoltageStates, ChargerStates
from spherov2.listeners.sensor import CollisionDetected
from spherov2.sphero_edu import EventType, SpheroEduAPI
from spherov2.toy.bolt import BOLT
from spherov2.types import Color

from robot import commands
from robot.profile import RobotProfile
from robot.virtual.body import Body, BodySettings
from robot.virtual.bolt import BoltSettings
from tests.robot.spherov2_peer import Asked, ServedBolt, Wire, served, use_hci

NAME, ADDRESS = "SB-C0DE", "D0:5F:B8:00:C0:DE"
CM_S_PER_UNIT = RobotProfile().cm_s_per_unit
# Brisk, so that a short roll has a long part at full speed; nothing stops it while a busy machine lags.
PHYSICS = BodySettings(
    acceleration_cm_s2=500.0,
    speed_error=0.0,
    drift_rad_per_cm=0.0,
    locator_error=0.0,
    bump_angle_rad=0.0,
    light_noise_lux=0.0,
    drive_timeout_s=60.0,
)
FACING_RAD = 0.7
PATIENCE_S = 10.0
Sample = dict[str, dict[str, float]]
# float32, in metres or lux.
CLOSE = {"rel": 1e-5, "abs": 1e-4}


def light_at(x_cm, y_cm):
    """A field that says where it is read."""
    return 300.0 + 0.3 * x_cm + 0.07 * y_cm


@dataclass
class Session:
    bolt: ServedBolt
    wire: Wire
    toy: BOLT
    api: SpheroEduAPI
    samples: list[Sample]


@contextlib.contextmanager
def virtual_bolt(
    reach_cm: float, manners: BoltSettings | None = None, facing_rad: float = FACING_RAD
) -> Iterator[tuple[ServedBolt, Wire]]:
    reachable = box(-reach_cm, -reach_cm, reach_cm, reach_cm)
    rng = np.random.default_rng(5)
    body = Body(reachable, light_at, rng, PHYSICS, position_cm=(0.0, 0.0), facing_rad=facing_rad)
    with served(body, NAME, manners) as bolt, pytest.MonkeyPatch.context() as patch:
        yield bolt, use_hci(patch, bolt.endpoint)


def found() -> BOLT:
    return scanner.find_toy(toy_name=NAME, timeout=PATIENCE_S)


@pytest.fixture(scope="module")
def session() -> Iterator[Session]:
    # Stream frames of more than 80 bytes in pieces of 20, as over a link that was never asked for more.
    with virtual_bolt(500.0, BoltSettings(chunk_bytes=20)) as (bolt, wire):
        toy = found()
        samples: list[Sample] = []
        # Before there is a stream: it does not bear a change of listeners while it calls them.
        toy.sensor_control.add_sensor_data_listener(samples.append)
        with SpheroEduAPI(toy) as api:
            yield Session(bolt, wire, toy, api, samples)


def wait_for(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, "it never came true"
        time.sleep(0.01)


def test_it_is_found_and_taken_for_a_bolt() -> None:
    with virtual_bolt(50.0):
        toys = scanner.find_toys(timeout=0.8)
        assert [(type(toy), toy.name, toy.address) for toy in toys] == [(BOLT, NAME, ADDRESS)]
        assert scanner.find_toys(toy_names=["SB-FFFF"], timeout=0.3) == []


def test_the_connect_sequence_is_understood(session: Session) -> None:
    # A write may be noted a little after its answer has come.
    wait_for(lambda: len(session.wire.asked) >= 14)
    asked = [one.packet for one in session.wire.asked[:14]]
    names = {command.key: command.name for command in commands.COMMANDS}
    stream_set = ["streaming mask", "extended mask", "streaming mask"]
    assert [names[packet.did, packet.cid] for packet in asked] == [
        *("wake", "locator flags", "configure collision", "charger notify", "gyro-max notify"),
        *stream_set,
        *("LEDs", "matrix colour", "reset locator"),
        *stream_set,
    ]
    answers = session.wire.answers()[:14]
    assert [(one.did, one.cid, one.seq) for one in answers] == [(one.did, one.cid, one.seq) for one in asked]
    assert {one.error for one in answers} == {commands.OK}
    # What it set is what it reads back, through its own reading of both answers.
    assert session.toy.get_sensor_streaming_mask() == (150, 0, 0x03C7E27A)
    assert session.toy.get_extended_sensor_streaming_mask() == 0x03840000


def test_identity_and_battery(session: Session) -> None:
    toy = session.toy
    assert toy.get_mac_address().decode("ascii").upper() == ADDRESS.replace(":", "")
    assert toy.get_main_app_version() == toy.get_bootloader_version() == (6, 0, 46)
    assert toy.get_api_protocol_version() == (2, 0)
    assert toy.get_battery_voltage() == pytest.approx(session.bolt.look(lambda body: body.battery_v), abs=0.011)
    assert toy.get_battery_voltage_state() is BatteryVoltageStates.OK
    assert toy.get_charger_state() == ChargerStates.NOT_CHARGING
    awkward = bytes.fromhex("ab8dd8230550ff00") * 4
    assert toy.ping(awkward) == awkward


@pytest.mark.parametrize(("speed", "degrees"), [(60, 0), (40, 90), (141, 216)])
def test_a_roll_takes_the_body_as_far_as_its_time_says(session: Session, speed: int, degrees: int) -> None:
    """Equal ramps up and down: the way is the speed times the time between the two commands, less the turn."""
    bolt, written = session.bolt, session.wire.asked
    before = bolt.look(lambda body: (body.x_cm, body.y_cm, body.heading_rad))
    already = len(written)
    session.api.roll(degrees, speed, 0.7)
    wait_for(lambda: not bolt.look(lambda body: body.moving))
    x_cm, y_cm, distance_cm = bolt.look(lambda body: (body.x_cm - before[0], body.y_cm - before[1], body.distance_cm))

    def drives() -> list[Asked]:
        return [one for one in written[already:] if (one.packet.did, one.packet.cid) == commands.DRIVE.key]

    wait_for(lambda: drives()[-1].packet.data[0] == 0)
    start, *_, stop = drives()
    turn_s = abs(math.remainder(math.radians(degrees) - before[2], math.tau)) / PHYSICS.turn_rate_rad_s
    least_s, most_s = stop.earliest_s - start.latest_s - turn_s, stop.latest_s - start.earliest_s - turn_s
    way_cm = math.hypot(x_cm, y_cm)
    assert speed * CM_S_PER_UNIT * least_s - 1e-6 <= way_cm <= speed * CM_S_PER_UNIT * most_s + 1e-6
    assert 0 < way_cm <= distance_cm + 1e-9
    # Headings go clockwise from the way it faced when it was switched on.
    heading_rad = FACING_RAD - math.atan2(y_cm, x_cm)
    assert math.remainder(heading_rad - math.radians(degrees), math.tau) == pytest.approx(0.0, abs=1e-9)
    wait_for(lambda: session.api.get_location() == pytest.approx(locator_of(bolt), **CLOSE))


def locator_of(bolt: ServedBolt) -> dict[str, float]:
    """What the odometer must say: the true way from the start, in the robot's frame, cm."""
    x_cm, y_cm = bolt.look(lambda body: (body.x_cm, body.y_cm))
    ahead, right = (math.cos(FACING_RAD), math.sin(FACING_RAD)), (math.sin(FACING_RAD), -math.cos(FACING_RAD))
    return {"x": x_cm * right[0] + y_cm * right[1], "y": x_cm * ahead[0] + y_cm * ahead[1]}


def test_the_stream_agrees_with_the_body_while_it_rolls(session: Session) -> None:
    def speed_cm_s(sample: Sample) -> float:
        return math.hypot(*sample["velocity"].values())

    def cruising() -> list[Sample]:
        return [one for one in session.samples[already:] if speed_cm_s(one) > 50 * CM_S_PER_UNIT - 1e-3]

    session.api.stop_roll()
    wait_for(lambda: bool(session.samples) and speed_cm_s(session.samples[-1]) == 0)
    already = len(session.samples)
    session.api.set_heading(300)
    session.api.set_speed(50)
    wait_for(lambda: len(cruising()) >= 4)
    steady = cruising()
    session.api.stop_roll()
    rolling = [one for one in session.samples[already:] if speed_cm_s(one) > 0]
    heading_rad = math.radians(300)
    for sample in rolling:
        velocity, locator, attitude = sample["velocity"], sample["locator"], sample["attitude"]
        size = speed_cm_s(sample)
        assert size <= 50 * CM_S_PER_UNIT + 1e-3
        expected = {"x": size * math.sin(heading_rad), "y": size * math.cos(heading_rad)}
        assert velocity == pytest.approx(expected, **CLOSE)
        # Yaw counts the other way round, -180 to 180.
        assert attitude == pytest.approx({"pitch": 0.0, "roll": 0.0, "yaw": 60.0}, **CLOSE)
        half_rad = math.radians(30)
        quaternion = {"x": 0.0, "y": 0.0, "z": math.sin(half_rad), "w": math.cos(half_rad)}
        assert sample["quaternion"] == pytest.approx(quaternion, **CLOSE)
        assert sample["accelerometer"] == {"x": 0.0, "y": 0.0, "z": 1.0}
        x_cm = locator["x"] * math.sin(FACING_RAD) + locator["y"] * math.cos(FACING_RAD)
        y_cm = locator["y"] * math.sin(FACING_RAD) - locator["x"] * math.cos(FACING_RAD)
        assert sample["ambient_light"]["ambient_light"] == pytest.approx(light_at(x_cm, y_cm), rel=1e-5)
    assert len({sample["locator"]["x"] for sample in steady}) == len(steady)


def test_the_light_is_also_read_on_request(session: Session) -> None:
    session.api.stop_roll()
    wait_for(lambda: not session.bolt.look(lambda body: body.moving))
    expected = session.bolt.look(lambda body: light_at(body.x_cm, body.y_cm))
    assert session.toy.get_ambient_light_sensor_value() == pytest.approx(expected, rel=1e-6)


def test_leds_and_matrix(session: Session) -> None:
    def level() -> float:
        return session.bolt.look(lambda body: body.led_level)

    api, already = session.api, len(session.wire.asked)
    api.set_main_led(Color(0, 51, 20))
    assert level() == pytest.approx(0.2)
    api.set_main_led(Color(0, 0, 0))
    assert level() == 0.0
    session.toy.set_compressed_frame_player_pixel(7, 0, 255, 0, 141)
    assert level() == pytest.approx(1 / 64)
    api.set_front_led(Color(216, 141, 171))
    api.set_back_led(Color(1, 2, 3))
    wait_for(lambda: len(session.wire.asked) >= already + 5)
    asked = {one.packet.seq for one in session.wire.asked[already:] if one.packet.did == commands.LEDS.did}
    answers = [one for one in session.wire.answers() if one.did == commands.LEDS.did and one.seq in asked]
    assert [one.error for one in answers] == [commands.OK] * 5


def test_a_wall_is_felt_and_sleep_is_slept() -> None:
    """Facing up the arena, it meets the upper wall under 30°; then it sleeps, deaf to a drive, until woken."""
    with virtual_bolt(20.0, facing_rad=math.pi / 2) as (bolt, wire), found() as toy:
        reports: list[CollisionDetected] = []
        felt, slept = threading.Event(), threading.Event()
        toy.add_collision_detected_notify_listener(lambda report: (reports.append(report), felt.set()))
        toy.add_did_sleep_notify_listener(slept.set)
        toy.configure_collision_detection(1, 90, 130, 90, 130, 1)
        toy.drive_with_heading(100, 30, 0)
        assert felt.wait(PATIENCE_S)
        toy.drive_with_heading(0, 30, 0)
        place = bolt.look(lambda body: (body.x_cm, body.y_cm))
        assert place == pytest.approx((20 * math.tan(math.pi / 6), 20.0))
        (report,) = reports
        # From the wall back into the arena lies 180°, which is 150° clockwise of the way it rolled.
        assert math.atan2(report.acceleration_x, report.acceleration_y) == pytest.approx(math.radians(150), abs=1e-3)
        assert (report.x_axis, report.y_axis) == (False, True)
        toy.sleep()
        assert slept.wait(PATIENCE_S)
        assert bolt.robot.asleep
        toy.drive_with_heading(100, 180, 0)
        assert wire.answers()[-1].error == commands.TARGET_UNAVAILABLE
        assert bolt.look(lambda body: (body.x_cm, body.y_cm)) == place
        toy.wake()
        assert not bolt.robot.asleep
        assert toy.get_battery_voltage() > 3.0


def test_its_events_come_and_its_ping_keeps_the_robot_awake() -> None:
    """Its second layer: the words said in time; the collision event; a ping for `will sleep`; sleep in the end."""
    manners = BoltSettings(anti_dos_s=2.0, inactivity_s=1.0, sleep_notice_s=2.0)
    with virtual_bolt(20.0, manners) as (bolt, wire):
        hit = threading.Event()
        with SpheroEduAPI(found()) as api:
            api.register_event(EventType.on_collision, lambda _: hit.set())
            api.set_speed(100)
            assert hit.wait(PATIENCE_S)
            api.set_speed(0)
            # Without the first it would be asleep by the time of the second.
            wait_for(lambda: sum((one.packet.did, one.packet.cid) == commands.PING.key for one in wire.asked) >= 2)
            assert not bolt.robot.asleep
        assert bolt.robot.asleep
        wait_for(lambda: not bolt.robot.is_connected)
