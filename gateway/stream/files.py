"""What a session does with the C3D files that its server sends."""

from typing import Protocol

from gateway.rtc3d.packets import FilePiece


class FileReceiver(Protocol):
    """Takes the C3D files of one stream. Its methods are called in the event loop and must not block."""

    def receive(self, piece: FilePiece) -> None:
        """Take the next piece of a file."""

    def interrupt(self, reason: str) -> None:
        """Give up a file that is not complete, because the connection has ended."""


class IgnoredFiles:
    """A FileReceiver that keeps nothing."""

    def receive(self, piece: FilePiece) -> None:
        """Ignore a piece."""

    def interrupt(self, reason: str) -> None:
        """Do nothing."""
