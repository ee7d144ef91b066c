import asyncio
import contextlib
import struct

import numpy as np
import pytest
from bleak import BleakScanner
from shapely.geometry import box

from lab.base.errors import RequestError
from lab.clock import run
from robot import commands
from robot.commands import COMMANDS, Request
from robot.link import COMMANDS_UUID
from robot.packets import Packet, encode
from robot.virtual.body import Body
from robot.virtual.bolt import BoltSettings, VirtualBolt
from robot.virtual.radio import AirSettings
from tests.robot.plainclient import Client, session

# The protocol's table: device, command, target (0: none), a good payload, bytes of the answer's payload.
TABLE = {
    "API version": (0x10, 0x01, 0, "", 2),
    "main app version": (0x11, 0x00, 0, "", 6),
    "bootloader version": (0x11, 0x01, 0, "", 6),
    "MAC address": (0x11, 0x06, 0, "", 12),
    "wake": (0x13, 0x0D, 0, "", 0),
    "battery voltage": (0x13, 0x03, 0, "", 2),
    "battery voltage state": (0x13, 0x17, 0, "", 1),
    "charger state": (0x13, 0x1F, 0, "", 1),
    "charger notify": (0x13, 0x20, 0, "01", 0),
    "raw motors": (0x16, 0x01, 0x12, "01 28 01 28", 0),
    "reset yaw": (0x16, 0x06, 0x12, "", 0),
    "drive": (0x16, 0x07, 0x12, "3c 01 67 00", 0),
    "stabilisation": (0x16, 0x0C, 0x12, "05", 0),
    "LEDs": (0x1A, 0x1C, 0x11, "3f ff 00 00 00 00 ff", 0),
    "matrix pixel": (0x1A, 0x2D, 0x12, "07 00 ff 00 00", 0),
    "matrix colour": (0x1A, 0x2F, 0x12, "ff 80 00", 0),
    "streaming mask": (0x18, 0x00, 0x12, "00 96 00 00 07 00 78", 0),
    "streaming mask get": (0x18, 0x01, 0x12, "", 7),
    "extended mask": (0x18, 0x0C, 0x12, "00 04 00 00", 0),
    "extended mask get": (0x18, 0x0D, 0x12, "", 4),
    "gyro-max notify": (0x18, 0x0F, 0x12, "01", 0),
    "configure collision": (0x18, 0x11, 0x12, "01 5a 82 5a 82 01", 0),
    "reset locator": (0x18, 0x13, 0x12, "", 0),
    "locator flags": (0x18, 0x17, 0x12, "00", 0),
    "ambient light": (0x18, 0x30, 0x12, "", 4),
    "sleep": (0x13, 0x01, 0, "", 0),
    "deep sleep": (0x13, 0x00, 0, "", 0),
}


def test_every_command_of_the_table_with_right_short_and_long_payloads(bench) -> None:
    async def script(b, client: Client) -> None:
        assert set(TABLE) | {"ping"} == {command.name for command in COMMANDS}
        for name, (did, cid, target, payload, answer_bytes) in TABLE.items():
            data = bytes.fromhex(payload)

            async def ask(data: bytes, to: int, did=did, cid=cid) -> Packet:
                client.seq += 1
                ids = {"target": to, "source": 0x01} if to else {}
                return await client.send(Packet(0x3A if to else 0x0A, did, cid, client.seq, data, **ids))

            for wrong in {data[:-1], data + b"\x00"} - {data}:
                refusal = await ask(wrong, target)
                assert (refusal.error, refusal.data) == (commands.BAD_LENGTH, b""), name
            if target:
                # Its device exists, but the other processor does not have it.
                assert (await ask(data, 0x11 ^ 0x12 ^ target)).error == commands.BAD_CID, name
                assert (await ask(data, 0x13)).error == commands.BAD_TARGET, name
            answer = await ask(data, target)
            assert (answer.did, answer.cid, answer.error, len(answer.data)) == (did, cid, 0, answer_bytes), name
            if target:
                assert (answer.flags, answer.target, answer.source) == (0x39, 0x01, target), name
            else:
                assert (answer.flags, answer.target, answer.source) == (0x09, None, None), name
            if name == "sleep":
                assert b.virtual.asleep
                assert (await ask(b"", 0)).error == commands.TARGET_UNAVAILABLE
        for word in (b"", b"\xab\x8d\xd8", bytes(300)):
            assert (await client.ask(Request(commands.PING, word))).data == word

    session(bench, script)


def test_what_it_cannot_do_is_refused_with_the_right_code(bench) -> None:
    async def script(_, client: Client) -> None:
        async def code(packet: Packet) -> int | None:
            return (await client.send(packet)).error

        assert await code(Packet(0x0A, 0x77, 0x00, 1)) == commands.BAD_DID
        assert await code(Packet(0x0A, 0x13, 0x77, 2)) == commands.BAD_CID
        assert await code(Packet(0x3A, 0x16, 0x06, 3, b"\x00", target=0x12, source=1)) == commands.BAD_LENGTH
        assert await code(Packet(0x3A, 0x16, 0x06, 4, target=0x33, source=1)) == commands.BAD_TARGET
        assert await code(Packet(0x3A, 0x16, 0x06, 5, target=0x11, source=1)) == commands.BAD_CID
        for request in (
            Request(commands.DRIVE, struct.pack(">BHB", 10, 360, 0)),
            Request(commands.RAW_MOTORS, bytes([3, 0, 0, 0])),
            Request(commands.MATRIX_PIXEL, bytes([8, 0, 1, 1, 1])),
            Request(commands.STABILISATION, b"\x06"),
        ):
            assert (await client.ask(request)).error == commands.BAD_PARAMETER
        for mask, levels, error in ((0x00, 0, 0), (0x15, 3, 0), (0x15, 2, 5), (0x15, 4, 5), (0x40, 1, 7), (0xFF, 8, 7)):
            leds = await client.ask(Request(commands.LEDS, bytes([mask] + [9] * levels)))
            assert leds.error == error, mask
        assert (await client.ask(Request(commands.LEDS))).error == commands.BAD_LENGTH

    session(bench, script)


def test_answers_follow_the_style_of_the_question(bench) -> None:
    async def script(_, client: Client) -> None:
        only_target = await client.send(Packet(0x1A, 0x16, 0x06, 9, target=0x12))
        assert (only_target.flags, only_target.target, only_target.source) == (0x29, None, 0x12)
        # No answer wanted; answer wanted in case of error alone.
        for flags in (0x08, 0x0E):
            await client.client.write_gatt_char(COMMANDS_UUID, encode(Packet(flags, 0x13, 0x0D, 20)), response=False)
        await asyncio.sleep(0.5)
        assert not [packet for packet in client.packets if packet.is_response]
        assert (await client.send(Packet(0x0E, 0x13, 0x77, 21))).error == commands.BAD_CID

    session(bench, script)


@pytest.mark.parametrize(("mtu", "chunk_bytes", "longest"), [(23, 0, 20), (185, 0, 182), (185, 1, 1), (23, 7, 7)])
def test_frames_come_in_pieces_that_fit(bench, mtu: int, chunk_bytes: int, longest: int) -> None:
    async def script(_, client: Client) -> None:
        word = bytes([0xAB, 0x8D, 0xD8, 0x00]) * 12
        assert (await client.ask(Request(commands.PING, word))).data == word
        assert max(len(piece) for piece in client.pieces) <= longest
        # 48 bytes, 36 of them escaped, in a frame of 8.
        frame = sum(len(piece) for piece in client.pieces)
        assert frame >= 48 + 36 + 8
        assert len(client.pieces) == -(-frame // longest)

    session(bench, script, air=AirSettings(mtu=mtu), manners=BoltSettings(chunk_bytes=chunk_bytes))


def test_any_stream_has_its_interval_its_channels_and_its_count(bench) -> None:
    async def script(b, client: Client) -> None:
        times: list[float] = []
        await client.ask(commands.stream(0, 0))
        await client.ask(commands.stream_extended(0x03840000))
        await client.ask(commands.stream(150, 0x03C7E27A, count=7))
        client.packets.clear()
        for _ in range(40):
            await asyncio.sleep(0.05)
            times += [asyncio.get_running_loop().time()] * (len(client.packets) - len(times))
        assert len(client.packets) == 7
        assert all((p.did, p.cid, p.seq, p.source) == (0x18, 0x02, 0xFF, 0x12) for p in client.packets)
        assert {len(p.data) for p in client.packets} == {80}
        assert np.diff(times) == pytest.approx([0.15] * 6, abs=0.051)
        values = dict(
            zip(
                commands.layout_of(0x03C7E27A, 0x03840000).names,
                struct.unpack(">20f", client.packets[-1].data),
                strict=True,
            )
        )
        assert values["acceleration_z_g"] == 1.0
        assert values["quaternion_w"] == pytest.approx(1.0)
        assert values["ambient_lux"] == pytest.approx(b.body.light_lux())
        # The masks can be read back; a stream of nothing is none.
        assert (await client.ask(Request(commands.STREAM_GET))).data == struct.pack(">HBI", 150, 7, 0x03C7E27A)
        assert (await client.ask(Request(commands.STREAM_EXTENDED_GET))).data == struct.pack(">I", 0x03840000)
        await client.ask(commands.stream_extended(0))
        await client.ask(commands.stream(50, 0))
        client.packets.clear()
        await asyncio.sleep(1.0)
        assert client.packets == []

    session(bench, script)


@pytest.mark.parametrize("interval_ms", [25, 50, 150])
def test_a_thousand_frames_come_at_the_interval_asked_for(bench, interval_ms: int) -> None:
    async def script(_, client: Client) -> None:
        layout = commands.layout_for("core_time", "ambient_lux")
        await client.ask(commands.stream_extended(layout.extended))
        client.packets.clear()
        loop = asyncio.get_running_loop()
        times: list[float] = []
        received = client.parser.feed

        def feed(chunk):
            found = received(chunk)
            times.extend(loop.time() for packet in found if not packet.is_response)
            return found

        client.parser.feed = feed
        began_s = loop.time()
        await client.ask(commands.stream(interval_ms, layout.primary))
        for _ in range(6):
            # Keeps it awake, and must not disturb the rhythm.
            await asyncio.sleep(interval_ms / 6)
            await client.ask(commands.drive(30, 1.0))
        await asyncio.sleep(began_s + interval_ms * 1.0005 - loop.time())
        assert len(times) == 1000
        assert np.array(times) - began_s == pytest.approx(interval_ms / 1000 * np.arange(1, 1001), abs=1e-4)
        told = [layout.decode(packet.data)[0] for packet in client.packets if not packet.is_response]
        assert told == pytest.approx(times, abs=1e-4)

    session(bench, script)


def test_leds_show_in_the_body(bench) -> None:
    async def script(b, client: Client) -> None:
        await client.ask(commands.matrix_colour(0, 255, 0))
        assert b.body.led_level == 1.0
        await client.ask(commands.matrix_colour(0, 0, 0))
        await client.ask(Request(commands.MATRIX_PIXEL, bytes([3, 4, 255, 255, 255])))
        assert b.body.led_level == pytest.approx(1 / 64)

    session(bench, script)


def test_a_host_that_does_not_say_the_words_is_dropped(bench) -> None:
    async def main() -> None:
        async with bench(connect=False) as b:
            client = Client(b)
            async with client.open(words=False):
                start_s = asyncio.get_running_loop().time()
                async with asyncio.timeout(20.0):
                    await client.gone.wait()
                assert asyncio.get_running_loop().time() - start_s == pytest.approx(10.0, abs=0.5)
                assert not b.virtual.is_connected
            polite = Client(b)
            async with polite.open():
                await asyncio.sleep(30.0)
                assert b.virtual.is_connected

    run(main(), virtual=True)


def test_it_announces_sleep_sleeps_and_wakes(bench) -> None:
    async def script(b, client: Client) -> None:
        await client.ask(commands.stream(500, commands.layout_for("locator_x_m").primary))
        await asyncio.sleep(40.0)
        said = [(p.did, p.cid) for p in client.packets if p.did == 0x13]
        assert said == [commands.WILL_SLEEP.key, commands.DID_SLEEP.key]
        assert b.virtual.asleep
        client.packets.clear()
        await asyncio.sleep(3.0)
        assert client.packets == []
        assert (await client.ask(commands.drive(20, 0.0))).error == commands.TARGET_UNAVAILABLE
        assert (await client.ask(Request(commands.WAKE))).error == 0
        assert (await client.ask(commands.drive(20, 0.0))).error == 0
        assert not b.virtual.asleep

    session(bench, script, manners=BoltSettings(inactivity_s=20.0, sleep_notice_s=5.0))


def test_deep_sleep_takes_it_off_the_air(bench) -> None:
    async def main() -> None:
        async with bench(connect=False) as b:
            client = Client(b)
            async with client.open():
                with contextlib.suppress(TimeoutError):
                    await client.ask(Request(commands.DEEP_SLEEP))
                await asyncio.sleep(1.0)
                assert not b.virtual.is_connected
            assert await BleakScanner.find_device_by_name("SB-1234", 3.0, backend=b.radio.scanner_backend) is None

    run(main(), virtual=True)


def test_the_battery_state_follows_its_voltage(bench) -> None:
    async def script(b, client: Client) -> None:
        states = []
        for charge in (1.0, 0.2, 0.05):
            b.body.battery_charge = charge
            states.append((await client.ask(Request(commands.BATTERY_STATE))).data[0])
        assert states == [1, 2, 3]

    session(bench, script)


def test_names_addresses_and_settings_are_checked(bench) -> None:
    async def main() -> None:
        async with bench(connect=False) as b:
            body = Body(box(0, 0, 1, 1), lambda x, y: x, np.random.default_rng(1))
            for name in ("Bolt", "SB-12345", "SB-XYZW"):
                with pytest.raises(RequestError, match="no BOLT's name"):
                    VirtualBolt(b.radio, body, name)
            twin = VirtualBolt(b.radio, body, "SB-1234")
            with pytest.raises(RequestError, match="is taken"):
                await twin.start()
            with pytest.raises(RequestError):
                BoltSettings(anti_dos_s=0.0)
            other = VirtualBolt(b.radio, body, "SB-ABCD")
            await other.start()
            await other.start()
            found = await BleakScanner.discover(1.0, backend=b.radio.scanner_backend)
            assert {device.name for device in found} == {"SB-1234", "SB-ABCD"}
            await other.close()

    run(main(), virtual=True)
