"""What stands between a client's connection and its transport while faults are on."""

from __future__ import annotations

import asyncio
import itertools
import logging
import math
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from gateway.rtc3d.packets import Packet, PacketType
from gateway.rtc3d_server.client_session import error_packet
from gateway.simulator.faults.base import Chunk, LineFault, Run, type_of

if TYPE_CHECKING:
    from gateway.rtc3d_server.client_connection import ClientConnection
    from gateway.simulator.faults.control import Faults

MAX_WAITING_BYTES: Final = 4 * 1024 * 1024
"""What may wait to be sent on one connection; beyond it, packets are lost."""

_log = logging.getLogger(__name__)


class Line:
    """Passes one connection's bytes through the faults that are on, in both directions.

    What is sent keeps its order, however late the faults make it. The line is there as long as a
    fault of its connection is on or anything waits in it.
    """

    def __init__(self, connection: ClientConnection, faults: Faults) -> None:
        self._connection = connection
        self._faults = faults
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[Chunk] = deque()
        self._waiting_bytes = 0
        self._was_full = False
        self._sending: asyncio.TimerHandle | None = None
        self._held: dict[int, bytes] = {}  # replies that frames overtake, by the order of their coming
        self._numbers = itertools.count()
        self._frames_first: dict[int, int] = {}  # by held reply: how many frames are still to go first
        self._timers: dict[int, asyncio.TimerHandle] = {}  # by held reply
        self._unread = bytearray()
        self._reading: asyncio.TimerHandle | None = None

    @property
    def waiting_bytes(self) -> int:
        """How many bytes wait to be sent or to be read."""
        return self._waiting_bytes + sum(map(len, self._held.values())) + len(self._unread)

    # What the connection calls --------------------------------------------------------------

    def send(self, packet: bytes) -> None:
        """Send one packet as the faults have it."""
        runs = self._runs()
        chunks = [Chunk(time.monotonic(), packet)]
        acted = []
        for run, fault in runs:
            changed = fault.outgoing(chunks, run)
            if changed != chunks:
                acted.append(run)
            chunks = changed
        self._queue(chunks)
        self._count_frame(packet)
        self._faults.acted(acted)

    def answer(self, command: Packet) -> list[bytes]:
        """Return the replies to a client's packet as the faults have them."""
        runs = self._runs()
        for run, fault in runs:
            refusal = fault.refusal(command)
            if refusal is not None:
                self._faults.acted([run])
                return [error_packet(refusal)]
        replies = self._connection.client.answer(command)
        acted = []
        for run, fault in runs:
            changed = fault.replies(command, replies, self)
            if changed != replies:
                acted.append(run)
            replies = changed
        self._faults.acted(acted)
        return replies

    def holds(self, data: bytes) -> bool:
        """Return whether the server does not read these bytes now; they are given to it later then."""
        waits = [(run, fault.reading_s(len(data))) for run, fault in self._runs()]
        wait_s = max((wait_s for _, wait_s in waits), default=0.0)
        if not wait_s and not self._unread:
            return False
        self._unread += data
        self._connection.transport.pause_reading()
        if self._reading is None and math.isfinite(wait_s):
            self._reading = self._loop.call_later(wait_s, self.read)
        self._faults.acted([run for run, its_wait_s in waits if its_wait_s])
        return True

    def flush(self) -> None:
        """Send at once all that waits, in its order."""
        for number in list(self._held):
            self._send_held(number)
        self._write_due(math.inf)

    def read(self) -> None:
        """Read at once what is unread."""
        if self._reading is not None:
            self._reading.cancel()
            self._reading = None
        if self._unread:
            data = bytes(self._unread)
            self._unread.clear()
            self._connection.resume_reading()
            self._connection.take(data)
        self._leave_if_idle()

    def close(self) -> None:
        """Forget what waits: the connection is no more."""
        for timer in (self._sending, self._reading, *self._timers.values()):
            if timer is not None:
                timer.cancel()
        self._waiting.clear()
        self._held.clear()
        self._unread.clear()

    # What faults call -----------------------------------------------------------------------

    def inject(self, data: bytes) -> None:
        """Send bytes that no fault is to change, after all that waits."""
        self._queue([Chunk(time.monotonic(), data)])

    def hold_for(self, reply: bytes, delay_s: float) -> None:
        """Send a reply so much later; whatever else is sent overtakes it."""
        number = next(self._numbers)
        self._held[number] = reply
        self._timers[number] = self._loop.call_later(delay_s, self._send_held, number)

    def hold_for_frames(self, reply: bytes, frames: int) -> None:
        """Send a reply after so many more data frames, or after No Data."""
        number = next(self._numbers)
        self._held[number] = reply
        self._frames_first[number] = frames

    def fault_ended(self) -> None:
        """Read what no fault holds back any more; leave the connection if there is nothing else to do."""
        is_held = any(math.isinf(fault.reading_s(len(self._unread))) for _, fault in self._runs())
        if self._unread and self._reading is None and not is_held:
            self.read()
        self._leave_if_idle()

    # ----------------------------------------------------------------------------------------

    def _runs(self) -> list[tuple[Run, LineFault]]:
        return self._faults.on_line(self._connection)

    def _queue(self, chunks: list[Chunk]) -> None:
        size = sum(len(chunk.data) for chunk in chunks)
        if self._waiting and self._waiting_bytes + size > MAX_WAITING_BYTES:
            if not self._was_full:
                name = self._connection.client.name
                _log.warning("%s: more waits than %d MiB; packets are lost", name, MAX_WAITING_BYTES >> 20)
            self._was_full = True
            return
        self._waiting.extend(chunks)
        self._waiting_bytes += size
        self._write_due()

    def _write_due(self, now_s: float | None = None) -> None:
        now_s = time.monotonic() if now_s is None else now_s
        while self._waiting and self._waiting[0].when_s <= now_s:
            data = self._waiting.popleft().data
            while self._waiting and self._waiting[0].joins and self._waiting[0].when_s <= now_s:
                data += self._waiting.popleft().data
            self._waiting_bytes -= len(data)
            self._connection.write(data)
        if self._sending is not None:
            self._sending.cancel()
            self._sending = None
        if self._waiting:
            wait_ms = math.ceil(1000 * (self._waiting[0].when_s - now_s))  # see Simulator.schedule
            self._sending = self._loop.call_later(wait_ms / 1000, self._write_due)
        else:
            self._leave_if_idle()

    def _count_frame(self, packet: bytes) -> None:
        if type_of(packet) not in {PacketType.DATA, PacketType.NO_DATA}:
            return
        for number, frames in list(self._frames_first.items()):
            if frames > 1 and type_of(packet) == PacketType.DATA:
                self._frames_first[number] = frames - 1
            else:
                self._send_held(number)

    def _send_held(self, number: int) -> None:
        self._frames_first.pop(number, None)
        timer = self._timers.pop(number, None)
        if timer is not None:
            timer.cancel()
        self.send(self._held.pop(number))

    def _leave_if_idle(self) -> None:
        if not (self._waiting or self._held or self._unread or self._runs()):
            self._connection.line = None
