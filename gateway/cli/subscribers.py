"""Subscribers of what a gateway publishes, one class per side: for ``echo``, ``demo`` and tests."""

import re
import threading
from collections.abc import Callable
from typing import Any, Final

import lcm
import zenoh

from gateway.config.values import zenoh_reason
from gateway.errors import OutputError
from gateway.messages.topics import lcm_channel, zenoh_key
from gateway.outputs.zenoh.output import zenoh_config

Receive = Callable[[str, bytes], None]
"""Called with the key or channel and the message, from a thread of the listener's own."""

QUEUE_MESSAGES: Final = 10_000
"""LCM's own default of 30 messages drops some whenever this process pauses for a moment."""

_POLL_MS: Final = 100


def key_pattern(prefix: str, source: str | None, component: str | None) -> str:
    """Return the key expression of one component, or of all (None), of one source or of all."""
    return zenoh_key(prefix, source or "*") + "/" + (component or "**")


def channel_pattern(prefix: str, source: str | None, component: str | None) -> str:
    """Return the regular expression of the channels; the arguments are as for ``key_pattern``."""
    if source is not None and component is not None:
        return re.escape(lcm_channel(prefix, source, component))
    if source is not None:
        return re.escape(lcm_channel(prefix, source)) + "_.+"
    return re.escape(prefix) + "_.+" + ("" if component is None else "_" + re.escape(component.upper()))


def open_zenoh(connect: str | None) -> zenoh.Session:
    """Return an open session; raises OutputError if it does not open.

    With ``connect``, an endpoint such as tcp/127.0.0.1:7447, it is a client of that and looks for
    nobody else; without, a peer that finds others by multicast as Zenoh does by default.
    """
    config: dict[str, Any] = {}
    if connect is not None:
        config = {
            "mode": "client",
            "connect": {"endpoints": [connect]},
            "scouting": {"multicast": {"enabled": False}},
        }
    try:
        return zenoh.open(zenoh_config(config))
    except zenoh.ZError as error:
        where = f" to {connect}" if connect else ""
        raise OutputError(
            f"no Zenoh session{where}: {zenoh_reason(error)}; is the gateway or the router there?",
            cause="not open",
        ) from error


class ZenohListener:
    """Subscribes to ``keys``, a key expression, on a session that stays the caller's."""

    def __init__(self, session: zenoh.Session, keys: str, receive: Receive) -> None:
        def on_sample(sample: zenoh.Sample) -> None:
            receive(str(sample.key_expr), sample.payload.to_bytes())

        self._subscriber = session.declare_subscriber(keys, on_sample)

    def close(self) -> None:
        """Unsubscribe."""
        self._subscriber.undeclare()


class LcmListener:
    """Subscribes to ``channels``, a regular expression, and handles them in a thread of its own."""

    def __init__(self, connection: lcm.LCM, channels: str, receive: Receive) -> None:
        self._lcm = connection
        self._subscription = connection.subscribe(channels, receive)
        self._subscription.set_queue_capacity(QUEUE_MESSAGES)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._handle, name="lcm-listener", daemon=True)
        self._thread.start()

    def _handle(self) -> None:
        while not self._stop.is_set():
            self._lcm.handle_timeout(_POLL_MS)

    def close(self) -> None:
        """End the thread and unsubscribe."""
        self._stop.set()
        self._thread.join()
        self._lcm.unsubscribe(self._subscription)
