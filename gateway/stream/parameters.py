"""Reading the server's parameters (§6) over a connection."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Final, Protocol, TypeVar

from gateway.rtc3d.commands import Command, SendParameters
from gateway.rtc3d.packets import Packet
from gateway.rtc3d.parameters_xml import ParsedParameters

LONG_XML_BYTES: Final = 64 * 1024
"""Longer XML is processed in a thread: to parse 1 MiB of it, made to be slow, takes 4 s."""

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


async def process_xml(xml: bytes, function: Callable[[bytes], _Result]) -> _Result:
    """Return ``function(xml)``; call it in a thread if the XML is long, so that frames do not wait."""
    if len(xml) > LONG_XML_BYTES:
        return await asyncio.to_thread(function, xml)
    return function(xml)
