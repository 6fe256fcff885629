"""Messages out on LCM: one channel per topic."""

import ipaddress
import logging
import socket
import time
from collections.abc import Callable
from typing import Final
from urllib.parse import urlsplit

import lcm

from gateway.config.settings import LcmSettings
from gateway.errors import OutputError
from gateway.log import HOLD_S, FailureLog
from gateway.messages.topics import Topic, lcm_channel, unique_name
from gateway.outputs.status import OutputHealth

_RETRY_S: Final = 1.0

logger = logging.getLogger(__name__)


def multicast_problem(url: str) -> str:
    """Return why datagrams to a ``udpm:`` or ``mpudpm:`` URL would not leave this machine; "" if they would.

    LCM says so on C's stderr only and raises a bare RuntimeError, so it is found out before.
    """
    parts = urlsplit(url)
    if parts.scheme not in {"udpm", "mpudpm"}:
        return ""
    try:
        group, port = str(ipaddress.IPv4Address(parts.hostname or "239.255.76.67")), parts.port or 7667
    except ValueError:
        return ""  # not an address: LCM itself refuses it
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((group, port))
    except OSError as error:
        return (
            f"no multicast to {url}: {error}; bring a network interface up, or give it a multicast route: "
            "ip route add 224.0.0.0/4 dev INTERFACE"
        )
    return ""


def open_lcm(url: str) -> lcm.LCM:
    """Return an LCM object on ``url``; raises OutputError with the reason and the remedy."""
    problem = multicast_problem(url)
    if problem:
        raise OutputError(problem, cause="not open")
    try:
        return lcm.LCM(url)
    except RuntimeError as error:
        raise OutputError(f"LCM does not open {url}: {error}; check lcm.url", cause="not open") from error


class LcmPublisher:
    """Sends the messages of one topic on ``channel``."""

    wanted = True  # LCM has no way to know who listens

    def __init__(self, output: "LcmOutput", channel: str) -> None:
        self.channel = channel
        self._output = output
        self._closed = False

    def publish(self, message: bytes) -> None:
        """Send one message; raises OutputError if the network did not take it."""
        if self._closed:
            raise OutputError(f"LCM channel {self.channel} is closed; ask for a new one", cause="closed")
        self._output.send(self.channel, message)

    def close(self) -> None:
        """Free the channel's name."""
        if not self._closed:
            self._closed = True
            self._output.forget(self)


class LcmOutput:
    """One LCM object. ``shared`` is one that exists already: memq:// reaches no other."""

    name = "lcm"

    def __init__(self, settings: LcmSettings, shared: lcm.LCM | None = None) -> None:
        self.settings = settings
        self.max_rate_hz = settings.max_rate_hz
        self._shared = shared
        self._lcm: lcm.LCM | None = None
        self._channels: set[str] = set()
        self._declarations: list[Callable[[lcm.LCM], None]] = []
        self._problem = "LCM is not open; start the output first"
        self._retry_at_s = 0.0
        self._opening = FailureLog(logger, self.name)
        self._sending = FailureLog(logger, self.name, HOLD_S)
        self._is_failing = False

    def start(self) -> None:
        """Open LCM; what fails is tried again by ``maintain``."""
        try:
            self._lcm = self._shared or open_lcm(self.settings.effective_url)
        except OutputError as error:
            self._problem = str(error)
            self._opening.failed(self._problem)
            self._retry_at_s = time.monotonic() + _RETRY_S
        else:
            self._problem = ""
            self._opening.succeeded(f"sending to {self.settings.effective_url}")
            for declare in self._declarations:
                declare(self._lcm)

    @property
    def is_shared(self) -> bool:
        """Whether somebody else handles this LCM object's subscriptions."""
        return self._shared is not None

    def when_open(self, declare: Callable[[lcm.LCM], None]) -> None:
        """Call ``declare`` with the LCM object once it is open."""
        self._declarations.append(declare)
        if self._lcm is not None:
            declare(self._lcm)

    def publisher(self, topic: Topic) -> LcmPublisher:
        """Return a new publisher of ``topic`` on a channel that no other publisher of ours has."""
        name = lcm_channel(self.settings.prefix, topic.source, *topic.path)
        channel = unique_name(name, self._channels)
        self._channels.add(channel)
        return LcmPublisher(self, channel)

    def forget(self, publisher: LcmPublisher) -> None:
        """Free the channel of a closed publisher."""
        self._channels.discard(publisher.channel)

    def send(self, channel: str, message: bytes) -> None:
        """Publish on ``channel``; raises OutputError if it failed. The next message is tried again."""
        if self._lcm is None:
            raise OutputError(self._problem, cause="not open")
        try:
            self._lcm.publish(channel, message)
        except OSError as error:
            url = self.settings.effective_url
            self._problem = multicast_problem(url) or f"LCM did not send to {url}: {error}; check lcm.url"
            self._sending.failed(self._problem)
            self._is_failing = True
            raise OutputError(self._problem, cause="send failed") from error
        if self._is_failing:
            self._problem = ""
            self._sending.recovered(f"sending to {self.settings.effective_url}")
            self._is_failing = self._sending.failing

    def announce(self, source: str) -> None:
        """LCM has nothing of the kind; the status messages show who serves ``source``."""

    def withdraw(self, source: str) -> None:
        """LCM has nothing of the kind."""

    def show_flowing(self, source: str, flowing: bool) -> None:
        """LCM has nothing of the kind; the status messages show the state of every stream."""

    def maintain(self) -> None:
        """Open LCM if it is not open and the last try is a while ago."""
        if self._lcm is None and time.monotonic() >= self._retry_at_s:
            self.start()

    def health(self) -> OutputHealth:
        """Return whether the last message could be sent."""
        return OutputHealth(not self._problem, self._problem)

    def close(self) -> None:
        """Let LCM go: it has no close, deleting the object frees its sockets and thread."""
        self._lcm = None
        self._problem = "LCM is closed; start the gateway again"
        self._retry_at_s = float("inf")
