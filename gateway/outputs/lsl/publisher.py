"""The publisher of one source's frames on LSL: it queues them for the thread that sends."""

import functools
import threading
import time
from collections.abc import Callable, Collection
from typing import Final

from gateway.errors import OutputError
from gateway.messages.encode import Stamp
from gateway.messages.host_time import HostClock, host_clock, now_steady_us
from gateway.outputs.contract import ServerParameters
from gateway.outputs.lsl.source_streams import CapturedFrame, SourceStreams
from gateway.outputs.lsl.supervisor import LslProcesses
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import Frame, FrameLayout

_READINGS: Final = 5
"""How many pairs of readings are compared: the process may be interrupted between two clocks."""

_MEASURE_S: Final = 1.0
_CHANGE_US: Final = 1_000
"""The two clocks differ only while the computer is suspended, so a smaller change is an error of reading."""


class CaptureTimes:
    """Finds the capture time of frames on the steady clock (host_time), whatever happens to the wall clock.

    The times in a stamp are the steady clock plus the offset of the wall clock when the frame arrived. If
    somebody has set the wall clock since then, the former offset counts. The stamp does not say which one
    that was, but the frame has arrived a moment ago: the other offset gives another time.
    """

    def __init__(self, clock: HostClock = host_clock) -> None:
        self._clock = clock
        self._offset_us = self._former_offset_us = clock.offset_us
        self._changed_us = 0  # when the change was noticed, on the steady clock

    def steady_us(self, stamp: Stamp) -> int:
        """Return when the frame of ``stamp``, which has just arrived, was captured."""
        now_us = now_steady_us()
        offset_us = self._clock.offset_us
        if offset_us != self._offset_us:
            self._former_offset_us, self._offset_us, self._changed_us = self._offset_us, offset_us, now_us
        if not self._changed_us <= stamp.utime - offset_us <= now_us:
            ages_us = [
                (now_us + offset - stamp.utime, offset) for offset in (offset_us, self._former_offset_us)
            ]
            offset_us = min((each for each in ages_us if each[0] >= 0), default=ages_us[0])[1]
        return stamp.capture_utime - offset_us


class SuspendedTime:
    """How much the steady clock is ahead of the monotonic one: it also counts while the computer sleeps."""

    def __init__(self) -> None:
        self._us = _measured_difference_us()
        self._measured_s = time.monotonic()

    def read_us(self) -> int:
        """Return the difference in µs. It is the same in every call until the computer is suspended."""
        now_s = time.monotonic()
        if now_s - self._measured_s >= _MEASURE_S:
            self._measured_s = now_s
            difference_us = _measured_difference_us()
            if abs(difference_us - self._us) >= _CHANGE_US:
                self._us = difference_us
        return self._us


def _measured_difference_us() -> int:
    """Return steady clock minus monotonic clock, from the reading that was interrupted least."""
    best_us, difference_us = -1, 0
    for _ in range(_READINGS):
        before_us = time.monotonic_ns() // 1000
        steady_us = now_steady_us()
        duration_us = time.monotonic_ns() // 1000 - before_us
        if best_us < 0 or duration_us < best_us:
            best_us, difference_us = duration_us, steady_us - before_us
    return difference_us


MAX_WAITING: Final = 4096
MAX_WAITING_BYTES: Final = 32 * 1024 * 1024
"""The limits of what waits for the thread. Further frames are refused."""


class LslFramePublisher:
    """Takes the frames of one source.

    ``start_sending`` has the thread call ``send_waiting`` soon; ``forget`` is called when the publisher
    closes.
    """

    def __init__(
        self,
        streams: SourceStreams,
        processes: LslProcesses,
        start_sending: Callable[[], None],
        forget: Callable[["LslFramePublisher"], None],
    ) -> None:
        self.streams = streams
        self.on_change: Callable[[], None] = lambda: None
        """To be called when ``prepare`` may return something else, or has something else to do."""
        self._forget = forget
        self._processes = processes
        self._start_sending = start_sending
        self._times = CaptureTimes()
        self._lock = threading.Lock()
        self._waiting: list[CapturedFrame | Callable[[], None]] = []
        self._num_bytes = 0
        self._num_items: dict[ComponentType, int] = {}  # the most that streams were opened for
        self._is_closed = False

    def wants(self, components: Collection[ComponentType]) -> bool:
        """Return whether somebody receives a stream of these components."""
        numbers, wanted = self.streams.numbers, self._processes.wanted
        return any(numbers.get(each) in wanted for each in components)

    def prepare(self, layout: FrameLayout, components: frozenset[ComponentType]) -> bool:
        """Have the streams of these components opened; return whether somebody receives one of them."""
        num_items = layout.num_items(components)
        more = {each: count for each, count in num_items.items() if count > self._num_items.get(each, -1)}
        with self._lock:
            if more and not self._is_closed:
                self._num_items |= more
                # Even if the queue is full, because nobody may ask again.
                self._append(functools.partial(self.streams.open_for, more), 0)
        return self.wants(num_items)

    def publish(self, frame: Frame, stamp: Stamp, components: frozenset[ComponentType]) -> None:
        """Queue a frame. Raises OutputError if too many wait, or if receivers wait for LSL to come back."""
        if self._is_closed:
            raise OutputError("LSL is closed; ask for a new publisher", cause="closed")
        if not self._processes.is_ready:
            raise OutputError(f"LSL: {self._processes.problem}", cause="not open")
        captured = CapturedFrame(frame, stamp, components, self._times.steady_us(stamp))
        with self._lock:
            if self._is_full:
                raise OutputError(
                    "the process for LSL does not take frames fast enough; this computer is too busy",
                    cause="queue full",
                )
            self._append(captured, len(frame.body))

    def set_parameters(self, parameters: ServerParameters) -> None:
        """Use other parameters for the frames after this call."""
        with self._lock:
            self._num_items.clear()
            self._append(functools.partial(self.streams.set_parameters, parameters), 0)
        self.on_change()

    @property
    def _is_full(self) -> bool:
        return len(self._waiting) >= MAX_WAITING or self._num_bytes > MAX_WAITING_BYTES

    def _append(self, entry: CapturedFrame | Callable[[], None], num_bytes: int) -> None:
        if not self._waiting:
            self._start_sending()
        self._waiting.append(entry)
        self._num_bytes += num_bytes

    def send_waiting(self, suspended_us: int) -> None:
        """Send what waits. Called in the thread that sends."""
        with self._lock:
            entries, self._waiting, self._num_bytes = self._waiting, [], 0
        frames: list[CapturedFrame] = []
        for entry in entries:
            if isinstance(entry, CapturedFrame):
                frames.append(entry)
                continue
            self._push(frames, suspended_us)
            frames = []
            entry()
        self._push(frames, suspended_us)

    def _push(self, frames: list[CapturedFrame], suspended_us: int) -> None:
        if self._processes.is_ready:
            self.streams.push(frames, self._processes.wanted, suspended_us)
        else:
            self.streams.count_not_open(len(frames))

    def close(self) -> None:
        """Close the streams of the source."""
        if not self._is_closed:
            self._is_closed = True
            self._forget(self)

    @property
    def source(self) -> str:
        """The name of the source."""
        return self.streams.source
