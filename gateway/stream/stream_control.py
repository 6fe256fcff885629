"""Requests to the server about its stream: handshake, rate, pause."""

import logging
from collections.abc import Callable
from dataclasses import replace

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import LinkError, ParametersError, ReplyTimeoutError, ServerError
from gateway.rtc3d.commands import (
    Command,
    SendParameters,
    SetByteOrder,
    StopStreaming,
    StreamFrames,
    Version,
)
from gateway.rtc3d.packets import Packet
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters
from gateway.stream.rate_control import halved, stream_requests
from gateway.stream.session import Session
from gateway.stream.status import StreamStatus

OnParameters = Callable[[bytes, ParsedParameters], None]
"""Takes the server's XML as received, and its parsed form."""

logger = logging.getLogger(__name__)


class StreamControl:
    """Controls the stream of one connected session. Use once, like the session.

    If the server refuses or does not answer a command, the status shows a limitation, and the gateway
    continues without it (field note 2). Every method raises LinkError if the connection ends.
    """

    def __init__(
        self,
        source: SourceSettings,
        stream: StreamSettings,
        status: StreamStatus,
        session: Session,
        on_parameters: OnParameters,
    ) -> None:
        self._source = source
        self._stream = stream
        self._status = status
        self._session = session
        self._on_parameters = on_parameters
        self._request = StreamFrames()  # as the server accepted it, at the full rate

    async def start(self) -> None:
        """Do the handshake (§5.3.1 to §5.3.3) and request frames (§5.3.5).

        Also raises LinkError if the server refuses all forms of StreamFrames (see ``stream_requests``).
        """
        await self._ask_optional(Version())
        if self._source.byte_order == "little":
            await self._ask_optional(SetByteOrder("little"))
        parameters = await self._fetch_parameters()
        frequency_hz = None
        if parameters is not None and parameters.markers is not None:
            frequency_hz = parameters.markers.frequency_hz
        for request in stream_requests(self._stream.rate, self._stream.components, frequency_hz):
            if await self._request_frames(request):
                self._request = request
                self._status.handshake_done(self._session.protocol_state, self._session.server)
                return
        raise LinkError(
            f"{self._session.server} refuses to stream in every form that the protocol has; "
            "check its real-time output settings"
        )

    async def change_rate(self, halvings: int) -> None:
        """Request the agreed rate, halved ``halvings`` times. If the server refuses, the rate stays."""
        await self._request_frames(replace(self._request, rate=halved(self._request.rate, halvings)))

    async def pause(self) -> None:
        """Stop the frames (§5.3.5); keep the connection."""
        await self._ask_optional(StopStreaming())
        self._status.rate_agreed("")

    async def resume(self) -> None:
        """Request frames again, as agreed in the handshake."""
        await self._request_frames(self._request)

    async def _request_frames(self, request: StreamFrames) -> bool:
        """Request frames; return whether the server accepted. No answer counts as acceptance."""
        try:
            await self._session.ask(request)
        except ServerError as error:
            self._status.add_limitation(f"the server refused {request}: {error}")
            return False
        except ReplyTimeoutError:
            self._status.add_limitation(f"the server did not acknowledge {request}")
        self._status.rate_agreed("" if request.rate is None else str(request.rate))
        return True

    async def _fetch_parameters(self) -> Parameters | None:
        """Return the server's parameters and pass them on; None if there are none."""
        packet = await self._ask_optional(SendParameters())
        if packet is None:
            return None
        try:
            parsed = parse_parameters(packet.body)
        except ParametersError as error:
            self._status.add_limitation(f"no parameters: {error}")
            return None
        for text in parsed.recovered:
            logger.info("%s: parameters repaired: %s", self._source.name, text)
        self._on_parameters(packet.body, parsed)
        return parsed.parameters

    async def _ask_optional(self, command: Command) -> Packet | None:
        """Send ``command``; return the answer, or None if the server refused or did not answer."""
        try:
            return await self._session.ask(command)
        except ServerError as error:
            self._status.add_limitation(f"the server refused {command}: {error}")
        except ReplyTimeoutError:
            self._status.add_limitation(f"the server did not answer {command}")
        return None
