"""The robot's end of the radio: a GATT service on MicroPython's ``bluetooth`` module.

Advertises as ``CL-`` and the last four digits of its address, takes one host at a time, and advertises again when
that host has gone.
"""
# pyright: reportMissingImports=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false, reportMissingModuleSource=false
# MicroPython's own modules exist on the robot alone.

import struct

import bluetooth

from robot.micropython import wire

_CENTRAL_CONNECT, _CENTRAL_DISCONNECT, _WRITTEN = 1, 2, 3  # the interrupts' numbers in MicroPython's documentation
_ADVERTISE_US = 200000
_MOST_COMMANDS = 8


def advertisement(name: str) -> bytes:
    """The 31 bytes at most that say who is there: flags, the whole name, the service's uuid."""
    uuid = bytes(reversed(bytes.fromhex(wire.SERVICE_UUID.replace("-", ""))))
    fields = ((0x01, b"\x06"), (0x09, name.encode()), (0x07, uuid))  # 6: general discoverable, no classic Bluetooth
    return b"".join(struct.pack("BB", len(value) + 1, kind) + value for kind, value in fields)


class Ble:
    """The link of ``Roamer`` on a robot.

    What the interrupt brings is queued for the loop, at most eight commands; a host sends one and waits.

    Attributes:
        name: What it is advertised as.
    """

    def __init__(self, identity: bytes):
        """Switch the radio on, register the service and advertise; ``identity`` is what IDENTITY reads as."""
        self._commands: list[bytes] = []
        self._host: int | None = None
        self._radio = bluetooth.BLE()
        self._radio.active(True)
        self.name = wire.NAME_PREFIX + self._radio.config("mac")[1][-2:].hex().upper()
        self._radio.config(gap_name=self.name)
        self._radio.irq(self._interrupted)
        characteristics = []
        for uuid, read, write, notify in wire.TABLE:
            flags = (bluetooth.FLAG_READ if read else 0) | (bluetooth.FLAG_NOTIFY if notify else 0)
            flags |= (bluetooth.FLAG_WRITE | bluetooth.FLAG_WRITE_NO_RESPONSE) if write else 0
            characteristics.append((bluetooth.UUID(uuid), flags))
        service = (bluetooth.UUID(wire.SERVICE_UUID), tuple(characteristics))
        (handles,) = self._radio.gatts_register_services((service,))
        self._handles = {row[0]: handle for row, handle in zip(wire.TABLE, handles)}  # noqa: B905 - no strict there
        self._radio.gatts_write(self._handles[wire.IDENTITY_UUID], identity)
        self._advertise()

    def _advertise(self) -> None:
        self._radio.gap_advertise(_ADVERTISE_US, adv_data=advertisement(self.name))

    def _interrupted(self, event: int, data: tuple[int, ...]) -> None:
        if event == _CENTRAL_CONNECT:
            self._host = data[0]
        elif event == _CENTRAL_DISCONNECT:
            self._host = None
            self._advertise()
        elif event == _WRITTEN and data[1] == self._handles[wire.CONTROL_UUID]:
            command = bytes(self._radio.gatts_read(data[1]))
            if len(self._commands) < _MOST_COMMANDS:
                self._commands.append(command)

    def connected(self) -> bool:
        """Whether a host holds the link."""
        return self._host is not None

    def command(self) -> bytes | None:
        """The oldest command not yet taken, or None."""
        return self._commands.pop(0) if self._commands else None

    def notify(self, uuid: str, record: bytes) -> None:
        """Tell the host, when there is one. A link that breaks meanwhile is news that the interrupt will bring."""
        host = self._host
        if host is not None:
            try:  # noqa: SIM105 - MicroPython has no contextlib
                self._radio.gatts_notify(host, self._handles[uuid], record)
            except OSError:
                pass
