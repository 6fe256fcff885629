"""Keeps one stream of one source going: connect, stream, and after every failure again, for ever."""

import asyncio
import logging
import random
from collections.abc import Callable, Iterator

from gateway.config import Reconnect, Source, Stream
from gateway.errors import LinkError
from gateway.log import FailureLog
from gateway.session import Handlers, Session
from gateway.status import StreamStatus

logger = logging.getLogger(__name__)


def backoff_delays_s(reconnect: Reconnect) -> Iterator[float]:
    """Yield the waits between tries: doubling, capped, each between half and all of its length.

    The jitter keeps many gateways from coming back to a restarted server in step.
    """
    delay_s = reconnect.first_delay_s
    while True:
        yield delay_s * random.uniform(0.5, 1.0)  # noqa: S311 - spreads load, hides nothing
        delay_s = min(2 * delay_s, reconnect.max_delay_s)


class Supervisor:
    """Runs the sessions of one stream, one after the other."""

    def __init__(
        self,
        source: Source,
        stream: Stream,
        status: StreamStatus,
        handlers: Handlers,
        delays_s: Callable[[Reconnect], Iterator[float]] = backoff_delays_s,
    ) -> None:
        self._source = source
        self._stream = stream
        self._status = status
        self._handlers = handlers
        self._delays_s = delays_s
        self._session: Session | None = None
        self._failures = FailureLog(logger, f"{source.name} ({status.components})")

    @property
    def session(self) -> Session | None:
        """The session that questions can be asked of; None while there is none."""
        return self._session if self._session is not None and self._session.ready else None

    async def run(self) -> None:
        """Keep the stream going until cancelled; then say Bye.

        The rule: whatever goes wrong with a connection (LinkError) is tried again, without end,
        because a motion-capture computer that is off today is on tomorrow. Anything else is a
        mistake in this program and is raised.
        """
        delays_s = self._delays_s(self._source.reconnect)
        while True:
            self._session = session = Session(self._source, self._stream, self._status, self._handlers)
            try:
                await session.connect()
                await session.start_stream()
                self._failures.recovered(f"streaming from {session.server}")
                await session.ended()
            except LinkError as error:
                self._status.note_error(str(error))
                self._failures.failed(str(error))
            finally:
                await session.close()
            if session.delivered:
                delays_s = self._delays_s(self._source.reconnect)
            self._status.state = "waiting to reconnect"
            await asyncio.sleep(next(delays_s))
            self._status.reconnects += 1
