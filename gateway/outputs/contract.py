"""What every output is to the fan-out; tests/contract/ holds each one to it."""

from collections.abc import Mapping
from typing import Protocol

from gateway.messages.topics import Topic
from gateway.outputs.status import OutputHealth
from gateway.rtc3d.components import ComponentType


class Publisher(Protocol):
    """Sends the messages of one topic."""

    @property
    def wanted(self) -> bool:
        """Whether anybody may be listening; always True where the output cannot know."""

    def publish(self, message: bytes) -> None:
        """Send one message without waiting.

        Raises OutputError if it was not handed over; the message is then lost, and the next may be
        sent as before.
        """

    def close(self) -> None:
        """Give up the topic. Messages published later raise OutputError."""


class Output(Protocol):
    """A way out of the gateway. Only ``start`` and ``close`` may take long; neither raises.

    An output that cannot send keeps trying by itself; ``health`` says in words what is wrong.
    """

    @property
    def name(self) -> str:
        """The short name that counters go by: zenoh, lcm."""

    @property
    def max_rate_hz(self) -> Mapping[ComponentType, float]:
        """The highest rate of each component that is to be limited."""

    def start(self) -> None:
        """Begin to open what the output sends through; returns at once."""

    def publisher(self, topic: Topic) -> Publisher:
        """Return a new publisher of ``topic``, before or after the output is open."""

    def announce(self, source: str) -> None:
        """Show to all that the gateway serves ``source``, until ``withdraw`` or the output's end."""

    def withdraw(self, source: str) -> None:
        """Show no longer that the gateway serves ``source``."""

    def show_flowing(self, source: str, flowing: bool) -> None:
        """Show to all whether frames of ``source`` flow."""

    def maintain(self) -> None:
        """Look after the output: called once a second from the loop; does not block."""

    def health(self) -> OutputHealth:
        """Return whether the output can send, and if not why and what to do."""

    def close(self) -> None:
        """Close everything. Safe to call more than once, and from any state."""
