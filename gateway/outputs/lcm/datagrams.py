"""Receiving short messages on LCM's multicast without LCM's library.

The library trusts what it receives (lcm 1.5.3, lcm_udpm.c): a datagram without the NUL behind its channel,
or a fragment whose place is behind the end of its message, makes it use memory that is not its own, and ends
the process. Anyone whose datagrams reach this computer can send them. docs/reference/messages.md describes
LCM's packets.
"""

import ipaddress
import socket
import struct
from collections.abc import Callable
from typing import Final

from gateway.errors import OutputError
from gateway.outputs.lcm.connection import multicast_destination, multicast_problem

_MAGIC: Final = b"LC02"
"""Begins a datagram with a whole message. Those with fragments of one are ignored."""

NO_CHANNEL: Final = ""

_HEADER_BYTES: Final = 8
_MAX_DATAGRAM_BYTES: Final = 65_535


def split_datagram(datagram: bytes) -> tuple[str, bytes] | None:
    """Return the channel and the message in a datagram; None if it has no whole message."""
    if not datagram.startswith(_MAGIC):
        return None
    channel, nul, message = datagram[_HEADER_BYTES:].partition(b"\0")
    return (channel.decode("utf-8", "replace"), message) if nul else None


class LcmDatagrams:
    """Receives on a URL udpm://, and passes the channel and the bytes of each message to ``receive``.

    A datagram that has no whole message counts as an empty message on NO_CHANNEL, because it takes as much
    time. Raises OutputError if the group cannot be joined.
    """

    def __init__(self, url: str, receive: Callable[[str, bytes], None]) -> None:
        self._receive = receive
        destination = multicast_destination(url)
        problem = multicast_problem(url) if destination else f"{url} has no multicast address; check lcm.url"
        if destination is None or problem:
            raise OutputError(problem, cause="not open")
        try:
            self._socket = _joined_socket(*destination)
        except OSError as error:
            raise OutputError(f"LCM does not open {url}: {error}; check lcm.url", cause="not open") from error

    def handle_timeout(self, timeout_ms: int) -> None:
        """Wait for one datagram, as ``lcm.LCM.handle_timeout`` for a message. Raises OSError."""
        self._socket.settimeout(timeout_ms / 1000)
        try:
            datagram = self._socket.recv(_MAX_DATAGRAM_BYTES)
        except TimeoutError:
            return
        self._receive(*(split_datagram(datagram) or (NO_CHANNEL, b"")))

    def close(self) -> None:
        """Leave the group."""
        self._socket.close()


def _joined_socket(group: str, port: int) -> socket.socket:
    """Return a socket that receives what is sent to a multicast group. Raises OSError."""
    joined = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        joined.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        joined.bind((group, port))
        membership = struct.pack("=4s4s", ipaddress.IPv4Address(group).packed, bytes(4))
        joined.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    except OSError:
        joined.close()
        raise
    return joined
