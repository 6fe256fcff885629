"""A few pages over HTTP/1.1 for programs that watch: GET alone, small requests, one per connection.

It runs in the event loop, so that a page is made of counters that agree with each other. Whoever may
connect may be hostile: how long, how large and how many requests are is bounded.
"""

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Final, NamedTuple

MAX_REQUEST_BYTES: Final = 8192
"""Of a request's head; who sends more is cut off."""

MAX_CONNECTIONS: Final = 16
"""At once; the next is closed unanswered."""

REQUEST_S: Final = 5.0
"""How long a connection may last."""


class Page(NamedTuple):
    """An answer."""

    status: HTTPStatus
    content_type: str
    body: bytes


class HttpPages:
    """Serves ``pages``, made anew for each request, by their paths."""

    def __init__(self, pages: Mapping[str, Callable[[], Page]]) -> None:
        self._pages = pages
        self._server: asyncio.Server | None = None
        self._connections: dict[asyncio.Task[None], asyncio.WriteTransport] = {}

    async def start(self, address: str, port: int) -> None:
        """Listen; raises OSError if that address or port is not to be had."""
        self._server = await asyncio.start_server(self._serve, address, port, limit=MAX_REQUEST_BYTES)

    async def close(self) -> None:
        """Stop listening, and cut off who is connected."""
        if self._server is not None:
            self._server.close()
        # Not cancelled: asyncio's streams log that as an error (before Python 3.12).
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
            # Whatever goes wrong here is the other side's affair, and nobody is there to be told.
            with contextlib.suppress(
                TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError
            ):
                async with asyncio.timeout(REQUEST_S):
                    head = await reader.readuntil(b"\r\n\r\n")
                    writer.write(_encoded(self._answer(head)))
                    await writer.drain()
                    writer.close()
                    await writer.wait_closed()
        finally:
            writer.transport.abort()
            del self._connections[task]

    def _answer(self, head: bytes) -> Page:
        request = head.split(b"\r\n", 1)[0].decode("latin-1").split(" ")
        if len(request) != 3 or not request[2].startswith("HTTP/1."):
            return _refusal(HTTPStatus.BAD_REQUEST)
        method, target, _ = request
        page = self._pages.get(target.partition("?")[0])
        if page is None:
            known = "".join(f"{path}\n" for path in self._pages)
            return Page(HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", f"There is:\n{known}".encode())
        if method != "GET":
            return _refusal(HTTPStatus.METHOD_NOT_ALLOWED)
        return page()


def _refusal(status: HTTPStatus) -> Page:
    return Page(status, "text/plain; charset=utf-8", f"{status.phrase}; only GET is served\n".encode())


def _encoded(page: Page) -> bytes:
    head = (
        f"HTTP/1.1 {page.status} {page.status.phrase}\r\n"
        f"Content-Type: {page.content_type}\r\n"
        f"Content-Length: {len(page.body)}\r\n"
        "Allow: GET\r\n"
        "Cache-Control: no-store\r\n"
        "Connection: close\r\n\r\n"
    )
    return head.encode() + page.body
