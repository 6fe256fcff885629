"""Opens TCP connections to RT servers, and explains failures."""

import asyncio
import socket
from collections.abc import Awaitable, Callable
from typing import Any

from gateway.config.settings import SourceSettings
from gateway.errors import ConnectError
from gateway.stream.running_time import running_timeout

Connect = Callable[[SourceSettings, Any], Awaitable[asyncio.Transport]]
"""Connects a protocol, an object with the methods of ``asyncio.Protocol``, to a source's server."""


async def open_connection(source: SourceSettings, protocol: Any) -> asyncio.Transport:
    """Connect ``protocol`` to the source's server and return the transport.

    Raises ConnectError with the reason and what to check.
    """
    server = f"{source.host}:{source.port}"
    loop = asyncio.get_running_loop()
    try:
        async with running_timeout(source.connect_timeout_s):
            # uvloop cannot cancel a look-up: it logs a late failure as an error, and the next look-up waits
            # for it. So a thread looks the name up first; create_connection then does so again.
            await asyncio.to_thread(socket.getaddrinfo, source.host, source.port)
            transport, _ = await loop.create_connection(lambda: protocol, source.host, source.port)
            return transport
    except TimeoutError:
        raise ConnectError(
            f"no answer from {server} within {source.connect_timeout_s:g} s; "
            "is the computer on and reachable, and its firewall open for this port?"
        ) from None
    except socket.gaierror as error:
        raise ConnectError(
            f"host name {source.host!r} is not known ({error.strerror}); check sources.host and DNS"
        ) from error
    except ConnectionRefusedError as error:
        raise ConnectError(
            f"connection refused by {server}; is the RT server running, and is this its port?"
        ) from error
    except OSError as error:
        raise ConnectError(
            f"no connection to {server}: {error.strerror or error}; check address, cable and routing"
        ) from error
