"""A minimal HTTP/1.1 server for monitoring: GET and HEAD, small requests, one per connection.

Pages are built in the event loop, so their counters are consistent with each other. Clients are
untrusted: size, duration and number of connections are bounded, and so is how often a page is built.
"""

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from typing import Final, NamedTuple

from gateway.log import DefectLog
from gateway.outputs.listen_address import foreign_request

logger = logging.getLogger(__name__)

MAX_REQUEST_BYTES: Final = 8192
"""The size limit of a request's head; a connection that exceeds it is closed."""

MAX_CONNECTIONS: Final = 128
"""How many connections may be open; one more disconnects the oldest, which has had the most time."""

REQUEST_TIMEOUT_S: Final = 5.0
"""How long a connection may last."""

MAX_PAGE_AGE_S: Final = 0.1
"""How long a page is served again: building it takes the event loop some ms, however many clients ask."""

_MAX_DISCARDED_BYTES: Final = 65536
"""How much to read after the request, such as the body of a POST; more is reset."""


class Page(NamedTuple):
    """An HTTP response."""

    status: HTTPStatus
    content_type: str
    body: bytes


class HttpPages:
    """Serves ``pages``: a function for each path, called for each request.

    ``host`` is the name or address to listen on, as configured: requests for other names are refused.
    """

    def __init__(self, pages: Mapping[str, Callable[[], Page]], host: str = "127.0.0.1") -> None:
        self._pages = pages
        self._host = host
        self._has_refused = False
        self._server: asyncio.Server | None = None
        self._built: dict[str, tuple[float, Page]] = {}
        """The newest page of each path, and when it was built, on the monotonic clock in s."""
        self._defects = DefectLog(logger, "metrics")
        self._connections: dict[asyncio.Task[None], asyncio.WriteTransport] = {}
        """The open connections, oldest first."""

    async def start(self, addresses: Sequence[str], port: int) -> None:
        """Listen on IP addresses; raises OSError if one of them or the port cannot be bound."""
        self._server = await asyncio.start_server(self._serve, addresses, port, limit=MAX_REQUEST_BYTES)

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
        if task is None:
            return
        if len(self._connections) >= MAX_CONNECTIONS:
            oldest = next(iter(self._connections))
            self._connections.pop(oldest).abort()
        self._connections[task] = writer.transport
        try:
            # The client caused these errors; an operator of the gateway can do nothing about them.
            with contextlib.suppress(
                TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError
            ):
                async with asyncio.timeout(REQUEST_TIMEOUT_S):
                    head = await reader.readuntil(b"\r\n\r\n")
                    writer.write(self._response(head))
                    await writer.drain()
                    writer.write_eof()
                    # If bytes are unread, closing resets the connection, and the client may lose the page.
                    discarded = 0
                    while discarded < _MAX_DISCARDED_BYTES and (data := await reader.read(4096)):
                        discarded += len(data)
        finally:
            writer.transport.abort()
            self._connections.pop(task, None)

    def _response(self, head: bytes) -> bytes:
        method = head.partition(b" ")[0]
        page = self._respond(head)
        return _head(page) + (b"" if method == b"HEAD" else page.body)

    def _respond(self, head: bytes) -> Page:
        request = head.split(b"\r\n", 1)[0].decode("latin-1").split(" ")
        if len(request) != 3 or not request[2].startswith("HTTP/1."):
            return _error_page(HTTPStatus.BAD_REQUEST)
        refusal = foreign_request(self._host, _header(head, b"host"), _header(head, b"origin"))
        if refusal:
            self._log_refusal(refusal)
            return _error_page(HTTPStatus.FORBIDDEN, refusal)
        method, target, _ = request
        path = target.partition("?")[0]
        if path not in self._pages:
            paths = "".join(f"{path}\n" for path in self._pages)
            return Page(HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", f"Pages:\n{paths}".encode())
        if method not in {"GET", "HEAD"}:
            return _error_page(HTTPStatus.METHOD_NOT_ALLOWED)
        return self._page(path)

    def _log_refusal(self, refusal: str) -> None:
        if not self._has_refused:
            self._has_refused = True
            logger.warning("metrics: a request was refused: %s", refusal)

    def _page(self, path: str) -> Page:
        """Return the page, built at most MAX_PAGE_AGE_S ago."""
        now_s = time.monotonic()
        built_s, page = self._built.get(path, (-math.inf, None))
        if page is None or now_s - built_s > MAX_PAGE_AGE_S:
            try:
                page = self._pages[path]()
            except Exception as defect:  # noqa: BLE001 - the client gets an error page
                text = f"defect in the gateway: no page {path}; report this with the log"
                self._defects.log(defect, text)
                page = _error_page(HTTPStatus.INTERNAL_SERVER_ERROR, "see the log")
            self._built[path] = now_s, page
        return page


def _header(head: bytes, name: bytes) -> list[str]:
    """Return the values of a header, whose name is in lower case."""
    fields = (line.partition(b":") for line in head.split(b"\r\n")[1:])
    return [value.strip().decode("latin-1") for key, _, value in fields if key.strip().lower() == name]


def _error_page(status: HTTPStatus, reason: str = "only GET and HEAD are served") -> Page:
    return Page(status, "text/plain; charset=utf-8", f"{status.phrase}; {reason}\n".encode())


def _head(page: Page) -> bytes:
    return (
        f"HTTP/1.1 {page.status} {page.status.phrase}\r\n"
        f"Content-Type: {page.content_type}\r\n"
        f"Content-Length: {len(page.body)}\r\n"
        "Allow: GET, HEAD\r\n"
        "Cache-Control: no-store\r\n"
        "Connection: close\r\n\r\n"
    ).encode()
