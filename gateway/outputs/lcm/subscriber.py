"""Subscribing to a gateway's messages on LCM, for ``echo``, the demo and tests."""

import contextlib
import logging
import re
import threading

import lcm

from gateway.messages.topics import DEFAULT_LCM_PREFIX, lcm_channel
from gateway.outputs.kind import DemoSide, Receive, Subscription, SubscriptionRequest
from gateway.outputs.lcm.connection import QUEUE_MESSAGES, Waiting, open_lcm, receiving_url, reconnect
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.presence import is_presence
from gateway.outputs.lcm.sender import RETRY_S
from gateway.outputs.lcm.settings import LcmSettings, effective_lcm_url
from gateway.runtime.failures import FailureLog

logger = logging.getLogger(__name__)


def channel_pattern(prefix: str, source: str | None, component: str | None) -> str:
    """Return the regular expression of the channels. None means all sources, or all components.

    The pose of one tool is 6d/LABEL, those of all tools are 6d/*.
    """
    takes_all = component is None or component.endswith("/*")
    path = [] if component is None else component.removesuffix("/*").split("/", 1)
    if source is not None:
        channels = re.escape(lcm_channel(prefix, source, *path))
    elif path:
        channels = f"{re.escape(prefix)}_.+{re.escape(lcm_channel('', *path))}"
    else:
        return f"{re.escape(prefix)}_.+"
    return f"{channels}_.+" if takes_all else channels


class LcmSubscriber:
    """Subscribes to ``channels``, a regular expression, and receives messages in its own thread."""

    def __init__(self, connection: lcm.LCM, channels: str, receive: Receive) -> None:
        self._lcm = connection
        self._subscription = connection.subscribe(channels, receive)
        self._subscription.set_queue_capacity(QUEUE_MESSAGES)
        self._is_connected = True
        self._failures = FailureLog(logger, "lcm")
        self._stop = threading.Event()
        self._waiting = Waiting()
        self._thread = threading.Thread(target=self._receive, name="lcm-subscriber", daemon=True)
        self._thread.start()

    def _receive(self) -> None:
        while not self._stop.is_set():
            try:
                if self._waiting.wait(self._lcm):
                    self._lcm.handle_timeout(0)
            except OSError as error:
                self._is_connected = False
                self._failures.failed(f"the connection is lost, so no more messages arrive: {error}")
                while not self._is_connected and not self._stop.wait(RETRY_S):
                    with contextlib.suppress(OSError):
                        reconnect(self._lcm, "RECONNECTED")
                        self._is_connected = True
                        self._failures.recovered("connected again")

    def close(self) -> None:
        """End the thread and unsubscribe."""
        self._stop.set()
        self._waiting.wake()
        self._thread.join()
        self._waiting.close()
        if self._is_connected:  # LCM would connect again first, and let no other thread run meanwhile
            self._lcm.unsubscribe(self._subscription)


def without_presence(receive: Receive) -> Receive:
    """Return a function that passes all messages on but those with which gateways show themselves.

    They are on the URL of requests, which may be that of the messages or that of another gateway's.
    """

    def receive_message(channel: str, message: bytes) -> None:
        if not is_presence(channel, message):
            receive(channel, message)

    return receive_message


def subscribe(request: SubscriptionRequest, receive: Receive) -> LcmSubscriber:
    """Subscribe with a new LCM object; ``request.address`` is its URL. Raises OutputError."""
    channels = channel_pattern(request.prefix or DEFAULT_LCM_PREFIX, request.source, request.component)
    connection = open_lcm(receiving_url(effective_lcm_url(request.address)))
    return LcmSubscriber(connection, channels, without_presence(receive))


def demo(use_network: bool) -> DemoSide:
    """Return LCM for the demo: in memory, or on multicast with ``use_network``."""
    settings = LcmSettings(url=None if use_network else "memq://")
    connection = open_lcm(receiving_url(settings.effective_url))

    def subscribe_here(source: str, receive: Receive) -> Subscription:
        channels = channel_pattern(settings.prefix, source, None)
        return LcmSubscriber(connection, channels, without_presence(receive))

    # memq:// connects only users of one LCM object, so the output and the subscriber share it.
    return DemoSide(settings, LcmOutput(settings, None if use_network else connection), subscribe_here)


def no_gateway_on_lcm(name: str, url: str) -> str:
    """Return why nothing may arrive; ``name`` is the prefix or what the channels of the source begin with."""
    return (
        f"no gateway found on LCM ({name}, {url}); check that it is running with this prefix and URL, and "
        "that its ttl reaches this computer"
    )
