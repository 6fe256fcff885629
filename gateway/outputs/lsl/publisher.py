"""The publisher of one source's frames on LSL: it queues them for the thread that sends."""

import functools
import threading
from collections.abc import Callable, Collection
from typing import Final

from gateway.errors import OutputError
from gateway.messages.stamp import Stamp
from gateway.outputs.contract import ServerParameters
from gateway.outputs.lsl.capture_time import CaptureTimes
from gateway.outputs.lsl.source_streams import CapturedFrame, SourceStreams
from gateway.outputs.lsl.supervisor import LslProcesses
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import Frame, FrameLayout

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

    def publish(
        self,
        frame: Frame,
        stamp: Stamp,
        sequence: int,  # noqa: ARG002 - LSL has none
        components: frozenset[ComponentType],
    ) -> None:
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
