"""Copying a take from a running gateway, piece by piece."""

from collections.abc import Callable
from typing import IO, Final, NamedTuple

from gateway.client.transport import Query, Replies, Reply, Transport
from gateway.errors import QueryError
from gateway.outputs.contract import READ_OPTION
from gateway.takes.files.event_log import EventBoundary

ATTEMPTS: Final = 3
"""How often a piece is requested whose reply does not come."""

Progress = Callable[[int, int], object]
"""Takes how many bytes have been copied, and how many there are in all."""


class FetchedTake(NamedTuple):
    """A take of ``source`` that was copied: all of it, or what there was of one that is still running."""

    source: str
    num_bytes: int
    is_complete: bool


class TakeTransfer:
    """The transfer of one take, of ``source`` or of the only one that has it (None)."""

    def __init__(self, transport: Transport, name: str, source: str | None, timeout_s: float) -> None:
        self._transport = transport
        self._name = name
        self._source = source
        self._timeout_s = timeout_s

    def copy_to(self, file: IO[bytes], progress: Progress) -> FetchedTake:
        """Write the take to ``file``, without the beginning of an event at its end. Raises QueryError.

        A take can grow meanwhile: the copy ends where it ended when the copy began.
        """
        first = piece = self._first_piece()
        total: int = first.facts["bytes"]
        boundary = EventBoundary()
        done = 0
        while True:
            content = piece.content[: total - done]
            if piece.facts["bytes"] < total or (done < total and not content):
                raise QueryError(
                    f"take {self._name!r} became shorter while it was copied: it was deleted or replaced; "
                    "try again",
                    code="unreadable",
                )
            if done == total:
                break
            file.write(content)
            boundary.feed(content)
            done += len(content)
            progress(done, total)
            piece = self._next_piece(first, done)
        if piece.facts["bytes"] == total:
            return FetchedTake(first.source, total, True)
        file.truncate(boundary.complete_bytes)
        return FetchedTake(first.source, boundary.complete_bytes, False)

    def _first_piece(self) -> Reply:
        """Return the first piece, from the only source that has the take."""
        pieces, problems = self._ask(self._source, 0)
        if len(pieces) > 1:
            names = ", ".join(sorted(piece.source for piece in pieces))
            remedy = "--connect to one gateway" if self._source else "--source"
            raise QueryError(f"several sources have a take {self._name!r}: {names}; choose with {remedy}")
        if not pieces:
            raise _most_telling(problems)
        return pieces[0]

    def _next_piece(self, first: Reply, offset: int) -> Reply:
        """Return the piece at ``offset`` from the gateway that sent the first one."""
        problems: list[QueryError] = []
        for _ in range(ATTEMPTS):
            pieces, problems = self._ask(first.source, offset)
            for piece in pieces:
                if piece.gateway == first.gateway:
                    return piece
            if not all(problem.code == "timeout" for problem in problems):
                break
        raise _most_telling(problems)

    def _ask(self, source: str | None, offset: int) -> Replies[list[Reply]]:
        """Return the pieces at ``offset``: replies whose facts have the size of the take as ``bytes``."""
        query = Query("take", "takes", options={READ_OPTION: self._name, "offset": str(offset)})
        replies = self._transport.ask(query, source, self._timeout_s)
        pieces = []
        for reply in replies.received:
            facts, num_bytes = reply.facts, reply.facts.get("bytes")
            is_right = (facts.get("name"), facts.get("offset")) == (self._name, offset)
            if is_right and isinstance(num_bytes, int) and num_bytes >= 0:
                pieces.append(reply)
            else:
                text = f"source {reply.source!r}: a piece of take {self._name!r} cannot be read"
                replies.problems.append(QueryError(text, code="unreadable"))
        return Replies(pieces, replies.problems)


def _most_telling(problems: list[QueryError]) -> QueryError:
    """Return the problem to show: a source without the take matters least."""
    others = [problem for problem in problems if problem.code not in {"bad-request", "disabled"}]
    return (others or problems or [QueryError("the gateway sent no piece", code="unreadable")])[0]
