"""The output for viewers: it serves each source in the thread of the server."""

import asyncio
import errno
import logging
from collections.abc import Callable, Mapping
from typing import Final

from gateway.errors import system_reason
from gateway.logs.failures import DefectLog, FailureLog, defect_text
from gateway.logs.losses import Losses
from gateway.messages.host_time import now_utime
from gateway.messages.topics import Topic
from gateway.outputs.contract import (
    FramePublisher,
    IgnoringPublisher,
    Output,
    OutputHealth,
    Publisher,
    ServerParameters,
)
from gateway.outputs.foxglove.live_source import QUEUE_FULL, SLOW, FoxglovePublisher, ServedSource
from gateway.outputs.foxglove.server import FoxgloveServer
from gateway.outputs.foxglove.settings import FoxgloveSettings
from gateway.outputs.listen_address import host_in_url
from gateway.outputs.threads import LoopThread

_RETRY_S: Final = 1.0
_CLOSE_S: Final = 1.0

logger = logging.getLogger(__name__)


class FoxgloveOutput(Output):
    """Serves viewers on one address, in a thread of its own, which also converts the frames."""

    name = "foxglove"
    drop_causes = (SLOW, QUEUE_FULL)

    def __init__(self, settings: FoxgloveSettings) -> None:
        self.settings = settings
        self._address = f"{host_in_url(settings.host)}:{settings.port}"
        self._problem = f"not listening on {self._address} yet"
        self._failures = FailureLog(logger, self.name)
        self._defects = DefectLog(logger, self.name)
        self._server = FoxgloveServer(settings.host, settings.port, str(now_utime()), settings.origins)
        self._sources: dict[str, ServedSource] = {}
        self._thread: LoopThread | None = None
        self._is_closed = False

    def start(self) -> None:
        """Start to listen, with retries."""
        if self._thread is None and not self._is_closed:
            self._thread = LoopThread("foxglove")
            self._thread.run(self._listen())

    async def _listen(self) -> None:
        """Listen as soon as the address can be bound."""
        while True:
            if await self._has_opened():
                return
            await asyncio.sleep(_RETRY_S)

    async def _has_opened(self) -> bool:
        try:
            await self._server.open()
        except OSError as error:
            problem = f"cannot listen on {self._address}: {_bind_problem(error)}"
            self._failures.failed(problem)
        except Exception as defect:  # noqa: BLE001 - the task would end, and nothing would try again
            problem = f"{defect_text(defect)}; report this with the log"
            self._defects.log(defect)
        else:
            problem = ""
            self._failures.succeeded(f"viewers can connect to ws://{self._address}")
        if not self._is_closed:
            self._problem = problem
        return not problem

    def publisher(self, topic: Topic) -> Publisher:  # noqa: ARG002 - the signature is that of Output
        """Return a publisher that does nothing: viewers get whole frames."""
        return IgnoringPublisher()

    def frame_publisher(self, source: str) -> FramePublisher:
        """Return a new publisher of a source."""
        return FoxglovePublisher(source, self._served(source))

    def _served(self, source: str) -> ServedSource:
        if source not in self._sources:
            self._sources[source] = ServedSource(source, self._server, self._call, self._call_in_time)
        return self._sources[source]

    def health(self) -> OutputHealth:
        """Return whether viewers can connect."""
        return OutputHealth(not self._problem, self._problem)

    def is_configured_like(self, other: Output) -> bool:
        """Return whether the settings are the same."""
        return isinstance(other, FoxgloveOutput) and self.settings == other.settings

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what viewers lose."""
        self._served(source).losses = losses

    def watch_wanted(self, source: str, on_change: Callable[[], None]) -> bool:
        """A source is wanted while a viewer subscribes to anything that is in its frames."""
        self._served(source).watch_wanted(on_change)
        return True

    def announce(self, source: str) -> None:
        """Advertise the channels of ``source``."""
        self._served(source).open()

    def withdraw(self, source: str) -> None:
        """Withdraw the channels of ``source``."""
        served = self._sources.pop(source, None)
        if served is not None:
            served.close()

    def publish_parameters(self, source: str, parameters: ServerParameters) -> None:
        """Describe the source to viewers, and convert its next frames with these parameters."""
        self._served(source).set_parameters(parameters)

    def topic_names(self, source: str) -> Mapping[str, Mapping[str, str]]:
        """Return the names of fields that differ from the labels of channels and plates."""
        served = self._sources.get(source)
        return {} if served is None else served.field_names

    def close(self) -> None:
        """Disconnect all viewers and release the address."""
        self._is_closed = True
        self._problem = "the server for viewers is closed; start the gateway again"
        for source in list(self._sources.values()):
            source.close()
        if self._thread is not None:
            self._thread.close(self._server.close, _CLOSE_S)

    # Calls of the server. Before the thread starts, nobody else calls it.

    def _call(self, call: Callable[[], None]) -> None:
        """Have the thread make a call that must not be left out."""
        if self._thread is None:
            self._defects.attempt(call, None)
        elif not self._thread.offer(call):
            self._thread.run(_make(call))

    def _call_in_time(self, call: Callable[[], None], num_bytes: int) -> bool:
        """Have the thread make a call; return False if too many wait already."""
        return self._thread is not None and self._thread.offer(call, num_bytes)


async def _make(call: Callable[[], None]) -> None:
    call()


def _bind_problem(error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return "another program uses this port; stop it, or choose another foxglove.port"
    if error.errno == errno.EADDRNOTAVAIL:
        return "this computer does not have this address; correct foxglove.host"
    if error.errno == errno.EACCES:
        return "this port needs the rights of root; choose a foxglove.port from 1024"
    return f"{system_reason(error)}; correct foxglove.host and foxglove.port"
