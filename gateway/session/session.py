"""One TCP session with an RT server, used once: the asyncio layer around ``rtc3d.client_protocol``."""

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable
from typing import Final, NoReturn, Protocol

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import ClosedError, DefectError, LinkError, SilenceError
from gateway.messages.host_time import host_clock
from gateway.rtc3d.client_protocol import (
    Answered,
    ByteOrderMismatch,
    ClientProtocol,
    FrameRejected,
    PossibleReply,
    ProtocolEvent,
    ProtocolState,
    Refused,
    StreamCorrupted,
    UnexpectedPacket,
)
from gateway.rtc3d.commands import Bye, Command, StopStreaming
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import FilePiece, Packet, decode_text
from gateway.runtime.failures import defect_text
from gateway.runtime.safe_text import safe_text
from gateway.session.backlog import LONG_READ_BYTES, Backlog, OnFrames, ReadClocks, Reading
from gateway.session.process_clock import RunningTimeout, running_clock
from gateway.session.replies import Replies
from gateway.session.state import Phase
from gateway.session.status import StreamStatus
from gateway.session.tcp import Connect, open_connection, set_socket_options


def defect_error(defect: BaseException) -> DefectError:
    """Return the error for an exception that nobody expected."""
    error = DefectError(f"{defect_text(defect)}; connecting again; report this with the log")
    error.__cause__ = defect
    return error


class FileSink(Protocol):
    """Takes the C3D files of one stream. Its methods are called in the event loop and must not block."""

    def receive(self, piece: FilePiece) -> None:
        """Take the next piece of a file."""

    def interrupt(self, reason: str) -> None:
        """Give up a file that is not complete, because the connection has ended."""


_BYE_S: Final = 0.5
"""How long a server may take to close after Bye; some never do (field note 10)."""

_TURN_US: Final = 2000
"""How long one read is processed; then other sources have their turn. Publishing its frames adds to it."""

_MAX_PACKETS: Final = 64
"""How many packets are processed between two readings of the clock."""

logger = logging.getLogger(__name__)


class Session:
    """One connection of one stream: ``connect``, then ``ask`` and ``monitor``, then ``close``.

    The event loop calls ``on_frames`` and ``files``, which must not block; without ``files``, those of the
    server are ignored. ``connect`` opens the connection, ``read_clocks`` dates what arrives. Time-outs count
    only the time during which this process runs, so a stop of the process is not the server's silence.

    The first error ends the session, and so does ``close``. Every call that is waiting then, and every later
    call, raises that first error; later errors change nothing.
    """

    def __init__(
        self,
        source: SourceSettings,
        stream: StreamSettings,
        status: StreamStatus,
        on_frames: OnFrames,
        files: FileSink | None = None,
        connect: Connect = open_connection,
        read_clocks: ReadClocks = host_clock.read,
    ) -> None:
        self.server = f"{source.host}:{source.port}"
        self._source = source
        self._only_events = stream.has_only_events
        self._status = status
        speed = stream.backlog_speed if stream.backlog == "all" else None
        self._reading = Reading(self._process)
        self._frames = Backlog(
            on_frames, status.clock, speed, read_clocks, self._reading.set_backlog, self._fail_by_defect
        )
        self._files = files
        self._connect = connect
        self._read_clocks = read_clocks
        self._running = running_clock()
        self._protocol = ClientProtocol(source.max_packet_bytes, source.max_c3d_bytes)
        self._transport: asyncio.Transport | None = None
        self._error: LinkError | None = None  # why the session ended
        self._rejection = ""  # of the newest frame that was rejected: why, and when on the running clock
        self._rejected_s = 0.0
        self._ended = asyncio.Event()  # _error is set
        self._lost = asyncio.Event()  # the transport is closed
        self._ask_lock = asyncio.Lock()  # held while a command is pending
        self.replies = Replies(source, self._blocked_until_s, self._assume_reply)
        self._state_changed = asyncio.Event()  # set when the protocol's state changes
        self._quiet_since_s = 0.0  # when the stall time-out last started, on the running clock
        self._last_piece_s = 0.0  # when the newest piece of a file arrived: nothing can arrive before its end

    @property
    def is_open(self) -> bool:
        """Whether the session is connected and has not ended."""
        return self._transport is not None and self._error is None

    @property
    def protocol_state(self) -> ProtocolState:
        """What the gateway has requested, and what the server sends."""
        return self._protocol.state

    @property
    def byte_order(self) -> str:
        """The byte order of the server's frames, big or little; "" before the first frame with data."""
        return self._protocol.byte_order or ""

    @property
    def has_data(self) -> bool:
        """Whether the server sends frames, or reports that no measurement runs."""
        return self.protocol_state in {ProtocolState.STREAMING, ProtocolState.NO_MEASUREMENT}

    async def connect(self) -> None:
        """Connect to the server. Raises ConnectError with the reason and what to check."""
        self._status.connecting(self.server)
        self._transport = await self._connect(self._source, self)
        self._reading.begin(self._transport)
        self._quiet_since_s = self._running.time()
        self._status.connected(self.server)

    async def ask(self, command: Command) -> Packet:
        """Send ``command`` and return the packet that answers it; one command at a time.

        Raises ServerError with the server's text if the server refuses, ReplyTimeoutError if it does not
        answer within reply_timeout_s, LinkError if the connection ends.
        """
        async with self._ask_lock:
            self._check_open()
            state_before = self._protocol.state
            self._protocol.send(command)
            self._report_change(state_before)
            try:
                return await self.replies.ask(command, self._flush)
            finally:
                state_before = self._protocol.state
                self._protocol.give_up()
                self._report_change(state_before)

    async def wait_for_data(self, timeout_s: float) -> bool:
        """Wait for frames or No Data; return whether the server sends either."""
        with contextlib.suppress(TimeoutError):
            async with RunningTimeout(timeout_s):
                while not self.has_data and self._error is None:
                    self._state_changed.clear()
                    await self._state_changed.wait()
        self._check_open()
        return self.has_data

    def _blocked_until_s(self) -> float:
        """Return when a backlog or a piece of a file last came before other packets, on the running clock."""
        return max(self._frames.caught_up_s, self._last_piece_s)

    def control_recording(self, *, start: bool) -> None:
        """Start or stop the server's recording (field note 16). Raises LinkError if the session has ended."""
        self._check_open()
        self._protocol.send_recording(start=start)
        self._flush()

    async def monitor(self, check_silence: Callable[[], Awaitable[None]]) -> NoReturn:
        """Wait until the session ends or the server is silent; then raise LinkError with the reason.

        After each ``stall_timeout_s`` without a frame, call ``check_silence`` if silence may be normal. It
        raises LinkError if it is not.
        """
        while True:
            self._check_open()
            quiet_since_s = max(self._quiet_since_s, self._blocked_until_s())
            wait_s = self._source.stall_timeout_s - (self._running.time() - quiet_since_s)
            if wait_s <= 0:
                self._check_stall()
                await check_silence()
                self._quiet_since_s = self._running.time()
                continue
            with contextlib.suppress(TimeoutError):
                async with RunningTimeout(wait_s):
                    await self._ended.wait()

    def _check_stall(self) -> None:
        """Raise SilenceError if no frame is accepted although a measurement runs.

        Events are rare, so a stream that has only events may be silent. Frames that are rejected after No
        Data belong to a new measurement.
        """
        is_stopping = isinstance(self._protocol.pending_command, StopStreaming)
        is_measuring = self._protocol.state is ProtocolState.STREAMING or (
            self._protocol.state is ProtocolState.NO_MEASUREMENT and self.rejection
        )
        if is_measuring and not self._only_events and not is_stopping:
            text = silence = f"no frame from {self.server} for {self._source.stall_timeout_s:g} s"
            reason = f"{silence} although a measurement runs"
            if self.rejection:
                text = reason = f"all frames from {self.server} are rejected: {self.rejection}"
            self._status.enter(Phase.SILENT, "silence", text)
            raise SilenceError(f"{reason}; connecting again")

    @property
    def rejection(self) -> str:
        """Why a frame was rejected within the last ``stall_timeout_s``; "" if none was."""
        is_recent = self._running.time() - self._rejected_s < self._source.stall_timeout_s
        return self._rejection if is_recent else ""

    def fail(self, error: LinkError) -> None:
        """End the session with ``error`` and drop the connection, unless it has ended already."""
        if self._error is None:
            self._end(error)
            if self._transport is not None:
                self._transport.abort()

    def _fail_by_defect(self, defect: Exception) -> None:
        if self._error is None:
            self.fail(defect_error(defect))  # the supervisor logs it and connects again
        else:
            self._status.defect(defect)

    async def close(self) -> None:
        """Send Bye, and close the connection when the server does, or after 0.5 s.

        If the session has ended already, only release the connection.
        """
        if self._transport is None:
            return
        if self._error is None:
            self._protocol.send(Bye())
            self._flush()
            self._end(ClosedError(f"the connection to {self.server} was closed by the gateway"))
            # Continue to read: closing a socket with unread data resets the connection, and the server might
            # never read the Bye.
            with contextlib.suppress(TimeoutError):
                self._transport.write_eof()
                async with asyncio.timeout(_BYE_S):
                    await self._lost.wait()
        self._transport.abort()
        while not (self._frames.is_empty and self._reading.is_idle):  # noqa: ASYNC110 - takes few turns
            await asyncio.sleep(0)  # each turn of the loop publishes a part of what has arrived

    # The methods of an asyncio.Protocol, which the event loop calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Set the options of the socket. The event loop has turned Nagle off (§2.1).

        This method does not store the transport; ``connect`` does. If ``connect`` is cancelled, uvloop closes
        the transport without calling ``connection_lost``.
        """
        set_socket_options(transport.get_extra_info("socket"))

    def data_received(self, data: bytes) -> None:
        """Process the bytes of one read. From here to the outputs there are only plain calls, no tasks."""
        utime, steady_us = self._read_clocks()
        self._status.bytes_in += len(data)
        if self._process(data, utime, steady_us) or len(data) >= LONG_READ_BYTES:
            self._reading.wait_for_turn(utime, steady_us)

    def _process(self, data: bytes, utime: int, steady_us: int) -> bool:
        """Process the bytes of one read for a limited time; return whether some of them remain."""
        protocol = self._protocol
        state_before = protocol.state
        try:
            frames, events = protocol.receive(data, _MAX_PACKETS)
            for event in events:
                self._on_event(event)
            has_more = protocol.has_more
            end_us = self._read_clocks()[1] + _TURN_US if has_more else 0
            while has_more and self._read_clocks()[1] < end_us:
                further, events = protocol.receive(b"", _MAX_PACKETS)
                frames += further
                for event in events:
                    self._on_event(event)
                has_more = protocol.has_more
            if protocol.state is not state_before:
                self._report_change(state_before)
            if frames:
                self._status.last_frame_s = self._quiet_since_s = self._running.tick()
                self._frames.receive(frames, utime, steady_us)
        except Exception as defect:  # noqa: BLE001 - a defect ends only this session
            self._fail_by_defect(defect)
            return False
        return has_more

    def eof_received(self) -> None:
        """Let the event loop close the connection: a server that sends no more is of no use."""

    def pause_writing(self) -> None:
        """End the session: commands are few and short, so the server has not read for long."""
        self.fail(ClosedError(f"{self.server} does not read the gateway's commands; restart its application"))

    def resume_writing(self) -> None:
        """Do nothing; ``pause_writing`` has ended the session."""

    def connection_lost(self, exc: Exception | None) -> None:
        """End the session, unless it has ended already: the connection is closed, by either side."""
        try:
            self._protocol.end()
            reason = f"broke: {exc}" if exc else "was closed by the server"
            self.fail(ClosedError(f"the connection to {self.server} {reason}"))
        except Exception as defect:  # noqa: BLE001 - a defect ends only this session
            self._fail_by_defect(defect)
        self._lost.set()

    def _on_event(self, event: ProtocolEvent) -> None:
        match event:
            case Answered(_, packet):
                self.replies.end(packet)
            case Refused(_, error):
                self.replies.end(error)
            case PossibleReply():
                self.replies.assume_soon()
            case FrameRejected(frame_error, announced):
                # The frame would have had so many messages, if its component count is true.
                num_wanted = len(self._status.components.split())
                num_lost = min(announced, num_wanted) if 0 < announced <= len(ComponentType) else 1
                self._rejection, self._rejected_s = str(frame_error), self._running.time()
                self._status.frame_rejected(self._rejection, num_lost)
            case FilePiece() if self._error is None:
                self._last_piece_s = self._running.time()
                if self._files is not None:
                    self._files.receive(event)
            case ByteOrderMismatch(byte_order):
                self._status.add_limitation(
                    f"the server sends {byte_order}-endian frames, not the byte order agreed"
                )
            case StreamCorrupted(packet_error):
                closed = ClosedError(f"{self.server}: {packet_error}")
                closed.__cause__ = packet_error
                self.fail(closed)
            case UnexpectedPacket(packet):
                logger.debug(
                    "%s: unexpected packet of type %d: %s",
                    self._source.name, packet.type, safe_text(decode_text(packet.body[:200])),
                )  # fmt: skip

    def _assume_reply(self) -> None:
        """No further reply has followed: the newest one answers the pending command."""
        if self._error is not None:
            return
        try:
            state_before = self._protocol.state
            for event in self._protocol.assume_reply():
                self._on_event(event)
            self._report_change(state_before)
        except Exception as defect:  # noqa: BLE001 - a defect ends only this session
            self._fail_by_defect(defect)

    def _report_change(self, state_before: ProtocolState) -> None:
        """Report the protocol's state if it has changed, and restart the stall time-out."""
        if self._protocol.state is state_before or self._error is not None:
            return
        self._quiet_since_s = self._running.time()
        self._state_changed.set()
        self._status.protocol_changed(self._protocol.state, self.byte_order, self.server)

    def _check_open(self) -> None:
        """Raise the session's error if it has ended, ClosedError if it is not connected."""
        if self._error is not None:
            raise self._error
        if self._transport is None:
            raise ClosedError(f"{self.server}: not connected")

    def _end(self, error: LinkError) -> None:
        """End the session. Calls that are waiting, and later calls, raise ``error``."""
        self._error = error
        self._ended.set()
        self._state_changed.set()
        self.replies.end(error)
        try:
            if self._files is not None:
                self._files.interrupt(str(error))
            if isinstance(error, DefectError):  # which may be one in publishing
                self._frames.drop()
            else:
                self._frames.finish()
        except Exception as defect:  # noqa: BLE001 - calls that wait for the end must return
            self._error = defect_error(defect)

    def _flush(self) -> None:
        if self._transport is not None:
            self._transport.write(self._protocol.bytes_to_send())
