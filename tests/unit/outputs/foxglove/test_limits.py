"""What viewers may use up: slow ones, too many, and those that never complete a handshake."""

import asyncio
import json
import logging
import os
import re
import socket
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack, contextmanager

import pytest

from gateway.outputs.foxglove import connections
from gateway.rtc3d.components import ComponentType
from tests.foxglove_viewer import (
    CONTINUATION,
    PING,
    TEXT,
    HandshakeRefusedError,
    Viewer,
    client_frame,
    upgrade_request,
    viewing,
)
from tests.unit.outputs.foxglove.live import LiveSource, frame_of, serving
from tests.waiting import wait_until_async

LARGE = frame_of({ComponentType.MARKERS: [(1, 2, 3, 0)] * 5000})  # 100 kB for a viewer


@contextmanager
def stalled_viewer(port: int) -> Iterator[socket.socket]:
    """A viewer that subscribes to everything and reads nothing."""
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        connection.connect(("127.0.0.1", port))
        connection.sendall(upgrade_request(b"AAAAAAAAAAAAAAAAAAAAAA==", "foxglove.sdk.v1"))
        wanted = [{"id": number, "channelId": number} for number in range(20)]
        connection.sendall(client_frame(json.dumps({"op": "subscribe", "subscriptions": wanted}).encode()))
        yield connection


async def publish_until_lost(lab: LiveSource) -> int:
    """Publish large frames until a viewer loses some; return how many."""
    published = 0

    def is_lost() -> bool:
        nonlocal published
        lab.publish(LARGE)
        published += 1
        return "slow client" in lab.losses

    await wait_until_async(is_lost)
    return published


async def test_a_slow_viewer_loses_messages_which_are_counted_and_another_loses_none(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with serving("lab") as (port, [lab]), viewing(port, "/lab/markers") as viewer:
        await lab.wait_until_wanted()
        with stalled_viewer(port):
            published = await publish_until_lost(lab)
            for _ in range(100):
                lab.publish(LARGE)
            await viewer.wait_for("/lab/markers", published + 100)
            assert len(viewer.received["/lab/markers"]) == published + 100
            messages, frames = lab.losses["slow client"]
            assert messages == frames >= 100
            assert viewer.warnings == []
    [warning] = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert warning.startswith("lab to foxglove: the viewer at 127.0.0.1:")


async def test_a_slow_viewer_is_told_once_and_gets_the_messages_that_found_a_place() -> None:
    async with serving("lab") as (port, [lab]), await Viewer.open(port) as viewer:
        await viewer.wait_until(lambda: viewer.channels)
        viewer.subscribe("/lab/markers")
        await lab.wait_until_wanted()
        viewer.pause()
        published = await publish_until_lost(lab)
        viewer.resume()
        await viewer.wait_until(lambda: viewer.warnings)
        assert viewer.warnings == ["Send buffer limit reached"]  # the words of Foxglove's own bridge
        lost = lab.losses["slow client"][0]
        await viewer.wait_for("/lab/markers", published - lost)
        lab.publish_items(ComponentType.MARKERS, [(1, 2, 3, 0)])
        await viewer.wait_for("/lab/markers", published - lost + 1)
        assert lab.losses["slow client"][0] == lost


async def test_a_viewer_that_reads_nothing_for_long_is_disconnected(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(connections, "MAX_STALL_S", 0.1)
    async with serving("lab") as (port, [lab]):
        with stalled_viewer(port):
            await lab.wait_until_wanted()

            def is_unwanted() -> bool:
                lab.publish(LARGE)
                return not lab.wanted

            await wait_until_async(is_unwanted)
    assert num_logged(caplog, "is disconnected: it has not read what waits for it for 0.1 s") == 1


async def test_a_flood_of_requests_ends_the_connection_and_the_log_says_why(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    async with serving("lab") as (port, _), viewing(port) as hostile:
        hostile.send_bytes(client_frame(b"ping" * 10, 9) * 50_000)
        await hostile.wait_until(lambda: hostile.is_closed)
    assert num_logged(caplog, "is disconnected: it sends more than a viewer does") == 1


async def test_a_request_may_come_in_pieces() -> None:
    async with serving("lab") as (port, [lab]), viewing(port) as viewer:
        number = viewer.channel("/lab/markers")["id"]
        text = json.dumps({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": number}]}).encode()
        first, *others, last = (text[at : at + 1] for at in range(len(text)))
        viewer.send_bytes(piece(first, TEXT, is_last=False))
        for each in others:
            viewer.send_bytes(piece(each, CONTINUATION, is_last=False) + client_frame(b"", PING))
        viewer.send_bytes(piece(last, CONTINUATION, is_last=True))
        await lab.wait_until_wanted()


async def test_a_message_in_too_many_pieces_ends_the_connection(caplog: pytest.LogCaptureFixture) -> None:
    """Each piece needs memory until the message is complete, even if it is empty."""
    caplog.set_level(logging.INFO)
    async with serving("lab") as (port, _), viewing(port) as hostile:
        empty = piece(b"", CONTINUATION, is_last=False)
        hostile.send_bytes(piece(b"", TEXT, is_last=False) + empty * (connections.MAX_FRAGMENTS + 1))
        await hostile.wait_until(lambda: hostile.is_closed)
    assert num_logged(caplog, "is disconnected: it sends a message in more than 1000 pieces") == 1


def piece(data: bytes, opcode: int, *, is_last: bool) -> bytes:
    """Return a frame with a piece of a message (RFC 6455, 5.4)."""
    frame = client_frame(data, opcode)
    return frame if is_last else bytes((frame[0] & 0x7F,)) + frame[1:]


async def test_a_flood_of_empty_frames_ends_the_connection() -> None:
    """They are few bytes, but each costs as much time as a request."""
    async with serving("lab") as (port, _), viewing(port) as hostile:
        hostile.send_bytes(client_frame(b"", PING) * 10_000)
        await hostile.wait_until(lambda: hostile.is_closed)


async def test_thousands_of_subscriptions_may_come_at_once_each_in_a_message() -> None:
    names = [f"lab_{number}" for number in range(200)]
    async with serving(*names) as (port, sources), viewing(port) as viewer:
        await viewer.wait_until(lambda: len(viewer.topics) == 1200)
        for topic in viewer.topics:
            viewer.subscribe(topic)
        await wait_until_async(lambda: all(source.wanted for source in sources))
        assert not viewer.is_closed


def num_logged(caplog: pytest.LogCaptureFixture, text: str) -> int:
    return sum(text in record.getMessage() for record in caplog.records)


async def test_the_output_closes_at_once_although_a_viewer_reads_nothing() -> None:
    async with serving("lab") as (port, [lab]):
        with stalled_viewer(port):
            await lab.wait_until_wanted()
            await publish_until_lost(lab)
            began_s = time.monotonic()
            await asyncio.to_thread(lab.output.close)
            assert time.monotonic() - began_s < 5
            assert not lab.output.health().connected


async def test_one_viewer_too_many_is_refused_with_a_reason(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connections, "MAX_CLIENTS", 3)
    async with serving("lab") as (port, _):
        async with AsyncExitStack() as stack:
            for _ in range(3):
                await stack.enter_async_context(viewing(port))
            with pytest.raises(HandshakeRefusedError, match=r"503(.|\n)*viewers are connected already"):
                await Viewer.open(port)
        async with viewing(port):
            pass
    [warning] = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert re.fullmatch(r"foxglove: 127\.0\.0\.1:\d+ is refused: 3 viewers are connected; .*", warning)


async def test_handshakes_that_are_not_completed_end_in_favour_of_others() -> None:
    async with serving("lab") as (port, _):
        silent = [
            socket.create_connection(("127.0.0.1", port)) for _ in range(connections.MAX_HANDSHAKES + 10)
        ]
        try:
            async with viewing(port):
                pass
            silent[0].settimeout(10)
            assert silent[0].recv(1) == b""
        finally:
            for connection in silent:
                connection.close()


@pytest.mark.parametrize(
    "data",
    [
        client_frame(b'"' + b"x" * connections.MAX_REQUEST_BYTES + b'"'),
        bytes((0x81, 0xFF)) + b"\x7f" + b"\xff" * 7 + bytes(4),  # a frame of 8 EB
        bytes((0x81, 0x05)) + b"plain",  # not masked (RFC 6455, 5.1)
        client_frame(b"\xff\xfe"),  # no UTF-8
        os.urandom(2000),
        client_frame(b"ping" * 10, 9) * 50_000,  # more than a viewer sends
    ],
    ids=["too large", "enormous", "not masked", "no text", "random", "flood"],
)
async def test_a_viewer_that_violates_the_protocol_is_disconnected(
    data: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    async with serving("lab") as (port, [lab]), viewing(port, "/lab/markers") as viewer:
        await lab.wait_until_wanted()
        async with viewing(port, "/lab/markers") as hostile:
            hostile.send_bytes(data)
            await hostile.wait_until(lambda: hostile.is_closed)
        lab.publish_items(ComponentType.MARKERS, [(1, 2, 3, 0)])
        await viewer.wait_for("/lab/markers")
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


async def test_a_flood_of_other_protocols_is_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    async with serving("lab") as (port, _):
        caplog.clear()
        for number in range(50):
            with socket.create_connection(("127.0.0.1", port)) as connection:
                connection.sendall((b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01", os.urandom(100))[number % 3])
        async with viewing(port):
            pass
    assert not caplog.records
