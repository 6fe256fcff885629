"""Keeps what a session passes on of C3D files."""

from gateway.rtc3d.packets import FilePiece


class CollectedFiles:
    """``pieces`` are the contents of the pieces, ``interruptions`` the reasons why a connection ended."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.interruptions: list[str] = []

    def receive(self, piece: FilePiece) -> None:
        self.pieces.append(piece.body)

    def interrupt(self, reason: str) -> None:
        self.interruptions.append(reason)
