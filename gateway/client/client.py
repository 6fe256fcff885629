"""A client of running gateways, the same on Zenoh and on LCM."""

import contextlib
import json
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import IO, Any, Final, NamedTuple, Self

from gateway.client.history_requests import Completeness
from gateway.client.lcm_transport import LcmTransport
from gateway.client.reception import Reception
from gateway.client.transport import (
    FoundSources,
    GatewaySubscriber,
    Query,
    QueryReplies,
    QueryReply,
    Transport,
)
from gateway.client.zenoh_transport import ZenohTransport
from gateway.errors import OutputError, QueryError
from gateway.messages.topics import DEFAULT_LCM_PREFIX
from gateway.outputs.contract import CONTROL_OPTION, READ_OPTION
from gateway.outputs.lcm.settings import effective_lcm_url, lcm_queries_url
from gateway.outputs.zenoh.settings import DEFAULT_ZENOH_PREFIX
from gateway.outputs.zenoh.subscriber import open_zenoh
from gateway.runtime.program_end import Process, close_at_end
from gateway.takes.files.description import NO_DETAILS, TakeDetails
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


DEFAULT_TIMEOUT_S: Final = 5.0


class GatewayAddress(NamedTuple):
    """Where to find gateways: on LCM if ``is_lcm``, otherwise on Zenoh. None means the default.

    ``connect`` is an endpoint of Zenoh, such as tcp/192.0.2.5:7447. ``url`` is that of LCM's messages, and
    ``queries_url`` that of requests, if it is not the one derived from ``url``.
    """

    is_lcm: bool = False
    connect: str | None = None
    zenoh_config: Path | None = None
    url: str | None = None
    prefix: str | None = None
    queries_url: str | None = None


TakeReplies = QueryReplies[dict[str, dict[str, Any]]]
"""What gateways say about takes, by source; docs/reference/queries.md describes it."""


class GatewayClient:
    """Finds gateways, asks them, and subscribes to what they publish.

    It connects when it is first used. All methods block; a gateway has ``timeout_s`` to reply. They raise
    OutputError if LCM does not open or send, and ConfigError if Zenoh rejects its configuration file. Other
    problems are part of what they return, or raise QueryError.
    """

    def __init__(self, address: GatewayAddress, timeout_s: float = DEFAULT_TIMEOUT_S) -> None:
        self._address = address
        self._timeout_s = timeout_s
        self._opened: Transport | None = None
        self._process = Process()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        opened, self._opened = self._opened, None
        if opened is not None and not self._process.is_forked:
            opened.close()

    # What there is.

    def sources(self, wanted: str | None = None) -> FoundSources:
        """Return the sources of all gateways that are found, or only the ``wanted`` one."""
        try:
            return self._transport().find(wanted)
        except QueryError as error:
            found = FoundSources()
            found.absence = str(error)
            return found

    def parameters(
        self, source: str | None = None, sections: tuple[str, ...] = (), *, fresh: bool = False
    ) -> QueryReplies[list[QueryReply]]:
        """Return the parameters of a source, or of all that are found, as XML.

        ``sections`` are keys of SECTIONS (gateway.rtc3d.parameters), such as "3d"; () means all. ``fresh``
        makes the gateway ask its server now.
        """
        options = {"fresh": "true"} if fresh else {}
        return self._ask(Query("parameters", "the parameters", sections, options), source)

    # Takes.

    def takes(self, source: str | None = None) -> TakeReplies:
        """Return the takes of a source, or of all that are found."""
        return self._ask_takes({}, source)

    def start_take(
        self, name: str | None = None, details: TakeDetails = NO_DETAILS, *, source: str | None = None
    ) -> TakeReplies:
        """Start a take."""
        return self._ask_takes({CONTROL_OPTION: "start"} | _described(name, details), source)

    def stop_take(self, *, source: str | None = None) -> TakeReplies:
        """Stop the running take."""
        return self._ask_takes({CONTROL_OPTION: "stop"}, source)

    def save_take(
        self,
        name: str | None = None,
        details: TakeDetails = NO_DETAILS,
        *,
        last_s: float | None = None,
        after_s: float = 0.0,
        source: str | None = None,
    ) -> TakeReplies:
        """Keep the last seconds as a take: all that are kept, or ``last_s``, and ``after_s`` more."""
        options = {CONTROL_OPTION: "save"}
        if last_s is not None:
            options["last"] = _decimal(last_s)
        if after_s:
            options["after"] = _decimal(after_s)
        return self._ask_takes(options | _described(name, details), source)

    def fetch_take(
        self,
        name: str,
        file: IO[bytes],
        *,
        source: str | None = None,
        progress: Progress = lambda _done, _total: None,
    ) -> FetchedTake:
        """Copy a take to ``file``, over Zenoh only. Raises QueryError."""
        transport = self._transport()
        return TakeTransfer(transport, name, source, self._timeout_s).copy_to(file, progress)

    # What gateways publish.

    def subscribe(
        self,
        sources: Collection[str] | str,
        components: Collection[str] | str | None,
        reception: Reception[Any, Any],
        *,
        complete: bool = False,
        last_s: float | None = None,
        patience_s: float | None = None,
    ) -> GatewaySubscriber:
        """Subscribe to these sources (all, if empty) and components (None: all), or to one of each.

        With ``complete``, the messages of each key come in the order of their numbers, and those that were
        missed come from the gateway's history. With ``last_s``, each key begins with the messages of so many
        seconds. What arrives waits for those, no longer than ``patience_s`` (None: as long as a gateway may
        need). The subscriber has a connection of its own. Raises QueryError if Zenoh does not open.
        """
        sources = [sources] if isinstance(sources, str) else sources
        components = [components] if isinstance(components, str) else components
        transport = _open(self._address)
        try:
            return close_at_end(
                transport.subscribe(
                    sources, components, reception, Completeness(complete, last_s, patience_s)
                )
            )
        except BaseException:  # Ctrl-C, too: Zenoh's threads would keep the process alive
            transport.close()
            raise

    # The details.

    def _transport(self) -> Transport:
        """Return the connection. Raises QueryError if Zenoh does not open, OutputError if LCM does not."""
        if self._opened is None:
            self._opened = _open(self._address)
            self._process = Process()
        self._process.check("this client")
        return self._opened

    def _ask(self, query: Query, source: str | None) -> QueryReplies[list[QueryReply]]:
        try:
            return self._transport().ask(query, source, self._timeout_s)
        except QueryError as error:
            return QueryReplies([], [error])

    def _ask_takes(self, options: Mapping[str, str], source: str | None) -> TakeReplies:
        """Ask a source, or all that are found, with these options.

        If all sources are asked and one replies as wanted, those are left out whose gateway records no takes
        and, if takes are to be stopped, those without a running take.
        """
        replies = self._ask(Query("take", "takes", options=options), source)
        received: dict[str, dict[str, Any]] = {}
        problems = replies.problems
        for reply in replies.received:
            content = None
            with contextlib.suppress(ValueError, RecursionError):
                content = json.loads(reply.content)
            if isinstance(content, dict):
                received[reply.source] = content
            else:
                text = f"source {reply.source!r}: the reply about takes cannot be read"
                problems.append(QueryError(text, code="unreadable"))
        if source is None and received:
            expected = {"disabled", "nothing-yet"} if options.get(CONTROL_OPTION) == "stop" else {"disabled"}
            problems = [problem for problem in problems if problem.code not in expected]
        return QueryReplies(received, problems)


def _open(address: GatewayAddress) -> Transport:
    """Return an open connection. Raises ForkError, and see ``GatewayClient._transport``."""
    if address.is_lcm:
        url = effective_lcm_url(address.url)
        queries_url = address.queries_url or lcm_queries_url(url)
        return close_at_end(LcmTransport(url, queries_url, address.prefix or DEFAULT_LCM_PREFIX))
    try:
        session = open_zenoh(address.connect, address.zenoh_config)
    except OutputError as error:
        raise QueryError(str(error), code="no-gateway") from error
    return close_at_end(ZenohTransport(session, address.prefix or DEFAULT_ZENOH_PREFIX))


def _described(name: str | None, details: TakeDetails) -> dict[str, str]:
    """Return the options that say what a take is about. A semicolon would end an option."""
    texts = details._asdict().items()
    options = {key: text.replace("%", "%25").replace(";", "%3B") for key, text in texts if text}
    return options if name is None else {"name": name} | options


def _decimal(seconds: float) -> str:
    """Return a number of seconds without an exponent."""
    return f"{seconds:.3f}".rstrip("0").rstrip(".")


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

    def _first_piece(self) -> QueryReply:
        """Return the first piece, from the only source that has the take."""
        pieces, problems = self._ask(self._source, 0)
        if len(pieces) > 1:
            names = ", ".join(sorted(piece.source for piece in pieces))
            remedy = "--connect to one gateway" if self._source else "--source"
            raise QueryError(f"several sources have a take {self._name!r}: {names}; choose with {remedy}")
        if not pieces:
            raise _most_telling(problems)
        return pieces[0]

    def _next_piece(self, first: QueryReply, offset: int) -> QueryReply:
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

    def _ask(self, source: str | None, offset: int) -> QueryReplies[list[QueryReply]]:
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
        return QueryReplies(pieces, replies.problems)


def _most_telling(problems: list[QueryError]) -> QueryError:
    """Return the problem to show: a source without the take matters least."""
    others = [problem for problem in problems if problem.code not in {"bad-request", "disabled"}]
    return (others or problems or [QueryError("the gateway sent no piece", code="unreadable")])[0]
