"""HTTP pages over real sockets, with well-behaved and with hostile clients."""

import asyncio
import contextlib
import errno
import os
import socket
from collections.abc import AsyncIterator
from dataclasses import replace
from http import HTTPStatus
from typing import Any

import pytest
import pytest_asyncio

from gateway.daemon.monitoring import http_pages
from gateway.daemon.monitoring.http_pages import LIMITS, MAX_REQUEST_BYTES, HttpPages, Page
from tests.support.networks import free_port
from tests.support.waiting import wait_until_async


class Site:
    """Pages on a local port; ``served`` counts the calls of the page's function."""

    def __init__(self) -> None:
        self.port = free_port()
        self.served = 0
        self.pages = HttpPages({"/page": self._page, "/defect": self._defect})

    def _page(self) -> Page:
        self.served += 1
        return Page(HTTPStatus.OK, "text/plain; charset=utf-8", "µ\n".encode())

    def _defect(self) -> Page:
        raise ZeroDivisionError

    async def connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.open_connection("127.0.0.1", self.port)

    async def send(self, request: bytes) -> bytes:
        """Return everything that is received until the server closes the connection."""
        reader, writer = await self.connect()
        try:
            writer.write(request)
            async with asyncio.timeout(120):
                return await reader.read()
        except ConnectionError:
            return b""
        finally:
            writer.close()


@pytest_asyncio.fixture
async def site() -> AsyncIterator[Site]:
    site = Site()
    await site.pages.start(["127.0.0.1"], site.port)
    yield site
    await site.pages.close()


def status_of(answer: bytes) -> int:
    assert answer.startswith(b"HTTP/1.1 ")
    return int(answer.split()[1])


async def test_a_page_is_built_once_for_requests_that_follow_each_other(site: Site) -> None:
    await site.send(b"GET /page HTTP/1.1\r\n\r\n")
    answer = await site.send(b"GET /page HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert answer.decode() == (
        "HTTP/1.1 200 OK\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: 3\r\n"
        "Allow: GET, HEAD\r\nCache-Control: no-store\r\nConnection: close\r\n\r\nµ\n"
    )
    assert site.served == 1


async def test_a_page_is_built_again_once_it_is_old(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_pages, "MAX_PAGE_AGE_S", 0)
    for _ in range(2):
        assert status_of(await site.send(b"GET /page HTTP/1.1\r\nHost: localhost\r\n\r\n")) == 200
    assert site.served == 2


@pytest.mark.parametrize("path", [b"/page", b"/", b"/unknown"])
async def test_head_has_the_head_of_get_and_no_body(site: Site, path: bytes) -> None:
    head, separator, body = (await site.send(b"GET " + path + b" HTTP/1.1\r\n\r\n")).partition(b"\r\n\r\n")
    assert f"Content-Length: {len(body)}".encode() in head
    assert await site.send(b"HEAD " + path + b" HTTP/1.1\r\n\r\n") == head + separator


async def test_further_requests_and_a_body_do_not_reset_the_answer(site: Site) -> None:
    requests = b"GET /page HTTP/1.1\r\n\r\n" * 100
    assert (await site.send(requests)).endswith("\r\n\r\nµ\n".encode())
    post = b"POST /page HTTP/1.1\r\nContent-Length: 50000\r\n\r\n" + b"x" * 50_000
    assert status_of(await site.send(post)) == 405


async def test_a_request_may_arrive_in_pieces_and_have_a_query_string(site: Site) -> None:
    reader, writer = await site.connect()
    for piece in (b"GET /page?x=", b"1 HTTP/1.0\r\n", b"\r", b"\n"):
        writer.write(piece)
        await writer.drain()
        await asyncio.sleep(0)
    assert status_of(await reader.read()) == 200
    writer.close()


@pytest.mark.parametrize(
    ("status", "request_lines"),
    [
        (404, [b"GET / HTTP/1.1", b"GET /pages HTTP/1.1", b"HEAD /pages HTTP/1.1"]),
        (405, [b"POST /page HTTP/1.1", b"get /page HTTP/1.1"]),
        (400, [b"GET /page", b"GET /page HTTP/2", b"GET  /page HTTP/1.1", b"\x16\x03\x01\x02\x00", b""]),
    ],
)
async def test_other_requests_get_an_error(site: Site, status: int, request_lines: list[bytes]) -> None:
    """The request that begins with 16 hexadecimal is one of TLS."""
    for line in request_lines:
        assert status_of(await site.send(line + b"\r\n\r\n")) == status, line
    assert site.served == 0
    assert b"/page\n" in await site.send(b"GET / HTTP/1.1\r\n\r\n")


async def test_a_request_that_is_too_large_or_never_ends_is_disconnected(site: Site) -> None:
    assert await site.send(b"GET /page HTTP/1.1\r\nX: " + b"x" * (MAX_REQUEST_BYTES + 1)) == b""
    assert await site.send(b"x" * 1_000_000) == b""
    site.pages._connections.limits = replace(LIMITS, handshake_s=0.05)
    assert await site.send(b"GET /page HTTP/1.1\r\n") == b""


async def test_one_connection_too_many_disconnects_the_oldest(site: Site) -> None:
    connections = [await site.connect() for _ in range(LIMITS.clients + 10)]
    assert status_of(await site.send(b"GET /page HTTP/1.1\r\nHost: localhost\r\n\r\n")) == 200
    assert len(site.pages._connections) <= LIMITS.clients
    for reader, _ in connections[:10]:
        with contextlib.suppress(ConnectionError):
            assert await reader.read() == b""
    newest_reader, newest_writer = connections[-1]
    newest_writer.write(b"GET /page HTTP/1.1\r\n\r\n")
    assert status_of(await newest_reader.read()) == 200
    for _, writer in connections:
        writer.close()


async def test_a_client_that_disconnects_early_is_not_an_error(
    site: Site, caplog: pytest.LogCaptureFixture
) -> None:
    _, writer = await site.connect()
    writer.write(b"GET /pa")
    writer.transport.abort()
    assert status_of(await site.send(b"GET /page HTTP/1.1\r\nHost: localhost\r\n\r\n")) == 200
    assert not caplog.records


async def test_an_exception_in_a_page_is_logged_once_and_ends_only_that_request(
    site: Site, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http_pages, "MAX_PAGE_AGE_S", 0)
    for _ in range(3):
        assert status_of(await site.send(b"GET /defect HTTP/1.1\r\n\r\n")) == 500
    assert len(caplog.records) == 1
    assert status_of(await site.send(b"GET /page HTTP/1.1\r\nHost: localhost\r\n\r\n")) == 200


class WithoutFiles:
    """A listening socket for which the process has no file descriptor the first few times."""

    def __init__(self, listening: socket.socket, num_failures: int) -> None:
        self._listening = listening
        self.num_failures = num_failures

    def fileno(self) -> int:
        return self._listening.fileno()

    def close(self) -> None:
        self._listening.close()

    def accept(self) -> tuple[socket.socket, Any]:
        if self.num_failures:
            self.num_failures -= 1
            raise OSError(errno.EMFILE, "Too many open files")
        return self._listening.accept()


async def test_requests_are_answered_again_once_there_are_file_descriptors(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever looks at /healthz because of that must not have to restart the gateway."""
    monkeypatch.setattr(http_pages, "_ACCEPT_PAUSE_S", 0.0)
    monkeypatch.setattr(http_pages, "_RESERVED_FILES", 0)
    [real] = site.pages._listening
    while site.pages._reserved:
        os.close(site.pages._reserved.pop())
    asyncio.get_running_loop().remove_reader(real)
    listening: Any = WithoutFiles(real, 3)
    site.pages._listening = [listening]
    site.pages._resume(listening)
    assert status_of(await site.send(b"GET /page HTTP/1.1\r\nHost: localhost\r\n\r\n")) == 200
    assert listening.num_failures == 0


async def test_closing_disconnects_clients_and_frees_the_port(site: Site) -> None:
    again = HttpPages({})
    with pytest.raises(OSError, match="Address already in use"):
        await again.start(["127.0.0.1"], site.port)
    reader, writer = await site.connect()
    await wait_until_async(lambda: site.pages._connections)
    await site.pages.close()
    async with asyncio.timeout(120):
        assert await reader.read() == b""
    writer.close()
    await again.start(["127.0.0.1"], site.port)
    await again.close()


async def test_requests_of_foreign_sites_are_refused_and_logged_once(
    site: Site, caplog: pytest.LogCaptureFixture
) -> None:
    """A web page could read the metrics otherwise, by DNS rebinding or from another origin."""
    for field in (
        b"Host: evil.example",
        b"host:evil.example:9464",
        b"Host: localhost\r\nOrigin: http://evil.example",
    ):
        answer = await site.send(b"GET /page HTTP/1.1\r\n" + field + b"\r\n\r\n")
        assert status_of(answer) == 403
        assert b"evil.example" in answer
    assert site.served == 0
    assert len(caplog.records) == 1
    for field in (b"Host: 127.0.0.1:9464", b"Host: localhost\r\nOrigin: http://localhost"):
        assert status_of(await site.send(b"GET /page HTTP/1.1\r\n" + field + b"\r\n\r\n")) == 200
