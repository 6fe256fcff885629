"""What viewers may use up: slow ones, too many, and those that never complete a handshake."""

import json
import logging
import socket
from collections.abc import Iterator
from contextlib import AsyncExitStack, ExitStack, contextmanager
from dataclasses import replace

import pytest

from gateway.outputs.adapters.foxglove.connections import LIMITS, MAX_FRAGMENTS, MAX_REQUEST_BYTES
from gateway.rtc3d.components import ComponentType
from tests.support.errors import names
from tests.support.foxglove_viewer import (
    CONTINUATION,
    PING,
    TEXT,
    HandshakeRefusedError,
    Viewer,
    client_frame,
    upgrade_request,
    viewing,
)
from tests.support.records import kinds
from tests.support.waiting import wait_until_async
from tests.unit.outputs.adapters.foxglove.live import LiveSource, frame_of, serving, watching

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


def piece(data: bytes, opcode: int, *, is_last: bool) -> bytes:
    """Return a frame with a piece of a message (RFC 6455, 5.4)."""
    frame = client_frame(data, opcode)
    return frame if is_last else bytes((frame[0] & 0x7F,)) + frame[1:]


def num_logged(caplog: pytest.LogCaptureFixture, text: str) -> int:
    return sum(text in record.getMessage() for record in caplog.records)


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
    async with watching("/lab/markers") as (lab, viewer):
        with stalled_viewer(lab.output.settings.port):
            published = await publish_until_lost(lab)
            for _ in range(100):
                lab.publish(LARGE)
            await viewer.wait_for("/lab/markers", published + 100)
            assert len(viewer.received["/lab/markers"]) == published + 100
            messages, frames = lab.losses["slow client"]
            assert messages == frames >= 100
            assert viewer.warnings == []
    # On a busy computer, the loss may seem to end in between, and is logged again when it goes on.
    assert set(kinds(caplog)) == {("WARNING", "slow client")}


async def test_a_slow_viewer_is_told_once_and_gets_the_messages_that_found_a_place() -> None:
    async with watching("/lab/markers") as (lab, viewer):
        viewer.pause()
        published = await publish_until_lost(lab)
        viewer.resume()
        await viewer.wait_until(lambda: viewer.warnings)
        assert viewer.warnings == ["Send buffer limit reached"]  # the words of Foxglove's own bridge
        lost = lab.losses["slow client"][0]
        await viewer.wait_for("/lab/markers", published - lost)
        lab.publish_items(ComponentType.MARKERS)
        await viewer.wait_for("/lab/markers", published - lost + 1)
        assert lab.losses["slow client"][0] == lost


async def test_a_viewer_that_reads_nothing_for_long_is_disconnected(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    async with serving("lab") as (port, [lab]):
        lab.output._server.clients.limits = replace(LIMITS, unread_s=0.1)
        with stalled_viewer(port):
            await lab.wait_until_wanted()

            def is_unwanted() -> bool:
                lab.publish(LARGE)
                return not lab.wanted

            await wait_until_async(is_unwanted)
    assert num_logged(caplog, "for 0.1 s") == 1


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


async def test_thousands_of_subscriptions_may_come_at_once_each_in_a_message() -> None:
    names = [f"lab_{number}" for number in range(200)]
    async with serving(*names) as (port, sources), viewing(port) as viewer:
        await viewer.wait_until(lambda: len(viewer.topics) == 1200)
        for topic in viewer.topics:
            viewer.subscribe(topic)
        await wait_until_async(lambda: all(source.wanted for source in sources))
        assert not viewer.is_closed


async def test_one_viewer_too_many_is_refused_with_a_reason(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with serving("lab") as (port, [lab]):
        lab.output._server.clients.limits = replace(LIMITS, clients=3)
        async with AsyncExitStack() as stack:
            for _ in range(3):
                await stack.enter_async_context(viewing(port))
            with pytest.raises(HandshakeRefusedError, match="503"):
                await Viewer.open(port)
        async with viewing(port):
            pass
    assert kinds(caplog) == [("WARNING", "refused")]
    assert names(caplog.messages[-1], "foxglove", "127.0.0.1", "3 viewers")


async def test_handshakes_that_are_not_completed_end_in_favour_of_others() -> None:
    async with serving("lab") as (port, _):
        with ExitStack() as stack:
            num_silent = (LIMITS.handshakes or 0) + 10
            silent = [
                stack.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(num_silent)
            ]
            async with viewing(port):
                pass
            silent[0].settimeout(10)
            assert silent[0].recv(1) == b""


EMPTY = piece(b"", CONTINUATION, is_last=False)


@pytest.mark.parametrize(
    ("data", "text"),
    [
        pytest.param(
            client_frame(b"ping" * 10, PING) * 50_000,
            "sends more",
            id="flood",
        ),
        pytest.param(
            client_frame(b"", PING) * 10_000,
            "sends more",
            id="flood of empty frames",
        ),
        pytest.param(
            piece(b"", TEXT, is_last=False) + EMPTY * (MAX_FRAGMENTS + 1),
            "1000 pieces",
            id="pieces",  # each needs memory until the message is complete, even if it is empty
        ),
        pytest.param(client_frame(b'"' + b"x" * MAX_REQUEST_BYTES + b'"'), "", id="too large"),
        pytest.param(bytes((0x81, 0xFF)) + b"\x7f" + b"\xff" * 7 + bytes(4), "", id="8 EB"),
        pytest.param(bytes((0x81, 0x05)) + b"plain", "", id="not masked (RFC 6455, 5.1)"),
        pytest.param(client_frame(b"\xff\xfe"), "", id="no UTF-8"),
        pytest.param(b"\xf3\x85" + bytes(9), "", id="reserved bits and opcode (RFC 6455, 5.2)"),
    ],
)
async def test_a_viewer_that_violates_the_protocol_is_disconnected(
    data: bytes, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Another one goes on, and the log says why, if that helps."""
    caplog.set_level(logging.INFO)
    async with watching("/lab/markers") as (lab, viewer):
        async with viewing(lab.output.settings.port, "/lab/markers") as hostile:
            hostile.send_bytes(data)
            await hostile.wait_until(lambda: hostile.is_closed)
        lab.publish_items(ComponentType.MARKERS)
        await viewer.wait_for("/lab/markers")
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert not text or num_logged(caplog, text) == 1
