"""Bumble's link, controller, host and device, cut down for speed and widened by what air does.

Bumble formats every packet for its log whether or not anybody reads it; over an hour of simulated
stream that is most of the time. The methods here do the same without.
"""
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# bumble carries py.typed but leaves many signatures bare.

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Any

from bumble import core, hci, ll
from bumble.controller import Connection, Controller
from bumble.device import Device
from bumble.host import Host
from bumble.link import LocalLink
from bumble.transport.common import TransportSink, TransportSource
from numpy.random import Generator

from lab.base.errors import RequestError

NOTIFICATION = 0x1B
"""ATT opcode of a notification."""
CONNECTION_TIMEOUT = 0x08
NOT_ESTABLISHED = 0x3E
"""Reasons for the end of a link: nothing heard any more; never answered."""
_ACL_BYTES = 251
# HCI event "number of completed packets" of one connection, up to its handle.
_COMPLETED = bytes((hci.HCI_EVENT_PACKET, hci.HCI_NUMBER_OF_COMPLETED_PACKETS_EVENT, 5, 1))


class DelayLine:
    """Does one thing after another, each after a delay of its own but never before the one ahead of it."""

    def __init__(self) -> None:
        self._waiting: deque[Callable[[], None]] = deque()
        self._last_s = 0.0

    def put(self, delay_s: float, action: Callable[[], None]) -> None:
        """Do ``action`` in ``delay_s`` from now, or right after what was put in before and is due later."""
        loop = asyncio.get_running_loop()
        self._last_s = max(self._last_s, loop.time() + delay_s)
        self._waiting.append(action)
        # One timer for each, which does whatever is next: timers of one instant fire in any order.
        loop.call_at(self._last_s, self._next)

    def cut(self) -> None:
        """Drop what waits; nothing may be put in any more."""
        self._waiting.clear()

    def _next(self) -> None:
        if self._waiting:
            self._waiting.popleft()()


class Air(LocalLink):
    """An in-process link with delay and loss, in which a controller may be cut off from all others.

    Args:
        latency_s: Least delay of every data packet.
        jitter_s: Most that is added to it, drawn evenly for each packet. The packets of one direction of
            one link keep their order, as Bluetooth's do.
        lost_share: Share of the ATT notifications that are dropped.
        rng: Source of losses and jitter; None when neither is wanted.
    """

    def __init__(self, latency_s: float, jitter_s: float, lost_share: float, rng: Generator | None) -> None:
        super().__init__()
        self._latency_s = latency_s
        self._jitter_s = jitter_s
        self._lost_share = lost_share
        self._rng = rng
        self._losses: dict[Controller, float] = {}
        self._silent: set[Controller] = set()
        # By sender and receiver: the receiver's end of the link, and what is on its way to it.
        self._lines: dict[tuple[hci.Address, hci.Address], tuple[Connection, DelayLine]] = {}

    def remove_controller(self, controller: Controller) -> None:
        """Take a controller off the air for good."""
        super().remove_controller(controller)
        self._losses.pop(controller, None)
        self._silent.discard(controller)

    def lose(self, controller: Controller, share: float) -> None:
        """Drop ``share`` of the notifications that ``controller`` sends, besides what the air drops anyway.

        Raises:
            RequestError: There is no random generator to draw the losses from.
        """
        if share > 0 and self._rng is None:
            raise RequestError("virtual radio: losing notifications needs a random generator; hand one in")
        self._losses[controller] = share

    def silence(self, controller: Controller) -> None:
        """Let nothing through to or from ``controller``; its links stay, with nobody at the other end."""
        self._silent.add(controller)

    def readmit(self, controller: Controller) -> None:
        """Let ``controller`` be heard again; its links have timed out meanwhile, at both ends."""
        self._silent.discard(controller)
        for other in tuple(self.controllers):
            for connection in tuple(other.le_connections.values()):
                if other is controller or connection.peer_address == controller.random_address:
                    other.on_le_disconnected(connection, CONNECTION_TIMEOUT)

    def _loses(self, sender: Controller, data: bytes) -> bool:
        """Whether this packet of ``sender`` gets lost. Layout: length (2), channel (2), then the ATT opcode."""
        share = self._lost_share
        if self._losses:
            share = 1.0 - (1.0 - share) * (1.0 - self._losses.get(sender, 0.0))
        if self._rng is None or share <= 0 or len(data) <= 4 or data[4] != NOTIFICATION:
            return False
        return self._rng.random() < share

    def send_acl_data(
        self,
        sender_controller: Controller,
        destination_address: hci.Address,
        transport: core.PhysicalTransport,
        data: bytes,
    ) -> None:
        """Carry one L2CAP packet across."""
        if self._loses(sender_controller, data):
            return
        connection = sender_controller.le_connections.get(destination_address)
        if connection is None:
            return
        sender = connection.self_address
        receiver = self._peer(sender, destination_address)
        if receiver is None or sender_controller in self._silent or receiver in self._silent:
            return
        if not self._latency_s and not self._jitter_s:
            asyncio.get_running_loop().call_soon(receiver.on_link_acl_data, sender, transport, data)
            return
        end = receiver.le_connections[sender]
        known, line = self._lines.get((sender, destination_address), (None, None))
        if line is None or known is not end:
            line = DelayLine()
            self._lines[sender, destination_address] = end, line

        def deliver() -> None:
            # Not to a later link between the same two.
            if receiver.le_connections.get(sender) is end:
                receiver.on_link_acl_data(sender, transport, data)

        jitter_s = self._jitter_s * self._rng.random() if self._jitter_s and self._rng is not None else 0.0
        line.put(self._latency_s + jitter_s, deliver)

    def send_ll_control_pdu(
        self, sender_address: hci.Address, receiver_address: hci.Address, packet: ll.ControlPdu
    ) -> None:
        """Carry one control packet to the other end of a link; when that end is gone, nowhere."""

        def deliver(receiver: Controller) -> None:
            if sender_address in receiver.le_connections:
                receiver.on_ll_control_pdu(sender_address, packet)

        peer = self._peer(sender_address, receiver_address)
        sender = self._peer(receiver_address, sender_address)
        if peer is not None and peer not in self._silent and sender not in self._silent:
            asyncio.get_running_loop().call_soon(deliver, peer)

    def send_advertising_pdu(self, sender_controller: Controller, packet: ll.AdvertisingPdu) -> None:
        """Carry an advertisement or a connection request to everybody.

        Of two that answer one advertisement, the advertiser takes the first; the other's link fails at once.
        """
        loop = asyncio.get_running_loop()
        others = [controller for controller in self.controllers if controller is not sender_controller]
        others = [] if sender_controller in self._silent else [each for each in others if each not in self._silent]
        if not isinstance(packet, ll.ConnectInd):
            for controller in others:
                loop.call_soon(controller.on_ll_advertising_pdu, packet)
            return

        def deliver() -> None:
            taken = False
            for controller in others:
                before = controller.le_connections.get(packet.initiator_address)
                controller.on_ll_advertising_pdu(packet)
                taken = taken or controller.le_connections.get(packet.initiator_address) is not before
            connection = sender_controller.le_connections.get(packet.advertiser_address)
            if not taken and connection is not None:
                sender_controller.on_le_disconnected(connection, NOT_ESTABLISHED)

        loop.call_soon(deliver)

    def _peer(self, address: hci.Address, peer_address: hci.Address) -> Controller | None:
        """Who holds the other end of the link from ``address`` to ``peer_address``.

        Both count, since two centrals that know nothing of each other may have the same address.
        """
        for controller in self.controllers:
            connection = controller.le_connections.get(address)
            if connection is not None and connection.self_address == peer_address:
                return controller
        return None


class QuietController(Controller):
    """A controller that keeps no log of its packets, gives up connection requests, and breaks links."""

    le_acl_data_packet_length = _ACL_BYTES

    def __init__(self, name: str, air: Air, *, public_address: str | None = None) -> None:
        super().__init__(name, link=air, public_address=public_address)

    def on_packet(self, packet: bytes) -> None:
        """Take an HCI packet from the host."""
        if packet[0] == hci.HCI_ACL_DATA_PACKET:
            self.on_hci_acl_data_packet(hci.HCI_AclDataPacket.from_bytes(packet))
        else:
            super().on_packet(packet)

    def on_hci_acl_data_packet(self, packet: hci.HCI_AclDataPacket) -> None:
        """Pass data on to the link, and tell the host that there is room for more."""
        connection = self.find_connection_by_handle(packet.connection_handle)
        host = self.host
        # None: the link broke while the packet was on its way.
        if connection is not None and host is not None:
            connection.assembler.feed_packet(packet)
            done = _COMPLETED + packet.connection_handle.to_bytes(2, "little") + b"\x01\x00"
            asyncio.get_running_loop().call_soon(host.on_packet, done)

    def send_hci_packet(self, packet: hci.HCI_Packet) -> None:
        """Hand an HCI packet to the host in the loop's next turn."""
        host = self.host
        if host is not None:
            asyncio.get_running_loop().call_soon(host.on_packet, bytes(packet))

    def on_link_acl_data(self, sender_address: hci.Address, transport: core.PhysicalTransport, data: bytes) -> None:
        """Take data from the link; what arrives after the link broke is dropped."""
        if sender_address in self.le_connections:
            super().on_link_acl_data(sender_address, transport, data)

    def give_up_connecting(self) -> None:
        """Forget a connection request. Bumble's controller keeps a cancelled one, and refuses every later one."""
        self.pending_le_connection = None

    # bumble's commands are generic in what they return, and these two leave it open.
    def on_hci_le_create_connection_cancel_command(self, _command: Any) -> hci.HCI_StatusReturnParameters:
        """Forget a connection request because its host says so, and report it as failed, as the standard has it."""
        request = self.pending_le_connection
        if request is None:
            return hci.HCI_StatusReturnParameters(hci.HCI_ErrorCode.COMMAND_DISALLOWED_ERROR)
        self.give_up_connecting()
        failed = hci.HCI_LE_Connection_Complete_Event(
            status=hci.HCI_ErrorCode.UNKNOWN_CONNECTION_IDENTIFIER_ERROR,
            connection_handle=0,
            role=hci.Role.CENTRAL,
            peer_address_type=request.peer_address.address_type,
            peer_address=request.peer_address,
            connection_interval=0,
            peripheral_latency=0,
            supervision_timeout=0,
            central_clock_accuracy=0,
        )
        # After the answer to this command, which leaves when this returns.
        asyncio.get_running_loop().call_soon(self.send_hci_packet, failed)
        return hci.HCI_StatusReturnParameters(hci.HCI_ErrorCode.SUCCESS)

    def on_hci_reset_command(self, _command: Any) -> hci.HCI_StatusReturnParameters:
        """Begin anew; bumble's controller would keep links, scan and advertisements of the time before."""
        self.vanish()
        return hci.HCI_StatusReturnParameters(hci.HCI_ErrorCode.SUCCESS)

    def vanish(self) -> None:
        """Fall silent without a word to the host; the peers find that they hear nothing any more."""
        self.give_up_connecting()
        self.le_scan_enable = False
        for advertiser in (self.le_legacy_advertiser, *self.advertising_sets.values()):
            advertiser.stop()
        self.advertising_sets.clear()
        for connection in tuple(self.le_connections.values()):
            connection.send_ll_control_pdu(ll.TerminateInd(CONNECTION_TIMEOUT))
        self.le_connections.clear()

    def break_links(self, reason: int) -> None:
        """End every connection with ``reason``, told to both ends."""
        for connection in tuple(self.le_connections.values()):
            connection.send_ll_control_pdu(ll.TerminateInd(reason))
            self.on_le_disconnected(connection, reason)


class QuietHost(Host):
    """A host that keeps no log of its packets. A snooper, when one is set, still sees everything.

    Args:
        sink: The controller, or the way to it.
        source: Where its packets come from, when it does not hand them over itself.
    """

    def __init__(self, sink: TransportSink, source: TransportSource | None = None) -> None:
        super().__init__(controller_source=source, controller_sink=sink)

    def on_transport_lost(self) -> None:
        """The way to the controller is gone: whoever waits for an answer is told, every link has ended."""
        if self.pending_response is not None and self.pending_response.done():
            self.pending_response = None
        super().on_transport_lost()

    async def _send_command(self, command: Any, response_timeout: float | None = None) -> Any:
        """Ask the controller. Bumble's own time-out, Python 3.11's ``wait_for``, can lose a cancellation."""
        async with asyncio.timeout(response_timeout):
            return await super()._send_command(command)

    def send_hci_packet(self, packet: hci.HCI_Packet) -> None:
        """Hand an HCI packet to the controller."""
        if self.snooper is not None:
            super().send_hci_packet(packet)
        elif self.hci_sink is not None:
            self.hci_sink.on_packet(bytes(packet))

    def send_acl_sdu(self, connection_handle: int, sdu: bytes) -> None:
        """Send data to the peer; data for a link that is gone is dropped, as the air would."""
        if connection_handle in self.connections:
            super().send_acl_sdu(connection_handle, sdu)

    def on_packet(self, packet: bytes) -> None:
        """Take an HCI packet from the controller: the two kinds that carry a stream by the short way."""
        if self.snooper is None and self.ready:
            if packet[0] == hci.HCI_ACL_DATA_PACKET:
                self.on_hci_acl_data_packet(hci.HCI_AclDataPacket.from_bytes(packet))
                return
            if packet.startswith(_COMPLETED):
                handle = int.from_bytes(packet[4:6], "little")
                queue = self.get_data_packet_queue(handle)
                if queue is not None:
                    queue.on_packets_completed(int.from_bytes(packet[6:8], "little"), handle)
                return
        super().on_packet(packet)


class QuietDevice(Device):
    """A device that hands notifications straight to their subscribers, unlogged and uncached."""

    # Bumble's decorator puts a handle where its signature says connection.
    def on_gatt_pdu(self, connection: Any, pdu: bytes) -> None:
        """Take an ATT packet that came over the connection with this handle."""
        if pdu[0] == NOTIFICATION and len(pdu) >= 3:
            known = self.connections.get(connection)
            if known is not None:
                subscribers = known.gatt_client.notification_subscribers
                value = pdu[3:]
                for subscriber in tuple(subscribers.get(pdu[1] | pdu[2] << 8, ())):
                    if callable(subscriber):
                        subscriber(value)
                    else:
                        subscriber.emit(subscriber.EVENT_UPDATE, value)
        else:
            super().on_gatt_pdu(connection, pdu)
