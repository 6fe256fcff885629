"""What one session asks of its server to get frames: the handshake, and later changes of the rate."""

import logging
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
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.stream.rate_control import halved, stream_requests
from gateway.stream.session import Session
from gateway.stream.status import StreamStatus

logger = logging.getLogger(__name__)


class StreamControl:
    """Agrees with the server of one connected session; used once, as the session is.

    What the server refuses or does not answer is noted in the status as a limitation and done without
    (field note 2).
    """

    def __init__(
        self, source: SourceSettings, stream: StreamSettings, status: StreamStatus, session: Session
    ) -> None:
        self._source = source
        self._stream = stream
        self._status = status
        self._session = session
        self._request = StreamFrames()  # the one that the server accepted

    async def start(self) -> None:
        """Shake hands (§5.3.1 to §5.3.3) and ask for frames (§5.3.5).

        Raises LinkError if the connection ends, or the server refuses to stream in every form.
        """
        self._status.begin_session()
        await self._try(Version())
        if self._source.byte_order == "little":
            await self._try(SetByteOrder("little"))
        parameters = await self._fetch_parameters()
        frequency_hz = None
        if parameters is not None and parameters.markers is not None:
            frequency_hz = parameters.markers.frequency_hz
        for request in stream_requests(self._stream.rate, self._stream.components, frequency_hz):
            if await self._ask_for_frames(request):
                self._request = request
                return
        raise LinkError(
            f"{self._session.server} refuses to stream in every form that the protocol has; "
            "check its real-time output settings"
        )

    async def change_rate(self, halvings: int) -> None:
        """Ask for the agreed rate halved so many times; if the server refuses, the rate stays."""
        await self._ask_for_frames(replace(self._request, rate=halved(self._request.rate, halvings)))

    async def pause(self) -> None:
        """Stop the frames (§5.3.5); the connection stays."""
        await self._try(StopStreaming())
        self._status.rate = ""

    async def resume(self) -> None:
        """Ask for frames again, as agreed."""
        await self._ask_for_frames(self._request)

    async def _ask_for_frames(self, request: StreamFrames) -> bool:
        """Return whether the server accepted, or let it be guessed by saying nothing."""
        try:
            await self._session.ask(request)
        except ServerError as error:
            self._limit(f"the server refused {request}: {error}")
            return False
        except ReplyTimeoutError:
            self._limit(f"the server did not acknowledge {request}")
        self._status.rate = "" if request.rate is None else str(request.rate)
        return True

    async def _fetch_parameters(self) -> Parameters | None:
        packet = await self._try(SendParameters())
        if packet is None:
            return None
        try:
            parsed = parse_parameters(packet.body)
        except ParametersError as error:
            self._limit(f"no parameters: {error}")
            return None
        for text in parsed.recovered:
            logger.info("%s: parameters repaired: %s", self._source.name, text)
        self._session.handlers.parameters(packet.body, parsed)
        return parsed.parameters

    async def _try(self, command: Command) -> Packet | None:
        """Return the answer; None if the server refused the command or did not answer it."""
        try:
            return await self._session.ask(command)
        except ServerError as error:
            self._limit(f"the server refused {command}: {error}")
        except ReplyTimeoutError:
            self._limit(f"the server did not answer {command}")
        return None

    def _limit(self, text: str) -> None:
        level = logging.WARNING if self._status.limit(text) else logging.DEBUG
        logger.log(level, "%s: %s", self._source.name, text)
