"""The connections of viewers, with limits on what they can use up: clients are not trusted.

The protocol is described in the repository foxglove/ws-protocol (docs/spec.md). Its two names mean the same:
clients made before 2026, such as Lichtblick 1.21, know the first one only, and newer ones the second.
"""

import base64
import json
import logging
import re
import struct
import time
from collections.abc import Collection, Iterable
from typing import Any, Final, NamedTuple

from websockets.asyncio.server import ServerConnection
from websockets.frames import DATA_OPCODES, Frame
from websockets.http11 import Request, Response
from websockets.protocol import State

from gateway.errors import QueryError
from gateway.foxglove_schemas.topics import Topic
from gateway.logs.failures import EventLog
from gateway.messages.decode import json_text
from gateway.outputs.listen_address import foreign_page
from gateway.server_limits import Clients, ServerLimits

SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")

_MESSAGE_DATA: Final = struct.Struct("<BIQ")
"""Opcode, id of the subscription, time in ns since 1970; the message follows."""

_MESSAGE_DATA_OPCODE: Final = 1
_MAX_ID: Final = (1 << 32) - 1
_WARNING: Final = 1
_ERROR: Final = 2


class Subscription(NamedTuple):
    """The client chooses ``number``; the messages on ``channel`` have it."""

    number: int
    channel: int


class ClientRequest(NamedTuple):
    """What a client asks for: to begin subscriptions, and to end those with these numbers."""

    subscriptions: tuple[Subscription, ...] = ()
    ended: tuple[int, ...] = ()


def server_info(name: str, session: str) -> str:
    """Return the first message to a client. With another ``session``, it forgets all earlier messages."""
    return json_text({"op": "serverInfo", "name": name, "capabilities": [], "sessionId": session})


def channel_text(number: int, topic: Topic) -> str:
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


def warning(text: str) -> str:
    """Return the message that shows a warning in the viewer."""
    return json_text({"op": "status", "level": _WARNING, "message": text})


def error(text: str) -> str:
    """Return the message that shows an error in the viewer."""
    return json_text({"op": "status", "level": _ERROR, "message": text})


def message_data(subscription: int, utime: int, data: bytes) -> bytes:
    """Return a message of a channel; ``utime`` is in µs since 1970."""
    return _MESSAGE_DATA.pack(_MESSAGE_DATA_OPCODE, subscription, utime * 1000) + data


def parse_request(message: str | bytes) -> ClientRequest:
    """Return what a client asks for.

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
            return ClientRequest(subscriptions=tuple(_subscription(found) for found in subscriptions))
        case {"op": "unsubscribe", "subscriptionIds": list(numbers)}:
            return ClientRequest(ended=tuple(_number(number) for number in numbers))
    raise QueryError("only subscribe and unsubscribe are served")


def _subscription(content: Any) -> Subscription:
    match content:
        case {"id": number, "channelId": channel}:
            return Subscription(_number(number), _number(channel))
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

_FOXGLOVE: Final = re.compile(r"https://([a-z0-9-]+\.)*foxglove\.dev")
_DESKTOP: Final = "file://"
"""Lichtblick for the desktop is a page from the disk, which no web site can be."""

_SLOW: Final = "Send buffer limit reached"
"""The words of Foxglove's own bridge. Lichtblick adds an explanation to them."""

logger = logging.getLogger(__name__)


class ViewerAdmission:
    """Decides which connections may stay open, and logs why others end."""

    def __init__(self, host: str, origins: Collection[str]) -> None:
        self.clients: Clients[ServerConnection] = Clients(LIMITS, lambda each: each.transport.abort())
        self._host = host
        self._origins = frozenset(origin.lower() for origin in origins)
        self._events = EventLog(logger, "foxglove")

    def refuse(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the response to a foreign page or to a viewer that is one too many; None to accept it."""
        headers = request.headers
        reason = foreign_page(
            self._host, headers.get_all("Host"), headers.get_all("Origin"), self._is_of_a_viewer
        )
        if reason:
            reason = f"{reason}; if a viewer of yours is there, add it to foxglove.origins"
            text = f"{_address(connection)} is refused: {reason}"
            self._events.log(logging.WARNING, text, "foreign page")
            return connection.respond(403, f"{reason}\n")
        if not self.clients.is_full:
            return None
        most = self.clients.limits.clients
        text = f"{_address(connection)} is refused: {most} viewers are connected; close one of them"
        self._events.log(logging.WARNING, text, "refused")
        return connection.respond(503, f"{most} viewers are connected already; close one of them.\n")

    def _is_of_a_viewer(self, origin: str) -> bool:
        """Return whether pages of this origin are viewers: Foxglove's, from the disk, or configured."""
        origin = origin.lower()
        return origin in self._origins or origin == _DESKTOP or bool(_FOXGLOVE.fullmatch(origin))

    def disconnect(self, connection: ServerConnection, reason: str) -> None:
        """End a connection at once, without waiting for the peer."""
        if not connection.transport.is_closing():
            text = f"{_address(connection)} is disconnected: {reason}"
            self._events.log(logging.INFO, text, "disconnected")
            connection.transport.abort()


class Connection(ServerConnection):
    """A connection that is closed if the peer sends more than a viewer does."""

    def __init__(self, admission: ViewerAdmission, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._admission = admission
        self._received = admission.clients.limits.new_received_budget()
        self._num_fragments = 0  # of the message that is not complete yet

    def connection_made(self, transport: Any) -> None:
        """See asyncio.Protocol."""
        super().connection_made(transport)
        self._admission.clients.open(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """See asyncio.Protocol."""
        self._admission.clients.close(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """See asyncio.Protocol. Data is parsed in pieces: one read may have 40 000 empty frames to count."""
        piece_bytes = self._admission.clients.limits.read_bytes
        for start in range(0, len(data), piece_bytes):
            piece = data[start : start + piece_bytes]
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
                self._admission.disconnect(self, f"it sends a message in more than {MAX_FRAGMENTS} pieces")
        if not self.transport.is_closing():
            super().process_event(event)

    def _count_received(self, num_bytes: int) -> None:
        if not self._received.try_take(num_bytes):
            self._admission.disconnect(self, "it sends more than a viewer does")


def _address(connection: ServerConnection) -> str:
    """Return the address of a peer for messages, such as 192.0.2.7:40512."""
    host, port, *_ = connection.remote_address or ("?", 0)
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


class Viewer:
    """A connected viewer."""

    def __init__(self, connection: ServerConnection, admission: ViewerAdmission) -> None:
        self.subscriptions: dict[int, int] = {}
        """The numbers of channels by those of subscriptions."""
        self._connection = connection
        self._admission = admission
        self._max_waiting_bytes = admission.clients.limits.unread_bytes_each
        self._unread_s = admission.clients.limits.unread_s
        self._queued_bytes = 0  # for the next ``_flush``
        self._was_slow = False
        self._stalled_s: float | None = None  # since when too much waits, on the monotonic clock

    @property
    def address(self) -> str:
        """Its address for messages, such as 192.0.2.7:40512."""
        return _address(self._connection)

    def send_data(self, subscription: int, utime: int, data: bytes) -> bool:
        """Send a message of a channel, or return False if too much waits already: then it is lost."""
        if self._waiting_bytes > self._max_waiting_bytes:
            self._stall()
            return False
        self._stalled_s = None
        self._send(message_data(subscription, utime, data))
        return True

    def _stall(self) -> None:
        """Tell the user once that messages are lost; disconnect a viewer that does not read at all."""
        now_s = time.monotonic()
        if self._stalled_s is None:
            self._stalled_s = now_s
        elif now_s - self._stalled_s > self._unread_s:
            # A ping of websockets would wait until it is sent.
            self._disconnect(f"it has not read what waits for it for {self._unread_s:g} s")
        if not self._was_slow:
            self._was_slow = True
            self.send_control(warning(_SLOW))

    def send_control(self, message: str) -> None:
        """Send a message about channels, which the viewer must not miss."""
        if self._waiting_bytes > _CONTROL_SHARE * self._max_waiting_bytes:
            self._disconnect("it does not read what it must know about the topics")
        else:
            self._send(message.encode(), is_text=True)

    def _disconnect(self, reason: str) -> None:
        self._admission.disconnect(self._connection, reason)

    def _send(self, message: bytes, *, is_text: bool = False) -> None:
        """Send a message in this turn of the loop, in one system call with others.

        With four viewers of all topics, a frame takes 0.3 ms instead of 0.5 ms.
        """
        frames = self._connection.protocol
        if frames.state is not State.OPEN:
            return
        (frames.send_text if is_text else frames.send_binary)(message)
        if not self._queued_bytes:
            self._connection.loop.call_soon(self._flush)
        self._queued_bytes += len(message)
        if self._queued_bytes > _FLUSH_BYTES:
            self._flush()

    def _flush(self) -> None:
        self._queued_bytes = 0
        # websockets sends them itself if it has something to send in the same turn.
        data = b"".join(self._connection.protocol.data_to_send())
        if data and not self._connection.transport.is_closing():
            self._connection.transport.write(data)

    @property
    def _waiting_bytes(self) -> int:
        waiting: int = self._connection.transport.get_write_buffer_size()
        return waiting + self._queued_bytes
