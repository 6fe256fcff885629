"""One TCP connection to an RT server, used once: asyncio's shell over ``rtc3d.connection``."""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable
from typing import Final, NamedTuple, cast

from gateway.config import Source, Stream
from gateway.errors import (
    ClosedError,
    ConnectError,
    LinkError,
    ParametersError,
    ReplyTimeoutError,
    ServerError,
    SilenceError,
)
from gateway.log import FailureLog
from gateway.rate import stream_requests
from gateway.rtc3d.commands import Bye, Command, SendParameters, SetByteOrder, Version
from gateway.rtc3d.components import ComponentType, Frame
from gateway.rtc3d.connection import (
    Answered,
    Broken,
    Connection,
    Event,
    FileReceived,
    FrameRejected,
    OtherByteOrder,
    Refused,
    State,
    Stray,
)
from gateway.rtc3d.packets import Packet, text_of
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters
from gateway.status import StreamStatus, now_utime

_BYE_S: Final = 0.5
"""How long a server may take to close after Bye; some never do (field note 10)."""

logger = logging.getLogger(__name__)


class Handlers(NamedTuple):
    """Who takes what a session receives. Called from the event loop; they must not wait."""

    frame: Callable[[Frame, int], None]
    """The frame, and the host's time at which it came, in µs since the Unix epoch."""
    parameters: Callable[[bytes, ParsedParameters], None]
    """The server's XML as it came, and what it says."""
    connected: Callable[[], None]
    """The handshake is done."""
    file: Callable[[bytes], None]
    """A complete C3D file."""


class Session(asyncio.Protocol):
    """One connection of one stream: ``connect``, ``start_stream``, ``ended``, ``close``, in this order.

    It keeps ``status`` up to date. Every method that waits raises LinkError once the connection is of
    no more use, always with the first reason.
    """

    def __init__(self, source: Source, stream: Stream, status: StreamStatus, handlers: Handlers) -> None:
        self._source = source
        self._stream = stream
        self._status = status
        self._handlers = handlers
        self._connection = Connection(source.max_packet_bytes, source.max_c3d_bytes)
        self._state = State.IDLE
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._ended: asyncio.Future[None] = self._loop.create_future()
        self._lost = asyncio.Event()
        self._error: LinkError | None = None
        self._reply: asyncio.Future[Packet] | None = None
        self._asking = asyncio.Lock()
        self._last_frame_s = 0.0
        self._rejected = FailureLog(logger, source.name)
        self._unknown_types: set[int] = set()
        self.server = f"{source.host}:{source.port}"
        self.ready = False
        """Whether questions may be asked: after the handshake, before the end."""

    @property
    def delivered(self) -> bool:
        """Whether the server came as far as frames, or as saying that no measurement runs."""
        return self._state in {State.STREAMING, State.NO_MEASUREMENT}

    async def connect(self) -> None:
        """Connect; raises ConnectError with the reason and what to look at."""
        self._status.state = "connecting"
        try:
            async with asyncio.timeout(self._source.connect_timeout_s):
                await self._loop.create_connection(lambda: self, self._source.host, self._source.port)
        except TimeoutError:
            raise ConnectError(
                f"no answer from {self.server} within {self._source.connect_timeout_s:g} s; "
                "is the computer on and reachable, and its firewall open for this port?"
            ) from None
        except socket.gaierror as error:
            raise ConnectError(
                f"host name {self._source.host!r} is not known ({error.strerror}); check sources.host and DNS"
            ) from error
        except OSError as error:
            raise ConnectError(_connect_text(self.server, error)) from error

    async def start_stream(self) -> None:
        """Shake hands (§5.3.1 to §5.3.5) and ask for frames.

        What the server refuses or does not answer is noted in the status as a limitation and done
        without (field note 2). Raises LinkError if it refuses to stream in every form.
        """
        self._status.state = "handshaking"
        self._status.limitations.clear()
        self._status.byte_order = self._status.rate = ""
        self._status.session += 1
        await self._try(Version())
        if self._source.byte_order == "little":
            await self._try(SetByteOrder("little"))
        parameters = await self._fetch_parameters()
        frequency_hz = None
        if parameters is not None and parameters.markers is not None:
            frequency_hz = parameters.markers.frequency_hz
        for request in stream_requests(self._stream.rate, self._stream.components, frequency_hz):
            self._last_frame_s = self._loop.time()
            try:
                await self.ask(request)
            except ServerError as error:
                self._limit(f"the server refused {request}: {error}")
                continue
            except ReplyTimeoutError:
                self._limit(f"the server did not acknowledge {request}")
            self._status.rate = "" if request.rate is None else str(request.rate)
            self.ready = True
            self._handlers.connected()
            return
        raise LinkError(
            f"{self.server} refuses to stream in every form that the protocol has; "
            "check its real-time output settings"
        )

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
        self._handlers.parameters(packet.body, parsed)
        return parsed.parameters

    async def _try(self, command: Command) -> Packet | None:
        """Return the answer; None if the server refused the command or did not answer it."""
        try:
            return await self.ask(command)
        except ServerError as error:
            self._limit(f"the server refused {command}: {error}")
        except ReplyTimeoutError:
            self._limit(f"the server did not answer {command}")
        return None

    def _limit(self, text: str) -> None:
        self._status.limitations.append(text)
        logger.warning("%s: %s", self._source.name, text)

    async def ask(self, command: Command) -> Packet:
        """Send ``command`` and return the packet that answers it; one command at a time.

        Raises ServerError with the server's text if it refused, ReplyTimeoutError if it did not
        answer within reply_timeout_s, LinkError if the connection ended.
        """
        async with self._asking:
            self._check_open()
            self._connection.send(command)
            self._reply = self._loop.create_future()
            self._flush()
            try:
                async with asyncio.timeout(self._source.reply_timeout_s):
                    return await self._reply
            except TimeoutError:
                raise ReplyTimeoutError(
                    f"{self.server} did not answer {command} within {self._source.reply_timeout_s:g} s"
                ) from None
            finally:
                self._connection.give_up()
                self._reply = None

    def record(self, *, start: bool) -> None:
        """Start or stop the server's recording (field note 16); raises LinkError after the end."""
        self._check_open()
        self._connection.send_recording(start=start)
        self._flush()

    def _check_open(self) -> None:
        if self._error is not None:
            raise self._error
        if self._transport is None:
            raise ClosedError(f"{self.server}: not connected")

    async def ended(self) -> None:
        """Wait for the end, and for silence; raises LinkError with the reason."""
        while True:
            quiet_s = self._loop.time() - self._last_frame_s
            wait_s = self._source.stall_timeout_s - quiet_s
            if wait_s <= 0:
                await self._on_silence()
                continue
            try:
                async with asyncio.timeout(wait_s):
                    await asyncio.shield(self._ended)
            except TimeoutError:
                continue

    async def _on_silence(self) -> None:
        """Frames have been missing for stall_timeout_s: raise SilenceError, or find the server alive.

        Silence is a fault while a measurement runs, except for events, which come when they come.
        Otherwise a harmless question shows whether the server is there: any answer will do.
        """
        only_events = set(self._stream.components) == {ComponentType.EVENT}
        if self._state is State.STREAMING and not only_events:
            raise SilenceError(
                f"no frame from {self.server} for {self._source.stall_timeout_s:g} s "
                "although a measurement runs; connecting again"
            )
        try:
            await self.ask(Version())
        except ServerError:
            pass
        except ReplyTimeoutError as error:
            raise SilenceError(f"{error}, and sends no frames; connecting again") from None
        self._last_frame_s = self._loop.time()

    async def close(self) -> None:
        """Say Bye, and end the connection at the latest half a second later."""
        self.ready = False
        if self._transport is None:
            return
        if self._error is None:
            self._connection.send(Bye())
            self._flush()
            # The rest of the stream is read on: closing with data unread would reset the connection,
            # and the server might never see the Bye.
            # OSError: the server has just reset the connection, and asyncio has yet to say so.
            with contextlib.suppress(TimeoutError, OSError):
                self._transport.write_eof()
                async with asyncio.timeout(_BYE_S):
                    await self._lost.wait()
        self._transport.abort()

    # What asyncio calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport. asyncio has turned Nagle off (§2.1)."""
        self._transport = cast(asyncio.Transport, transport)
        sock = transport.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)

    def data_received(self, data: bytes) -> None:
        """Take bytes; the straight path from here to the outputs is calls, not tasks."""
        utime = now_utime()
        status = self._status
        status.bytes_in += len(data)
        for event in self._connection.receive(data):
            if type(event) is Frame:
                status.frames_in += 1
                self._last_frame_s = self._loop.time()
                if event.unknown_types:
                    self._note_unknown(event.unknown_types)
                self._handlers.frame(event, utime)
            else:
                self._on_event(event)
        if self._connection.state is not self._state:
            self._on_state()

    def connection_lost(self, exc: Exception | None) -> None:
        """Note the end, whoever caused it."""
        self._connection.end()
        reason = f"broke: {exc}" if exc else "was closed by the server"
        self._fail(ClosedError(f"the connection to {self.server} {reason}"))
        self._lost.set()

    def _on_state(self) -> None:
        self._state = self._connection.state
        if self._state in {State.STREAMING, State.NO_MEASUREMENT, State.IDLE}:
            self._status.state = self._state.value
            self._status.byte_order = self._connection.byte_order or ""
            self._last_frame_s = self._loop.time()

    def _on_event(self, event: Event) -> None:
        match event:
            case Answered(_, packet):
                if self._reply is not None and not self._reply.done():
                    self._reply.set_result(packet)
            case Refused(_, error):
                if self._reply is not None and not self._reply.done():
                    self._reply.set_exception(error)
            case FrameRejected(frame_error):
                self._status.drops["frame rejected"] += 1
                self._status.note_error(f"frame rejected: {frame_error}")
                self._rejected.failed(f"frame rejected: {frame_error}")
            case FileReceived(content):
                self._handlers.file(content)
            case OtherByteOrder(byte_order):
                self._limit(f"the server sends {byte_order}-endian frames, not the byte order agreed")
            case Broken(packet_error):
                self._fail(ClosedError(f"{self.server}: {packet_error}"))
            case Stray(packet):
                logger.debug(
                    "%s: nobody waits for packet type %d: %.200s",
                    self._source.name, packet.type, text_of(packet.body[:200]),
                )  # fmt: skip

    def _note_unknown(self, types: tuple[int, ...]) -> None:
        self._status.drops["unknown component"] += len(types)
        new = set(types) - self._unknown_types
        # Bounded, because the numbers are the server's.
        if new and len(self._unknown_types) < 16:
            self._unknown_types |= new
            logger.warning("%s: components of unknown type %s are skipped", self._source.name, sorted(new))

    def _fail(self, error: LinkError) -> None:
        """End with the first reason: every waiter gets it."""
        if self._error is not None:
            return
        self._error = error
        self.ready = False
        if self._reply is not None and not self._reply.done():
            self._reply.set_exception(error)
        self._ended.set_exception(error)
        self._ended.exception()  # retrieved: nobody need be waiting
        if self._transport is not None:
            self._transport.abort()

    def _flush(self) -> None:
        if self._transport is not None:
            self._transport.write(self._connection.bytes_to_send())


def _connect_text(server: str, error: OSError) -> str:
    if isinstance(error, ConnectionRefusedError):
        return f"connection refused by {server}; is the RT server running, and is this its port?"
    return f"no connection to {server}: {error.strerror or error}; check address, cable and routing"
