"""The output for viewers: it serves each source in the thread of the server."""

import asyncio
import errno
import itertools
import logging
import math
import threading
import time
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any, Final, cast

from gateway.errors import OutputError, PortError, system_reason
from gateway.messages.encode import Stamp
from gateway.messages.foxglove.messages import NUMBERS_PER_ITEM
from gateway.messages.host_time import now_utime
from gateway.outputs.adapters.foxglove.server import FoxgloveServer
from gateway.outputs.adapters.foxglove.settings import FoxgloveSettings
from gateway.outputs.adapters.foxglove.source_channels import (
    SLOW,
    QueuedFrame,
    SourceChannels,
    has_too_many_numbers,
)
from gateway.outputs.contract import FramePublisher, OutputHealth, ServerParameters
from gateway.outputs.frame_output import LoopThread, PortOpener, ServerOutput, in_this_loop
from gateway.outputs.listen_address import host_in_url
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import FrameLayout, RawFrame
from gateway.runtime.failures import DefectLog
from gateway.runtime.losses import Losses
from gateway.runtime.workers import QueueRoom

QUEUE_FULL: Final = "queue full"

_BIND_PROBLEMS: Final = {
    errno.EADDRINUSE: "another program uses this port; stop it, or choose another foxglove.port",
    errno.EADDRNOTAVAIL: "this computer does not have this address; correct foxglove.host",
    errno.EACCES: "this port needs the rights of root; choose a foxglove.port from 1024",
}

logger = logging.getLogger(__name__)


class FoxgloveOutput(ServerOutput):
    """Serves viewers on one address, in a thread of its own, which also converts the frames."""

    name = "foxglove"
    drop_causes = (SLOW, QUEUE_FULL)

    def __init__(self, settings: FoxgloveSettings) -> None:
        super().__init__()
        self.settings: FoxgloveSettings = settings
        self._address = f"{host_in_url(settings.host)}:{settings.port}"
        self._opener = PortOpener(logger, self.name, f"not listening on {self._address} yet")
        self._defects = DefectLog(logger, self.name)
        self._server = FoxgloveServer(settings.host, settings.port, str(now_utime()), settings.origins)
        self._sources: dict[str, FoxglovePublisher] = {}

    def _serve(self, thread: LoopThread) -> None:
        thread.run(self._opener.open(self._listen, f"viewers can connect to ws://{self._address}"))

    async def _listen(self) -> None:
        try:
            await self._server.open()
        except OSError as error:
            other = f"{system_reason(error)}; correct foxglove.host and foxglove.port"
            reason = _BIND_PROBLEMS.get(error.errno or 0, other)
            raise PortError(f"cannot listen on {self._address}: {reason}") from error

    def frame_publisher(self, source: str) -> FramePublisher:
        """Return a new publisher of a source."""
        publisher = FoxglovePublisher(source, self._server, self._call)
        self._sources[source] = publisher
        return publisher

    def health(self) -> OutputHealth:
        """Return whether viewers can connect."""
        closed = "the server for viewers is closed; start the gateway again" if self._is_closed else ""
        problem = closed or self._opener.problem
        return OutputHealth(not problem, problem)

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what viewers lose."""
        self._sources[source].losses = losses

    def watch_wanted(self, source: str, on_change: Callable[[], None]) -> bool:
        """A source is wanted while a viewer subscribes to anything that is in its frames."""
        self._sources[source].watch_wanted(on_change)
        return True

    def announce(self, source: str) -> None:
        """Advertise the channels of ``source``."""
        self._sources[source].open()

    def withdraw(self, source: str) -> None:
        """Withdraw the channels of ``source``."""
        if source in self._sources:
            self._sources.pop(source).close()

    def publish_parameters(self, source: str, parameters: ServerParameters) -> None:
        """Describe the source to viewers, and convert its next frames with these parameters."""
        if source in self._sources:
            self._sources[source].set_parameters(parameters)

    def topic_names(self, source: str) -> Mapping[str, Mapping[str, str]]:
        """Return the names of fields that differ from the labels of channels and plates."""
        return self._sources[source].field_names if source in self._sources else {}

    def close(self) -> None:
        """Disconnect all viewers and release the address."""
        for source in list(self._sources.values()):
            source.close()
        super().close()

    async def _stop(self) -> None:
        await self._server.close()

    def _call(self, call: Callable[[], None]) -> None:
        """Have the thread make a call that must not be left out."""
        if self._thread is None:  # nobody else uses the server yet
            self._defects.attempt(call, None)
        elif not self._offer(call):
            self._thread.run(_make(call))


async def _make(call: Callable[[], None]) -> None:
    call()


MIN_PAUSE_S: Final = 0.01
"""Frames of one source are converted at least so far apart, several at a time if they come faster.

A viewer draws at most 60 pictures a second. Each frame by itself at 1000 Hz would cost three times as much.
"""

_MAX_TOGETHER_BYTES: Final = 128 * 1024
"""From how many bytes on the viewers' connections get a turn of the loop: until then, they send nothing.

So a viewer that reads in time loses nothing of what has waited for a busy computer.
"""


class FoxglovePublisher:
    """The FramePublisher of one source: whether viewers want it, and the queue of its SourceChannels.

    ``call`` has the thread make a call.
    """

    def __init__(self, name: str, server: FoxgloveServer, call: Callable[[Callable[[], None]], None]) -> None:
        self.wanted: frozenset[ComponentType] = frozenset()
        """The components that a viewer has subscribed to."""
        self.losses = Losses(logger, f"{name} to foxglove")
        """Where to count what viewers lose."""
        self._name = name
        self._server = server
        self._call = call
        self._report_wanted: Callable[[frozenset[ComponentType]], None] = lambda _wanted: None
        self._on_change: Callable[[], None] = lambda: None
        self._source: SourceChannels | None = None  # assigned in the thread only
        self._opened: set[ComponentType] = set()  # with numbers, since the newest parameters
        self._is_closed = False
        self._defects = DefectLog(logger, f"{name} to foxglove")
        self._sent_s = -math.inf  # when frames were sent last, on the monotonic clock; in the thread only
        self._lock = threading.Lock()  # of ``_waiting`` and ``_room``
        self._waiting: list[QueuedFrame | Callable[[], None]] = []
        self._room = QueueRoom()

    def watch_wanted(self, on_change: Callable[[], None]) -> None:
        """Call ``on_change`` in this event loop when ``wanted`` has changed."""
        self._on_change = on_change
        self._report_wanted = in_this_loop(self._set_wanted)

    def _set_wanted(self, wanted: frozenset[ComponentType]) -> None:
        if wanted != self.wanted and not self._is_closed:
            self.wanted = wanted
            self._on_change()

    def open(self) -> None:
        """Advertise the channels of the source."""
        self._queue(self._open)

    def _open(self) -> None:
        if self._source is None:
            self._source = SourceChannels(self._name, self._server, self.losses, self._report_wanted)

    def _while_open(self, call: Callable[..., None], *arguments: Any) -> None:
        """Make a call of the source, in the thread, if it is open then."""
        if self._source is not None:
            call(self._source, *arguments)

    def set_parameters(self, parameters: ServerParameters) -> None:
        """Convert the next frames with these parameters."""
        self._queue(partial(self._while_open, SourceChannels.set_parameters, parameters))
        self._opened.clear()
        self._on_change()  # so that frames are looked at again for what the parameters do not mention

    @property
    def field_names(self) -> Mapping[str, Mapping[str, str]]:
        """See ``Output.topic_names``."""
        return {} if self._source is None else self._source.field_names

    def wants(self, components: Collection[ComponentType]) -> bool:
        """Return whether a viewer has subscribed to any of these components."""
        return not self.wanted.isdisjoint(components)

    def prepare(self, layout: FrameLayout, components: frozenset[ComponentType]) -> bool:
        """Open channels for numbers in frames of ``layout``, as far as the parameters do not mention them.

        Return whether a viewer has subscribed to what these frames have. Nobody can subscribe to too many
        numbers. They count as lost while viewers watch the source.
        """
        found = [each for each in layout.components if each.type in components]
        for each in found if not self._is_closed else ():
            is_new = each.type in NUMBERS_PER_ITEM and each.num_items and each.type not in self._opened
            if is_new:
                self._opened.add(each.type)
                self._queue(partial(self._while_open, SourceChannels.open_for, each))
        is_lost = any(map(has_too_many_numbers, found)) and bool(self.wanted)
        return self.wants([each.type for each in found]) or is_lost

    def publish(self, frame: RawFrame, stamp: Stamp, components: frozenset[ComponentType]) -> None:
        """Hand over a frame; see FramePublisher."""
        if self._is_closed:
            raise OutputError(f"foxglove: {self._name} is closed; ask for a new publisher", cause="closed")
        queued = QueuedFrame(frame, stamp, components)
        if self.wanted and not self._queue(queued, len(frame.body)):
            raise OutputError(
                f"foxglove: the frames of {self._name} come faster than they can be converted; show fewer "
                "topics in the viewers",
                cause=QUEUE_FULL,
            )

    def close(self) -> None:
        """Withdraw the channels of the source, and refuse all frames from now on."""
        if not self._is_closed:
            self._is_closed = True
            self.wanted = frozenset()
            self._queue(self._close)

    def _close(self) -> None:
        self._while_open(SourceChannels.close)
        self._source = None

    def _queue(self, entry: QueuedFrame | Callable[[], None], num_bytes: int = 0) -> bool:
        """Queue a frame of ``num_bytes``, or a call, which must be made; return False if there is no room."""
        with self._lock:
            if isinstance(entry, QueuedFrame) and not self._room.take(num_bytes):
                return False
            self._waiting.append(entry)
            is_first = len(self._waiting) == 1
        if is_first:
            self._call(self._send_soon)
        return True

    # In the thread.

    def _send_soon(self) -> None:
        delay_s = self._sent_s + MIN_PAUSE_S - time.monotonic()
        if delay_s > 0:
            asyncio.get_running_loop().call_later(delay_s, self._send_waiting)
        else:
            self._send_waiting()

    def _send_waiting(self) -> None:
        """Send the frames that wait, and make the calls, in their order."""
        with self._lock:
            entries = self._take_waiting()
            if self._waiting:
                asyncio.get_running_loop().call_soon(self._send_waiting)
        for key, group in itertools.groupby(entries, _alike):
            together = list(group)
            if key is None:
                for call in together:
                    self._defects.attempt(cast(Callable[[], None], call), None)
            else:
                self._defects.attempt(partial(self._while_open, SourceChannels.send_frames, together), None)
                self._sent_s = time.monotonic()

    def _take_waiting(self) -> list[QueuedFrame | Callable[[], None]]:
        """Return what to send in this turn of the loop, and remove it; under the lock."""
        num_bytes = num_taken = 0
        while num_taken < len(self._waiting) and num_bytes < _MAX_TOGETHER_BYTES:
            entry = self._waiting[num_taken]
            num_taken += 1
            if isinstance(entry, QueuedFrame):
                self._room.free(len(entry.frame.body))
                num_bytes += len(entry.frame.body)
        taken, self._waiting = self._waiting[:num_taken], self._waiting[num_taken:]
        return taken


def _alike(entry: QueuedFrame | Callable[[], None]) -> tuple[int, frozenset[ComponentType]] | None:
    """Return what frames that are converted together have in common; None for a call."""
    return (id(entry.frame.layout), entry.components) if isinstance(entry, QueuedFrame) else None
