"""Takes as peers use them: start, stop, save, list and read."""

from typing import Protocol

from gateway.outputs.takes.stored import SourceTakes, StoredTake, TakePiece
from gateway.takes.description import NO_DETAILS, TakeDetails


class Takes(Protocol):
    """The takes of all sources. Call it in the event loop; no call waits for the disk for long.

    Every method raises QueryError: bad-request for a name, text or number that cannot be, a take that exists
    or is running already, or does not exist; nothing-yet if there is nothing to stop or save; disk if the
    folder cannot be used. The text is for the peer.
    """

    async def start(self, source: str, name: str = "", details: TakeDetails = NO_DETAILS) -> StoredTake:
        """Start a take and return it; everything that is published after this call is in it.

        "" means a name of source and time. A source has one running take.
        """
        ...

    async def stop(self, source: str) -> StoredTake:
        """End the running take, and return it when everything is on the disk."""
        ...

    async def save(
        self,
        source: str,
        last_s: float,
        after_s: float = 0.0,
        name: str = "",
        details: TakeDetails = NO_DETAILS,
    ) -> StoredTake:
        """Keep the last ``last_s`` seconds as a take, which goes on for ``after_s`` seconds.

        Returns it at once; it is running until it is complete.
        """
        ...

    async def list(self, source: str) -> SourceTakes:
        """Return the takes of a source."""
        ...

    async def read(self, source: str, name: str, offset: int) -> TakePiece:
        """Return up to MAX_PIECE_BYTES of a take; an empty piece at its end."""
        ...
