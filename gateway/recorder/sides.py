"""What the command ``record`` needs of Zenoh and of LCM."""

from typing import Protocol


class RecordingSide(Protocol):
    """A subscriber that hands what it receives to a recording."""

    def tick(self) -> None:
        """Query what the descriptions of new sources need. Called often, in one thread."""

    def silence(self) -> str:
        """Return why nothing may have arrived: no gateway, or none with these sources. It may take 1 s."""

    def close(self) -> None:
        """Unsubscribe. It may block while a peer does not read."""
