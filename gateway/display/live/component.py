"""One component of a source, such as its markers, as it arrives."""

import time
from collections import deque
from typing import Any, Final, NamedTuple

import numpy as np

from gateway.descriptions.labels import Description, describe
from gateway.messages.host_time import now_utime
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.takes.files.component_rows import NATIVE_ITEM_DTYPES, Array, Rows, decode_rows

_WINDOW_S: Final = 2.0


class MessageRate:
    """Messages per second, over two seconds."""

    def __init__(self) -> None:
        self._counts: deque[tuple[float, int]] = deque()  # time and number of messages so far

    def add(self, num_messages: int, now_s: float) -> None:
        """Take the number of all messages so far."""
        self._counts.append((now_s, num_messages))
        while len(self._counts) > 2 and now_s - self._counts[1][0] >= _WINDOW_S:
            self._counts.popleft()

    def shift(self, seconds: float) -> None:
        """Let everything so far have happened later: a pause does not count."""
        self._counts = deque((time_s + seconds, number) for time_s, number in self._counts)

    @property
    def rate_hz(self) -> float:
        """Messages per second; 0 before there are two counts."""
        if len(self._counts) < 2:
            return 0.0
        (first_s, first), (last_s, last) = self._counts[0], self._counts[-1]
        return (last - first) / max(last_s - first_s, 1e-3)


WINDOW_S: Final = 10.0
_STEP_S: Final = 0.5


def visible_percent(share: float) -> float:
    """Return a share from 0 to 1 in %, for one decimal: only 0 and 1 themselves become 0.0 and 100.0."""
    return 100 * share if share in {0, 1} else min(max(100 * share, 0.1), 99.9)


class Visibility:
    """Counts in steps of half a second, over WINDOW_S, in how many frames each item was visible."""

    def __init__(self) -> None:
        self._steps: deque[tuple[float, int, Array]] = deque()  # begin, number of frames, visible frames

    def add(self, is_visible: Array, now_s: float) -> None:
        """Take frames; ``is_visible`` has the shape (frames, items).

        If the number of items changes, counting starts again.
        """
        self._forget(now_s)
        num_frames, num_items = is_visible.shape
        if self._steps and len(self._steps[-1][2]) != num_items:
            self._steps.clear()
        counts = is_visible.sum(axis=0)
        if self._steps and now_s - self._steps[-1][0] < _STEP_S:
            begin_s, former_frames, former_counts = self._steps.pop()
            self._steps.append((begin_s, former_frames + num_frames, former_counts + counts))
        else:
            self._steps.append((now_s, num_frames, counts))

    def shift(self, seconds: float) -> None:
        """Let everything so far have happened later: a pause does not count."""
        self._steps = deque((begin_s + seconds, frames, counts) for begin_s, frames, counts in self._steps)

    def shares(self, now_s: float) -> Array:
        """Return for each item the share of frames in which it was visible, from 0 to 1, shape (items,).

        The shape is (0,) if no frame came within WINDOW_S.
        """
        self._forget(now_s)
        num_frames = sum(frames for _, frames, _ in self._steps)
        if not num_frames:
            return np.zeros(0)
        total: Array = np.sum([counts for _, _, counts in self._steps], axis=0)
        return total / num_frames

    def _forget(self, now_s: float) -> None:
        while self._steps and now_s - self._steps[0][0] > WINDOW_S:
            self._steps.popleft()


_NUM_SAMPLES: Final = 2000


class Percentiles(NamedTuple):
    """Percentiles of a latency, in milliseconds."""

    p50_ms: float
    p99_ms: float


class Latency:
    """The latencies of the newest messages, at most 2000, by stage.

    Latencies to this computer are on two clocks if the gateway runs on another computer, and then they are
    only as exact as these clocks agree. They may be negative.
    """

    def __init__(self) -> None:
        self._samples = np.zeros((_NUM_SAMPLES, 2))  # ms from capture to the gateway, and from there to here
        self._num_added = 0

    def add(self, capture_utime: Array, utime: Array, arrived_utime: Array) -> None:
        """Take the times of messages, each with the shape (messages,), in µs since the Unix epoch."""
        times = np.stack([capture_utime, utime, arrived_utime]).astype(np.float64)[:, -_NUM_SAMPLES:]
        places = (self._num_added + np.arange(times.shape[1])) % _NUM_SAMPLES
        self._samples[places] = np.diff(times, axis=0).T / 1000
        self._num_added += times.shape[1]

    @property
    def to_gateway(self) -> Percentiles | None:
        """From the capture to the arrival at the gateway; None before the first message."""
        return self._percentiles(0)

    @property
    def to_here(self) -> Percentiles | None:
        """From the arrival at the gateway to the arrival at this program; None before the first message."""
        return self._percentiles(1)

    def _percentiles(self, stage: int) -> Percentiles | None:
        if not self._num_added:
            return None
        p50, p99 = np.percentile(self._samples[: self._num_added, stage], (50, 99))
        return Percentiles(float(p50), float(p99))


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
