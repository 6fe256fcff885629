"""The output for Lab Streaming Layer, in which EEG labs record and process what several devices measure."""

import functools
import importlib.util
import itertools
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping
from typing import Final

from gateway.errors import ConfigError
from gateway.logs.failures import DefectLog
from gateway.logs.losses import Losses
from gateway.messages.topics import Topic
from gateway.outputs.contract import (
    FramePublisher,
    IgnoringPublisher,
    Output,
    OutputHealth,
    Publisher,
    ServerParameters,
)
from gateway.outputs.kind import missing_package
from gateway.outputs.lsl.publisher import LslFramePublisher, SuspendedTime
from gateway.outputs.lsl.settings import LslSettings
from gateway.outputs.lsl.source_streams import SourceStreams
from gateway.outputs.lsl.supervisor import LslProcesses
from gateway.outputs.threads import in_this_loop
from gateway.workers import WorkerThread

MIN_PAUSE_S: Final = 0.005
"""The thread that sends pauses at least so long, so that frames at a high rate are sent several at a time."""

_CLOSE_S: Final = 1.5

logger = logging.getLogger(__name__)


class LslOutput(Output):
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
        self._settings = settings
        self._processes = LslProcesses(settings, self._wanted_changed)
        self._thread = WorkerThread("lsl-send")
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

    def publisher(self, topic: Topic) -> Publisher:  # noqa: ARG002 - no topic is published
        """Return a publisher that ignores what it gets: status and clock have no streams."""
        return IgnoringPublisher()

    def frame_publisher(self, source: str) -> FramePublisher:
        """Return the publisher of a source's frames."""
        streams = SourceStreams(
            source, self._computer, self._settings.buffer_s, self._numbers, self._processes.send
        )
        publisher = LslFramePublisher(streams, self._processes, self._start_sending, self._forget)
        self._publishers[source] = publisher
        return publisher

    def _forget(self, publisher: LslFramePublisher) -> None:
        if self._publishers.get(publisher.source) is publisher:
            del self._publishers[publisher.source]
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

    def is_configured_like(self, other: Output) -> bool:
        """Return whether the settings are the same; there is nothing to take over."""
        return isinstance(other, LslOutput) and other._settings == self._settings  # noqa: SLF001 - of this class

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
        self._processes.restart(self._reopen)

    def _reopen(self) -> None:
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
