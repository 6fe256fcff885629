"""A minimal HTTP/1.1 server for monitoring: GET only, small requests, one per connection.

Pages are built in the event loop, so their counters are consistent with each other. Clients are
untrusted: size, duration and number of requests are bounded.
"""

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Final, NamedTuple

MAX_REQUEST_BYTES: Final = 8192
"""The size limit of a request's head; a connection that exceeds it is closed."""

MAX_CONNECTIONS: Final = 16
"""How many connections may be open; further ones are closed without an answer."""

REQUEST_TIMEOUT_S: Final = 5.0
"""How long a connection may last."""


class Page(NamedTuple):
    """An HTTP response."""

    status: HTTPStatus
    content_type: str
    body: bytes


class HttpPages:
    """Serves ``pages``: a function for each path, called for each request."""

    def __init__(self, pages: Mapping[str, Callable[[], Page]]) -> None:
        self._pages = pages
        self._server: asyncio.Server | None = None
        self._connections: dict[asyncio.Task[None], asyncio.WriteTransport] = {}

    async def start(self, address: str, port: int) -> None:
        """Listen; raises OSError if the address or the port cannot be bound."""
        self._server = await asyncio.start_server(self._serve, address, port, limit=MAX_REQUEST_BYTES)

    async def close(self) -> None:
        """Stop listening and close all connections."""
        if self._server is not None:
            self._server.close()
        # Abort instead of cancelling: before Python 3.12, asyncio's streams log a cancellation as an error.
        for transport in self._connections.values():
            transport.abort()
        await asyncio.gather(*self._connections, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is None or len(self._connections) >= MAX_CONNECTIONS:
            writer.transport.abort()
            return
        self._connections[task] = writer.transport
        try:
            # The client caused these errors; an operator of the gateway can do nothing about them.
            with contextlib.suppress(
                TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError
            ):
                async with asyncio.timeout(REQUEST_TIMEOUT_S):
                    head = await reader.readuntil(b"\r\n\r\n")
                    writer.write(_encode(self._respond(head)))
                    await writer.drain()
                    writer.close()
                    await writer.wait_closed()
        finally:
            writer.transport.abort()
            del self._connections[task]

    def _respond(self, head: bytes) -> Page:
        request = head.split(b"\r\n", 1)[0].decode("latin-1").split(" ")
        if len(request) != 3 or not request[2].startswith("HTTP/1."):
            return _error_page(HTTPStatus.BAD_REQUEST)
        method, target, _ = request
        page = self._pages.get(target.partition("?")[0])
        if page is None:
            paths = "".join(f"{path}\n" for path in self._pages)
            return Page(HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", f"Pages:\n{paths}".encode())
        if method != "GET":
            return _error_page(HTTPStatus.METHOD_NOT_ALLOWED)
        return page()


def _error_page(status: HTTPStatus) -> Page:
    return Page(status, "text/plain; charset=utf-8", f"{status.phrase}; only GET is served\n".encode())


def _encode(page: Page) -> bytes:
    head = (
        f"HTTP/1.1 {page.status} {page.status.phrase}\r\n"
        f"Content-Type: {page.content_type}\r\n"
        f"Content-Length: {len(page.body)}\r\n"
        "Allow: GET\r\n"
        "Cache-Control: no-store\r\n"
        "Connection: close\r\n\r\n"
    )
    return head.encode() + page.body
