"""Finding the sources of gateways on LCM: by the status that each sends once a second."""

import queue
import re
import time
from contextlib import suppress
from typing import Final

from gateway.cli.found_sources import FoundSources, read_status
from gateway.messages.topics import lcm_channel
from gateway.outputs.discovery import DISCOVERY_S
from gateway.outputs.lcm.connection import open_lcm, receiving_url
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.safe_text import safe_text

_LISTEN_S: Final = 1.5
"""Every gateway sends a status within this time. If none is heard, this listens for DISCOVERY_S."""

_READ_S: Final = 1.0
"""How long to read what has arrived, if it is much."""

_MAX_WAITING: Final = 10_000

_CHANNEL: Final = re.compile("_STATUS(_[0-9]+)?$")
"""The end of a channel. Another source with a similar name has a number behind it (topics.unique_name)."""


def find_on_lcm(url: str, prefix: str, source: str | None = None) -> FoundSources:
    """Return the sources that are heard on ``url``, or only ``source``. Raises OutputError."""
    found = FoundSources()
    num_unread = 0
    received: queue.Queue[tuple[str, bytes]] = queue.Queue(_MAX_WAITING)

    def receive(channel: str, message: bytes) -> None:
        nonlocal num_unread
        try:
            received.put_nowait((channel, message))
        except queue.Full:
            num_unread += 1

    subscriber = LcmSubscriber(
        open_lcm(receiving_url(url)), f"{re.escape(prefix)}_.+{_CHANNEL.pattern}", receive
    )
    start_s = time.monotonic()
    try:
        while (left_s := start_s + (_LISTEN_S if found.sources else DISCOVERY_S) - time.monotonic()) > 0:
            with suppress(queue.Empty):
                _add(found, prefix, source, *received.get(timeout=left_s))
    finally:
        subscriber.close()
    while not received.empty() and time.monotonic() < start_s + DISCOVERY_S + _READ_S:
        _add(found, prefix, source, *received.get())
    found.num_left_out += received.qsize() + num_unread
    return found


def _add(found: FoundSources, prefix: str, wanted: str | None, channel: str, message: bytes) -> None:
    """Add the source of a status, unless another is wanted, or it has a longer prefix: MOCAP_HALL."""
    if not found.takes(message):
        return
    source = read_status(message, "")
    if not source.name:
        source = source._replace(
            name=safe_text(_CHANNEL.split(channel)[0].removeprefix(f"{prefix}_").lower())
        )
    channels = lcm_channel(prefix, source.name)
    if channel.startswith(channels):
        found.hear(source.name)
        if wanted is None or channels == lcm_channel(prefix, wanted):
            found.add(source)
