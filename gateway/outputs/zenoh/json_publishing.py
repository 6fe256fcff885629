"""JSON for subscribers that cannot decode LCM's types: KEY/json beside the key of a component or a tool.

A message is converted only while somebody subscribes to its JSON, at most ``zenoh.json_max_rate_hz`` times a
second for each key, and in a thread of its own, which uses a fifth of a processor at most. The sources share
this time evenly: the large frames of one do not delay the others.
"""

import functools
import logging
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Final

import zenoh

from gateway.errors import raise_unless_defect
from gateway.messages.decode import JSON, MAX_JSON_SOURCE_BYTES, decode, json_text
from gateway.messages.descriptions.labels import describe, event_labels
from gateway.messages.history import utime_of
from gateway.messages.topics import JSON_NAME, Topic
from gateway.outputs.contract import ServerParameters
from gateway.outputs.pacing import Pacer
from gateway.outputs.zenoh.config import zenoh_reason
from gateway.outputs.zenoh.session import declare_publisher, has_subscribers, undeclare
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.losses import Losses
from gateway.runtime.token_bucket import TokenBucket
from gateway.runtime.workers import QueueRoom, WorkerThread

MAX_DESCRIPTION_CHARACTERS: Final = 256 * 1024
"""Longer lists of labels and units are left out: they come from the server, and are in every text."""

_BURST_S: Final = 0.25
"""The messages of this time may come at once, as after a delay on the network."""

_REST: Final = 4
"""How many times as long as a conversion the thread pauses after it."""

_MAX_WAITING: Final = 1024
_MAX_WAITING_BYTES: Final = 16 * 1024 * 1024
"""How many messages of one source wait for their conversion, and their size."""

_CAPTURE_UTIME: Final = slice(16, 24)
"""Places in a message, behind the fingerprint."""

logger = logging.getLogger(__name__)


class JsonConverter:
    """The JSON of one Zenoh session: the thread that converts and sends, and what it needs to know."""

    def __init__(self, max_rate_hz: float) -> None:
        self._max_rate_hz = max_rate_hz
        self._parameters: dict[str, ServerParameters] = {}  # by the source's name
        self.losses: defaultdict[str, Losses] = defaultdict(lambda: Losses(logger, "zenoh"))
        """By the source's name, what cannot be sent as JSON."""
        self._lock = threading.Lock()
        self._waiting: defaultdict[str, _Waiting] = defaultdict(_Waiting)  # by the source's name
        self._used_s = 0.0  # what the source had used that was served last
        self._thread = WorkerThread("zenoh-json")
        self._converting: Future[None] | None = None  # the call of the thread that converts what waits
        self._closing = threading.Event()

    def publisher(self, topic: Topic, key: str, on_wanted: Callable[[], None]) -> "JsonPublisher | None":
        """Return the publisher of the JSON of ``topic``, whose own key is ``key``; None if it has none."""
        if self._max_rate_hz == 0 or topic.path[0] not in COMPONENTS_BY_KEY:
            return None
        is_event = topic.path == (ComponentType.EVENT.key,)
        pace = None if is_event else JsonPace(self._max_rate_hz)
        return JsonPublisher(self, topic, f"{key}/{JSON_NAME}", pace, on_wanted)

    def set_parameters(self, source: str, parameters: ServerParameters) -> None:
        """Take the labels from these parameters from now on."""
        self._parameters[source] = parameters

    def parameters(self, source: str, version: int) -> Parameters | None:
        """Return the parameters of this version; None if they are not known, or not any more."""
        newest = self._parameters.get(source)
        return None if newest is None or newest.version != version else newest.parsed

    def offer(self, source: str, convert: Callable[[], None], num_bytes: int) -> bool:
        """Have the thread make a call, which holds ``num_bytes``; return False if too many wait."""
        with self._lock:
            waiting = self._waiting[source]
            if self._closing.is_set():
                return True  # a message more or less
            if not waiting.room.take(num_bytes):
                return False
            if not waiting.calls:
                # What it did not use while nothing waited does not let it use more now.
                waiting.used_s = max(waiting.used_s, self._used_s)
            waiting.calls.append((convert, num_bytes))
            if self._converting is None or self._converting.done():  # done: no thread could be started
                self._converting = self._thread.submit(self._convert_waiting)
        return True

    def _convert_waiting(self) -> None:
        """Make the calls that wait, each time one of the source that has used the least time."""
        while not self._closing.is_set():
            with self._lock:
                all_waiting = [each for each in self._waiting.values() if each.calls]
                if not all_waiting:
                    self._converting = None
                    return
                waiting = min(all_waiting, key=lambda each: each.used_s)
                convert, num_bytes = waiting.calls.popleft()
                waiting.room.free(num_bytes)
                self._used_s = waiting.used_s
            began_s = time.monotonic()
            convert()
            duration_s = time.monotonic() - began_s
            waiting.used_s += duration_s
            self._closing.wait(_REST * duration_s)

    @property
    def is_closing(self) -> bool:
        """Whether the output closes, so that what waits is not sent."""
        return self._closing.is_set()

    def close(self) -> None:
        """End the thread, without waiting for the message that it converts or sends."""
        with self._lock:
            self._closing.set()
        self._thread.close()


class _Waiting:
    """The conversions of one source that wait, with the bytes that they hold, and the time used so far."""

    def __init__(self) -> None:
        self.calls: deque[tuple[Callable[[], None], int]] = deque()
        self.room = QueueRoom(_MAX_WAITING, _MAX_WAITING_BYTES)
        self.used_s = 0.0


class JsonPace:
    """Picks ``max_rate_hz`` messages of one key per second, at even intervals of their capture.

    A replay may be faster than the capture was, so the messages per second are limited besides.
    """

    def __init__(self, max_rate_hz: float) -> None:
        self._pacer = Pacer(max_rate_hz)
        self._bucket = TokenBucket(max_rate_hz, max(_BURST_S * max_rate_hz, 1.0))

    def due(self, message: bytes) -> bool:
        """Return whether to send this message. Call it for every message."""
        utime = utime_of(message)
        capture_utime = int.from_bytes(message[_CAPTURE_UTIME], "big", signed=True)
        is_due = self._pacer.due(None if capture_utime == utime else capture_utime, utime)
        return is_due and self._bucket.try_take()


class JsonPublisher:
    """Sends the messages of one topic as JSON on ``key``, while a subscriber matches it.

    Without a ``pace``, it sends all of them. Otherwise it leaves messages out, also those that are replaced
    by newer ones while they wait.
    """

    def __init__(
        self,
        keys: JsonConverter,
        topic: Topic,
        key: str,
        pace: JsonPace | None,
        on_wanted: Callable[[], None],
    ) -> None:
        self.wanted = False
        """Whether a subscriber matches the key now."""
        self._keys = keys
        self._topic = topic
        self._key = key
        self._pace = pace
        self._on_wanted = on_wanted
        self._publisher: zenoh.Publisher | None = None
        self._lock = threading.Lock()
        self._newest: bytes | None = None  # the paced message that waits
        self._described: tuple[Parameters, int] | None = None
        self._description = ""  # of ``_described``

    def declare(self, session: zenoh.Session) -> None:
        """Declare the publisher on an open session."""
        self._publisher = declare_publisher(
            *(session, self._key, self._set_wanted),
            encoding=JSON,
            congestion_control=zenoh.CongestionControl.DROP,
        )
        if has_subscribers(self._publisher):  # as ZenohPublisher does
            self._set_wanted(True)

    def check_subscribers(self) -> None:
        """Check again for subscribers, because a notification may have been missed."""
        publisher = self._publisher
        if publisher is not None:
            self._set_wanted(has_subscribers(publisher))

    def _set_wanted(self, wanted: bool) -> None:
        self.wanted = wanted
        self._on_wanted()

    def offer(self, message: bytes) -> None:
        """Send a message as JSON soon, unless it is left out. Never raises; what is refused is counted."""
        if self._pace is not None and not self._pace.due(message):
            return
        if len(message) > MAX_JSON_SOURCE_BYTES:
            self._count_loss(
                "json too long",
                f"a message of {len(message)} bytes is too long for {self._key}; subscribe to the key "
                f"without /{JSON_NAME}",
            )
        elif self._pace is None:
            self._offer(functools.partial(self._send, message), message)
        else:
            with self._lock:
                is_waiting, self._newest = self._newest is not None, message
            if not is_waiting and not self._offer(self._send_newest, message):
                self._newest = None

    def _offer(self, convert: Callable[[], None], message: bytes) -> bool:
        if self._keys.offer(self._topic.source, convert, len(message)):
            return True
        self._count_loss(
            "json queue full",
            f"messages for {self._key} come faster than they can be converted; subscribe to fewer keys "
            f"with /{JSON_NAME}, or set a lower zenoh.json_max_rate_hz",
        )
        return False

    def _count_loss(self, cause: str, text: str) -> None:
        self._keys.losses[self._topic.source].lost(cause, text, frames=0)

    # In the thread.

    def _send_newest(self) -> None:
        with self._lock:
            message, self._newest = self._newest, None
        if message is not None:
            self._send(message)

    def _send(self, message: bytes) -> None:
        publisher = self._publisher
        if publisher is None or not self.wanted:
            return
        try:
            decoded = decode(message)
            text, description = json_text(decoded), self._description_of(decoded)
            publisher.put((f"{text[:-1]},{description}}}" if description else text).encode())
        except zenoh.ZError as error:
            if self._publisher is not None and not self._keys.is_closing:
                self._count_loss("put failed", f"Zenoh did not take {self._key}: {zenoh_reason(error)}")
        except BaseException as error:
            raise_unless_defect(error)
            self._count_loss("json failed", f"a message for {self._key} cannot be converted: {error!r}")
            logger.debug("zenoh: %s", self._key, exc_info=error)

    def _description_of(self, message: Any) -> str:
        """Return the fields with the labels and units, as JSON; "" if they are not known."""
        if len(self._topic.path) > 1:
            return _fields(label=self._topic.path[1])
        parameters = self._keys.parameters(self._topic.source, message.parameters_version)
        if parameters is None:
            return ""
        kind = COMPONENTS_BY_KEY[self._topic.path[0]]
        if kind is ComponentType.EVENT:
            labels = event_labels(parameters)
            return _fields(labels=[labels.get(event.id, "") for event in message.events])
        num_items = int(getattr(message, f"num_{kind.item_noun}"))
        if self._described != (parameters, num_items):
            found = describe(kind, parameters, num_items)
            moment_unit = {"moment_unit": found.moment_unit} if kind is ComponentType.FORCE else {}
            self._description = _fields(labels=found.labels, units=found.units, **moment_unit)
            self._described = parameters, num_items
        return self._description

    def close(self) -> None:
        """Undeclare the publisher."""
        publisher, self._publisher = self._publisher, None
        self.wanted = False
        undeclare(publisher, self._key)


def _fields(**values: Any) -> str:
    """Return the fields of an object as JSON, without the braces; "" if they are too long."""
    text = json_text(values)[1:-1]
    return text if len(text) <= MAX_DESCRIPTION_CHARACTERS else ""
