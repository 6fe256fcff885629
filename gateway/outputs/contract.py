"""The contract between the gateway and its outputs; tests/contract/ holds every output to it.

The core is ``start``, ``publisher``, ``health`` and ``close``. Everything else is an optional ability: a
method or an attribute with a default that does nothing. An output overrides the abilities that it has. No
caller checks the class of an output.
"""

import asyncio
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import rtc3d

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import Stamp
from gateway.messages.history import FoundMessages, WantedMessages
from gateway.messages.texts import xml_text
from gateway.messages.topics import Topic
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.frames import FrameLayout, RawFrame
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.losses import Loss, Losses

WHOLE_FRAME: Final = "frame"
"""What stands for the component in the counters of an output that takes whole frames."""


@dataclass
class OutputStatus:
    """The counters of one output for one source: messages and their bytes by component, losses by cause.

    ``takes_frames`` is whether the output takes whole frames instead of components.
    """

    name: str
    messages: Counter[str] = field(default_factory=Counter)
    losses: Sequence[Loss] = ()
    message_bytes: Counter[str] = field(default_factory=Counter)
    takes_frames: bool = False


@dataclass(frozen=True)
class OutputHealth:
    """Whether an output can send, and if not, what is wrong and what to do."""

    connected: bool
    problem: str = ""


KeyPath = tuple[str, ...]
"""A key below PREFIX/SOURCE/, split at its slashes: ("parameters", "3d")."""

CONTROL_OPTION: Final = "set"
STOP: Final = "stop"
"""What is stopped by a command with this value of the option is stopped whatever else peers ask."""
"""The option of queries that start, stop or change something. They need ``remote_control`` of the source."""

READ_OPTION: Final = "read"
"""The option of queries for a piece of a file. They are answered only on outputs with flow control."""

NO_LIMITS: Final[Mapping[ComponentType, float]] = {}


class Publisher(Protocol):
    """Sends the messages of one topic."""

    @property
    def wanted(self) -> bool:
        """Whether there may be a subscriber; always True if the output cannot know."""

    def publish(self, message: bytes) -> None:
        """Send one message. Wait for a slow peer for some milliseconds at most.

        This wait is how back-pressure reaches the server: the session reads on only after ``publish``.

        Raises OutputError if the output does not accept it. Then this message is lost, but the next one may
        be sent as usual.
        """

    def close(self) -> None:
        """Close the publisher. After that, ``publish`` raises OutputError."""


class FramePublisher(Protocol):
    """Takes the whole frames of one source, for outputs that need more than one component at a time."""

    def wants(self, components: Collection[ComponentType]) -> bool:
        """Return whether any of ``components`` may have a subscriber; True if the output cannot know.

        A stream on demand is not requested while no output wants any of its components.
        """

    def prepare(self, layout: FrameLayout, components: frozenset[ComponentType]) -> bool:
        """Prepare for frames of ``layout``; return whether somebody receives any of their ``components``.

        If not, such frames are neither published nor counted. Called before the first frame of a layout, and
        again after each call of ``on_change`` (``Output.watch_wanted``), so it costs nothing per frame. An
        output that learns from frames which items there are does so here.
        """

    def publish(self, frame: RawFrame, stamp: Stamp, components: frozenset[ComponentType]) -> None:
        """Send the ``components`` of one frame without blocking.

        Raises OutputError if the output does not accept the frame.
        """

    def close(self) -> None:
        """Close the publisher."""


class LazyPayload(Protocol):
    """A payload that takes long to make, or much memory. The thread that sends the answer makes it."""

    @property
    def num_bytes(self) -> int:
        """How long it is, about."""

    @property
    def is_made(self) -> bool:
        """Whether ``make`` returns at once."""

    def make(self) -> bytes:
        """Return the bytes. It may block, so call it in a thread. Raises QueryError."""


class Answer(NamedTuple):
    """An answer to a peer: its content, the encoding as named by Zenoh, and facts such as the age in s."""

    content: bytes | LazyPayload
    encoding: str
    attachment: Mapping[str, Any] = {}

    @property
    def num_bytes(self) -> int:
        """The size of the payload; of one that is not made yet, about."""
        return len(self.content) if isinstance(self.content, bytes) else self.content.num_bytes

    @property
    def payload(self) -> bytes:
        """The bytes of the content. If it is lazy, see its ``make``."""
        return self.content if isinstance(self.content, bytes) else self.content.make()


class ServerParameters(NamedTuple):
    """A server's parameters (§6): the XML as received, empty if the server gives none any more.

    ``session`` is the number of its session, ``version`` grows whenever the parameters change. ``message``
    is the recorded ``parameters_t`` if a take is replayed: an output that publishes this type sends it
    unchanged. ``components`` are those that the source's streams request, ``parsed`` is what the XML says of
    them, without the items of others, and ``frame`` the coordinate frame of the source's poses; in answers to
    peers, they are not filled in.
    """

    xml: bytes
    session: int
    version: int
    age_s: float = 0.0
    message: bytes = b""
    parsed: Parameters = Parameters()
    frame: CoordinateFrame = CoordinateFrame("")
    components: frozenset[ComponentType] = frozenset(WIRE_ORDER)


_UTIME: Final = slice(8, 16)


def encode_parameters(
    parameters: ServerParameters, *, utime: int, arrived_utime: int, sequence: int
) -> bytes:
    """Return parameters as a ``parameters_t``, the same on LCM and in takes.

    ``utime`` is when it is published, ``arrived_utime`` when the parameters arrived from the server, both in
    µs since the Unix epoch.
    """
    message = rtc3d.parameters_t()
    message.utime, message.capture_utime = utime, arrived_utime
    message.sequence = sequence
    message.session, message.parameters_version = parameters.session, parameters.version
    message.xml = xml_text(parameters.xml)
    return bytes(message.encode())


def published_again(message: bytes, utime: int) -> bytes:
    """Return an encoded ``parameters_t`` as of a later time, in µs since the Unix epoch."""
    return message[: _UTIME.start] + utime.to_bytes(8, "big", signed=True) + message[_UTIME.stop :]


class ServerFile(NamedTuple):
    """A C3D file that the server sent. It is at ``path`` until newer files replace it."""

    path: Path
    num_bytes: int

    @property
    def description(self) -> dict[str, Any]:
        """What peers are told about it."""
        return {"name": self.path.name, "bytes": self.num_bytes}


Command = Callable[[str, Mapping[str, str]], Awaitable[Answer]]
"""A command of one output: takes the source's name and the options; raises QueryError.

It changes something only with CONTROL_OPTION; the service has then checked that peers may control the source.
"""


class QueryService(Protocol):
    """Answers the queries of peers about every source. Call it in the event loop."""

    def serves(self, source: str) -> bool:
        """Return whether the gateway has this source now."""

    def server(self, source: str) -> str:
        """Return HOST:PORT of the server of a source; "" if the gateway does not have the source."""

    def keys(self, source: str) -> list[KeyPath]:
        """Return every key that a wildcard may select; not those of ``commands``."""

    def commands(self) -> Sequence[str]:
        """Return the keys that no wildcard selects: recording control, and the outputs' own commands."""

    def accepted_keys(self, source: str) -> str:
        """Return the keys that can be queried, as text for an error message."""

    async def answer(self, source: str, path: KeyPath, options: Mapping[str, str]) -> Answer:
        """Return the answer for one key; raises QueryError.

        If the options have CONTROL_OPTION, peers must be allowed to control the source, and the rate of such
        queries is limited.
        """

    async def answer_all(
        self, source: str, paths: Sequence[KeyPath], options: Mapping[str, str]
    ) -> dict[KeyPath, Answer]:
        """Return the answers for several keys, without the keys that have none.

        Raises QueryError if no key has one.
        """

    async def parameters(self, source: str, sections: Sequence[str], *, fresh: bool) -> ServerParameters:
        """Return the parameters of some sections (§6); () means all. Raises QueryError.

        With ``fresh``, accept no cached parameters older than ``fresh_interval_s``.
        """


class Output(ABC):
    """One destination of the gateway's messages, such as a Zenoh session or an LCM URL.

    Only ``close`` may block. No method raises, except ``publish`` of the publishers. An output that cannot
    send retries by itself, and ``health`` says what is wrong.
    """

    name: str
    """The name in the configuration, in counters and in logs: zenoh, lcm."""

    max_rate_hz: Mapping[ComponentType, float] = NO_LIMITS
    """The highest rate, in Hz, of each component that has a limit."""

    has_tool_poses: bool = False
    """Whether to publish the pose of each tool on its own topic."""

    drop_causes: Sequence[str] = ()
    """The causes of drops that the metrics show from the start, as 0. Others appear with their first drop."""

    # The core.

    @abstractmethod
    def start(self) -> None:
        """Start to open the connection, and return at once."""

    @abstractmethod
    def publisher(self, topic: Topic) -> Publisher:
        """Return a new publisher of ``topic``. The output need not be open yet."""

    def until_declared(self) -> Future[None] | None:
        """Return what is done when all publishers so far can send; None if they can, or if it is not open.

        Only who must not lose the first message of a topic waits for it, in another thread than the loop's.
        """
        return None

    @abstractmethod
    def health(self) -> OutputHealth:
        """Return whether the output can send, and if not, why and what to do."""

    def warnings(self) -> Sequence[str]:
        """Return what works and yet needs attention, a sentence each: the gateway is degraded."""
        return ()

    @abstractmethod
    def close(self) -> None:
        """Close everything. Called in a thread; safe to call more than once and in any state."""

    # Maintenance.

    def maintain(self) -> None:
        """Do periodic work without blocking. Called once a second in the event loop."""

    def is_configured_like(self, other: "Output") -> bool:
        """Return whether a reload can keep this output: ``take_over`` makes it behave like ``other``."""
        return self is other

    def take_over(self, other: "Output") -> bool:
        """Apply the settings of ``other``, which is configured like this output; return whether any differ.

        Called in the event loop by a reload that keeps this output. What was published goes on.
        """
        differs = self.has_tool_poses is not other.has_tool_poses
        self.has_tool_poses = other.has_tool_poses
        return differs

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what the output itself loses of ``source``, such as requests of peers.

        Called before ``announce``. Messages that ``publish`` refuses are counted by the gateway.
        """

    def watch_wanted(self, source: str, on_change: Callable[[], None]) -> bool:
        """Return whether ``wanted`` of the publishers of ``source`` is exact; by default, it may be late.

        If it is exact, the gateway publishes only what is wanted, and counts nothing else as sent. The output
        must call ``on_change`` in the event loop whenever ``wanted`` of a publisher changes, or what
        ``FramePublisher.prepare`` would return. Called before ``announce``.
        """
        return False

    # Liveliness.

    def announce(self, source: str) -> None:
        """Start to serve ``source`` and show it to peers, until ``withdraw``."""

    def withdraw(self, source: str) -> None:
        """Stop serving ``source``."""

    def show_streaming(self, source: str, is_streaming: bool) -> None:
        """Show peers whether frames of ``source`` arrive."""

    # Whole frames instead of components.

    def frame_publisher(self, source: str) -> FramePublisher | None:
        """Return a publisher of whole frames of ``source``; None if the output takes single components."""
        return None

    # Parameters and files from the server.

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Publish the parameters of a source's server. Called for every connection and every change.

        Returns a future if messages that are published after this call could overtake the parameters. It is
        done when they no longer can.
        """
        return None

    def topic_names(self, source: str) -> Mapping[str, Mapping[str, str]]:
        """Return the names that this output has given to items of ``source`` whose labels it cannot use.

        By the component's key, and then by the label: {"6d": {"Left Foot": "Left_Foot"}}.
        """
        return {}

    def announce_file(self, source: str, file: ServerFile) -> None:
        """Announce a C3D file that the server sent."""

    # Recordings and measurements of the server.

    def show_measurement(self, source: str, is_running: bool | None) -> None:
        """Take note that a measurement runs on the server of ``source``, or that none does.

        None means that this is unknown, because no connection has frames or No Data.
        """

    async def follow_recording(self, source: str, *, start: bool, name: str) -> Mapping[str, Any]:
        """Follow a recording that a peer starts or stops on the server of ``source``.

        Called before it starts and after it has stopped. Returns what to add to the reply to the peer.
        """
        return {}

    # Messages that were published before.

    async def recorded_messages(self, source: str, key: str, wanted: WantedMessages) -> FoundMessages | None:
        """Return messages from the disk that the gateway has published since it was started.

        ``key`` is that of a component, "status", "clock" or "6d/TOOL". The answer is like that of
        MessageHistory.find; None if the output has none of this key. Raises QueryError: busy, or disk.
        """
        return None

    def oldest_recorded(self, source: str, key: str) -> tuple[int, int] | None:
        """Return number and time, in µs since the Unix epoch, of the oldest message on the disk."""
        return None

    # Queries of peers.

    def serve_queries(self, service: QueryService) -> None:
        """Start to answer queries of peers with ``service``. Called once, before ``start``."""

    async def stop_queries(self) -> None:
        """Stop answering queries. Called before ``close``."""

    @property
    def query_results(self) -> Mapping[str, Mapping[str, int]] | None:
        """By source, the number of queries by result; None if the output answers none.

        The result is ok, the code of the error in the reply, or no-reply.
        """
        return None

    @property
    def commands(self) -> Mapping[str, Command]:
        """The output's own commands by name. Peers call them as keys below PREFIX/SOURCE/."""
        return {}


class IgnoringPublisher:
    """Accepts messages and does nothing with them: for outputs of whole frames, which have no topics."""

    wanted = False

    def publish(self, message: bytes) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""
