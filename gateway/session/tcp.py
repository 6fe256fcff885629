"""Opens TCP connections to RT servers, and explains failures.

A look-up cannot be cancelled, and without an answer it takes half a minute. So each has a thread, and there
is at most one at a time for a name. asyncio's and uvloop's own look-ups share a few threads.
"""

import asyncio
import contextlib
import ipaddress
import socket
from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from typing import Any, Final

from gateway.config.settings import SourceSettings
from gateway.errors import FILES_ADVICE, NO_FILES, ConnectError
from gateway.runtime.workers import WorkerThread, result_of
from gateway.session.process_clock import RunningTimeout, running_clock

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
        found = _look_ups[host] = WorkerThread(f"look-up {host}").submit(lambda: _get_addresses(host))
    try:
        return await result_of(found)  # others may wait for it, too
    finally:
        if found.done() and _look_ups.get(host) is found:
            del _look_ups[host]


def _get_addresses(host: str) -> list[str]:
    found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    addresses = dict.fromkeys(_text(*address) for *_, address in found)
    return list(addresses)[:MAX_ADDRESSES]


def _text(host: str | int, _port: object = None, _flow: object = 0, scope: object = 0) -> str:
    """Return an address of getaddrinfo as text, with its scope if it has one, for example fe80::1%2."""
    return f"{host}%{scope}" if scope and "%" not in str(host) else str(host)


Connect = Callable[[SourceSettings, Any], Awaitable[asyncio.Transport]]
"""Connects a protocol, an object with the methods of ``asyncio.Protocol``, to a source's server."""


_RECEIVE_BUFFER_BYTES: Final = 16 * 1024 * 1024
"""How much the kernel should be able to hold; it limits this to half of the maximum in tcp_rmem."""


def set_socket_options(connection: socket.socket) -> None:
    """Have the kernel detect a server that has disappeared, and hold what comes while this process stops.

    The kernel's autotuning enlarges a receive buffer only as far as one round trip needs. In a local network
    that is next to nothing: at 2 MB/s it stays at 128 KiB, which holds 50 ms. SO_RCVLOWAT has the kernel make
    room for that many bytes before it wakes the reader. The room stays when the value is reset. SO_RCVBUF
    would be limited to net.core.rmem_max, usually 208 KiB, and switch the autotuning off.
    """
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, _RECEIVE_BUFFER_BYTES)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, 1)


async def open_connection(source: SourceSettings, protocol: Any) -> asyncio.Transport:
    """Connect ``protocol`` to the source's server and return the transport.

    If the host name has several addresses, they are tried in turn, and each gets an equal share of the time
    that is left of ``connect_timeout_s``, so that one that does not answer does not hide the others.
    Raises ConnectError with the reason and what to check.
    """
    clock = running_clock()
    end_s = clock.time() + source.connect_timeout_s
    addresses = await _addresses(source)
    *others, last = addresses
    for number, address in enumerate(others):
        with contextlib.suppress(ConnectError):
            share_s = (end_s - clock.time()) / (len(addresses) - number)
            return await _connect(source, protocol, address, share_s)
    return await _connect(source, protocol, last, end_s - clock.time())


async def _addresses(source: SourceSettings) -> list[str]:
    """Return the addresses of the source's host. Raises ConnectError if they are not found in time."""
    try:
        async with RunningTimeout(source.connect_timeout_s):
            return await look_up(source.host)
    except TimeoutError:
        raise ConnectError(
            f"host name {source.host!r} was not resolved within {source.connect_timeout_s:g} s; "
            "check the name server (DNS), or use an IP address in sources.host"
        ) from None
    except socket.gaierror as error:
        raise ConnectError(
            f"host name {source.host!r} is not known ({error.strerror}); check sources.host and DNS"
        ) from error
    except OSError as error:
        raise ConnectError(
            f"host name {source.host!r} cannot be resolved: {error.strerror or error}; "
            "check the name server (DNS), or use an IP address in sources.host"
        ) from error


_NETWORK_ADVICE: Final = "check address, cable and routing, and whether a firewall rejects the connection"
"""Firewalls that reject give the same errors as a network without a route."""


async def _connect(
    source: SourceSettings, protocol: Any, address: str, timeout_s: float
) -> asyncio.Transport:
    server = f"{source.host}:{source.port}"
    loop = asyncio.get_running_loop()
    try:
        async with RunningTimeout(timeout_s):
            transport, _ = await loop.create_connection(lambda: protocol, address, source.port)
            return transport
    except TimeoutError:
        raise ConnectError(
            f"no answer from {server} within {source.connect_timeout_s:g} s; "
            "is the computer on and reachable, and its firewall open for this port?"
        ) from None
    except ConnectionRefusedError as error:
        raise ConnectError(
            f"connection refused by {server}; is the RT server running, and is this its port?"
        ) from error
    except OSError as error:
        advice = FILES_ADVICE if error.errno in NO_FILES else _NETWORK_ADVICE
        raise ConnectError(f"no connection to {server}: {error.strerror or error}; {advice}") from error
