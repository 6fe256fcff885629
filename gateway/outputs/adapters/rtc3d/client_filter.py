"""What the gateway adds to the connection of an RTC3D client: limits, control of recordings, C3D files."""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Coroutine
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Final

from gateway.errors import CommandError, FrameError, QueryError
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d import commands
from gateway.rtc3d.packets import (
    PACKET_HEADER,
    PACKET_HEADER_BYTES,
    Packet,
    PacketType,
    decode_text,
    encode_packet,
)
from gateway.runtime.failures import DefectLog
from gateway.runtime.losses import Losses
from gateway.runtime.server_limits import Clients, notice_vanished
from gateway.runtime.workers import WorkerThread
from gateway.session.server.client_connection import ClientConnection, ConnectionFilter
from gateway.session.server.client_session import MAX_FRAME_REQUESTS, error_packet, recording_switch

SLOW_CLIENT: Final = "slow client"
"""The cause of frames that a client did not get because it does not read fast enough."""

FILE: Final = "C3D file"
"""The cause of C3D files that a client did not get."""

_CONTROL_S: Final = 30.0
"""How long a client waits at most for the start or the end of a recording."""

_PARAMETERS_S: Final = 1.0
"""How long a client waits for the parameters while the gateway is connecting to the server."""

_CHUNK_BYTES: Final = 256 * 1024
_FILE_BUFFER_BYTES: Final = 1024 * 1024
_FILE_POLL_S: Final = 0.01
_MAX_FILES: Final = 4
"""C3D files are sent in pieces, as fast as the client reads. So many wait for one client."""

MAX_HELD_PACKETS: Final = MAX_FRAME_REQUESTS + 24
"""How many packets wait for the end of a file: one reply, and No Data for the requests for frames."""

_LONGEST_NAME: Final = 32  # of a command, in bytes

_log = logging.getLogger(__name__)

ControlRecording = Callable[[str, bool, str], Coroutine[Any, Any, str]]
"""Starts (True) or stops the recording of a source, with options or ""; raises QueryError.

Returns the text of the server's reply, "" if it sent none."""


class SourceState:
    """What the gateway knows about a source, and whether its clients ask for frames.

    The gateway's event loop assigns all attributes but ``wanted``; the thread of the clients reads them.
    """

    def __init__(self, source: str) -> None:
        self.source = source
        self.is_streaming = False
        """Whether frames arrive."""
        self.is_measuring: bool | None = None
        """Whether a measurement runs; None if that is unknown."""
        self.parameters = ServerParameters(b"", 0, 0)
        self.losses = Losses(_log, f"{source} to rtc3d")
        self.wanted = False
        """Whether any client asks for frames. The server assigns it."""
        self.heard = asyncio.Event()
        """Set in the thread once anything is known."""

    @property
    def has_no_measurement(self) -> bool:
        """Whether it is known that no frames can come now."""
        return not self.is_streaming and self.is_measuring is False

    @property
    def is_known(self) -> bool:
        """Whether anything is known of the source: parameters, frames, or that it has none."""
        return self.parameters.version > 0 or self.is_streaming or self.is_measuring is not None


class ClientFilter(ConnectionFilter):
    """Limits what a client can do without a command, and lets it control recordings and get files.

    ``disk`` reads the files, and ``control`` starts and stops recordings.
    """

    def __init__(
        self,
        connection: ClientConnection,
        state: SourceState,
        clients: "Clients[ClientFilter]",
        disk: WorkerThread,
        control: ControlRecording,
    ) -> None:
        super().__init__(connection)
        self._state = state
        self._clients = clients
        self._disk = disk
        self._control = control
        self._files: list[Path] = []
        self._held: list[bytes] = []  # packets that wait for the end of a file
        self._tasks: set[asyncio.Task[None]] = set()  # they end with the connection
        self._stops: set[asyncio.Task[None]] = set()  # they do not
        self._defects = DefectLog(_log, "rtc3d")
        self._greeting = asyncio.get_running_loop().call_later(clients.limits.handshake_s, self._give_up)
        notice_vanished(connection.transport.get_extra_info("socket"), clients.limits)

    def send(self, packet: bytes) -> None:
        """Send a packet, or hold it until the end of a file."""
        if not self.is_busy:
            self.connection.write(packet)
        elif len(self._held) < MAX_HELD_PACKETS:
            self._held.append(packet)
        else:
            text = (
                f"client {self.connection.name} reads a C3D file too slowly: {MAX_HELD_PACKETS} packets wait "
                "for its end, further ones are dropped; check that program, or the network to it"
            )
            self._state.losses.lost(SLOW_CLIENT, text, frames=0)

    def answer(self, packet: Packet) -> list[bytes]:
        """Return the replies to a packet.

        Those to the control of a recording come later, and so do the parameters while the gateway connects.
        """
        control = recording_control(packet)
        if control is not None:
            self._greet()
            tasks = self._tasks if control.start else self._stops
            self._hold(partial(self._control_recording, packet, control), tasks)
        elif not self._state.is_known and asks_for_parameters(packet):
            self._hold(partial(self._answer_when_known, packet), self._tasks)
        else:
            return self._answer_now(packet)
        return []

    def _answer_now(self, packet: Packet) -> list[bytes]:
        replies = self.connection.answer(packet)
        if self not in self._clients.served and any(reply[7] != PacketType.ERROR for reply in replies):
            self._greet()
        return replies

    def connection_lost(self) -> None:
        """End what is done for the client. But what it has started and asked to stop is stopped."""
        self._clients.close(self)
        self._greeting.cancel()
        for task in self._tasks:
            task.cancel()
        for packet in self.connection.waiting:
            control = recording_control(packet)
            if control is not None and not control.start:
                self._start(self._stop_recording(), self._stops)
                break

    async def _stop_recording(self) -> None:
        """Stop the recording, for a client that has gone before its request was handled."""
        try:
            await self._control(self._state.source, False, "")
        except QueryError as error:
            _log.warning(
                "%s: client %s has gone, and its recording was not stopped: %s; stop it on the server",
                *(self._state.source, self.connection.name, error),
            )

    def abort(self) -> None:
        """Disconnect the client at once."""
        self.connection.transport.abort()

    def _greet(self) -> None:
        self._clients.serve(self)
        self._greeting.cancel()

    def _give_up(self) -> None:
        wait_s = self._clients.limits.handshake_s
        _log.debug("%s sent no command within %g s; closing", self.connection.name, wait_s)
        self.connection.write(error_packet(f"No command within {wait_s:g} s; closing"))
        self.connection.transport.close()

    def _start(self, work: Coroutine[Any, Any, None], tasks: set[asyncio.Task[None]]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    # Replies that come later ----------------------------------------------------------------

    def _hold(
        self, work: Callable[[], Coroutine[Any, Any, list[bytes]]], tasks: set[asyncio.Task[None]]
    ) -> None:
        """Answer no further packet until this work is done, and has returned the replies to this one."""
        self.connection.hold_commands()
        self._start(self._send_result(work), tasks)

    async def _send_result(self, work: Callable[[], Coroutine[Any, Any, list[bytes]]]) -> None:
        try:
            for reply in await work():
                self.send(reply)
        except Exception as defect:  # noqa: BLE001 - a defect in the gateway must not stop the client
            self._defects.log(defect)
            self.send(error_packet("No answer because of a defect in the gateway"))
        finally:
            self.connection.continue_commands()

    async def _answer_when_known(self, packet: Packet) -> list[bytes]:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_PARAMETERS_S):
                await self._state.heard.wait()
        return self._answer_now(packet)

    async def _control_recording(self, packet: Packet, control: commands.ControlRecording) -> list[bytes]:
        try:
            async with asyncio.timeout(_CONTROL_S):
                reply = await self._control(self._state.source, control.start, control.options)
            if reply:
                return [encode_packet(PacketType.COMMAND, reply.encode("latin-1"))]
            return self.connection.answer(packet)
        except (QueryError, TimeoutError) as error:
            done = "started" if control.start else "stopped"
            text = str(error) or f"no answer within {_CONTROL_S:g} s"
            return [error_packet(f"The recording was not {done}: {text}")]

    # Files ----------------------------------------------------------------------------------

    def send_file(self, path: Path) -> None:
        """Send a C3D file after those that wait. Frames are dropped meanwhile; events and replies wait."""
        if len(self._files) >= _MAX_FILES:
            self._file_lost(path, f"{_MAX_FILES} files wait for it already")
            return
        self._files.append(path)
        if len(self._files) == 1:
            self._start(self._send_files(), self._tasks)

    async def _send_files(self) -> None:
        while self._files:
            try:
                await self._send_file(self._files[0])
            except OSError as error:
                self._file_lost(self._files[0], error.strerror or str(error))
            except Exception as defect:  # noqa: BLE001 - the next file can still be sent
                self._defects.log(defect)
                self._file_lost(self._files[0], "a defect in the gateway")
            self._files.pop(0)

    def _file_lost(self, path: Path, reason: str) -> None:
        text = (
            f"client {self.connection.name} does not get {path.name}: {reason}; the gateway keeps files in "
            "its spool"
        )
        self._state.losses.lost(FILE, text, frames=0)

    async def _send_file(self, path: Path) -> None:
        """Send one file. Raises OSError; if that is in the middle of the file, the connection ends."""
        file: BinaryIO = await self._disk.run(lambda: path.open("rb"))
        try:
            num_bytes = await self._disk.run(lambda: path.stat().st_size)
            self.is_busy = True
            try:
                self.connection.write(PACKET_HEADER.pack(PACKET_HEADER_BYTES + num_bytes, PacketType.C3D))
                await self._send_content(file, num_bytes)
            except Exception:
                self.connection.transport.abort()
                raise
            finally:
                self.is_busy = False
        finally:
            self._disk.submit(file.close)
        held, self._held = self._held, []
        for packet in held:
            self.connection.write(packet)
        self.connection.continue_sending()

    async def _send_content(self, file: BinaryIO, num_bytes: int) -> None:
        transport = self.connection.transport
        while num_bytes:
            size = min(num_bytes, _CHUNK_BYTES)
            chunk = await self._disk.run(partial(file.read, size))
            if len(chunk) != size:
                raise OSError("it is shorter than it was")
            self.connection.write(chunk)
            num_bytes -= size
            # Nobody says when this much has been read: the limits of the transport are higher.
            while transport.get_write_buffer_size() > _FILE_BUFFER_BYTES:  # noqa: ASYNC110
                await asyncio.sleep(_FILE_POLL_S)


def recording_control(packet: Packet) -> commands.ControlRecording | None:
    """Return how a packet controls a recording (field notes 16 and 18); None if it is something else."""
    try:
        if packet.type == PacketType.COMMAND:
            command = commands.parse_command(packet.body)
            return command if isinstance(command, commands.ControlRecording) else None
        if packet.type == PacketType.DATA:
            start = recording_switch(packet.body, "big")
            return None if start is None else commands.ControlRecording(start)
    except (CommandError, FrameError):
        pass  # the session refuses it in its own words
    return None


def asks_for_parameters(packet: Packet) -> bool:
    """Return whether a packet is SendParameters."""
    words = decode_text(packet.body[:_LONGEST_NAME]).split() if packet.type == PacketType.COMMAND else []
    return bool(words) and words[0].lower() == "sendparameters"
