"""Recordings that peers start and stop on the server of one source."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final, NamedTuple

from gateway.errors import QueryError
from gateway.queries.server_requests import ServerRequests
from gateway.rtc3d.commands import ControlRecording


class RecordingAccess(NamedTuple):
    """What starts and stops recordings of one source (True starts).

    ``send_packet`` sends the packet of field note 16, and returns False if there is no connection.
    ``follow`` lets the outputs follow a recording: see Output.follow_recording.
    """

    send_packet: Callable[[bool], bool]
    follow: Callable[[bool, str], Awaitable[Mapping[str, Any]]]


_NOT_ACCEPTED: Final = {"refused", "timeout"}


class Recordings:
    """Starts and stops recordings.

    Servers can be asked in two ways, neither in the specification: with a packet that cannot name the file
    (field note 16), and with commands that can (field note 18). Without a name, the packet is sent, which
    gets no reply. With a name, the command is sent, and the packet if the server does not accept the command.

    ``before`` are the recordings of the source that this one replaces after a reload.
    """

    def __init__(
        self,
        source: str,
        requests: ServerRequests,
        access: RecordingAccess,
        before: "Recordings | None" = None,
    ) -> None:
        self._source = source
        self._requests = requests
        self._access = access
        self._is_named: bool = False if before is None else before._is_named  # noqa: SLF001 - the same class
        self._lock = asyncio.Lock()

    async def control(self, *, start: bool, name: str) -> dict[str, Any]:
        """Start or stop a recording; return what the peer gets. Raises QueryError."""
        if not name.isascii():
            raise QueryError(
                "the name of a recording on the server can have ASCII letters only, as commands do (§5.1)"
            )
        async with self._lock:
            if not self._requests.is_connected:
                raise self._requests.no_connection_error()
            return await (self._start(name) if start else self._stop())

    async def _start(self, name: str) -> dict[str, Any]:
        following = asyncio.ensure_future(self._access.follow(True, name))
        await asyncio.sleep(0)  # takes begin before the recording, which does not wait for their disk
        try:
            self._is_named = bool(name) and await self._is_accepted(
                ControlRecording(start=True, options=f",file={name}.c3d")
            )
            if not self._is_named:
                self._send(start=True)
        except QueryError:
            await following
            await self._access.follow(False, "")
            raise
        named = {"name": name, "is_named": self._is_named} if name else {}
        return {"source": self._source, "sent": "start", **named, **await following}

    async def _stop(self) -> dict[str, Any]:
        if not (self._is_named and await self._is_accepted(ControlRecording(start=False))):
            self._send(start=False)
        self._is_named = False
        return {"source": self._source, "sent": "stop", **await self._access.follow(False, "")}

    async def _is_accepted(self, command: ControlRecording) -> bool:
        try:
            await self._requests.send(command)
        except QueryError as error:
            if error.code not in _NOT_ACCEPTED:
                raise
            return False
        return True

    def _send(self, *, start: bool) -> None:
        if not self._access.send_packet(start):
            raise self._requests.no_connection_error()
