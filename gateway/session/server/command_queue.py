"""The packets of one client that wait for an answer, and how many of them are answered in a second."""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Final

from gateway.rtc3d.packets import Packet, PacketReader
from gateway.runtime.token_bucket import TokenBucket

MAX_COMMAND_BYTES: Final = 64 * 1024
"""The largest packet that a client may send."""

MAX_COMMANDS_PER_S: Final = 1000.0
"""How many packets of one client are answered in a second; further ones wait."""

_PAUSE_S: Final = 0.05  # for a client that sends too many


class CommandQueue:
    """A client's packets, in the order in which they are answered.

    ``answer_next`` answers one of them. ``schedule`` has it called in the loop's next turn, so that no client
    delays the others.
    """

    def __init__(self, answer_next: Callable[[], None]) -> None:
        self.packets: deque[Packet] = deque()
        """The packets that wait."""
        self.is_held = False
        """Whether they wait for the answer to the one before."""
        self.is_scheduled = False
        """Whether ``answer_next`` is going to be called."""
        self._answer_next = answer_next
        self._reader = PacketReader(max_packet_bytes=MAX_COMMAND_BYTES, max_c3d_bytes=MAX_COMMAND_BYTES)
        self._rate = TokenBucket(MAX_COMMANDS_PER_S)

    @property
    def bad_size(self) -> int | None:
        """The size that the packet after these has, if it is out of bounds: it cannot be read."""
        return None if self._reader.error is None else self._reader.error.size

    def feed(self, data: bytes) -> None:
        """Add the packets in bytes from the client."""
        self.packets.extend(self._reader.feed(data))

    def take(self) -> Packet | None:
        """Remove the first packet and return it; None if there were too many: the next call comes later."""
        if not self._rate.try_take():
            self.schedule(_PAUSE_S)
            return None
        return self.packets.popleft()

    def schedule(self, delay_s: float = 0.0) -> None:
        """Call ``answer_next`` in a later turn of the loop, once."""
        if not self.is_scheduled:
            self.is_scheduled = True
            loop = asyncio.get_running_loop()
            if delay_s:
                loop.call_later(delay_s, self._run)
            else:
                loop.call_soon(self._run)

    def _run(self) -> None:
        self.is_scheduled = False
        self._answer_next()
