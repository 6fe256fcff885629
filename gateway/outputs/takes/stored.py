"""How takes are described to peers."""

from collections.abc import Sequence
from typing import Final, NamedTuple

from gateway.takes.description import NO_DETAILS, TakeDetails

MAX_PIECE_BYTES: Final = 1024 * 1024
"""The most bytes of a take that one call reads."""


class StoredTake(NamedTuple):
    """A take in the folder.

    ``begin_utime`` is the time of its first message in µs since the Unix epoch, ``seconds`` how long it
    lasts, ``num_lost`` how many messages found no room on the disk. A take is running until everything of it
    is in its files. It is cut off if one of its files was not ended in order, because the gateway was killed
    or the disk failed.
    """

    name: str
    num_bytes: int
    begin_utime: int
    seconds: float
    is_running: bool = False
    num_lost: int = 0
    is_cut_off: bool = False
    details: TakeDetails = NO_DETAILS


class SourceTakes(NamedTuple):
    """The takes of a source, the newest first.

    ``running`` is the one that was started and not stopped yet, ``kept_s`` how many seconds the rolling
    segments hold, which ``save`` keeps.
    """

    running: StoredTake | None
    takes: Sequence[StoredTake]
    kept_s: float


class TakePiece(NamedTuple):
    """A part of the bytes of a take; the files of a saved take are read as one."""

    name: str
    num_bytes: int
    offset: int
    content: bytes
