"""Bumble's link, controller, host and device, cut down for speed and widened by what air does.

Bumble formats every packet for its log whether or not anybody reads it; over an hour of simulated
stream that is most of the time. The methods here do the same without.
"""
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# bumble carries py.typed but leaves many signatures bare.

from __future__ import annotations

import asyncio
from typing import Any

from bumble import core, hci, ll
from bumble.controller import Controller
from bumble.device import Device
from bumble.host import Host
from bumble.link import LocalLink
from bumble.transport.common import TransportSink, TransportSource
from numpy.random import Generator

NOTIFICATION = 0x1B
"""ATT opcode of a notification."""
CONNECTION_TIMEOUT = 0x08
NOT_ESTABLISHED = 0x3E
"""Reasons for the end of a link: nothing heard any more; never answered."""
_ACL_BYTES = 251
# HCI event "number of completed packets" of one connection, up to its handle.
_COMPLETED = bytes((hci.HCI_EVENT_PACKET, hci.HCI_NUMBER_OF_COMPLETED_PACKETS_EVENT, 5, 1))


class Air(LocalLink):
    """An in-process link with delay and loss.

    Args:
        latency_s: Delay of every data packet.
        lost_share: Share of the ATT notifications that are dropped.
        rng: Source of the losses; None when none are wanted.
    """

    def __init__(self, latency_s: float, lost_share: float, rng: Generator | None) -> None:
        super().__init__()
        self._latency_s = latency_s
        self._lost_share = lost_share if rng is not None else 0.0
        self._rng = rng

    def send_acl_data(
        self,
        sender_controller: Controller,
        destination_address: hci.Address,
        transport: core.PhysicalTransport,
        data: bytes,
    ) -> None:
        """Carry one L2CAP packet across."""
        # Layout: length (2), channel (2), then the ATT opcode.
        lossy = self._lost_share > 0 and len(data) > 4 and data[4] == NOTIFICATION
        if lossy and self._rng is not None and self._rng.random() < self._lost_share:
            return
        connection = sender_controller.le_connections.get(destination_address)
        if connection is None:
            return
        sender = connection.self_address
        receiver = self._peer(sender, destination_address)
        if receiver is None:
            return
        loop = asyncio.get_running_loop()
        if self._latency_s > 0:
            loop.call_later(self._latency_s, receiver.on_link_acl_data, sender, transport, data)
        else:
            loop.call_soon(receiver.on_link_acl_data, sender, transport, data)

    def send_ll_control_pdu(
        self, sender_address: hci.Address, receiver_address: hci.Address, packet: ll.ControlPdu
    ) -> None:
        """Carry one control packet to the other end of a link; when that end is gone, nowhere."""

        def deliver(receiver: Controller) -> None:
            if sender_address in receiver.le_connections:
                receiver.on_ll_control_pdu(sender_address, packet)

        peer = self._peer(sender_address, receiver_address)
        if peer is not None:
            asyncio.get_running_loop().call_soon(deliver, peer)

    def send_advertising_pdu(self, sender_controller: Controller, packet: ll.AdvertisingPdu) -> None:
        """Carry an advertisement or a connection request to everybody.

        Of two that answer one advertisement, the advertiser takes the first; the other's link fails at once.
        """
        if not isinstance(packet, ll.ConnectInd):
            super().send_advertising_pdu(sender_controller, packet)
            return
        others = [controller for controller in self.controllers if controller is not sender_controller]

        def deliver() -> None:
            taken = False
            for controller in others:
                before = controller.le_connections.get(packet.initiator_address)
                controller.on_ll_advertising_pdu(packet)
                taken = taken or controller.le_connections.get(packet.initiator_address) is not before
            connection = sender_controller.le_connections.get(packet.advertiser_address)
            if not taken and connection is not None:
                sender_controller.on_le_disconnected(connection, NOT_ESTABLISHED)

        asyncio.get_running_loop().call_soon(deliver)

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
