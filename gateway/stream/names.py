"""Looking up host names, so that a name server that does not answer delays nobody else.

A look-up cannot be cancelled, and without an answer it takes half a minute. So each has a thread, and there
is at most one at a time for a name. asyncio's and uvloop's own look-ups share a few threads.
"""

import ipaddress
import socket
from concurrent.futures import Future
from typing import Final

from gateway.worker_thread import WorkerThread, result_of

MAX_ADDRESSES: Final = 8
"""How many addresses of a name are tried."""

_look_ups: Final[dict[str, Future[list[str]]]] = {}
"""By name: those that run, and those that ended after all who waited for them had given up."""


def is_address(host: str) -> bool:
    """Return whether ``host`` is a number: an IPv4 address, or an IPv6 address with or without a scope."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


async def look_up(host: str) -> list[str]:
    """Return the addresses of ``host``, at most MAX_ADDRESSES, in the order in which to try them.

    An address is returned as it is. Callers limit the time: an answer that comes later is kept for the next
    call. Raises OSError, which is gaierror if the name is not known.
    """
    if is_address(host):
        return [host]
    found = _look_ups.get(host)
    if found is None:
        found = _look_ups[host] = WorkerThread(f"look-up {host}").submit(lambda: _addresses(host))
    try:
        return await result_of(found)  # others may wait for it, too
    finally:
        if found.done() and _look_ups.get(host) is found:
            del _look_ups[host]


def _addresses(host: str) -> list[str]:
    found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    addresses = dict.fromkeys(_text(*address) for *_, address in found)
    return list(addresses)[:MAX_ADDRESSES]


def _text(host: str | int, _port: object = None, _flow: object = 0, scope: object = 0) -> str:
    """Return an address of getaddrinfo as text, with its scope if it has one, for example fe80::1%2."""
    return f"{host}%{scope}" if scope and "%" not in str(host) else str(host)
