"""Reading the server's parameters (§6) over a connection."""

import threading
from collections.abc import Awaitable, Callable
from typing import Final, Protocol, TypeVar

from gateway.rtc3d.commands import Command, SendParameters
from gateway.rtc3d.packets import Packet
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.worker_thread import WorkerThread

LONG_XML_BYTES: Final = 64 * 1024
"""Only one source at a time processes longer XML. To parse 1 MiB of it, made to be slow, takes 1.4 s."""

_processing_long_xml: Final = threading.Lock()

UNANSWERED: Final = f"the server did not answer {SendParameters()}"
"""The limitation of a stream whose server was silent in the handshake, until it gives its parameters."""

_Result = TypeVar("_Result")


class Connection(Protocol):
    """What reading the parameters needs of a Session."""

    @property
    def is_open(self) -> bool:
        """Whether the session is connected and has not ended."""

    async def ask(self, command: Command) -> Packet:
        """Send a command and return the reply; raises ServerError, ReplyTimeoutError or LinkError."""


ReadParameters = Callable[[Connection], Awaitable[ParsedParameters]]
"""Returns the parameters for a connection's handshake; raises ParametersError and the errors of ``ask``."""


class XmlThread:
    """Processes the XML of one source in a thread of its own, so that no frame waits for it.

    The threads of several sources would take turns with the event loop, which would then wait for each of
    them. So they process long XML one at a time. Short XML, that of almost any server, does not wait.
    """

    def __init__(self, source: str) -> None:
        self._thread = WorkerThread(f"xml-{source}")

    async def process(self, xml: bytes, function: Callable[[bytes], _Result]) -> _Result:
        """Return ``function(xml)``."""
        if len(xml) <= LONG_XML_BYTES:
            return await self._thread.run(lambda: function(xml))
        return await self._thread.run(lambda: _process_alone(xml, function))


def _process_alone(xml: bytes, function: Callable[[bytes], _Result]) -> _Result:
    with _processing_long_xml:
        return function(xml)
