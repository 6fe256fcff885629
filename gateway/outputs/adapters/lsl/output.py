"""The output for Lab Streaming Layer, in which EEG labs record and process what several devices measure."""

import functools
import importlib.util
import itertools
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Collection, Mapping
from typing import Final

from gateway.errors import ConfigError, OutputError
from gateway.messages.encode import Stamp
from gateway.messages.host_time import HostClock, clock_difference_us, host_clock, now_steady_us
from gateway.outputs.adapters.lsl.settings import LslSettings
from gateway.outputs.adapters.lsl.source_streams import CapturedFrame, SourceStreams
from gateway.outputs.adapters.lsl.supervisor import LslProcesses
from gateway.outputs.contract import FramePublisher, OutputHealth, ServerParameters
from gateway.outputs.frame_output import FrameOutput, in_this_loop
from gateway.outputs.kind import missing_package
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import FrameLayout, RawFrame
from gateway.runtime.failures import DefectLog
from gateway.runtime.losses import Losses
from gateway.runtime.workers import WorkerThread

MIN_PAUSE_S: Final = 0.01
"""The thread that sends pauses at least so long, so that frames at a high rate are sent several at a time."""

_CLOSE_S: Final = 1.5

logger = logging.getLogger(__name__)


class LslOutput(FrameOutput):
    """Offers one LSL stream per source and component, and pushes what somebody receives.

    liblsl runs in a process of its own (see process.py). A thread converts the frames and sends them there.
    """

    name = "lsl"
    drop_causes = ("not open", "queue full", "unknown unit", "too many channels")

    def __init__(self, settings: LslSettings) -> None:
        if importlib.util.find_spec("pylsl") is None:
            raise missing_package(self.name, "lsl", ModuleNotFoundError(name="pylsl"))
        if settings.config is not None and not os.access(settings.config, os.R_OK):
            raise ConfigError(
                f"lsl.config: {settings.config} cannot be read; correct the path, or remove the key"
            )
        self.settings: LslSettings = settings
        self._processes = LslProcesses(settings, self._wanted_changed)
        # The kernel kills the process for LSL when the thread that started it ends (PR_SET_PDEATHSIG).
        self._thread = WorkerThread("lsl-send", ends_when_idle=False)
        self._numbers = itertools.count(1)
        self._computer = socket.gethostname()
        self._publishers: dict[str, LslFramePublisher] = {}  # by source
        self._suspended = SuspendedTime()
        self._lock = threading.Lock()
        self._will_send = False
        self._sent_s = 0.0
        self._defects = DefectLog(logger, self.name)
        self._ended = threading.Event()
        self._is_started = False

    def start(self) -> None:
        """Start the process for LSL."""
        self._is_started = True
        self._submit(self._restart)

    def frame_publisher(self, source: str) -> FramePublisher:
        """Return the publisher of a source's frames."""
        streams = SourceStreams(
            source, self._computer, self.settings.buffer_s, self._numbers, self._processes.send
        )
        publisher = LslFramePublisher(streams, self._processes, self._start_sending, self._forget)
        self._publishers[source] = publisher
        return publisher

    def _forget(self, publisher: "LslFramePublisher") -> None:
        source = publisher.streams.source
        if self._publishers.get(source) is publisher:
            del self._publishers[source]
        self._submit(publisher.streams.close)

    def watch_wanted(self, source: str, on_change: Callable[[], None]) -> bool:
        """Frames are wanted while somebody receives a stream that they have samples for."""
        self._publishers[source].on_change = in_this_loop(on_change)
        return True

    def _wanted_changed(self) -> None:
        for publisher in list(self._publishers.values()):
            publisher.on_change()

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what the thread that sends cannot push."""
        self._publishers[source].streams.losses = losses

    def publish_parameters(self, source: str, parameters: ServerParameters) -> None:
        """Describe the streams of ``source`` by other parameters."""
        if source in self._publishers:
            self._publishers[source].set_parameters(parameters)

    def topic_names(self, source: str) -> Mapping[str, Mapping[str, str]]:
        """Return the names of items whose labels are not printable, too long, or those of others, too."""
        publisher = self._publishers.get(source)
        names = {} if publisher is None else publisher.streams.names
        return {key: changed for key, changed in names.items() if changed}

    def health(self) -> OutputHealth:
        """Return whether streams can be offered."""
        problem = self._processes.problem
        return OutputHealth(not problem, problem)

    @property
    def version(self) -> str:
        """The version of liblsl; "" if it is not loaded."""
        return self._processes.version

    def maintain(self) -> None:
        """Start the process again if it has ended, and open the streams that had to wait."""
        if self._is_started and self._processes.is_due:
            self._submit(self._restart)
        for publisher in self._publishers.values():
            if publisher.streams.waiting:
                self._submit(publisher.streams.open_waiting)

    def close(self) -> None:
        """End the process and the thread."""
        self._thread.close(self._stop)
        self._ended.wait(_CLOSE_S)

    def _submit(self, call: Callable[[], None]) -> None:
        """Have the thread that sends make ``call``; log what it raises."""
        self._thread.submit(functools.partial(self._defects.attempt, call, None))

    # In the thread that sends.

    def _restart(self) -> None:
        if self._processes.restart():
            for publisher in list(self._publishers.values()):
                publisher.streams.reopen()

    def _start_sending(self) -> None:
        with self._lock:
            if self._will_send:
                return
            self._will_send = True
        self._thread.offer(self._send_waiting)

    def _send_waiting(self) -> None:
        time.sleep(max(0.0, self._sent_s + MIN_PAUSE_S - time.monotonic()))
        with self._lock:
            self._will_send = False
        suspended_us = self._suspended.read_us()
        for publisher in list(self._publishers.values()):
            self._defects.attempt(functools.partial(publisher.send_waiting, suspended_us), None)
        self._sent_s = time.monotonic()

    def _stop(self) -> None:
        self._processes.stop()
        self._ended.set()


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

    def publish(self, frame: RawFrame, stamp: Stamp, components: frozenset[ComponentType]) -> None:
        """Queue a frame. Raises OutputError if too many wait, or if receivers wait for LSL to come back."""
        if self._is_closed:
            raise OutputError("LSL is closed; ask for a new publisher", cause="closed")
        if not self._processes.is_ready:
            raise OutputError(f"LSL: {self._processes.problem}", cause="not open")
        captured = CapturedFrame(frame, stamp, components, self._times.steady_us(stamp))
        with self._lock:
            if len(self._waiting) >= MAX_WAITING or self._num_bytes > MAX_WAITING_BYTES:
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


# Times --------------------------------------------------------------------------------------

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
        self._us = clock_difference_us(now_steady_us, _monotonic_us)
        self._measured_s = time.monotonic()

    def read_us(self) -> int:
        """Return the difference in µs. It is the same in every call until the computer is suspended."""
        now_s = time.monotonic()
        if now_s - self._measured_s >= _MEASURE_S:
            self._measured_s = now_s
            difference_us = clock_difference_us(now_steady_us, _monotonic_us)
            if abs(difference_us - self._us) >= _CHANGE_US:
                self._us = difference_us
        return self._us


def _monotonic_us() -> int:
    return time.monotonic_ns() // 1000
