"""One TCP connection to an RT server, used once: the event loop's shell over ``rtc3d.connection``."""

import asyncio
import contextlib
import logging
import socket
import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import (
    ClosedError,
    ConnectError,
    LinkError,
    ReplyTimeoutError,
    ServerError,
    SilenceError,
)
from gateway.log import HOLD_S, FailureLog
from gateway.messages.host_time import now_utime
from gateway.rtc3d.client_protocol import (
    Answered,
    Broken,
    ClientProtocol,
    Event,
    FileReceived,
    FrameRejected,
    OtherByteOrder,
    Refused,
    State,
    Stray,
)
from gateway.rtc3d.commands import Bye, Command, Version
from gateway.rtc3d.components import ByteOrder, ComponentType
from gateway.rtc3d.frames import Frame
from gateway.rtc3d.packets import Packet, text_of
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.stream.state import StreamInput
from gateway.stream.status import StreamStatus

_BYE_S: Final = 0.5
"""How long a server may take to close after Bye; some never do (field note 10)."""

_INPUTS: Final = {
    State.STREAMING: StreamInput.FRAME,
    State.NO_MEASUREMENT: StreamInput.NO_DATA,
    State.IDLE: StreamInput.STOPPED,
}
"""What a change of the connection's state means to the stream."""

_monotonic: Final = time.monotonic  # compiled, a Final is not looked up by its name at every call

logger = logging.getLogger(__name__)


class Handlers(NamedTuple):
    """Who takes what a session receives. Called from the event loop; they must not wait."""

    frames: Callable[[list[Frame], int, float], None]
    """Frames that came together, oldest first; when, in µs since the Unix epoch and in s of monotonic()."""
    parameters: Callable[[bytes, ParsedParameters], None]
    """The server's XML as it came, and what it says."""
    file: Callable[[bytes], None]
    """A complete C3D file."""


class Session:
    """One connection of one stream: ``connect``, ``ask``, ``ended``, ``close``, in this order.

    It keeps ``status`` up to date. Every method that waits raises LinkError once the connection is of
    no more use, always with the first reason.
    """

    def __init__(
        self, source: SourceSettings, stream: StreamSettings, status: StreamStatus, handlers: Handlers
    ) -> None:
        self._source = source
        self._stream = stream
        self._status = status
        self.handlers = handlers
        self._take_frames = handlers.frames  # called for every read
        self._connection = ClientProtocol(source.max_packet_bytes, source.max_c3d_bytes)
        self._seen = State.IDLE  # of the connection
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._ended: asyncio.Future[None] = self._loop.create_future()
        self._lost = asyncio.Event()
        self._error: LinkError | None = None
        self._reply: asyncio.Future[Packet] | None = None
        self._asking = asyncio.Lock()
        self._last_frame_s = 0.0
        self._rejected = FailureLog(logger, source.name, HOLD_S)
        self._is_rejecting = False  # as it says; to ask it would be 1 % of the instructions of a read
        self.server = f"{source.host}:{source.port}"

    @property
    def is_open(self) -> bool:
        """Whether the connection is there and of use."""
        return self._transport is not None and self._error is None

    async def connect(self) -> None:
        """Connect; raises ConnectError with the reason and what to look at."""
        self._status.move(StreamInput.DIAL, self.server)
        try:
            async with asyncio.timeout(self._source.connect_timeout_s):
                # create_connection will look it up again, but uvloop cannot end a lookup there: what comes
                # of one given up is logged as an error, and the next waits behind it.
                await asyncio.to_thread(socket.getaddrinfo, self._source.host, self._source.port)
                protocol: Any = self  # by its methods: what is compiled has no base class in Python
                self._transport, _ = await self._loop.create_connection(
                    lambda: protocol, self._source.host, self._source.port
                )
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
        self._last_frame_s = _monotonic()
        self._status.move(StreamInput.CONNECTED, self.server)

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
            quiet_s = _monotonic() - self._last_frame_s
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
        if self._seen is State.STREAMING and not only_events:
            text = f"no frame from {self.server} for {self._source.stall_timeout_s:g} s"
            self._status.move(StreamInput.SILENCE, text)
            raise SilenceError(f"{text} although a measurement runs; connecting again")
        try:
            await self.ask(Version())
        except ServerError:
            pass
        except ReplyTimeoutError as error:
            raise SilenceError(f"{error}, and sends no frames; connecting again") from None
        self._last_frame_s = _monotonic()

    async def close(self) -> None:
        """Say Bye, and end the connection at the latest half a second later."""
        if self._transport is None:
            return
        if self._error is None:
            self._connection.send(Bye())
            self._error = ClosedError(f"the connection to {self.server} was closed by the gateway")
            self._flush()
            # The rest of the stream is read on: closing with data unread would reset the connection,
            # and the server might never see the Bye.
            with contextlib.suppress(TimeoutError):
                self._transport.write_eof()
                async with asyncio.timeout(_BYE_S):
                    await self._lost.wait()
        self._transport.abort()

    # What the event loop calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Have the kernel look for a server that has vanished. The loop has turned Nagle off (§2.1).

        The transport is kept once ``connect`` has it: if that is cancelled before, uvloop closes the
        transport without a call of ``connection_lost``.
        """
        sock = transport.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)

    def data_received(self, data: bytes) -> None:
        """Take bytes; the straight path from here to the outputs is calls, not tasks."""
        utime = now_utime()
        self._status.bytes_in += len(data)
        frames, events = self._connection.receive(data)
        for event in events:
            self._on_event(event)
        if self._connection.state is not self._seen:
            self._on_state()
        if frames:
            self._last_frame_s = now_s = _monotonic()
            self._take_frames(frames, utime, now_s)
            if self._is_rejecting:
                self._rejected.recovered("frames are good again")
                self._is_rejecting = self._rejected.failing

    def connection_lost(self, exc: Exception | None) -> None:
        """Note the end, whoever caused it."""
        self._connection.end()
        reason = f"broke: {exc}" if exc else "was closed by the server"
        self._fail(ClosedError(f"the connection to {self.server} {reason}"))
        self._lost.set()

    def _on_state(self) -> None:
        self._seen = self._connection.state
        self._last_frame_s = _monotonic()
        self._status.byte_order = self._connection.byte_order or ""
        if self._seen in _INPUTS:
            self._status.move(_INPUTS[self._seen], self.server)

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
                self._is_rejecting = True
            case FileReceived(content):
                self.handlers.file(content)
            case OtherByteOrder(byte_order):
                self._on_other_byte_order(byte_order)
            case Broken(packet_error):
                closed = ClosedError(f"{self.server}: {packet_error}")
                closed.__cause__ = packet_error
                self._fail(closed)
            case Stray(packet):
                logger.debug(
                    "%s: nobody waits for packet type %d: %.200s",
                    self._source.name, packet.type, text_of(packet.body[:200]),
                )  # fmt: skip

    def _on_other_byte_order(self, byte_order: ByteOrder) -> None:
        text = f"the server sends {byte_order}-endian frames, not the byte order agreed"
        if self._status.limit(text):
            logger.warning("%s: %s", self._source.name, text)

    def _fail(self, error: LinkError) -> None:
        """End with the first reason: every waiter gets it."""
        if self._error is not None:
            return
        self._error = error
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
