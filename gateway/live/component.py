"""One component of a source, such as its markers, as it arrives."""

import time
from collections import deque
from typing import Any, Final

import numpy as np

from gateway.descriptions.labels import Description, describe
from gateway.live.latency import Latency
from gateway.live.rate import MessageRate
from gateway.live.visibility import Visibility
from gateway.messages.host_time import now_utime
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.takes.component_rows import NATIVE_ITEM_DTYPES, Array, Rows, decode_rows

MAX_WAITING: Final = 20_000
"""How many messages of one component may wait for ``update``; older ones are skipped."""

_MAX_WAITING_BYTES: Final = 32 * 1024 * 1024

_STOPPED_S: Final = 0.5
"""Data that do not come for this long, and for STOPPED_FRAMES frames, have stopped."""
_STOPPED_FRAMES: Final = 4

SLOW_SHARE: Final = 0.95
"""A rate below this share of the announced one is slow."""

_CAN_BE_MISSING: Final = (ComponentType.MARKERS, ComponentType.TOOLS)


class LiveComponent:
    """The newest messages of one component.

    ``receive`` is called in the threads of Zenoh or LCM, everything else in the thread that reads.
    """

    def __init__(self, component: ComponentType) -> None:
        self.type = component
        self.batch = decode_rows(component, [])
        """What came between the last two calls of ``update``, in its order."""
        self.newest_head: Any | None = None
        """The newest message before its items, with the fields of HEAD; None before the first."""
        self.newest_items: Array = np.empty(0, NATIVE_ITEM_DTYPES[component])
        """The items of the newest message, shape (items,), in native byte order."""
        self.arrived_s: float | None = None
        """When the newest message arrived, on the monotonic clock; None before the first."""
        self.newest_arrived_utime: int | None = None
        """When the newest message arrived, before it waited for ``update``: µs since the Unix epoch."""
        self.num_skipped = 0
        """How many messages were not decoded, because too many waited."""
        self.num_malformed = 0
        """How many messages could not be decoded."""
        self.latency = Latency()
        self.description: Description = describe(component, None, 0)
        """The labels, units and announced rate of the newest items."""
        self._visibility = Visibility()
        self._rate = MessageRate()
        self._rate_before_stop_hz = 0.0
        self._num_messages = 0
        self._updated_s = time.monotonic()
        self._waiting: deque[tuple[bytes, int]] = deque()  # messages, and when they arrived
        self._waiting_bytes = 0
        self._described: tuple[Parameters | None, int] | None = None

    # In the threads that receive, one at a time.

    def receive(self, message: bytes) -> None:
        """Take a message."""
        self._waiting.append((message, now_utime()))
        self._waiting_bytes += len(message)
        while len(self._waiting) > MAX_WAITING or self._waiting_bytes > _MAX_WAITING_BYTES:
            self._waiting_bytes -= len(self._waiting.popleft()[0])
            self.num_skipped += 1

    def take_waiting(self) -> list[tuple[bytes, int]]:
        """Return the messages that wait, each with its time of arrival, and remove them."""
        waiting, self._waiting, self._waiting_bytes = self._waiting, deque(), 0
        return [*waiting]

    # In the thread that reads.

    def hold(self) -> None:
        """Count no time since the last ``update``."""
        pause_s = time.monotonic() - self._updated_s
        self._updated_s += pause_s
        if self.arrived_s is not None:
            self.arrived_s += pause_s
        self._rate.shift(pause_s)
        self._visibility.shift(pause_s)

    def update(self, arrived: list[tuple[bytes, int]], parameters: Parameters | None) -> None:
        """Decode messages that have arrived, and describe their items by the source's parameters."""
        now_s = self._updated_s = time.monotonic()
        self.batch = rows = decode_rows(self.type, [message for message, _ in arrived])
        self._num_messages += len(arrived)
        self.num_malformed += rows.malformed
        self._rate.add(self._num_messages, now_s)
        if len(rows.heads):
            self.arrived_s = now_s
            self.newest_arrived_utime = arrived[-1][1]
            self._rate_before_stop_hz = self._rate.rate_hz
            self._take_newest(rows)
            if not rows.malformed:
                times = np.array([utime for _, utime in arrived])
                self.latency.add(rows.heads["capture_utime"], rows.heads["utime"], times)
            for items in rows.items.values():
                if self.type in _CAN_BE_MISSING:
                    self._visibility.add(_is_visible(items), now_s)
        wanted = (parameters, len(self.newest_items))
        if self._described is None or self._described[0] is not parameters or self._described[1] != wanted[1]:
            self._described = wanted
            self.description = describe(self.type, *wanted)

    def _take_newest(self, rows: Rows) -> None:
        self.newest_head = rows.heads[-1]
        self.newest_items = rows.items[int(self.newest_head["num_items"])][-1]

    @property
    def rate_hz(self) -> float:
        """How many messages come per second, over two seconds."""
        return self._rate.rate_hz

    @property
    def announced_rate_hz(self) -> float | None:
        """The rate that the server has announced; None if it has not."""
        return self.description.rate_hz

    @property
    def is_visible(self) -> Array:
        """Whether each marker or tool is visible now, shape (items,): none is if data have stopped."""
        return _is_visible(self.newest_items) & (not self.is_stopped)

    @property
    def visible_shares(self) -> Array:
        """In which share of the frames of the last 10 s each marker or tool was visible, from 0 to 1.

        The shape is (items,); it is (0,) if no frame came in this time.
        """
        shares = self._visibility.shares(time.monotonic())
        return shares if len(shares) == len(self.newest_items) else shares[:0]

    @property
    def is_slow(self) -> bool:
        """Whether fewer messages come than the server has announced."""
        announced_hz = self.announced_rate_hz
        return announced_hz is not None and self.rate_hz < SLOW_SHARE * announced_hz

    @property
    def age_s(self) -> float | None:
        """How long ago the newest message arrived; None before the first."""
        return None if self.arrived_s is None else time.monotonic() - self.arrived_s

    @property
    def is_stopped(self) -> bool:
        """Whether data came before and come no more. Events come at any time, so they never stop."""
        if self.type is ComponentType.EVENT or self.arrived_s is None:
            return False
        frames_s = _STOPPED_FRAMES / self._rate_before_stop_hz if self._rate_before_stop_hz else 0.0
        return time.monotonic() - self.arrived_s > max(_STOPPED_S, frames_s)


def _is_visible(items: Array) -> Array:
    """Return for each marker or tool of an array whether it is visible, in the shape of ``items``.

    Any NaN in a position or orientation means missing (§7.3, field note 7).
    """
    names = [name for name in items.dtype.names or () if name not in {"reliability", "error"}]
    visible: Array = np.ones(items.shape, bool)
    for name in names:
        visible &= np.isfinite(items[name])
    return visible
