"""The publisher of one source's frames on LSL: it queues them for the thread that sends."""

import functools
import threading
from collections.abc import Callable
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

_MAX_LAYOUTS: Final = 64


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
        self._forget = forget
        self._processes = processes
        self._start_sending = start_sending
        self._times = CaptureTimes()
        self._lock = threading.Lock()
        self._waiting: list[CapturedFrame | ServerParameters] = []
        self._num_bytes = 0
        self._layouts: set[FrameLayout] = set()  # that have had a chance to open their streams
        self._is_closed = False

    @property
    def wanted(self) -> bool:
        """Whether somebody receives a stream of the source."""
        return not self._processes.wanted.isdisjoint(self.streams.numbers)

    def publish(
        self,
        frame: Frame,
        stamp: Stamp,
        sequence: int,  # noqa: ARG002 - LSL has none
        components: frozenset[ComponentType],
    ) -> None:
        """Queue a frame if somebody receives one of its streams, or if it may open one.

        Raises OutputError if too many frames wait, or if receivers wait for LSL to come back.
        """
        if self._is_closed:
            raise OutputError("LSL is closed; ask for a new publisher", cause="closed")
        if not self.wanted:
            if self._processes.interrupted:
                raise OutputError(f"LSL: {self._processes.problem}", cause="not open")
            if frame.layout in self._layouts:
                return
        if frame.layout not in self._layouts:
            if len(self._layouts) >= _MAX_LAYOUTS:
                self._layouts.clear()
            self._layouts.add(frame.layout)
        captured = CapturedFrame(frame, stamp, components, self._times.steady_us(stamp))
        with self._lock:
            is_full = len(self._waiting) >= MAX_WAITING or self._num_bytes > MAX_WAITING_BYTES
            if is_full:
                raise OutputError(
                    "the process for LSL does not take frames fast enough; this computer is too busy",
                    cause="queue full",
                )
            self._append(captured, len(frame.body))

    def set_parameters(self, parameters: ServerParameters) -> None:
        """Use other parameters for the frames after this call."""
        with self._lock:
            self._layouts.clear()
            self._append(parameters, 0)

    def _append(self, entry: CapturedFrame | ServerParameters, num_bytes: int) -> None:
        if not self._waiting:
            self._start_sending()
        self._waiting.append(entry)
        self._num_bytes += num_bytes

    def send_waiting(self, suspended_us: int) -> None:
        """Send what waits. Called in the thread that sends."""
        with self._lock:
            entries, self._waiting, self._num_bytes = self._waiting, [], 0
        if self._processes.interrupted:
            self.streams.count_interrupted(sum(isinstance(entry, CapturedFrame) for entry in entries))
        frames: list[CapturedFrame] = []
        push = functools.partial(self.streams.push, suspended_us=suspended_us)
        for entry in entries:
            if isinstance(entry, CapturedFrame):
                frames.append(entry)
                continue
            push(frames, self._processes.wanted)
            frames = []
            self.streams.set_parameters(entry)
        push(frames, self._processes.wanted)

    def close(self) -> None:
        """Close the streams of the source."""
        if not self._is_closed:
            self._is_closed = True
            self._forget(self)

    @property
    def source(self) -> str:
        """The name of the source."""
        return self.streams.source
