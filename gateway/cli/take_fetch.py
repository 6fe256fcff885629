"""``rtc3d-gateway take fetch``: copies a take from a gateway in pieces, over Zenoh."""

import contextlib
import json
from pathlib import Path
from typing import Any, Final, NamedTuple

import zenoh

from gateway.cli.file_progress import file_progress
from gateway.cli.gateway_queries import TimeLimits
from gateway.cli.take_gateway import GatewayAddress
from gateway.cli.take_list import size_text
from gateway.cli.zenoh_client import ZenohReply
from gateway.errors import QueryError
from gateway.outputs.contract import READ_OPTION
from gateway.takes.event_log import EventBoundary
from gateway.takes.new_file import NewFiles
from gateway.takes.reader import SUFFIX

ATTEMPTS: Final = 3
"""How often a piece is requested whose reply does not come."""


class _Piece(NamedTuple):
    """A part of a take of ``source`` that has ``num_bytes`` in all; ``gateway`` is the id of who sent it."""

    source: str
    content: bytes
    num_bytes: int
    gateway: str


def fetch_take(address: GatewayAddress, name: str, file: Path | None, *, quiet: bool = False) -> str:
    """Copy a take to ``file``, a new file or a folder; return what was done.

    Raises QueryError, and TakeError if the file exists or cannot be written.
    """
    log = f"{name}{SUFFIX}"
    path = Path(log) if file is None else file / log if file.is_dir() else file
    with NewFiles() as files:
        copy = files.create(path)  # before a long transfer: the file may exist already
        session = address.open_zenoh()
        try:
            done = _Transfer(address, session, name).copy_to(copy, quiet=quiet)
        finally:
            session.close()
    return f"{path}: {done}"


class _Transfer:
    """The transfer of one take."""

    def __init__(self, address: GatewayAddress, session: zenoh.Session, name: str) -> None:
        self._address = address
        self._session = session
        self._name = name

    def copy_to(self, file: Any, *, quiet: bool) -> str:
        """Write the take to ``file``, without the beginning of an event at its end; return a report.

        A take can grow meanwhile: the copy ends where it ended when the copy began.
        """
        first = self._first_piece()
        total = first.num_bytes
        boundary = EventBoundary()
        with file_progress(f"fetching {self._name}", quiet=quiet) as progress:
            done, piece = 0, first
            while done < total:
                content = piece.content[: total - done]
                if not content:
                    raise self._changed()
                file.write(content)
                boundary.feed(content)
                done += len(content)
                progress(done, total)
                piece = self._next_piece(first, done)
                if piece.num_bytes < total:
                    raise self._changed()
        if piece.num_bytes == total:
            return f"{size_text(total)} of take {self._name!r} of source {first.source!r}"
        complete = boundary.complete_bytes
        file.truncate(complete)
        return (
            f"the first {size_text(complete)} of take {self._name!r} of source {first.source!r}, which is "
            "still running"
        )

    def _changed(self) -> QueryError:
        return QueryError(
            f"take {self._name!r} became shorter while it was copied: it was deleted or replaced; try again",
            code="unreadable",
        )

    def _first_piece(self) -> _Piece:
        """Return the first piece, from the only source that has the take."""
        address, client = self._address, self._address.client(self._session)
        sources = [address.source] if address.source else client.sources(TimeLimits(address.timeout_s))
        pieces, problems = self._ask(sources, 0)
        if len(pieces) > 1:
            names = ", ".join(sorted(piece.source for piece in pieces))
            remedy = "--connect to one gateway" if address.source else "--source"
            raise QueryError(f"several sources have a take {self._name!r}: {names}; choose with {remedy}")
        if not pieces:
            raise _most_telling(problems)
        return pieces[0]

    def _next_piece(self, first: _Piece, offset: int) -> _Piece:
        """Return the piece at ``offset`` from the gateway that sent the first one."""
        problems: list[QueryError] = []
        for _ in range(ATTEMPTS):
            pieces, problems = self._ask([first.source], offset)
            for piece in pieces:
                if piece.gateway == first.gateway:
                    return piece
            if not all(problem.code == "timeout" for problem in problems):
                break
        raise _most_telling(problems)

    def _ask(self, sources: list[str], offset: int) -> tuple[list[_Piece], list[QueryError]]:
        client = self._address.client(self._session)
        options = {READ_OPTION: self._name, "offset": str(offset)}
        pieces: list[_Piece] = []

        def take(reply: ZenohReply) -> None:
            piece = _piece(reply, self._name, offset)
            if piece is None:
                text = f"source {reply.source!r}: a piece of take {self._name!r} cannot be read"
                client.problems.append(QueryError(text, code="unreadable"))
            else:
                pieces.append(piece)

        selectors = [self._address.selector(source, options) for source in sources]
        try:
            client.query(selectors, self._address.source, TimeLimits(self._address.timeout_s), take)
        except QueryError as error:
            client.problems.append(error)
        return pieces, client.problems


def _piece(reply: ZenohReply, name: str, offset: int) -> _Piece | None:
    """Return the piece in a reply; None if it is not the one that was asked for."""
    with contextlib.suppress(ValueError, TypeError, KeyError, RecursionError):
        description = json.loads(reply.attachment)
        num_bytes = description["bytes"]
        is_right = (description["name"], description["offset"]) == (name, offset)
        if is_right and isinstance(num_bytes, int) and num_bytes >= 0:
            return _Piece(reply.source, reply.payload, num_bytes, reply.gateway)
    return None


def _most_telling(problems: list[QueryError]) -> QueryError:
    """Return the problem to show: a source without the take matters least."""
    others = [problem for problem in problems if problem.code not in {"bad-request", "disabled"}]
    return (others or problems or [QueryError("the gateway sent no piece", code="unreadable")])[0]
