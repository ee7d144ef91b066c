from __future__ import annotations

import asyncio
import contextlib

import numpy as np
import pytest
from bleak import BleakClient, BleakScanner
from bleak.exc import BleakBluetoothNotAvailableError, BleakDeviceNotFoundError, BleakError

from lab.base.errors import RequestError
from lab.clock import run
from robot.errors import RadioError
from robot.virtual.radio import (
    CONNECTION_TIMEOUT,
    AirSettings,
    GattCharacteristic,
    GattService,
    Peripheral,
    VirtualRadio,
)

TALK = "0000aa01-574f-4f20-5370-6865726f2121"
SECRET = "0000aa02-574f-4f20-5370-6865726f2121"
SERVICES = (
    GattService(
        "0000aa00-574f-4f20-5370-6865726f2121",
        (GattCharacteristic(TALK, write=True, notify=True), GattCharacteristic(SECRET, read=True)),
    ),
)


@contextlib.asynccontextmanager
async def air(settings: AirSettings | None = None, *, names=("one",)):
    radio = VirtualRadio(settings, rng=np.random.default_rng(3))
    await radio.start()
    peripherals: list[Peripheral] = []
    for n, name in enumerate(names):
        peripheral = await radio.add_peripheral(name, f"D0:00:00:00:00:{n:02X}", SERVICES)
        await peripheral.start()
        peripherals.append(peripheral)
    try:
        yield radio, *peripherals
    finally:
        await radio.close()


def client_of(radio: VirtualRadio, peripheral: Peripheral, **options) -> BleakClient:
    return BleakClient(peripheral.address, backend=radio.client_backend, **{"timeout": 5.0, **options})


def test_scan_connect_write_read_and_notify() -> None:
    async def main() -> None:
        async with air() as (radio, one):
            written: list[tuple[str, bytes]] = []
            one.on_write = lambda uuid, value: written.append((uuid, value))
            found = await BleakScanner.discover(1.0, return_adv=True, backend=radio.scanner_backend)
            ((device, advertisement),) = found.values()
            assert (device.address, advertisement.local_name) == (one.address, "one")
            heard: list[bytes] = []
            async with BleakClient(device, backend=radio.client_backend) as client:
                assert client.is_connected
                assert one.is_connected
                assert client.name == "one"
                assert client.mtu_size == 185
                assert one.payload_bytes == 182
                assert [s.uuid for s in client.services][-1] == SERVICES[0].uuid
                talk = client.services.get_characteristic(TALK)
                assert set(talk.properties) == {"write", "write-without-response", "notify"}
                assert talk.max_write_without_response_size == 182
                one.notify(TALK, b"too early")
                await client.start_notify(TALK, lambda _, value: heard.append(bytes(value)))
                await client.write_gatt_char(TALK, b"loud", response=True)
                await client.write_gatt_char(TALK, b"soft", response=False)
                assert await client.read_gatt_char(SECRET) == b""
                (switch,) = talk.descriptors
                assert await client.read_gatt_descriptor(switch) == b"\x01\x00"
                one.notify(TALK, bytes(182))
                one.notify(TALK, b"x")
                await asyncio.sleep(0.01)
                with pytest.raises(RequestError, match="do not fit"):
                    one.notify(TALK, bytes(183))
                await client.stop_notify(TALK)
                one.notify(TALK, b"too late")
                await asyncio.sleep(0.01)
            assert written == [(TALK, b"loud"), (TALK, b"soft")]
            assert heard == [bytes(182), b"x"]
            await asyncio.sleep(0.01)
            assert not one.is_connected
            one.notify(TALK, b"nobody there")
            with pytest.raises(BleakError):
                await client.write_gatt_char(TALK, b"gone")

    run(main(), virtual=True)


def test_it_runs_on_a_real_clock_too() -> None:
    async def main() -> None:
        async with air() as (radio, one):
            heard = asyncio.Event()
            async with client_of(radio, one) as client:
                await client.start_notify(TALK, lambda *_: heard.set())
                one.notify(TALK, b"now")
                async with asyncio.timeout(5.0):
                    await heard.wait()

    run(main(), virtual=False)


def test_two_peripherals_at_once_keep_apart() -> None:
    async def main() -> None:
        async with air(names=("one", "two")) as (radio, one, two):
            heard: dict[str, list[bytes]] = {"one": [], "two": []}
            async with client_of(radio, one) as first, client_of(radio, two) as second:
                await first.start_notify(TALK, lambda _, value: heard["one"].append(bytes(value)))
                await second.start_notify(TALK, lambda _, value: heard["two"].append(bytes(value)))
                for n in range(20):
                    one.notify(TALK, bytes([1, n]))
                    two.notify(TALK, bytes([2, n]))
                await asyncio.sleep(0.1)
                one.hang_up()
                await asyncio.sleep(0.1)
                assert (first.is_connected, second.is_connected) == (False, True)
                two.notify(TALK, b"still here")
                await asyncio.sleep(0.1)
            assert heard["one"] == [bytes([1, n]) for n in range(20)]
            assert heard["two"] == [*(bytes([2, n]) for n in range(20)), b"still here"]

    run(main(), virtual=True)


def test_a_broken_link_is_told_and_advertising_begins_again() -> None:
    async def main() -> None:
        async with air() as (radio, one):
            gone: list[BleakClient] = []
            client = client_of(radio, one, disconnected_callback=gone.append)
            for _ in range(3):
                await client.connect()
                one.hang_up(CONNECTION_TIMEOUT)
                await asyncio.sleep(0.1)
                assert not client.is_connected
                assert not one.is_connected
            assert gone == [client] * 3
            await client.disconnect()

    run(main(), virtual=True)


def test_an_absent_peer_does_not_hang_nor_block_the_next() -> None:
    async def main() -> None:
        async with air(names=("one", "two")) as (radio, one, two):
            await one.hide()
            with pytest.raises(BleakDeviceNotFoundError):
                await client_of(radio, one).connect()
            # Heard, then gone before the request: the request must be taken back.
            connect = radio.central.connect_le

            async def late(*args, **options):
                await two.hide()
                return await connect(*args, **options)

            radio.central.connect_le = late
            with pytest.raises(BleakError):
                await client_of(radio, two).connect()
            radio.central.connect_le = connect
            assert radio.controller_of(radio.central).pending_le_connection is None
            await one.advertise()
            async with client_of(radio, one) as client:
                assert client.is_connected

    run(main(), virtual=True)


def test_a_question_under_way_ends_with_the_link() -> None:
    async def main() -> None:
        async with air(AirSettings(latency_s=0.2)) as (radio, one):
            loop = asyncio.get_running_loop()
            async with client_of(radio, one) as client:
                reading = asyncio.ensure_future(client.read_gatt_char(SECRET))
                await asyncio.sleep(0.05)
                start_s = loop.time()
                one.hang_up()
                with pytest.raises(BleakError, match="the link broke"):
                    await reading
                assert loop.time() - start_s < 0.1

    run(main(), virtual=True)


def test_latency_and_loss_are_as_asked() -> None:
    async def main() -> None:
        async with air(AirSettings(latency_s=0.03, lost_share=0.25)) as (radio, one):
            loop = asyncio.get_running_loop()
            arrivals: list[tuple[float, bytes]] = []
            async with client_of(radio, one) as client:
                await client.start_notify(TALK, lambda _, value: arrivals.append((loop.time(), bytes(value))))
                for n in range(1000):
                    sent_s = loop.time()
                    one.notify(TALK, n.to_bytes(2, "big"))
                    await asyncio.sleep(0.05)
                    if arrivals and arrivals[-1][1] == n.to_bytes(2, "big"):
                        assert arrivals[-1][0] - sent_s == pytest.approx(0.03)
            assert len(arrivals) == pytest.approx(750, abs=60)
            assert [value for _, value in arrivals] == sorted(value for _, value in arrivals)

    run(main(), virtual=True)


@pytest.mark.parametrize("latency_s", [0.0, 0.03])
def test_jitter_spreads_packets_evenly_and_keeps_their_order(latency_s: float) -> None:
    async def main() -> None:
        async with air(AirSettings(latency_s=latency_s, jitter_s=0.04)) as (radio, one):
            loop = asyncio.get_running_loop()
            sent: list[float] = []
            arrived: list[tuple[float, int]] = []
            async with client_of(radio, one) as client:
                await client.start_notify(
                    TALK, lambda _, value: arrived.append((loop.time(), int.from_bytes(value, "big")))
                )
                # Slower than the jitter, no packet waits for another; faster, many do.
                for every_s, count in ((0.05, 2000), (0.005, 2000)):
                    sent.clear()
                    arrived.clear()
                    for n in range(count):
                        sent.append(loop.time())
                        one.notify(TALK, n.to_bytes(2, "big"))
                        await asyncio.sleep(every_s)
                    await asyncio.sleep(0.1)
                    assert [n for _, n in arrived] == list(range(count))
                    delays = np.array([t_s for t_s, _ in arrived]) - sent - latency_s
                    assert delays.min() >= -1e-9
                    assert delays.max() <= 0.04 + 1e-9
                    if every_s > 0.04:
                        # Kolmogorov's bound at 0.1 % for an even spread.
                        even = np.arange(1, count + 1) / count
                        assert np.abs(np.sort(delays) / 0.04 - even).max() < 1.95 / np.sqrt(count)
                    else:
                        # The latest of the packets before is what counts: late more often than even.
                        assert delays.mean() > 0.025
                # A hundred at once come in order too, in both directions.
                arrived.clear()
                written: list[bytes] = []
                one.on_write = lambda _, value: written.append(value)
                for n in range(100):
                    one.notify(TALK, n.to_bytes(2, "big"))
                    await client.write_gatt_char(TALK, bytes([n]), response=False)
                await asyncio.sleep(0.5)
                assert [n for _, n in arrived] == list(range(100))
                assert written == [bytes([n]) for n in range(100)]

    run(main(), virtual=True)


def test_what_was_on_its_way_does_not_reach_the_next_link() -> None:
    async def main() -> None:
        async with air(AirSettings(latency_s=0.001)) as (radio, one):
            written: list[bytes] = []
            one.on_write = lambda _, value: written.append(value)
            async with client_of(radio, one) as client:
                radio.air._latency_s = 1.0
                await client.write_gatt_char(TALK, b"old", response=False)
                one.hang_up(CONNECTION_TIMEOUT)
                await asyncio.sleep(0.01)
            connection = await radio.connect(one.address, 0.9)
            assert one.is_connected
            await asyncio.sleep(2.0)
            assert written == []
            await connection.disconnect()

    run(main(), virtual=True)


def test_each_peripheral_loses_its_own_share_besides_the_airs() -> None:
    async def main() -> None:
        async with air(AirSettings(lost_share=0.2), names=("one", "two")) as (radio, one, two):
            counts = {"one": 0, "two": 0}
            async with client_of(radio, one) as first, client_of(radio, two) as second:

                def count(name: str):
                    def heard(*_) -> None:
                        counts[name] += 1

                    return heard

                await first.start_notify(TALK, count("one"))
                await second.start_notify(TALK, count("two"))
                one.lose(0.5)
                for _ in range(3000):
                    one.notify(TALK, b"1")
                    two.notify(TALK, b"2")
                    await asyncio.sleep(0.001)
                # Five standard deviations.
                assert counts["one"] == pytest.approx(3000 * 0.8 * 0.5, abs=135)
                assert counts["two"] == pytest.approx(3000 * 0.8, abs=110)

    run(main(), virtual=True)


def test_of_two_peripherals_one_falls_silent_and_comes_back() -> None:
    async def main() -> None:
        async with air(names=("one", "two")) as (radio, one, two):
            heard: list[bytes] = []
            async with client_of(radio, one) as first, client_of(radio, two) as second:
                for client in (first, second):
                    await client.start_notify(TALK, lambda _, value: heard.append(bytes(value)))
                one.fall_silent()
                for each in (one, two):
                    each.notify(TALK, each.name.encode())
                with pytest.raises(TimeoutError):
                    async with asyncio.timeout(2.0):
                        await first.write_gatt_char(TALK, b"anybody?", response=True)
                await second.write_gatt_char(TALK, b"you", response=True)
                assert heard == [b"two"]
                assert (first.is_connected, second.is_connected) == (True, True)
                one.come_back()
                await asyncio.sleep(0.01)
                assert (first.is_connected, second.is_connected) == (False, True)
                await first.connect()
                assert one.is_connected

    run(main(), virtual=True)


def test_a_radio_that_is_off_says_so() -> None:
    async def main() -> None:
        radio = VirtualRadio()
        with pytest.raises(RadioError, match="start it first"):
            _ = radio.central
        with pytest.raises(RadioError, match="start it first"):
            await radio.add_peripheral("one", "D0:00:00:00:00:01", SERVICES)
        with pytest.raises(BleakBluetoothNotAvailableError):
            await BleakScanner.discover(1.0, backend=radio.scanner_backend)
        with pytest.raises(BleakBluetoothNotAvailableError):
            await BleakClient("D0:00:00:00:00:01", backend=radio.client_backend).connect()
        await radio.start()
        await radio.start()
        await radio.close()
        await radio.close()

    run(main(), virtual=True)


def test_pairing_is_refused_and_settings_are_checked() -> None:
    async def main() -> None:
        async with air() as (radio, one):
            client = client_of(radio, one)
            with pytest.raises(BleakError, match="pair"):
                await client.pair()
            with pytest.raises(BleakError, match="pair"):
                await client.unpair()
            with pytest.raises(BleakError, match="pair"):
                await client_of(radio, one, pair=True).connect()
            assert client.mtu_size == 23

    run(main(), virtual=True)
    for wrong in ({"mtu": 22}, {"mtu": 600}, {"latency_s": -1.0}, {"lost_share": 1.5}, {"jitter_s": -1.0}):
        with pytest.raises(RequestError):
            AirSettings(**wrong)
    for chance in ({"lost_share": 0.1}, {"jitter_s": 0.1}):
        with pytest.raises(RequestError, match="random generator"):
            VirtualRadio(AirSettings(**chance))


@pytest.mark.slow
def test_an_hour_of_stream_arrives_whole_and_in_order() -> None:
    async def main() -> None:
        async with air() as (radio, one):
            heard: list[int] = []
            async with client_of(radio, one) as client:
                await client.start_notify(TALK, lambda _, value: heard.append(int.from_bytes(value, "big")))
                for n in range(72_000):
                    one.notify(TALK, n.to_bytes(4, "big"))
                    await asyncio.sleep(0.05)
            assert heard == list(range(72_000))

    run(main(), virtual=True)
