"""The connections of viewers, with limits on what they can use up: clients are not trusted.

The protocol is described in the repository foxglove/ws-protocol (docs/spec.md). Its two names mean the same:
clients made before 2026, such as Lichtblick 1.21, know the first one only, and newer ones the second.
"""

import base64
import json
import logging
import struct
import time
from collections.abc import Iterable
from typing import Any, Final, NamedTuple

from websockets.asyncio.server import ServerConnection
from websockets.frames import DATA_OPCODES, Frame
from websockets.protocol import OPEN

from gateway.errors import QueryError
from gateway.messages.decode import json_text
from gateway.messages.foxglove.topics import FoxgloveTopic
from gateway.outputs.listen_address import host_in_url
from gateway.runtime.failures import EventLog
from gateway.runtime.server_limits import Clients, ServerLimits

SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")

_MESSAGE_DATA: Final = struct.Struct("<BIQ")
"""Opcode, id of the subscription, time in ns since 1970; the message follows."""

_MESSAGE_DATA_OPCODE: Final = 1

_TEXT_FRAME: Final = 0x81
_BINARY_FRAME: Final = 0x82
"""The first byte of a frame with a whole message."""

_SIZE_IN_16_BITS: Final = 126
_SIZE_IN_64_BITS: Final = 127
"""In place of a size from 126 bytes, which follows."""

_FRAME_16: Final = struct.Struct("!BBH")
_FRAME_64: Final = struct.Struct("!BBQ")
_MAX_ID: Final = (1 << 32) - 1
WARNING: Final = 1
ERROR: Final = 2
"""The levels of messages that the viewer shows."""


class FoxgloveSubscription(NamedTuple):
    """The client chooses ``number``; the messages on ``channel`` have it."""

    number: int
    channel: int


def server_info(name: str, session: str) -> str:
    """Return the first message to a client. With another ``session``, it forgets all earlier messages."""
    return json_text({"op": "serverInfo", "name": name, "capabilities": [], "sessionId": session})


def channel_text(number: int, topic: FoxgloveTopic) -> str:
    """Return a channel for ``advertise``."""
    is_text = topic.schema_encoding in {"jsonschema", "ros2msg"}
    return json_text(
        {
            "id": number,
            "topic": topic.name,
            "encoding": topic.encoding,
            "schemaName": topic.schema_name,
            "schemaEncoding": topic.schema_encoding,
            "schema": topic.schema.decode() if is_text else base64.b64encode(topic.schema).decode(),
        }
    )


def advertise(channels: Iterable[str]) -> str:
    """Return the message that announces channels, which ``channel_text`` has made."""
    return f'{{"op":"advertise","channels":[{",".join(channels)}]}}'


def unadvertise(numbers: list[int]) -> str:
    """Return the message that withdraws channels."""
    return json_text({"op": "unadvertise", "channelIds": numbers})


def status(level: int, text: str) -> str:
    """Return the message that shows a text in the viewer, as a WARNING or an ERROR."""
    return json_text({"op": "status", "level": level, "message": text})


def message_data(subscription: int, utime: int, data: bytes) -> bytes:
    """Return a message of a channel; ``utime`` is in µs since 1970."""
    return _MESSAGE_DATA.pack(_MESSAGE_DATA_OPCODE, subscription, utime * 1000) + data


def frame_of(message: bytes, *, is_text: bool) -> bytes:
    """Return the frame of WebSocket with a whole message (RFC 6455, 5.2).

    websockets makes the same frame, but in five times the time.
    """
    first = _TEXT_FRAME if is_text else _BINARY_FRAME
    size = len(message)
    if size < _SIZE_IN_16_BITS:
        return b"%c%c%b" % (first, size, message)
    if size < 1 << 16:
        return _FRAME_16.pack(first, _SIZE_IN_16_BITS, size) + message
    return _FRAME_64.pack(first, _SIZE_IN_64_BITS, size) + message


def parse_request(message: str | bytes) -> tuple[list[FoxgloveSubscription], list[int]]:
    """Return which subscriptions a client begins, and the numbers of those that it ends.

    Raises QueryError for anything but subscriptions: the server announces no other capability.
    """
    if isinstance(message, bytes):
        raise QueryError("binary messages are not accepted")
    try:
        content = json.loads(message)
    except (ValueError, RecursionError):
        raise QueryError("a message is not JSON") from None
    match content:
        case {"op": "subscribe", "subscriptions": list(subscriptions)}:
            return [_subscription(found) for found in subscriptions], []
        case {"op": "unsubscribe", "subscriptionIds": list(numbers)}:
            return [], [_number(number) for number in numbers]
    raise QueryError("only subscribe and unsubscribe are served")


def _subscription(content: Any) -> FoxgloveSubscription:
    match content:
        case {"id": number, "channelId": channel}:
            return FoxgloveSubscription(_number(number), _number(channel))
    raise QueryError("a subscription needs id and channelId")


def _number(value: Any) -> int:
    # JavaScript has no integers, so a client may write 1.0.
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number and 0 <= value <= _MAX_ID and value == int(value):
        return int(value)
    raise QueryError(f"an id is not a whole number from 0 to {_MAX_ID}")


LIMITS: Final = ServerLimits(clients=32, handshakes=64, received_burst_bytes=512 * 1024.0)
"""A viewer may subscribe to thousands of topics at once, and is disconnected if it sends more than that.

1 MiB waiting are a second of 69 channels at 2000 Hz. The status 503 says that there are too many viewers.
"""

MAX_REQUEST_BYTES: Final = 64 * 1024
"""The size limit of a message from a viewer: about 1000 subscriptions."""

_BYTES_PER_FRAME: Final = 128
"""Added to the size of each frame: an empty one has 6 bytes, but takes as much time as others."""

MAX_FRAGMENTS: Final = 1000
"""How many frames a message may have. websockets limits their bytes only, and keeps even empty ones."""

_CONTROL_SHARE: Final = 8
"""So many times ``unread_bytes`` may wait with the messages about channels, which are not left out."""

_FLUSH_BYTES: Final = 64 * 1024
"""How many bytes are collected for one system call. After a delay, many messages come at once."""

_SLOW: Final = "Send buffer limit reached"
"""The words of Foxglove's own bridge. Lichtblick adds an explanation to them."""


class FoxgloveViewer(ServerConnection):
    """A viewer's connection. It ends if the viewer sends more than viewers do, or reads too little."""

    def __init__(
        self, clients: "Clients[FoxgloveViewer]", events: EventLog, *args: Any, **options: Any
    ) -> None:
        super().__init__(*args, **options)
        self.subscriptions: dict[int, int] = {}
        """The numbers of channels by those of subscriptions."""
        self._clients = clients
        self._events = events
        self._limits = clients.limits
        self._received = self._limits.new_received_budget()
        self._num_fragments = 0  # of the message that is not complete yet
        self._max_waiting_bytes = self._limits.unread_bytes_each
        self._queued_bytes = 0  # for the next ``_flush``
        self._was_slow = False
        self._stalled_s: float | None = None  # since when too much waits, on the monotonic clock

    @property
    def address(self) -> str:
        """Its address for messages, such as 192.0.2.7:40512."""
        host, port, *_ = self.remote_address or ("?", 0)
        return f"{host_in_url(host)}:{port}"

    def disconnect(self, reason: str) -> None:
        """End the connection at once, without waiting for the peer."""
        if not self.transport.is_closing():
            self._events.log(logging.INFO, f"{self.address} is disconnected: {reason}", "disconnected")
            self.transport.abort()

    # Reading --------------------------------------------------------------------------------

    def connection_made(self, transport: Any) -> None:
        """See asyncio.Protocol."""
        super().connection_made(transport)
        self._clients.open(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """See asyncio.Protocol."""
        self._clients.close(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """See asyncio.Protocol. Data is parsed in pieces: one read may have 40 000 empty frames to count."""
        for start in range(0, len(data), self._limits.read_bytes):
            piece = data[start : start + self._limits.read_bytes]
            self._count_received(len(piece))
            if self.transport.is_closing():
                return
            super().data_received(piece)

    def process_event(self, event: Any) -> None:
        """Count a frame, and handle it unless the connection ends; the method of websockets does the rest."""
        if isinstance(event, Frame):
            self._count_received(_BYTES_PER_FRAME)
            if event.opcode in DATA_OPCODES:
                self._num_fragments = 0 if event.fin else self._num_fragments + 1
            if self._num_fragments > MAX_FRAGMENTS:
                self.disconnect(f"it sends a message in more than {MAX_FRAGMENTS} pieces")
        if not self.transport.is_closing():
            super().process_event(event)

    def _count_received(self, num_bytes: int) -> None:
        if not self._received.try_take(num_bytes):
            self.disconnect("it sends more than a viewer does")

    # Writing --------------------------------------------------------------------------------

    def send_message(self, subscription: int, utime: int, data: bytes) -> bool:
        """Send a message of a channel, or return False if too much waits already: then it is lost."""
        if self._waiting_bytes <= self._max_waiting_bytes:
            self._stalled_s = None
            self._queue(message_data(subscription, utime, data))
            return True
        now_s = time.monotonic()
        if self._stalled_s is None:
            self._stalled_s = now_s
        elif now_s - self._stalled_s > self._limits.unread_s:
            # A ping of websockets would wait until it is sent.
            self.disconnect(f"it has not read what waits for it for {self._limits.unread_s:g} s")
        if not self._was_slow:  # say so once
            self._was_slow = True
            self.send_control(status(WARNING, _SLOW))
        return False

    def send_control(self, message: str) -> None:
        """Send a message about channels, which the viewer must not miss."""
        if self._waiting_bytes > _CONTROL_SHARE * self._max_waiting_bytes:
            self.disconnect("it does not read what it must know about the topics")
        else:
            self._queue(message.encode(), is_text=True)

    def _queue(self, message: bytes, *, is_text: bool = False) -> None:
        """Send a message in this turn of the loop, in one system call with others.

        With four viewers of all topics, a frame takes 0.3 ms instead of 0.5 ms.
        """
        if self.protocol.state is not OPEN:
            return
        self.protocol.writes.append(frame_of(message, is_text=is_text))
        if not self._queued_bytes:
            self.loop.call_soon(self._flush)
        self._queued_bytes += len(message)
        if self._queued_bytes > _FLUSH_BYTES:
            self._flush()

    def _flush(self) -> None:
        self._queued_bytes = 0
        # websockets sends them itself if it has something to send in the same turn.
        data = b"".join(self.protocol.data_to_send())
        if data and not self.transport.is_closing():
            self.transport.write(data)

    @property
    def _waiting_bytes(self) -> int:
        waiting: int = self.transport.get_write_buffer_size()
        return waiting + self._queued_bytes
