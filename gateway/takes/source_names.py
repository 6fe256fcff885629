"""Which source the channels of a take belong to."""

from collections.abc import Iterable
from typing import Final

import rtc3d

from gateway.errors import ProtocolError
from gateway.messages.decode import decode, message_type
from gateway.takes.event_log import Event

NAMED_WITHIN_EVENTS: Final = 50_000
"""Each source is named within this many events: by its description, or by its status once a second."""

_POSE: Final = "_6D_"


class SourceNames:
    """The names of the sources by the beginning of their channels, such as MOCAP_LAB.

    A source is named by its description or its status. Without both, its name is made from the channels.
    Each source has another name, also if two gateways with different prefixes have sources of one name.
    """

    def __init__(self, events: Iterable[Event]) -> None:
        self._names: dict[str, str] = {}  # by the beginning of the channels
        for event in events:
            try:
                kind = message_type(event.message)
                if kind is rtc3d.take_t or kind is rtc3d.status_t:
                    self._add(event.channel.rpartition("_")[0], decode(event.message).source)
            except ProtocolError:
                continue

    @property
    def names(self) -> list[str]:
        """The names of the sources so far."""
        return list(self._names.values())

    def source(self, channels: str) -> str:
        """Return the name of the source whose channels begin with this, such as MOCAP_LAB."""
        if channels not in self._names:
            self._add(channels, channels.partition("_")[2].lower() or channels.lower() or "take")
        return self._names[channels]

    def source_and_tool(self, channel: str) -> tuple[str, str] | None:
        """Return the source and the key of a tool's pose; None if it is not the channel of one.

        Labels and names of sources may have the separator in them, too.
        """
        known = [channels for channels in self._names if channel.startswith(channels + _POSE)]
        channels = max(known, key=len, default="") or channel.partition(_POSE)[0]
        label = channel[len(channels) + len(_POSE) :]
        return (self.source(channels), f"6d/{label}") if label else None

    def _add(self, channels: str, name: str) -> None:
        if channels in self._names:
            return
        taken = set(self._names.values())
        if not name or name in taken:
            name = channels.lower()
        number, candidate = 1, name
        while candidate in taken:
            number += 1
            candidate = f"{name}_{number}"
        self._names[channels] = candidate
