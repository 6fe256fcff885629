"""The parameters of one source's server: read at each connection, kept, published, and given to peers.

The server is asked for all of its parameters at once, and a peer's query for one section is answered from
that. For ``fresh_interval_s`` after an answer, a ``fresh`` query gets that answer and does not reach the
server, and neither does the handshake of another connection.
"""

import asyncio
import contextlib
import logging
import math
from collections.abc import Awaitable, Callable
from dataclasses import replace
from functools import partial

from gateway.config.settings import SourceSettings
from gateway.errors import GatewayError, ParametersError, QueryError, ReplyTimeoutError, ServerError
from gateway.queries.answers import (
    ParametersReading,
    QueryHistory,
    Sections,
    ServerAnswer,
    now_s,
    read_parameters,
    unreadable,
)
from gateway.queries.server_requests import NOT_ACCEPTED, ServerRequests
from gateway.rtc3d.commands import SendParameters
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters
from gateway.runtime.failures import FailureLog
from gateway.session.replies import Connection, XmlThread

logger = logging.getLogger(__name__)


Announce = Callable[[ServerAnswer | None, int], Awaitable[None]]
"""Takes new parameters, None if the former ones are void, and their version.

Publishes them, and then marks the frames that follow with the version.
"""


class ParameterCache:
    """The answers to SendParameters.

    ``version`` grows by one whenever the newest parameters mean something else than before, when they become
    void, and when another frame of poses goes with them. ``announce`` gets each change. ``history`` keeps the
    newest ones when the source is built again.
    """

    def __init__(
        self, settings: SourceSettings, requests: ServerRequests, announce: Announce, history: QueryHistory
    ) -> None:
        self._settings = settings
        self._requests = requests
        self._announce = announce
        self._history = history
        self._xml_thread = XmlThread(settings.name)
        self._change = asyncio.Lock()  # held while the newest parameters change, until that is announced
        # On one of these, the server gave the newest parameters. The others share them.
        self._connections: list[Connection] = []
        self._refusing: Connection | None = None  # one of these, on which the server refused them later on
        self._silent: list[Connection] = []  # without an answer in the handshake, and not asked since
        # The parameters that a handshake is reading. After the result None, other handshakes ask themselves.
        self._reading: asyncio.Future[ParsedParameters | None] | None = None
        # What the server answered about sections that the answer for all of them does not give, or for all
        # of them if that cannot be read. All of this is cleared when a connection begins.
        self._answers: dict[Sections, ServerAnswer] = {}
        self._refusal: tuple[QueryError, float] | None = None  # the server's of SendParameters, and when
        self._sends_sections = True
        self._problems = FailureLog(logger, settings.name)

    @property
    def newest(self) -> ServerAnswer | None:
        """The newest answer for all sections; None before the first, and while the former ones are void."""
        return self._history.newest

    @property
    def version(self) -> int:
        """The version of the newest parameters; 0 before the first."""
        return self._history.version

    @property
    def last_read_s(self) -> float:
        """When the server last sent all its parameters, on the event loop's clock; -inf if it never did."""
        return -math.inf if self.newest is None else self.newest.received_s

    # At the start of a connection.

    async def read_for_handshake(self, connection: Connection) -> ParsedParameters:
        """Return the parameters for the handshake of a new connection; see ReadParameters.

        If the server gives none, those of earlier connections are void. Streams of one source that connect
        at the same time share one request, but not with a connection that has ended meanwhile: after a
        restart, the server may be another one.
        """
        while self._reading is not None:
            shared = await asyncio.shield(self._reading)
            if shared is not None:
                return await self._share(connection, shared)
        newest = self.newest
        if newest is not None and self._is_current and self._is_valid(newest.received_s, fresh=True):
            return await self._share(connection, newest.parsed)
        self._reading = reading = asyncio.get_running_loop().create_future()
        try:
            parsed = await self._read(connection)
        except (ServerError, ReplyTimeoutError, ParametersError) as error:
            reading.set_exception(error)
            reading.exception()  # retrieve it, even if no other stream waits
            raise
        except BaseException:  # The connection was lost, or the stream is stopped.
            reading.set_result(None)
            raise
        else:
            reading.set_result(parsed)
            return parsed
        finally:
            self._reading = None

    async def _share(self, connection: Connection, parsed: ParsedParameters) -> ParsedParameters:
        """Announce the newest parameters again, for a new connection to the same server."""
        self._connections.append(connection)
        session = self._requests.session
        async with self._change:
            if self.newest is not None:
                self._history.newest = replace(self.newest, session=session)
                await self._announce(self.newest, self.version)
        return parsed

    async def _read(self, connection: Connection) -> ParsedParameters:
        self._connections = [each for each in self._connections if each.is_open]
        self._answers.clear()
        self._refusal = None
        self._sends_sections = True
        command = SendParameters()
        try:
            packet = await connection.ask(command)
        except ServerError as error:
            self._refusal = self._requests.refused(command, error), now_s()
            await self._invalidate(f"it refuses {command}: {error}")
            raise
        except ReplyTimeoutError as error:
            self._silent = [*(each for each in self._silent if each.is_open), connection]
            await self._invalidate(str(error))
            raise
        try:
            answer = await self._take(packet.body, announce_always=True)
        except ParametersError as error:
            await self._invalidate(str(error))
            self._keep_unreadable((), packet.body, error)  # with the version that is valid now
            raise
        self._connections.append(connection)
        self._problems.recovered("the server sends its parameters again")
        return answer.parsed

    async def _invalidate(self, reason: str) -> None:
        """Make the former parameters void, unless the server still gives them on another connection."""
        if not self._is_current:
            await self.make_void(reason)

    # The newest parameters, and their version.

    async def _take(self, xml: bytes, *, announce_always: bool = False) -> ServerAnswer:
        """Keep an answer for all sections, and announce it if it means something else than the former one.

        Raises ParametersError if nothing can be read from it; then nothing changes.
        """
        session = self._requests.session
        async with self._change:
            before = self.newest
            reading = await self._xml_thread.process(xml, lambda xml: read_parameters(xml, before))
            if reading.is_changed:
                self._history.version += 1
                self._log_change(reading, is_first=before is None)
            self._history.newest = answer = ServerAnswer((), xml, reading.parsed, session, self.version)
            if reading.is_changed or announce_always:
                await self._announce(answer, self.version)
            return answer

    async def begin_version(self) -> None:
        """Announce the parameters as another version, because they go with another frame of poses now."""
        self._answers.clear()
        async with self._change:
            self._history.version += 1
            if self.newest is not None:
                self._history.newest = replace(self.newest, version=self.version)
            await self._announce(self.newest, self.version)

    async def make_void(self, reason: str) -> None:
        """Forget the parameters, because the server does not give any now (field note 23)."""
        async with self._change:
            if self.newest is None:
                return
            self._history.newest = None
            self._history.version += 1
            self._history.events.log(
                logging.WARNING,
                f"the server gives no parameters any more: {reason}; the former names and units are void "
                f"(parameters_version {self.version})",
                "void",
            )
            await self._announce(None, self.version)

    def _log_change(self, reading: ParametersReading, *, is_first: bool) -> None:
        events, version = self._history.events, f"(parameters_version {self.version})"
        if is_first:
            if self.version > 1:
                events.log(logging.INFO, f"the server gives parameters again {version}", "given again")
            return
        if reading.renamed:
            events.log(
                logging.WARNING,
                f"markers or tools were renamed on the server: {reading.renamed}; programs that use the "
                f"names need the new ones {version}",
                "renamed",
            )
        if reading.changed_sections:
            sections = ", ".join(reading.changed_sections)
            events.log(logging.INFO, f"the server's parameters changed: {sections} {version}", "changed")

    # While connections are open.

    async def refresh(self) -> None:
        """Ask again for all parameters, over a connection on which the server gave them and did not refuse.

        Without such a connection, ask once more where the server did not answer in the handshake: it may
        have been busy for a moment. If there is no answer, the former parameters stay valid.
        """
        giving = [connection for connection in self._connections if connection is not self._refusing]
        for connection in (*giving, *self._silent):
            if connection in self._requests.connections:
                with contextlib.suppress(QueryError):
                    await self._request_all(connection)
                return

    async def get(self, sections: Sections, *, fresh: bool, stale_ok: bool) -> ServerAnswer:
        """Return the server's answer for some sections, () for all, from the cache or from the server.

        The answer of an earlier connection is returned only while there is none, and only if ``stale_ok``.
        Raises QueryError.
        """
        if not self._requests.is_connected:
            stale = self.newest if stale_ok else None
            if stale is not None and sections:
                stale = await stale.part(sections, self._xml_thread) or self._answers.get(sections)
            if stale is None:
                raise self._requests.no_connection_error()
            return stale
        try:
            return await self._get(sections, fresh=fresh)
        except QueryError as error:
            is_void = self.newest is None and self.version > 0
            if is_void and error.code in NOT_ACCEPTED:
                text = f"{error}; the parameters of its earlier connections are void"
                raise QueryError(text, code=error.code) from error
            raise

    async def _get(self, sections: Sections, *, fresh: bool) -> ServerAnswer:
        kept = (self.newest if self._is_current else None, self._answers.get(()))
        valid = (each for each in kept if each is not None and self._is_valid(each.received_s, fresh=fresh))
        everything = next(valid, None)
        if everything is None:
            if self._refusal is not None and self._is_valid(self._refusal[1], fresh=fresh):
                raise self._refusal[0]
            everything = await self._request_all(self._any_connection())
        part = await everything.part(sections, self._xml_thread) if sections else everything
        if part is not None:
            return part
        # The answer for all sections lacks these, or is not well-formed. So the server has to be asked.
        answer = self._answers.get(sections)
        if answer is not None and self._is_valid(answer.received_s, fresh=fresh):
            return answer
        return await self._requests.share(
            ("parameters", sections), partial(self._request_sections, sections, everything)
        )

    @property
    def _is_current(self) -> bool:
        """Whether the newest parameters are those of a server that is still connected."""
        return any(connection.is_open for connection in self._connections)

    def _is_valid(self, received_s: float, *, fresh: bool) -> bool:
        return not fresh or now_s() - received_s < self._settings.fresh_interval_s

    # Requests to the server.

    def _any_connection(self) -> Connection:
        """Return a connection, if possible one on which the server gave its parameters; raises QueryError."""
        ready = self._requests.connections
        if not ready:
            raise self._requests.no_connection_error()
        return next((connection for connection in self._connections if connection in ready), ready[0])

    async def _request_all(self, connection: Connection) -> ServerAnswer:
        return await self._requests.share(("parameters", ()), partial(self._send_request, connection))

    async def _send_request(self, connection: Connection) -> ServerAnswer:
        self._silent = [each for each in self._silent if each is not connection]
        try:
            packet = await self._requests.send(SendParameters(), connection=connection)
        except QueryError as error:
            if error.code == "refused":
                self._refusal = error, now_s()
                self._refusing = connection
            if error.code in NOT_ACCEPTED:
                self._report_problem(connection, error)
            raise
        version = self.version
        try:
            answer = await self._take(packet.body)
        except ParametersError as error:
            self._report_problem(connection, error)
            return self._keep_unreadable((), packet.body, error)
        self._refusing = None
        if connection not in self._connections:
            self._connections.append(connection)
        if answer.version != version:
            self._answers.clear()
        self._answers.pop((), None)
        self._problems.recovered("the server sends its parameters again")
        return answer

    def _report_problem(self, connection: Connection, error: GatewayError) -> None:
        """Log once that parameters cannot be read again over a connection on which that was possible."""
        if connection in self._connections and connection.is_open:
            self._problems.failed(
                f"the parameters cannot be read again: {error}; names and units stay as they were, and "
                "changes on the server are not noticed"
            )

    async def _request_sections(self, sections: Sections, everything: ServerAnswer) -> ServerAnswer:
        """Request some sections; if the server does not send single ones, return ``everything``."""
        if self._sends_sections:
            command, connection = SendParameters(sections), self._any_connection()
            try:
                xml = (await self._requests.send(command, connection=connection)).body
            except QueryError as error:
                if error.code not in NOT_ACCEPTED:
                    raise
                self._sends_sections = False
            else:
                session, version = self._requests.session, self.version
                try:
                    parsed = await self._xml_thread.process(xml, parse_parameters)
                except ParametersError as error:
                    return self._keep_unreadable(sections, xml, error)
                self._answers[sections] = answer = ServerAnswer(sections, xml, parsed, session, version)
                return answer
        newest = self.newest
        if newest is not None and newest.received_s >= everything.received_s:
            everything = newest  # it has arrived meanwhile
        self._answers[sections] = answer = replace(everything, sections=sections)
        return answer

    def _keep_unreadable(self, sections: Sections, xml: bytes, error: ParametersError) -> ServerAnswer:
        session, version = self._requests.session, self.version
        self._answers[sections] = answer = unreadable(sections, xml, session, version, error)
        return answer
