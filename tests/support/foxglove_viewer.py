"""A viewer that speaks Foxglove's WebSocket protocol by hand: the frames of RFC 6455, and what is in them.

It shares no code with the gateway, nor with the packages that the gateway uses for this. Messages are decoded
by the schemas that the server advertises.
"""

import asyncio
import base64
import contextlib
import hashlib
import json
import os
import struct
from collections import defaultdict
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import cache
from typing import Any, NamedTuple, Self

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

CONTINUATION, TEXT, BINARY, CLOSE, PING, PONG = 0, 1, 2, 8, 9, 10
_GUID = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"


class Received(NamedTuple):
    """A message of a channel, and its time in ns since 1970."""

    time_ns: int
    data: bytes
    content: Any


class HandshakeRefusedError(Exception):
    """The server's HTTP response, if it is not that of a WebSocket."""


def upgrade_request(key: bytes, subprotocol: str, *headers: str) -> bytes:
    """Return the request of a program, or with ``headers``, such as Origin, that of a browser."""
    return (
        b"GET / HTTP/1.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: " + key + b"\r\n"
        b"Sec-WebSocket-Protocol: "
        + subprotocol.encode()
        + b"\r\n"
        + "".join(f"{header}\r\n" for header in headers or ("Host: viewer",)).encode()
        + b"\r\n"
    )


def client_frame(payload: bytes, opcode: int = TEXT) -> bytes:
    """Return a frame of a client, which is masked (RFC 6455, 5.3)."""
    size = len(payload)
    if size < 126:
        head = bytes((0x80 | opcode, 0x80 | size))
    elif size < 1 << 16:
        head = bytes((0x80 | opcode, 0x80 | 126)) + struct.pack(">H", size)
    else:
        head = bytes((0x80 | opcode, 0x80 | 127)) + struct.pack(">Q", size)
    mask = os.urandom(4)
    repeated = mask * (size // 4 + 1)
    masked = int.from_bytes(payload) ^ int.from_bytes(repeated[:size])
    return head + mask + masked.to_bytes(size)


class Viewer:
    """A connected viewer. ``run`` it as a task, or let ``connect`` do so."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self.subscriptions: dict[int, dict[str, Any]] = {}
        """The channels by the numbers of subscriptions."""
        self._last_number = 100  # other than the numbers of channels
        self._task: asyncio.Task[None] | None = None
        self._changed = asyncio.Condition()
        self.subprotocol = ""
        self.info: dict[str, Any] = {}
        self.warnings: list[str] = []
        self.is_welcome = False
        """Whether the first list of channels has arrived, which may be empty."""
        self.channels: dict[int, dict[str, Any]] = {}
        """The channels that are advertised, by their numbers."""
        self.withdrawn: list[str] = []
        """The topics of channels that were withdrawn."""
        self.received: defaultdict[str, list[Received]] = defaultdict(list)
        """The messages by topic."""
        self.on_message: Callable[[str, Any], None] = lambda _topic, _content: None
        """Called with the topic and the content of each message."""
        self.is_closed = False

    @classmethod
    async def open(
        cls, port: int, subprotocol: str = "foxglove.sdk.v1", *headers: str, host: str = "127.0.0.1"
    ) -> Self:
        """Connect and complete the handshake. Raises HandshakeRefusedError."""
        reader, writer = await asyncio.open_connection(host, port, limit=1 << 26)
        key = base64.b64encode(os.urandom(16))
        writer.write(upgrade_request(key, subprotocol, *headers))
        head = (await reader.readuntil(b"\r\n\r\n")).decode()
        if not head.startswith("HTTP/1.1 101 "):
            writer.close()
            raise HandshakeRefusedError(head + (await reader.read(1000)).decode())
        fields = dict(line.lower().split(": ", 1) for line in head.split("\r\n")[1:-2])
        accept = base64.b64encode(hashlib.sha1(key + _GUID).digest()).decode()  # noqa: S324 - RFC 6455
        assert fields["sec-websocket-accept"] == accept.lower()
        viewer = cls(reader, writer)
        viewer.subprotocol = fields["sec-websocket-protocol"]
        return viewer

    async def __aenter__(self) -> Self:
        self._task = asyncio.create_task(self.run())
        await self.wait_until(lambda: self.is_welcome)
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._task is not None
        self._task.cancel()
        await asyncio.wait([self._task])
        self._writer.close()
        with contextlib.suppress(ConnectionError):
            await self._writer.wait_closed()
        if not self._task.cancelled():
            self._task.result()

    async def run(self) -> None:
        """Receive until the server closes the connection."""
        try:
            while True:
                opcode, payload = await self._read_frame()
                if opcode == CLOSE:
                    return
                if opcode == PING:
                    self._writer.write(client_frame(payload, PONG))
                elif opcode == TEXT:
                    self._handle(json.loads(payload))
                elif opcode == BINARY:
                    self._handle_data(payload)
                async with self._changed:
                    self._changed.notify_all()
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            self.is_closed = True
            async with self._changed:
                self._changed.notify_all()

    async def _read_frame(self) -> tuple[int, bytes]:
        first, size = await self._reader.readexactly(2)
        assert first & 0x80, "the server does not fragment"
        assert not size & 0x80, "frames of a server are not masked"
        if size == 126:
            (size,) = struct.unpack(">H", await self._reader.readexactly(2))
        elif size == 127:
            (size,) = struct.unpack(">Q", await self._reader.readexactly(8))
        return first & 0x0F, await self._reader.readexactly(size)

    def _handle(self, message: dict[str, Any]) -> None:
        match message["op"]:
            case "serverInfo":
                self.info = message
            case "advertise":
                self.is_welcome = True
                for channel in message["channels"]:
                    assert channel["id"] not in self.channels
                    self.channels[channel["id"]] = channel
            case "unadvertise":
                for number in message["channelIds"]:
                    self.withdrawn.append(self.channels.pop(number)["topic"])
                kept = self.subscriptions.items()
                self.subscriptions = {
                    each: channel for each, channel in kept if channel["id"] in self.channels
                }
            case "status":
                self.warnings.append(message["message"])
            case _:
                raise AssertionError(message)

    def _handle_data(self, payload: bytes) -> None:
        opcode, number, time_ns = struct.unpack_from("<BIQ", payload)
        assert opcode == 1
        channel = self.subscriptions.get(number)
        if channel is not None:  # otherwise it was on the way when the subscription ended
            data = payload[13:]
            content = decode(channel, data)
            self.received[channel["topic"]].append(Received(time_ns, data, content))
            self.on_message(channel["topic"], content)

    # What a user does.

    @property
    def topics(self) -> dict[str, str]:
        """The advertised topics, and the names of their schemas."""
        return {channel["topic"]: channel["schemaName"] for channel in self.channels.values()}

    def channel(self, topic: str) -> dict[str, Any]:
        """Return the channel of a topic, of which there must be one."""
        [found] = [channel for channel in self.channels.values() if channel["topic"] == topic]
        return found

    def send(self, message: dict[str, Any]) -> None:
        self.send_bytes(client_frame(json.dumps(message).encode()))

    def send_bytes(self, data: bytes) -> None:
        self._writer.write(data)

    def pause(self) -> None:
        """Read nothing from the network until ``resume``."""
        self._reader._transport.pause_reading()  # type: ignore[attr-defined]

    def resume(self) -> None:
        self._reader._transport.resume_reading()  # type: ignore[attr-defined]

    def subscribe(self, *topics: str) -> None:
        """Subscribe to advertised topics, all in one message."""
        wanted = []
        for topic in topics:
            self._last_number += 1
            channel = self.channel(topic)
            self.subscriptions[self._last_number] = channel
            wanted.append({"id": self._last_number, "channelId": channel["id"]})
        self.send({"op": "subscribe", "subscriptions": wanted})

    def unsubscribe(self, topic: str) -> None:
        [number] = [number for number, channel in self.subscriptions.items() if channel["topic"] == topic]
        self.send({"op": "unsubscribe", "subscriptionIds": [number]})

    async def wait_until(self, condition: Callable[[], object], timeout_s: float = 120) -> None:
        """Wait until a condition on what has been received holds."""
        async with asyncio.timeout(timeout_s), self._changed:
            await self._changed.wait_for(lambda: condition() or self.is_closed)
        assert condition(), "the server has closed the connection"

    async def wait_for(self, topic: str, count: int = 1) -> list[Received]:
        """Wait for at least ``count`` messages of a topic, and return all of them."""
        await self.wait_until(lambda: len(self.received[topic]) >= count)
        return self.received[topic]


@asynccontextmanager
async def viewing(port: int, *topics: str, subprotocol: str = "foxglove.sdk.v1") -> AsyncIterator[Viewer]:
    """Connect a viewer that subscribes to ``topics`` as soon as they are advertised."""
    async with await Viewer.open(port, subprotocol) as viewer:
        await viewer.wait_until(lambda: viewer.topics.keys() >= set(topics))
        if topics:
            viewer.subscribe(*topics)
        yield viewer


def decode(channel: dict[str, Any], data: bytes) -> Any:
    """Return a message decoded by the schema of its channel."""
    if channel["encoding"] == "json":
        assert channel["schemaEncoding"] == "jsonschema"
        assert json.loads(channel["schema"]) == {"type": "object"}
        return json.loads(data)
    if channel["encoding"] == "cdr":
        assert channel["schemaEncoding"] == "ros2msg"
        store = _message_types(channel["schemaName"], channel["schema"])
        return store.deserialize_cdr(data, channel["schemaName"])
    assert channel["encoding"] == channel["schemaEncoding"] == "protobuf"
    return _message_class(channel["schemaName"], channel["schema"]).FromString(data)


@cache
def _message_types(name: str, definition: str) -> Any:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, name))
    return store


@cache
def _message_class(name: str, schema: str) -> Any:
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(base64.b64decode(schema)).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(name))
