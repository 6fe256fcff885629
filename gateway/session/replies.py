"""The replies of a server to the commands of one session, and reading its parameters (§6)."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from typing import Final, Protocol, TypeVar

from gateway.config.settings import SourceSettings
from gateway.errors import GatewayError, ReplyTimeoutError, ServerError
from gateway.rtc3d.commands import Command, SendParameters
from gateway.rtc3d.packets import Packet
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.runtime.workers import WorkerThread
from gateway.session.process_clock import RunningTimeout, running_clock

_FURTHER_REPLY_S: Final = 0.3
"""How soon a slow server's next reply follows a late one. The replies that it owes leave it together."""


class Replies:
    """Waits for the reply to one command at a time; ``end`` ends the wait.

    ``blocked_until_s`` returns, on the running clock, until when other data kept replies from arriving.
    ``assume`` is called when no other reply has followed a possible one soon.
    """

    def __init__(
        self, source: SourceSettings, blocked_until_s: Callable[[], float], assume: Callable[[], None]
    ) -> None:
        self._server = f"{source.host}:{source.port}"
        self._timeout_s = source.reply_timeout_s
        self._blocked_until_s = blocked_until_s
        self._assume = assume
        self._running = running_clock()
        self._reply: asyncio.Future[Packet] | None = None  # to the command that was sent
        self._assume_timer: asyncio.TimerHandle | None = None  # runs after a possible reply
        self.answered: dict[type[Command], Command] = {}
        """The newest command of each type that the server has answered or refused."""

    async def ask(self, command: Command, send: Callable[[], None]) -> Packet:
        """Call ``send`` to send ``command``, and return the packet that answers it.

        Raises ServerError with the server's text if the server refuses, ReplyTimeoutError if it does not
        answer within reply_timeout_s, or the error with which the session ends.
        """
        self._reply = reply = self._running.loop.create_future()
        send()
        try:
            packet = await self._wait(reply)
        except TimeoutError:
            raise ReplyTimeoutError(
                f"{self._server} did not answer {command} within {self._timeout_s:g} s"
            ) from None
        except ServerError:
            self.answered[type(command)] = command
            raise
        finally:
            self._reply = None
        self.answered[type(command)] = command
        return packet

    def end(self, result: Packet | GatewayError) -> None:
        """End the wait with the answer, or with why there is none."""
        if self._reply is None or self._reply.done():
            return
        if isinstance(result, Packet):
            self._reply.set_result(result)
        else:
            self._reply.set_exception(result)

    def assume_soon(self) -> None:
        """Note a possible reply; it is assumed to be the answer if no other reply follows."""
        if self._assume_timer is not None:
            self._assume_timer.cancel()
        wait_s = min(_FURTHER_REPLY_S, self._timeout_s / 4)
        self._assume_timer = self._running.loop.call_later(wait_s, self._assume)

    async def _wait(self, reply: "asyncio.Future[Packet]") -> Packet:
        """Wait for ``reply``; raise TimeoutError if the server does not answer within reply_timeout_s.

        The time-out starts again when what blocks replies ends: the reply may be behind it.
        """
        since_s = self._running.time()
        while not reply.done():
            since_s = max(since_s, self._blocked_until_s())
            wait_s = self._timeout_s - (self._running.time() - since_s)
            if wait_s <= 0:
                raise TimeoutError
            with contextlib.suppress(TimeoutError):
                async with RunningTimeout(wait_s):
                    await asyncio.wait({reply})
        return reply.result()


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
