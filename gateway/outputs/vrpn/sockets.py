"""The server's sockets: one for TCP and one for UDP, on the same address and port."""

import socket
from collections.abc import Sequence
from typing import Any, Final

_BACKLOG: Final = 64
"""How many clients wait in the kernel to be accepted."""


def bind(addresses: Sequence[tuple[Any, ...]], kind: socket.SocketKind) -> socket.socket:
    """Return a socket bound to the first of ``addresses``, which are results of getaddrinfo.

    IPv4 comes first, because libvrpn speaks nothing else. Raises OSError.
    """
    family, _, _, _, address = min(addresses, key=lambda each: each[0] != socket.AF_INET)
    bound = socket.socket(family, kind)
    try:
        bound.setblocking(False)
        if kind is socket.SOCK_STREAM:  # the port may have old connections that are not over yet
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        if kind is socket.SOCK_STREAM:
            bound.listen(_BACKLOG)
    except OSError:
        bound.close()
        raise
    return bound
