"""Foxglove's WebSocket protocol: its messages, worked out by hand from its description, and slow viewers."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.frames import OP_BINARY, OP_TEXT, Frame, Opcode

from gateway.errors import QueryError
from gateway.messages.foxglove.topics import FoxgloveTopic
from gateway.outputs.adapters.foxglove import connections
from gateway.outputs.adapters.foxglove.connections import (
    ERROR,
    LIMITS,
    WARNING,
    FoxgloveSubscription,
    FoxgloveViewer,
    advertise,
    channel_text,
    frame_of,
    message_data,
    parse_request,
    server_info,
    status,
    unadvertise,
)


def test_message_data_is_opcode_subscription_and_nanoseconds_little_endian() -> None:
    # 1; 258 = 0x0102; 1 700 000 000 000 001 µs = 1 700 000 000 000 001 000 ns = 0x17979CFE362A03E8.
    head = bytes.fromhex("01 02010000 e8032a36fe9c9717")
    assert message_data(258, 1_700_000_000_000_001, b"data") == head + b"data"


@pytest.mark.parametrize("size", [0, 125, 126, 0xFFFF, 0x10000])
@pytest.mark.parametrize("opcode", [OP_TEXT, OP_BINARY])
def test_frames_are_those_of_websockets(opcode: Opcode, size: int) -> None:
    """At each size from which the length has another form."""
    message = bytes(size)
    expected = Frame(opcode, message).serialize(mask=False)
    assert frame_of(message, is_text=opcode is OP_TEXT) == expected


def test_messages_of_the_server() -> None:
    """Binary schemas are advertised as Base64, and JSON schemas as text."""
    cloud = FoxgloveTopic("/lab/markers", "protobuf", "foxglove.PointCloud", "protobuf", b"\x00\xff\x10")
    text = FoxgloveTopic('/lab/"parameters"', "json", "rtc3d.Parameters", "jsonschema", b'{"type": "object"}')
    keys = ("id", "topic", "encoding", "schemaName", "schemaEncoding", "schema")
    first = (1, "/lab/markers", "protobuf", "foxglove.PointCloud", "protobuf", "AP8Q")
    second = (2, '/lab/"parameters"', "json", "rtc3d.Parameters", "jsonschema", '{"type": "object"}')
    channels = [dict(zip(keys, values, strict=True)) for values in (first, second)]
    info = {"op": "serverInfo", "name": "gateway", "capabilities": [], "sessionId": "17"}
    for message, expected in (
        (server_info("gateway", "17"), info),
        (
            advertise([channel_text(1, cloud), channel_text(2, text)]),
            {"op": "advertise", "channels": channels},
        ),
        (advertise([]), {"op": "advertise", "channels": []}),
        (unadvertise([2, 1]), {"op": "unadvertise", "channelIds": [2, 1]}),
        (status(WARNING, "slow"), {"op": "status", "level": 1, "message": "slow"}),
        (status(ERROR, "no"), {"op": "status", "level": 2, "message": "no"}),
    ):
        assert json.loads(message) == expected


def test_requests_of_viewers() -> None:
    # JavaScript writes 3.0 as 3, but other languages do not.
    subscribe = (
        '{"op":"subscribe","subscriptions":[{"id":0,"channelId":3.0},{"id":4294967295,"channelId":5,"x":1}]}'
    )
    assert parse_request(subscribe) == ([FoxgloveSubscription(0, 3), FoxgloveSubscription(4294967295, 5)], [])
    assert parse_request('{"op":"unsubscribe","subscriptionIds":[1, 2]}') == ([], [1, 2])


def one(subscription: str) -> str:
    return f'{{"op":"subscribe","subscriptions":[{subscription}]}}'


@pytest.mark.parametrize(
    "message",
    [
        *(b"\x01\x00\x00\x00\x00", "", "[", "[" * 100_000, "1" * 5000, "null", "[]"),
        '{"op":"advertise","channels":[]}',
        '{"op":"getParameters","parameterNames":[]}',
        *('{"op":"subscribe"}', '{"op":"subscribe","subscriptions":{}}', one("1"), one('{"id":1}')),
        *(one(f'{{"id":{number},"channelId":1}}') for number in ("true", "-1", "4294967296", '"1"', "1.5")),
        one('{"id":1,"channelId":0.1}'),
        *(f'{{"op":"unsubscribe","subscriptionIds":[{number}]}}' for number in ("null", "NaN", "1e999")),
    ],
)
def test_anything_else_is_refused_with_a_reason(message: str | bytes) -> None:
    with pytest.raises(QueryError, match=r"\w"):
        parse_request(message)


@given(st.lists(st.tuples(st.sampled_from([0, 1, 6, 3600]), st.booleans())))
def test_a_viewer_is_disconnected_after_one_long_stall_and_not_after_many_short_ones(
    steps: list[tuple[int, bool]],
) -> None:
    """Against a plain model: what counts is the time since the first message that found no place."""
    now_s = 1000.0
    stalled_s: float | None = None
    reasons: list[str] = []
    num_expected = 0
    queued: list[bytes] = []
    viewer: Any = SimpleNamespace(
        _max_waiting_bytes=10,
        _stalled_s=None,
        _was_slow=False,
        _limits=replace(LIMITS, unread_s=5.0),
        _queue=queued.append,
        disconnect=reasons.append,
        send_control=lambda _message: None,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(connections, "time", SimpleNamespace(monotonic=lambda: now_s))
        for wait_s, is_full in steps:
            now_s += wait_s
            viewer._waiting_bytes = 11 if is_full else 10
            assert FoxgloveViewer.send_message(viewer, 1, 0, b"") is not is_full
            if not is_full:
                stalled_s = None
            elif stalled_s is None:
                stalled_s = now_s
            num_expected += stalled_s is not None and now_s - stalled_s > 5
            assert len(reasons) == num_expected
    assert len(queued) == sum(not is_full for _, is_full in steps)
