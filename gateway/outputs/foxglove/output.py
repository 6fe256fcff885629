"""The output for viewers: it serves each source in the thread of the server."""

import errno
import logging
from collections.abc import Callable, Mapping

from gateway.errors import PortError, system_reason
from gateway.logs.failures import DefectLog
from gateway.logs.losses import Losses
from gateway.messages.host_time import now_utime
from gateway.outputs.contract import FramePublisher, OutputHealth, ServerParameters
from gateway.outputs.foxglove.live_source import QUEUE_FULL, SLOW, FoxglovePublisher, ServedSource
from gateway.outputs.foxglove.server import FoxgloveServer
from gateway.outputs.foxglove.settings import FoxgloveSettings
from gateway.outputs.frame_output import LoopThread, PortOpener, ServerOutput
from gateway.outputs.listen_address import host_in_url

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
        self._sources: dict[str, ServedSource] = {}

    def _serve(self, thread: LoopThread) -> None:
        thread.run(self._opener.open(self._listen, f"viewers can connect to ws://{self._address}"))

    async def _listen(self) -> None:
        try:
            await self._server.open()
        except OSError as error:
            raise PortError(f"cannot listen on {self._address}: {_bind_problem(error)}") from error

    def frame_publisher(self, source: str) -> FramePublisher:
        """Return a new publisher of a source."""
        return FoxglovePublisher(source, self._served(source))

    def _served(self, source: str) -> ServedSource:
        if source not in self._sources:
            self._sources[source] = ServedSource(source, self._server, self._call, self._offer)
        return self._sources[source]

    def health(self) -> OutputHealth:
        """Return whether viewers can connect."""
        closed = "the server for viewers is closed; start the gateway again" if self._is_closed else ""
        problem = closed or self._opener.problem
        return OutputHealth(not problem, problem)

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


def _bind_problem(error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return "another program uses this port; stop it, or choose another foxglove.port"
    if error.errno == errno.EADDRNOTAVAIL:
        return "this computer does not have this address; correct foxglove.host"
    if error.errno == errno.EACCES:
        return "this port needs the rights of root; choose a foxglove.port from 1024"
    return f"{system_reason(error)}; correct foxglove.host and foxglove.port"
