"""A minimal HTTP/1.1 server for monitoring: GET and HEAD, small requests, one per connection.

Pages are built in the event loop, so their counters are consistent with each other. Clients are
untrusted: size, duration and number of connections are bounded, and so is how often a page is built.
"""

import asyncio
import contextlib
import functools
import logging
import math
import os
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from typing import Final, NamedTuple

from gateway.errors import NO_FILES
from gateway.outputs.listen_address import foreign_request
from gateway.runtime.failures import DefectLog
from gateway.runtime.server_limits import Clients, ServerLimits

logger = logging.getLogger(__name__)

MAX_REQUEST_BYTES: Final = 8192
"""The size limit of a request's head; a connection that exceeds it is closed."""

LIMITS: Final = ServerLimits(clients=128)
"""A connection counts as in the handshake until it ends: one too many disconnects the oldest."""

MAX_PAGE_AGE_S: Final = 0.1
"""How long a page is served again: building it takes the event loop some ms, however many clients ask."""

_RESERVED_FILES: Final = 8
"""How many connections are served when the process has no file descriptor left, to say so."""

_ACCEPT_PAUSE_S: Final = 0.1
"""How long connections wait in the kernel when none can be accepted."""

_BACKLOG: Final = 100

_MAX_DISCARDED_BYTES: Final = 65536
"""How much to read after the request, such as the body of a POST; more is reset."""


_TEXT: Final = "text/plain; charset=utf-8"


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
        self._listening: list[socket.socket] = []
        self._reserved: list[int] = []
        """File descriptors for when no other is left."""
        self._host = host
        self._has_refused = False
        self._built: dict[str, tuple[float, Page]] = {}
        """The newest page of each path, and when it was built, on the monotonic clock in s."""
        self._defects = DefectLog(logger, "metrics")
        self._connections: Clients[asyncio.Task[None]] = Clients(LIMITS, asyncio.Task.cancel)

    async def start(self, addresses: Sequence[str], port: int) -> None:
        """Listen on IP addresses; raises OSError if one of them or the port cannot be bound."""
        try:
            for address in addresses:
                family = socket.AF_INET6 if ":" in address else socket.AF_INET
                server = socket.create_server((address, port), family=family, backlog=_BACKLOG)
                server.setblocking(False)
                self._listening.append(server)
        except OSError:
            await self.close()
            raise
        self._reserve_files()
        for listening in self._listening:
            self._resume(listening)

    async def close(self) -> None:
        """Stop listening and close all connections."""
        listening, self._listening = self._listening, []
        for each in listening:
            asyncio.get_running_loop().remove_reader(each)
            each.close()
        for task in self._connections:
            task.cancel()
        await asyncio.gather(*self._connections, return_exceptions=True)
        while self._reserved:
            os.close(self._reserved.pop())

    def _reserve_files(self) -> None:
        """Reserve as many file descriptors as are missing, if the system allows it."""
        with contextlib.suppress(OSError):
            while len(self._reserved) < _RESERVED_FILES:
                self._reserved.append(os.open(os.devnull, os.O_RDONLY))

    # There is no asyncio.Server: if the process has no file descriptor left, uvloop's closes connections
    # without a word, although /healthz is wanted most then.

    def _resume(self, listening: socket.socket) -> None:
        if listening in self._listening:
            asyncio.get_running_loop().add_reader(listening, self._accept, listening)

    def _accept(self, listening: socket.socket) -> None:
        """Accept a connection, with a reserved file descriptor if no other is left.

        If that is not possible, disconnect the oldest one and wait for a moment.
        """
        loop = asyncio.get_running_loop()
        self._reserve_files()
        try:
            try:
                connection, _ = listening.accept()
            except OSError as error:
                if error.errno not in NO_FILES or not self._reserved:
                    raise
                os.close(self._reserved.pop())
                connection, _ = listening.accept()
        except OSError as error:
            if error.errno in NO_FILES:
                self._connections.disconnect_oldest()
                loop.remove_reader(listening)
                loop.call_later(_ACCEPT_PAUSE_S, self._resume, listening)
            return
        task = loop.create_task(self._serve(connection))
        self._connections.open(task)
        task.add_done_callback(functools.partial(self._end, connection))

    def _end(self, connection: socket.socket, task: asyncio.Task[None]) -> None:
        connection.close()
        self._connections.close(task)
        self._reserve_files()
        if not task.cancelled() and (defect := task.exception()) is not None:
            self._defects.log(defect)

    async def _serve(self, connection: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        connection.setblocking(False)
        reader = asyncio.StreamReader(MAX_REQUEST_BYTES, loop)
        protocol = asyncio.StreamReaderProtocol(reader, loop=loop)
        # The client caused these errors; an operator of the gateway can do nothing about them.
        with contextlib.suppress(
            TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError
        ):
            transport, _ = await loop.connect_accepted_socket(lambda: protocol, connection)
            writer = asyncio.StreamWriter(transport, protocol, reader, loop)
            try:
                async with asyncio.timeout(self._connections.limits.handshake_s):
                    head = await reader.readuntil(b"\r\n\r\n")
                    writer.write(self._response(head))
                    await writer.drain()
                    writer.write_eof()
                    # If bytes are unread, closing resets the connection, and the client may lose the page.
                    discarded = 0
                    while discarded < _MAX_DISCARDED_BYTES and (data := await reader.read(4096)):
                        discarded += len(data)
            finally:
                transport.abort()

    def _response(self, head: bytes) -> bytes:
        """Return the response to the request with this head."""
        page = self._page_for(head)
        fields = (
            f"HTTP/1.1 {page.status} {page.status.phrase}\r\n"
            f"Content-Type: {page.content_type}\r\n"
            f"Content-Length: {len(page.body)}\r\n"
            "Allow: GET, HEAD\r\n"
            "Cache-Control: no-store\r\n"
            "Connection: close\r\n\r\n"
        )
        return fields.encode() + (b"" if head.startswith(b"HEAD ") else page.body)

    def _page_for(self, head: bytes) -> Page:
        """Return the page that a request wants, built at most MAX_PAGE_AGE_S ago, or an error page."""
        first, *lines = head.split(b"\r\n")
        request = first.decode("latin-1").split(" ")
        if len(request) != 3 or not request[2].startswith("HTTP/1."):
            return _error_page(HTTPStatus.BAD_REQUEST)
        fields: dict[bytes, list[str]] = {}
        for line in lines:
            name, _, value = line.partition(b":")
            fields.setdefault(name.strip().lower(), []).append(value.strip().decode("latin-1"))
        refusal = foreign_request(self._host, fields.get(b"host", []), fields.get(b"origin", []))
        if refusal:
            self._log_refusal(refusal)
            return _error_page(HTTPStatus.FORBIDDEN, refusal)
        method, target, _ = request
        path = target.partition("?")[0]
        if path not in self._pages:
            paths = "".join(f"{path}\n" for path in self._pages)
            return Page(HTTPStatus.NOT_FOUND, _TEXT, f"Pages:\n{paths}".encode())
        if method not in {"GET", "HEAD"}:
            return _error_page(HTTPStatus.METHOD_NOT_ALLOWED)
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

    def _log_refusal(self, refusal: str) -> None:
        if not self._has_refused:
            self._has_refused = True
            logger.warning("metrics: a request was refused: %s", refusal)


def _error_page(status: HTTPStatus, reason: str = "only GET and HEAD are served") -> Page:
    return Page(status, _TEXT, f"{status.phrase}; {reason}\n".encode())
