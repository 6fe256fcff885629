"""Subscribers to the gateway and the relay; several run in one process, each with its own session."""

import json
import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from typing import Any, Final

import lcm
import zenoh

from gateway.messages.encode import CONTENT_OFFSET
from gateway.rtc3d.commands import StreamFrames
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.rtc3d.packets import PACKET_HEADER, PacketType, encode_packet

LCM_BUFFER_BYTES: Final = 4_000_000
"""``recv_buf_size`` of subscribers that must lose nothing; docs/dev/performance.md explains it."""

_QUEUE_MESSAGES: Final = 100_000
_CONTENT: Final = struct.Struct(">iq")  # frame number and time stamp, after the prefix of every message
_KEPT: Final = 1000


@dataclass(frozen=True)
class Subscription:
    """The subscribers of one process: ``zenoh`` on Zenoh and ``lcm`` on LCM, each with its own session.

    ``component`` is one component, or "*" for all five. With ``reads``, Python reads every message.
    Otherwise only the libraries receive them, which costs the host the least.
    """

    zenoh_config: dict[str, Any]
    lcm_urls: tuple[str, ...]
    zenoh: int = 0
    lcm: int = 0
    component: str = "*"
    reads: bool = True


@dataclass
class Received:
    """What one subscriber received, by topic: messages, bytes, frame numbers, and ages in µs."""

    messages: Counter[str] = field(default_factory=Counter)
    message_bytes: Counter[str] = field(default_factory=Counter)
    numbers: dict[str, list[int]] = field(default_factory=dict)
    ages_us: dict[str, list[float]] = field(default_factory=dict)

    def record(self, topic: str, message: bytes) -> None:
        """Record one message; topics other than those of components are ignored."""
        now_us = time.monotonic_ns() / 1000
        if topic.rpartition("/")[2] not in _COMPONENTS and topic.rpartition("_")[2] not in _COMPONENTS:
            return
        number, stamp_us = _CONTENT.unpack_from(message, CONTENT_OFFSET)
        self.messages[topic] += 1
        self.message_bytes[topic] += len(message)
        self.numbers.setdefault(topic, []).append(number)
        self.ages_us.setdefault(topic, []).append(now_us - stamp_us)

    def missing(self, first: int, frames: int, components: int) -> int:
        """Return how many messages of ``frames`` frames from ``first`` are missing; duplicates count once."""
        wanted = set(range(first, first + frames))
        return frames * components - sum(len(wanted.intersection(each)) for each in self.numbers.values())


_COMPONENTS: Final = frozenset(COMPONENTS_BY_KEY) | frozenset(map(str.upper, COMPONENTS_BY_KEY))


def subscribe(wanted: Subscription) -> Generator[Any, str, None]:
    """Run subscribers in a Worker.

    The reply to "counts" is the number of messages of each topic, for each subscriber. The reply to "take" is
    a ``Received`` for each subscriber, which then starts again from zero.
    """
    subscribers: list[_ZenohSubscriber | _LcmSubscriber] = [
        *(_ZenohSubscriber(wanted) for _ in range(wanted.zenoh)),
        *(_LcmSubscriber(wanted) for _ in range(wanted.lcm)),
    ]
    try:
        request = yield None
        while True:
            if request == "counts":
                request = yield [subscriber.counts() for subscriber in subscribers]
            else:
                request = yield [subscriber.take() for subscriber in subscribers]
    finally:
        for subscriber in subscribers:
            subscriber.close()


class _ZenohSubscriber:
    def __init__(self, wanted: Subscription) -> None:
        self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(wanted.zenoh_config)))
        self._received = Received()
        self._reads = wanted.reads
        handler: Any = self._on_sample if wanted.reads else zenoh.handlers.RingChannel(_KEPT)
        self._subscriber = self._session.declare_subscriber(f"mocap/*/{wanted.component}", handler)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        self._received.record(str(sample.key_expr), sample.payload.to_bytes())

    def counts(self) -> Counter[str]:
        if not self._reads:
            while (sample := self._subscriber.handler.try_recv()) is not None:
                self._on_sample(sample)
        return self._received.messages

    def take(self) -> Received:
        received, self._received = self._received, Received()
        return received

    def close(self) -> None:
        self._session.close()


class _LcmSubscriber:
    """Subscribes on each URL. Without ``reads``, LCM's threads receive messages and its queues drop them."""

    def __init__(self, wanted: Subscription) -> None:
        component = ".+" if wanted.component == "*" else wanted.component.upper()
        self._lcms = [lcm.LCM(f"{url}&recv_buf_size={LCM_BUFFER_BYTES}") for url in wanted.lcm_urls]
        self._received = Received()
        self._reads = wanted.reads
        self._subscriptions = [
            each.subscribe(f"MOCAP_[A-Z]+_{component}", self._on_message) for each in self._lcms
        ]
        for subscription in self._subscriptions:
            subscription.set_queue_capacity(_QUEUE_MESSAGES)
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._handle, args=(each,)) for each in self._lcms]
        if wanted.reads:
            for thread in self._threads:
                thread.start()

    def _on_message(self, channel: str, message: bytes) -> None:
        self._received.record(channel, message)

    def _handle(self, connection: lcm.LCM) -> None:
        while not self._stop.is_set():
            connection.handle_timeout(100)

    def counts(self) -> Counter[str]:
        for each in self._lcms:
            while not self._reads and each.handle_timeout(0):
                pass
        return self._received.messages

    def take(self) -> Received:
        if not self._reads:
            for subscription in self._subscriptions:
                subscription.set_queue_capacity(1)
        received, self._received = self._received, Received()
        return received

    def close(self) -> None:
        self._stop.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join()


def subscribe_tcp(port: int, packet_bytes: int, offset: int) -> Iterator[Any]:
    """Run a plain TCP client in a Worker; each reply is the ages in µs of the frames of one connection.

    Each packet has ``packet_bytes`` bytes, with a frame number at ``offset``.
    """
    yield None
    while True:
        ages_us: list[float] = []
        command = encode_packet(PacketType.COMMAND, str(StreamFrames()).encode())
        with socket.create_connection(("127.0.0.1", port)) as connection:
            connection.sendall(command)
            size, _ = PACKET_HEADER.unpack(connection.recv(PACKET_HEADER.size, socket.MSG_WAITALL))
            connection.recv(size - PACKET_HEADER.size, socket.MSG_WAITALL)
            while len(packet := connection.recv(packet_bytes, socket.MSG_WAITALL)) == packet_bytes:
                now_us = time.monotonic_ns() / 1000
                ages_us.append(now_us - _CONTENT.unpack_from(packet, offset)[1])
        yield ages_us
