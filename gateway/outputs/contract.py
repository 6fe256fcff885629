"""The contract between the gateway and its outputs; tests/contract/ holds every output to it.

The core is ``start``, ``publisher``, ``health`` and ``close``. Everything else is an optional ability: a
method or an attribute with a default that does nothing. An output overrides what it can do, and no caller
asks for its class.
"""

from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple, Protocol

from gateway.messages.stamp import Stamp
from gateway.messages.topics import Topic
from gateway.outputs.status import OutputHealth
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import Frame

KeyPath = tuple[str, ...]
"""A key below PREFIX/SOURCE/, split at its slashes: ("parameters", "3d")."""

NO_LIMITS: Final[Mapping[ComponentType, float]] = {}


class Publisher(Protocol):
    """Sends the messages of one topic."""

    @property
    def wanted(self) -> bool:
        """Whether anybody may be subscribed; always True where the output cannot know."""

    def publish(self, message: bytes) -> None:
        """Send one message without blocking, whatever the peer does.

        Raises OutputError if the output does not take it. That message is lost; the next may be sent
        as before.
        """

    def close(self) -> None:
        """Close the publisher. Messages published later raise OutputError."""


class FramePublisher(Protocol):
    """Takes the whole frames of one source, for outputs that need more than one component at a time."""

    @property
    def wanted(self) -> bool:
        """Whether anybody may be subscribed; always True where the output cannot know."""

    def publish(
        self, frame: Frame, stamp: Stamp, sequence: int, components: frozenset[ComponentType]
    ) -> None:
        """Send the ``components`` of one frame without blocking.

        ``sequence`` counts the frames of the source from 0. Raises OutputError if the output does not take
        the frame.
        """

    def close(self) -> None:
        """Close the publisher."""


class Answer(NamedTuple):
    """An answer to a peer: its bytes, their Zenoh encoding, and further facts (ages in s, names, session)."""

    payload: bytes
    encoding: str
    attachment: Mapping[str, Any] = {}


class ServerParameters(NamedTuple):
    """A server's parameters (§6): its XML as received, the session it came in, and how old it is in s."""

    xml: bytes
    session: int
    age_s: float = 0.0


Command = Callable[[str, Mapping[str, str]], Awaitable[Answer]]
"""An output's own command: takes the source's name and the options; raises QueryError."""


class QueryService(Protocol):
    """Answers the queries of peers about every source. Call it in the event loop."""

    def serves(self, source: str) -> bool:
        """Return whether the gateway has this source now."""

    def keys(self, source: str) -> list[KeyPath]:
        """Return every key that a wildcard may select; commands and recording control are not among them."""

    def accepted_keys(self, source: str) -> str:
        """Return the keys that can be queried, as text for an error message."""

    async def answer(self, source: str, path: KeyPath, options: Mapping[str, str]) -> Answer:
        """Return the answer to one key; raises QueryError."""

    async def answer_all(
        self, source: str, paths: Sequence[KeyPath], options: Mapping[str, str]
    ) -> dict[KeyPath, Answer]:
        """Return the answers to several keys, without the keys that have none.

        Raises QueryError if none has one.
        """

    async def parameters(self, source: str, sections: Sequence[str], *, fresh: bool) -> ServerParameters:
        """Return the parameters in some sections (§6), () for all; raises QueryError."""


class Output(ABC):
    """A way out of the gateway.

    Only ``close`` may take long. Nothing here raises, except ``publish`` of publishers. An output that cannot
    send keeps trying by itself, and ``health`` says in words what is wrong.
    """

    name: str
    """The short name in the configuration, counters and logs: zenoh, lcm."""

    max_rate_hz: Mapping[ComponentType, float] = NO_LIMITS
    """The highest rate of each component that is limited, in Hz."""

    has_tool_poses: bool = False
    """Whether each tool's pose is published on a topic of its own."""

    drop_causes: Sequence[str] = ()
    """The causes of drops that are counted from 0 on in the metrics; others appear with their first drop."""

    # The core.

    @abstractmethod
    def start(self) -> None:
        """Start to open what the output sends through; return at once."""

    @abstractmethod
    def publisher(self, topic: Topic) -> Publisher:
        """Return a new publisher of ``topic``, before or after the output is open."""

    @abstractmethod
    def health(self) -> OutputHealth:
        """Return whether the output can send, and if not, why and what to do."""

    @abstractmethod
    def close(self) -> None:
        """Close everything. Safe to call more than once, and in any state; called in a thread."""

    # Upkeep.

    def maintain(self) -> None:
        """Do what is due; called once a second in the event loop, does not block."""

    def is_configured_like(self, other: "Output") -> bool:
        """Return whether ``other`` would behave the same, so that a reload can keep this one."""
        return self is other

    def drops(self, source: str) -> Mapping[str, int]:
        """Return how many requests about ``source`` the output dropped by itself, by cause."""
        return {}

    # Liveliness.

    def announce(self, source: str) -> None:
        """Serve ``source`` from now on, and show it to peers, until ``withdraw``."""

    def withdraw(self, source: str) -> None:
        """Serve ``source`` no longer."""

    def show_streaming(self, source: str, is_streaming: bool) -> None:
        """Show peers whether frames of ``source`` arrive."""

    # Whole frames instead of components.

    def frame_publisher(self, source: str) -> FramePublisher | None:
        """Return a publisher of whole frames of ``source``; None if the output takes single components."""
        return None

    # What the server sends besides frames.

    def publish_parameters(self, source: str, parameters: ServerParameters) -> None:
        """Publish the parameters of a source's server; called for every connection and every change."""

    def announce_file(self, source: str, description: Mapping[str, Any]) -> None:
        """Announce a C3D file that the server sent: its name and bytes."""

    # Queries of peers.

    def serve_queries(self, service: QueryService) -> None:
        """Answer queries of peers by ``service``; called once, before ``start``."""

    async def stop_queries(self) -> None:
        """Stop answering queries; called before ``close``."""

    @property
    def query_results(self) -> Mapping[str, int] | None:
        """How many queries were answered with ok, or with which error; None if the output answers none."""
        return None

    @property
    def commands(self) -> Mapping[str, Command]:
        """The output's own commands, which peers call as keys below PREFIX/SOURCE/, by name."""
        return {}
