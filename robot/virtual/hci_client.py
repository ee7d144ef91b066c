"""A virtual radio whose air is in another process, reached by HCI over TCP."""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# bumble carries py.typed but leaves many signatures bare.

from __future__ import annotations

import asyncio
import contextlib
import os
from typing import cast

from bumble import core, hci
from bumble.device import Device
from bumble.transport.common import StreamPacketSink, Transport
from bumble.transport.tcp_client import open_tcp_client_transport

from robot.errors import RadioError
from robot.virtual.air import QuietHost
from robot.virtual.antenna import AirSettings, Antenna, device_on
from robot.virtual.hci_server import format_endpoint, parse_endpoint

_CALL_TIMEOUT_S = 5.0


class HciRadio(Antenna):
    """The central of an ``HciServer``'s air. On a real clock only: TCP does not know virtual time.

    Args:
        endpoint: "HOST:PORT" of the server.
        settings: Only ``mtu`` is in this end's hands.

    Raises:
        RequestError: ``endpoint`` is no HOST:PORT.
    """

    def __init__(self, endpoint: str, settings: AirSettings | None = None) -> None:
        super().__init__(settings)
        self.endpoint = format_endpoint(*parse_endpoint(endpoint))
        self._off = f"no HCI link to {self.endpoint}: start this radio, and `chordlab robot virtual` there, first"
        self._wire: Transport | None = None

    async def start(self) -> None:
        """Connect to the server and switch the controller on; does nothing when it is on.

        Raises:
            RadioError: Nobody listens there, or what listens does not speak HCI.
        """
        if self._wire is not None:
            return
        try:
            async with asyncio.timeout(_CALL_TIMEOUT_S):
                # bumble takes a host of its own notation: everything before the last colon, no brackets.
                host, port = parse_endpoint(self.endpoint)
                self._wire = await open_tcp_client_transport(f"{host}:{port}")
        except (OSError, TimeoutError) as error:
            raise self._no_server(error) from error
        try:
            await self._switch_on(self._device(self._wire))
        except (core.BaseBumbleError, hci.HCI_Error, TimeoutError) as error:
            await self._hang_up()
            raise self._no_server(error) from error
        except BaseException:
            await self._hang_up()
            raise
        self._wire.source.terminated.add_done_callback(self._lost)

    async def close(self) -> None:
        """Switch the controller off and disconnect from the server."""
        await self._switch_off()
        await self._hang_up()

    def _device(self, wire: Transport) -> Device:
        # The local port is this connection's alone, and so makes an address that no other client here has.
        port = int(cast("StreamPacketSink", wire.sink).transport.get_extra_info("sockname")[1])
        address = f"F0:F0:F0:01:{port >> 8:02X}:{port & 0xFF:02X}"
        return device_on(QuietHost(wire.sink, wire.source), "host", address)

    def _no_server(self, error: Exception) -> RadioError:
        code = error.errno if isinstance(error, OSError) else None
        reason = os.strerror(code) if code else " ".join(str(error).split()) or "no answer in time"
        return RadioError(f"no HCI server at {self.endpoint} ({reason}): start `chordlab robot virtual` there first")

    def _lost(self, _: asyncio.Future[None]) -> None:
        # The device has told every connection's listeners; nothing can be asked of it any more.
        self._central = None

    async def _hang_up(self) -> None:
        wire, self._wire = self._wire, None
        if wire is not None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_CALL_TIMEOUT_S):
                    await wire.close()

    async def _withdraw(self, central: Device) -> None:
        with contextlib.suppress(core.BaseBumbleError, hci.HCI_Error, TimeoutError):
            async with asyncio.timeout(_CALL_TIMEOUT_S):
                await central.host.send_sync_command(hci.HCI_LE_Create_Connection_Cancel_Command())
