"""What the two transports of a client have in common: queries, replies, time limits, and their interface."""

import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import Any, Final, Generic, NamedTuple, Protocol, TypeVar

from gateway.client.found_sources import FoundSources
from gateway.client.reception import Reception
from gateway.errors import QueryError
from gateway.outputs.kind import DISCOVERY_S

RETRY_S: Final = 0.5
"""How long to wait before repeating a query that got no reply, or came while there were too many."""

BUSY_CODES: Final = frozenset({"busy", "rate"})
"""The codes of a gateway that gets too many queries. They count as no reply as long as there is time."""

_CLOSE_S: Final = 0.5

ReceivedT = TypeVar("ReceivedT")


class Query(NamedTuple):
    """A query about ``subject`` (parameters or takes), as one key of the gateway's sources.

    ``sections`` are parts of the parameters, such as "3d"; () means all.
    """

    key: str
    subject: str
    sections: tuple[str, ...] = ()
    options: Mapping[str, str] = {}


class Reply(NamedTuple):
    """A reply about ``source``, and what the gateway says about the content (``facts``).

    If gateways on Zenoh serve sources of the same name, the second one is called ``lab_2``. ``gateway`` is
    the id of the gateway's Zenoh session; "" on LCM.
    """

    source: str
    sections: tuple[str, ...]
    content: bytes
    facts: Mapping[str, Any] = {}
    gateway: str = ""

    @property
    def age_s(self) -> float | None:
        """The time since the gateway received parameters from the server; None if unknown."""
        return self._number("age_s")

    @property
    def version(self) -> int | None:
        """The ``parameters_version`` of the messages that parameters describe; None if unknown."""
        version = self._number("parameters_version")
        return None if version is None else int(version)

    def _number(self, name: str) -> float | None:
        try:
            value = float(self.facts[name])
        except (ValueError, TypeError, LookupError, OverflowError):
            return None
        return value if math.isfinite(value) else None


class Replies(NamedTuple, Generic[ReceivedT]):
    """All replies to a query, and the problems of other sources; QueryError lists their codes."""

    received: ReceivedT
    problems: list[QueryError]


class TimeLimits:
    """Two time limits, both counted from now: for finding a gateway, and for its replies."""

    def __init__(self, timeout_s: float) -> None:
        start_s = time.monotonic()
        self._timeout_s = timeout_s
        self._end_s = start_s + timeout_s
        self._discovery_end_s = start_s + DISCOVERY_S

    @property
    def left_s(self) -> float:
        """Seconds left for replies; 0 when the time is up."""
        return max(0.0, self._end_s - time.monotonic())

    @property
    def discovery_is_over(self) -> bool:
        """Whether every running gateway should have been found by now."""
        return time.monotonic() >= self._discovery_end_s

    def no_reply(self, subject: str) -> QueryError:
        """Return the error for a gateway that is running but did not reply about ``subject``."""
        return QueryError(
            f"no reply about {subject} within {self._timeout_s:g} s although a gateway is running; "
            "try again, or with a longer --timeout",
            code="timeout",
        )


class GatewaySubscriber(Protocol):
    """A subscriber that hands what it receives to a Reception."""

    def tick(self) -> None:
        """Query what is not known yet of new sources. Called often, in one thread."""

    def query_takes(self, source: Any) -> None:
        """Query which take the gateway of a source records; see Source.running_take."""

    def silence(self) -> str:
        """Return that no gateway is found, or none with these sources; "" if one is. It may take 1 s."""

    def close(self) -> None:
        """Unsubscribe. It may block while a peer does not read."""


class Transport(ABC):
    """An open connection to Zenoh or LCM."""

    @abstractmethod
    def find(self, wanted: str | None) -> FoundSources:
        """Return the sources that are found, all or only the ``wanted`` one. Raises OutputError."""

    @abstractmethod
    def ask(self, query: Query, source: str | None, timeout_s: float) -> Replies[list[Reply]]:
        """Ask ``source``, or every source that is found (None), until it has replied or time is up.

        Raises OutputError.
        """

    @abstractmethod
    def subscribe(
        self,
        sources: Collection[str],
        components: Collection[str] | None,
        reception: Reception[Any, Any],
    ) -> GatewaySubscriber:
        """See GatewayClient. Closing the subscriber closes this connection."""

    @abstractmethod
    def close(self) -> None:
        """Close the connection."""


def silence_text(subscriber: GatewaySubscriber, reception: Reception[Any, Any]) -> str:
    """Return why nothing has arrived so far. It may take 1 s."""
    names = ", ".join(source.name for source in reception.sources_now)
    found = f"a gateway serves {names or 'this source'}, but nothing arrives from it; try again"
    return subscriber.silence() or found


def close_in_time(subscriber: GatewaySubscriber) -> None:
    """Close a subscriber, but do not wait longer than 0.5 s: a peer that does not read delays it."""
    thread = threading.Thread(target=subscriber.close, name="subscriber-close", daemon=True)
    thread.start()
    thread.join(_CLOSE_S)
