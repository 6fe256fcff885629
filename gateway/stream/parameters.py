"""Reading the server's parameters (§6) over a connection."""

from collections.abc import Awaitable, Callable
from typing import Final, Protocol, TypeVar

from gateway.rtc3d.commands import Command, SendParameters
from gateway.rtc3d.packets import Packet
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.worker_thread import WorkerThread

LONG_XML_BYTES: Final = 64 * 1024
"""All sources share a thread for longer XML. To parse 1 MiB of it, made to be slow, takes 1.4 s."""

_long_xml_thread: Final = WorkerThread("xml-long")

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
    """Processes the XML of one source in a thread, so that no frame waits for it.

    Threads that run Python take turns with the event loop, which has to wait for each of them, and each keeps
    the memory that it needed once. So all sources share one thread for long XML. Short XML, that of almost
    any server, does not wait for it.
    """

    def __init__(self, source: str) -> None:
        self._thread = WorkerThread(f"xml-{source}")

    async def process(self, xml: bytes, function: Callable[[bytes], _Result]) -> _Result:
        """Return ``function(xml)``."""
        thread = self._thread if len(xml) <= LONG_XML_BYTES else _long_xml_thread
        return await thread.run(lambda: function(xml))
