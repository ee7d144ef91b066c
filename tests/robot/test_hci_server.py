"""A virtual BOLT served over HCI on TCP. Real sockets on loopback, so on the real clock."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import socket
import sys
from pathlib import Path

import pytest
from bleak import BleakScanner
from bleak.exc import BleakError
from bumble import core, hci
from bumble.device import Device, Peer
from bumble.gatt import GATT_GENERIC_ACCESS_SERVICE
from bumble.transport import open_transport

from lab.base.errors import RequestError
from lab.clock import run
from robot.bolt import scan
from robot.device import Sample
from robot.errors import RadioError, RobotNotFoundError, RobotUnreachableError
from robot.profile import RobotProfile
from robot.virtual import hci_server
from robot.virtual.faults import Fault, schedule
from robot.virtual.hci_client import HciRadio
from robot.virtual.hci_server import HciServer, format_endpoint, parse_endpoint
from robot.virtual.radio import VirtualRadio
from tests.robot.hci_bench import ADDRESS, NAME, antenna, bolt_on, served, until

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 30.0

CLIENT = """
import asyncio, json, sys
from robot.bolt import Bolt, scan
from robot.profile import RobotProfile
from robot.virtual.hci_client import HciRadio

async def main(endpoint, name, mode):
    radio = HciRadio(endpoint)
    await radio.start()
    heard = await scan(0.6, radio.scanner_backend)
    robot = Bolt(name, backend=radio.client_backend, scanner_backend=radio.scanner_backend)
    samples, lost = [], []
    robot.on_sample, robot.on_lost = samples.append, lost.append
    await robot.connect()
    identity = await robot.identity()
    await robot.start_stream(0.03)
    await robot.drive(0.0, 20.0)
    if mode == "roll for ever":
        print("rolling", flush=True)
        await asyncio.sleep(60.0)
    await asyncio.sleep(1.0)
    await robot.stop()
    await asyncio.sleep(0.5)
    await robot.stop_stream()
    await robot.disconnect()
    await radio.close()
    print(json.dumps({
        "heard": [one.name for one in heard], "address": identity.address, "battery_v": identity.battery_v,
        "samples": len(samples), "y_cm": samples[-1].y_cm, "x_cm": samples[-1].x_cm,
        "lux": sorted({round(sample.light_lux) for sample in samples}), "bad": robot.bad_frames, "lost": lost,
    }), flush=True)

asyncio.run(asyncio.wait_for(main(*sys.argv[1:]), 60.0))
"""
# Nothing of ours, as bumble's own examples are.
SCANNER = """
import asyncio, sys
from bumble.core import AdvertisingData
from bumble.device import Device
from bumble.hci import Address
from bumble.transport import open_transport

async def main(endpoint):
    async with await open_transport(f"tcp-client:{endpoint}") as (source, sink):
        device = Device.with_hci("scanner", Address("F0:F1:F2:F3:F4:F6"), source, sink)
        await device.power_on()
        heard = asyncio.Queue()
        device.on("advertisement", heard.put_nowait)
        await device.start_scanning()
        one = await heard.get()
        print(one.data.get(AdvertisingData.Type.COMPLETE_LOCAL_NAME), one.address.to_string(False))

asyncio.run(asyncio.wait_for(main(*sys.argv[1:]), 30.0))
"""


@contextlib.asynccontextmanager
async def other_process(code: str, *arguments: str):
    child = await asyncio.create_subprocess_exec(
        sys.executable, "-c", code, *arguments, cwd=ROOT, stdout=asyncio.subprocess.PIPE
    )
    try:
        yield child
    finally:
        if child.returncode is None:
            child.kill()
        async with asyncio.timeout(5.0):
            await child.communicate()


def test_another_process_finds_connects_drives_and_streams() -> None:
    async def main() -> None:
        async with served() as s, other_process(CLIENT, s.server.endpoint, NAME, "a little") as child:
            async with asyncio.timeout(PATIENCE_S):
                out, _ = await child.communicate()
            assert child.returncode == 0
            report = json.loads(out)
            assert report["heard"] == [NAME]
            assert report["address"] == ADDRESS
            assert report["battery_v"] == pytest.approx(s.body.battery_v, abs=0.02)
            assert report["samples"] >= 20
            assert (report["bad"], report["lost"]) == (0, [])
            # It has rolled ahead, along the arena's x, out of the dark; its odometer says so too.
            assert report["lux"][0] == 20
            assert report["lux"][-1] == 120
            assert report["y_cm"] == pytest.approx(s.body.x_cm, abs=1.0)
            assert 12.0 < s.body.x_cm < 56.35
            assert abs(s.body.y_cm) < 1e-6
            await until(lambda: s.server.clients == 0)
            assert not s.virtual.is_connected

    run(main(), virtual=False)


def test_a_bumble_client_in_another_process_finds_it_by_its_name() -> None:
    async def main() -> None:
        async with served() as s, other_process(SCANNER, s.server.endpoint) as child:
            async with asyncio.timeout(PATIENCE_S):
                out, _ = await child.communicate()
            assert out.decode().split() == [NAME, ADDRESS]

    run(main(), virtual=False)


def test_the_robots_faults_reach_clients_of_the_server() -> None:
    async def main() -> None:
        async with served() as s, antenna(s.server.endpoint) as radio:
            samples: list[Sample] = []
            lost: list[str] = []
            robot = bolt_on(radio)
            robot.on_sample, robot.on_lost = samples.append, lost.append
            await robot.connect()
            await robot.start_stream(0.025)
            await until(lambda: bool(samples))
            s.virtual.lose(1.0, 0.5)
            await asyncio.sleep(0.1)
            before = len(samples)
            await asyncio.sleep(0.3)
            assert len(samples) == before
            await until(lambda: len(samples) > before)
            schedule([Fault("vanish", asyncio.get_running_loop().time() - s.virtual.started_s, 1.0)], s.virtual)
            await asyncio.sleep(0.5)
            before = len(samples)
            assert await scan(0.4, radio.scanner_backend) == []
            assert (lost, len(samples)) == ([], before)
            await until(lambda: bool(lost))
            await robot.connect()
            s.virtual.drop_link(0.5)
            await until(lambda: len(lost) == 2)
            assert await scan(0.2, radio.scanner_backend) == []
            await robot.connect()
            await robot.disconnect()

    run(main(), virtual=False)


def test_a_client_killed_while_it_drives_frees_the_robot_which_stops() -> None:
    async def main() -> None:
        async with served() as s, other_process(CLIENT, s.server.endpoint, NAME, "roll for ever") as child:
            assert child.stdout is not None
            async with asyncio.timeout(PATIENCE_S):
                assert await child.stdout.readline() == b"rolling\n"
            assert s.virtual.is_connected
            child.kill()
            await until(lambda: not s.virtual.is_connected)
            s.body.advance(asyncio.get_running_loop().time())
            assert s.body.moving
            assert s.server.clients == 0
            async with antenna(s.server.endpoint) as radio:
                assert [one.name for one in await scan(0.5, radio.scanner_backend)] == [NAME]
            # Its own time-out (2 s after the last word) and a brake from 20 cm/s at 80 cm/s².
            s.body.advance(asyncio.get_running_loop().time() + 2.5)
            assert s.body.speed_cm_s == 0.0
            assert not s.body.moving

    run(main(), virtual=False)


def test_clients_take_turns_and_a_second_one_waits() -> None:
    async def main() -> None:
        async with served() as s, antenna(s.server.endpoint) as one, antenna(s.server.endpoint) as two:
            assert s.server.clients == 2
            first = bolt_on(one)
            second = bolt_on(two, profile=RobotProfile(command_pacing_s=0.0, scan_timeout_s=0.5))
            await first.connect()
            with pytest.raises(RobotNotFoundError, match="heard no robot at all"):
                await second.connect()
            assert await first.battery_v() > 3.4
            await first.disconnect()
            await second.connect()
            samples: list[Sample] = []
            second.on_sample = samples.append
            await second.start_stream(0.025)
            await until(lambda: len(samples) >= 20)
            await second.drive(math.pi / 2, 15.0)
            await until(lambda: samples[-1].x_cm > 1.0)
            await second.disconnect()
            await first.connect()
            assert (await first.identity()).name == NAME
            await first.disconnect()

    run(main(), virtual=False)


def test_two_robots_and_two_clients_keep_apart() -> None:
    async def main() -> None:
        async with served(robots=2) as s, antenna(s.server.endpoint) as one, antenna(s.server.endpoint) as two:
            first, second = bolt_on(one), bolt_on(two, "SB-0001")
            await first.connect()
            await second.connect()
            identities = await asyncio.gather(first.identity(), second.identity())
            assert [identity.address for identity in identities] == [ADDRESS, "D0:5F:B8:00:00:01"]
            await first.disconnect()
            assert await second.battery_v() > 3.4
            await second.disconnect()

    run(main(), virtual=False)


def test_a_server_that_goes_away_is_a_lost_link() -> None:
    async def main() -> None:
        async with served() as s, antenna(s.server.endpoint) as radio:
            lost: list[str] = []
            robot = bolt_on(radio)
            robot.on_lost = lost.append
            await robot.connect()
            await s.server.close()
            await until(lambda: bool(lost))
            assert lost == ["it disconnected"]
            with pytest.raises(RadioError, match="`chordlab robot virtual`"):
                _ = radio.central
            with pytest.raises(BleakError):
                await BleakScanner.discover(0.1, backend=radio.scanner_backend)
            await robot.disconnect()

    run(main(), virtual=False)


@contextlib.asynccontextmanager
async def stranger(endpoint: str, address: str = "F0:F1:F2:F3:F4:F5"):
    """A bumble client as bumble's own examples make it."""
    async with await open_transport(f"tcp-client:{endpoint}") as (source, sink):
        device = Device.with_hci("stranger", hci.Address(address), source, sink)
        await device.power_on()
        yield device


def test_a_bumble_client_without_our_backend() -> None:
    async def main() -> None:
        async with served() as s, stranger(s.server.endpoint) as device:
            # Nobody has this address: the request must be taken back, and be no obstacle to the next.
            with pytest.raises(core.BaseBumbleError):
                await device.connect(hci.Address("D0:00:00:00:00:00"), timeout=0.3)
            # By its public address too.
            for own in (hci.OwnAddressType.RANDOM, hci.OwnAddressType.PUBLIC):
                connection = await device.connect(hci.Address(ADDRESS), own_address_type=own, timeout=5.0)
                peer = Peer(connection)
                await peer.request_mtu(100)
                services = await peer.discover_services()
                assert "00010001-574F-4F20-5370-6865726F2121" in [str(each.uuid) for each in services]
                assert GATT_GENERIC_ACCESS_SERVICE in [each.uuid for each in services]
                assert s.virtual.is_connected
                await connection.disconnect()
                await until(lambda: not s.virtual.is_connected)
            # A reset without a word of farewell ends the link as well.
            await device.connect(hci.Address(ADDRESS), timeout=5.0)
            await until(lambda: s.virtual.is_connected)
            await device.host.reset()
            await until(lambda: not s.virtual.is_connected)

    run(main(), virtual=False)


def test_of_two_that_answer_one_advertisement_one_gets_the_robot() -> None:
    async def main() -> None:
        # The same address twice, as two runs of one script would have.
        async with served() as s, stranger(s.server.endpoint) as one, stranger(s.server.endpoint) as two:
            await s.virtual._peripheral.hide()
            asked = [asyncio.ensure_future(each.connect(hci.Address(ADDRESS), timeout=5.0)) for each in (one, two)]
            await until(lambda: sum(c.pending_le_connection is not None for c in s.server.radio.air.controllers) == 2)
            await s.virtual._peripheral.advertise()
            await asyncio.gather(*asked)
            await until(lambda: len(one.connections) + len(two.connections) == 1)
            (winner,) = (*one.connections.values(), *two.connections.values())
            services = await Peer(winner).discover_services()
            assert len(services) >= 4
            await winner.disconnect()

    run(main(), virtual=False)


def test_our_client_is_told_when_somebody_else_was_quicker() -> None:
    async def main() -> None:
        async with served() as s, antenna(s.server.endpoint) as radio:
            # The robot takes nobody: its ears are shut to connection requests.
            s.virtual._peripheral.controller.on_le_connect_ind = lambda packet: None
            robot = bolt_on(radio, profile=RobotProfile(connect_timeout_s=3.0))
            with pytest.raises(RobotUnreachableError, match="was heard but does not connect"):
                await robot.connect()
            del s.virtual._peripheral.controller.on_le_connect_ind
            await robot.connect()
            await robot.disconnect()

    run(main(), virtual=False)


def test_a_request_out_of_time_is_taken_back() -> None:
    async def main() -> None:
        async with served() as s, antenna(s.server.endpoint) as radio:
            connect = radio.central.connect_le

            async def late(*args, **options):
                await s.virtual._peripheral.hide()
                return await connect(*args, **options)

            radio.central.connect_le = late
            robot = bolt_on(radio, profile=RobotProfile(connect_timeout_s=0.5))
            with pytest.raises(RobotUnreachableError):
                await robot.connect()
            radio.central.connect_le = connect
            assert not any(c.pending_le_connection for c in s.server.radio.air.controllers)
            await s.virtual._peripheral.advertise()
            await robot.connect()
            await robot.disconnect()

    run(main(), virtual=False)


@pytest.mark.parametrize(
    "rubbish",
    [b"GET / HTTP/1.1\r\n\r\n", bytes.fromhex("01 05 20 01 00"), bytes.fromhex("02 00"), bytes.fromhex("01 ff ff 00")],
)
def test_who_does_not_speak_hci_does_no_harm(rubbish: bytes) -> None:
    async def main() -> None:
        async with served() as s:
            reader, writer = await asyncio.open_connection("127.0.0.1", s.server.port)
            writer.write(rubbish)
            await writer.drain()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.2):
                    await reader.read()
            writer.close()
            await until(lambda: s.server.clients == 0)
            async with antenna(s.server.endpoint) as radio:
                robot = bolt_on(radio)
                await robot.connect()
                await robot.disconnect()

    run(main(), virtual=False)


def test_who_does_not_read_and_who_is_too_many_is_cut_off(monkeypatch, caplog) -> None:
    async def main() -> None:
        async with served() as s:
            monkeypatch.setattr(hci_server, "_MOST_WAITING_BYTES", -1)
            with pytest.raises(RadioError, match="no HCI server at"):
                await HciRadio(s.server.endpoint).start()
            assert "stopped reading" in caplog.text
            monkeypatch.undo()
            monkeypatch.setattr(hci_server, "_MOST_CLIENTS", 1)
            async with antenna(s.server.endpoint):
                with pytest.raises(RadioError):
                    await HciRadio(s.server.endpoint).start()
            assert "1 are connected already" in caplog.text

    run(main(), virtual=False)


def test_endpoints() -> None:
    for text, parts in (
        ("127.0.0.1:6402", ("127.0.0.1", 6402)),
        ("[::1]:0", ("::1", 0)),
        ("here:65535", ("here", 65535)),
    ):
        assert parse_endpoint(text) == parts
        assert format_endpoint(*parts) == text
    for wrong in ("", ":", "6402", "127.0.0.1", "127.0.0.1:", ":6402", "a:b", "a:-1", "a:65536", "::1", "a:٣"):
        with pytest.raises(RequestError, match=r"is no HOST:PORT; write it like 127\.0\.0\.1:6402") as caught:
            parse_endpoint(wrong)
        assert "\n" not in str(caught.value)


def test_refusals_have_a_cure() -> None:
    async def main() -> None:
        radio = VirtualRadio()
        for host in ("0.0.0.0", "::", "192.0.2.1", "example.org"):
            with pytest.raises(RequestError, match="let other machines drive"):
                HciServer(radio, host, 0)
            assert HciServer(radio, host, 0, anywhere=True).host == host
        for host in ("127.0.0.1", "127.9.9.9", "::1", "localhost"):
            assert HciServer(radio, host, 0).clients == 0
        with pytest.raises(RadioError, match="start it first"):
            _ = HciServer(radio, "127.0.0.1", 0).port
        with pytest.raises(RadioError, match="start it first"):
            radio.admit()
        await HciServer(radio, "127.0.0.1", 0).close()
        with socket.create_server(("127.0.0.1", 0)) as taken:
            port = taken.getsockname()[1]
            with pytest.raises(RequestError, match=r"in use.*choose another HOST:PORT"):
                await HciServer(radio, "127.0.0.1", port).start()
        with pytest.raises(RadioError, match=rf"no HCI server at 127.0.0.1:{port} \(Connection refused\)"):
            await HciRadio(f"127.0.0.1:{port}").start()

    run(main(), virtual=False)
