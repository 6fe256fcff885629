"""How much memory the files that wait for the disk may take, over all sources."""

import threading
from collections import Counter
from typing import Final

_PIECE_BYTES: Final = 200
"""What a piece takes besides its content. A server may send a file byte by byte."""


class QueueMemory:
    """Counts the bytes of all sources that wait to be written.

    A source may hold as many bytes as are free for all, so at most half of the total: it cannot take the
    memory from the others. Any thread may call the methods.
    """

    def __init__(self, max_bytes: int) -> None:
        self._free = max_bytes
        self._held: Counter[str] = Counter()
        self._lock = threading.Lock()

    def reserve(self, source: str, piece: bytes) -> bool:
        """Reserve memory for a piece; return False if there is not enough."""
        num_bytes = len(piece) + _PIECE_BYTES
        with self._lock:
            if self._held[source] + num_bytes > self._free:
                return False
            self._held[source] += num_bytes
            self._free -= num_bytes
        return True

    def release(self, source: str, piece: bytes) -> None:
        """Return the memory of a piece that no longer waits."""
        num_bytes = len(piece) + _PIECE_BYTES
        with self._lock:
            self._held[source] -= num_bytes
            self._free += num_bytes

    @property
    def held_bytes(self) -> int:
        """How many bytes wait now."""
        with self._lock:
            return self._held.total()
