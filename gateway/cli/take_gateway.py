"""What the commands of ``take`` do with running gateways, asked on Zenoh or LCM."""

import contextlib
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import rtc3d
import typer
import zenoh
from rich.console import Console

from gateway.cli.export_progress import file_progress
from gateway.cli.gateway_clients import ZenohClient, ZenohReply, ask_lcm
from gateway.cli.gateway_queries import TimeLimits, exit_with
from gateway.cli.options import check_transport
from gateway.cli.take_report import ListedTake, size_text, write_list
from gateway.errors import OutputError, QueryError
from gateway.logs.safe_text import safe_json, safe_text
from gateway.messages.topics import zenoh_key
from gateway.outputs.contract import CONTROL_OPTION, READ_OPTION
from gateway.outputs.lcm.settings import effective_lcm_url
from gateway.outputs.zenoh.subscriber import open_zenoh
from gateway.takes.files.description import TakeDetails
from gateway.takes.files.event_log import EventBoundary
from gateway.takes.files.new_file import NewFiles
from gateway.takes.files.reader import SUFFIX

COMMAND = "take"


class TakeReplies(NamedTuple):
    """What the gateways replied, by source, and the problems of the others."""

    received: dict[str, dict[str, Any]]
    problems: list[QueryError]


class GatewayAddress(NamedTuple):
    """Where to find gateways, as given by the options of a command. ``source`` None means all of them."""

    source: str | None
    is_lcm: bool
    connect: str | None
    zenoh_config: Path | None
    url: str | None
    queries_url: str | None
    prefix: str | None
    timeout_s: float

    def open_zenoh(self) -> zenoh.Session:
        """Return an open session. Raises QueryError."""
        try:
            return open_zenoh(self.connect, self.zenoh_config)
        except OutputError as error:
            raise QueryError(str(error), code="no-gateway") from error

    def client(self, session: zenoh.Session) -> ZenohClient:
        """Return a client of ``session`` for takes."""
        return ZenohClient(session, self.zenoh_prefix, "takes")

    @property
    def zenoh_prefix(self) -> str:
        """The prefix of keys."""
        return self.prefix or "mocap"

    def selector(self, source: str, options: Mapping[str, str]) -> str:
        """Return the selector for takes of a source."""
        pairs = ";".join(f"{name}={value}" for name, value in options.items())
        return zenoh_key(self.zenoh_prefix, source, COMMAND) + (f"?{pairs}" if pairs else "")

    def ask(self, options: Mapping[str, str]) -> TakeReplies:
        """Ask ``source``, or every source that is found, with these options.

        If all sources are asked and one replies as wanted, those are left out whose gateway records no takes
        and, if takes are to be stopped, those without a running take. Raises QueryError, OutputError.
        """
        replies = self._ask_lcm(options) if self.is_lcm else self._ask_zenoh(options)
        if self.source is None and replies.received:
            expected = {"disabled", "nothing-yet"} if options.get(CONTROL_OPTION) == "stop" else {"disabled"}
            problems = [problem for problem in replies.problems if problem.code not in expected]
            return TakeReplies(replies.received, problems)
        return replies

    def _ask_zenoh(self, options: Mapping[str, str]) -> TakeReplies:
        session = self.open_zenoh()
        received: dict[str, dict[str, Any]] = {}
        client = self.client(session)

        def take(reply: ZenohReply) -> None:
            try:
                received[reply.source] = _content(reply.source, reply.payload)
            except QueryError as error:
                client.problems.append(error)

        try:
            limits = TimeLimits(self.timeout_s)
            sources = client.sources(limits) if self.source is None else [self.source]
            client.query([self.selector(source, options) for source in sources], self.source, limits, take)
        except QueryError as error:
            client.problems.append(error)
        finally:
            session.close()
        return TakeReplies(received, client.problems)

    def _ask_lcm(self, options: Mapping[str, str]) -> TakeReplies:
        request = rtc3d.command_request_t()
        request.command = COMMAND
        request.options = [f"{name}={value}" for name, value in options.items()]
        request.num_options = len(request.options)
        replies = ask_lcm(
            "COMMAND",
            request,
            prefix=self.prefix or "MOCAP",
            source=self.source,
            url=effective_lcm_url(self.url),
            queries_url=self.queries_url,
            timeout_s=self.timeout_s,
        )
        received: dict[str, dict[str, Any]] = {}
        problems = list(replies.problems)
        for source, reply in replies.received.items():
            try:
                received[source] = _content(source, reply.content.encode())
            except QueryError as error:
                problems.append(error)
        return TakeReplies(received, problems)


def _content(source: str, payload: bytes) -> dict[str, Any]:
    try:
        content = json.loads(payload)
    except (ValueError, RecursionError):
        content = None
    if not isinstance(content, dict):
        raise QueryError(f"source {source!r}: the reply about takes cannot be read", code="unreadable")
    return content


def gateway_address(
    source: str | None,
    lcm: bool,
    connect: str | None,
    zenoh_config: Path | None,
    url: str | None,
    queries_url: str | None,
    prefix: str | None,
    timeout_s: float,
) -> GatewayAddress:
    """Return where to ask, from the options of a command. Raises BadParameter if they contradict."""
    check_transport(lcm=lcm, connect=connect, zenoh_config=zenoh_config, url=url, queries_url=queries_url)
    return GatewayAddress(source, lcm, connect, zenoh_config, url, queries_url, prefix, timeout_s)


def start_take(address: GatewayAddress, name: str | None, details: TakeDetails, *, as_json: bool) -> None:
    """Start a take."""
    _control(
        address,
        {"set": "start"} | _named(name) | _described(details),
        lambda take: f"take {take.name!r} is running",
        as_json=as_json,
    )


def stop_take(address: GatewayAddress, *, as_json: bool) -> None:
    """Stop the running take."""
    _control(
        address,
        {"set": "stop"},
        lambda take: f"take {take.name!r} is stopped: {_facts(take)}",
        as_json=as_json,
    )


def save_take(
    address: GatewayAddress,
    name: str | None,
    last_s: float | None,
    after_s: float,
    details: TakeDetails,
    *,
    as_json: bool,
) -> None:
    """Keep the last seconds as a take."""
    options = {"set": "save"}
    if last_s is not None:
        options["last"] = _decimal(last_s)
    if after_s:
        options["after"] = _decimal(after_s)
    goes_on = f", and goes on for {after_s:g} s" if after_s else ""
    _control(
        address,
        options | _named(name) | _described(details),
        lambda take: f"take {take.name!r} is saved: {_facts(take)}{goes_on}",
        as_json=as_json,
    )


def list_takes(address: GatewayAddress, *, as_json: bool) -> None:
    """List takes."""
    replies = _ask(address, {})
    if as_json:
        _print_json(replies.received)
    else:
        write_list(replies.received, Console(file=sys.stdout))
    exit_with(replies.problems)


def copy_take(address: GatewayAddress, name: str, file: Path | None, *, quiet: bool) -> None:
    """Copy a take to a file."""
    try:
        fetched = fetch_take(address, name, file, quiet=quiet)
    except QueryError as error:
        exit_with([error])
        raise  # never reached
    print(safe_text(fetched))


def _named(name: str | None) -> dict[str, str]:
    """Return the option for the name of a take, None for its default."""
    return {} if name is None else {"name": name}


def _described(details: TakeDetails) -> dict[str, str]:
    """Return the options that say what a take is about. A semicolon would end an option."""
    texts = details._asdict().items()
    return {name: text.replace("%", "%25").replace(";", "%3B") for name, text in texts if text}


def _ask(address: GatewayAddress, options: Mapping[str, str]) -> TakeReplies:
    try:
        return address.ask(options)
    except QueryError as error:
        return TakeReplies({}, [error])


def _control(
    address: GatewayAddress, options: Mapping[str, str], text: Callable[[ListedTake], str], *, as_json: bool
) -> None:
    replies = _ask(address, options)
    if as_json:
        _print_json(replies.received)
    else:
        for source, content in replies.received.items():
            print(safe_text(f"{source}: {text(ListedTake(content))}"))
    exit_with(replies.problems)
    if any(ListedTake(content).problem for content in replies.received.values()):
        raise typer.Exit(1)


def _facts(take: ListedTake) -> str:
    return ", ".join(filter(None, (take.duration_text, take.size_text, take.problem)))


def _print_json(replies: Mapping[str, Any]) -> None:
    print(safe_json(json.dumps(replies, indent=2, ensure_ascii=False)))


def _decimal(seconds: float) -> str:
    """Return a number of seconds without an exponent."""
    return f"{seconds:.3f}".rstrip("0").rstrip(".")


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
