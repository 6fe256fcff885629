"""Any order of questions, answers, errors and connections, against a plain model of the parameters."""

import asyncio
from collections.abc import Callable, Coroutine
from itertools import pairwise
from typing import Any, Final

from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.errors import ClosedError, LinkError, ParametersError, QueryError, ReplyTimeoutError, ServerError
from gateway.rtc3d.commands import Command
from gateway.rtc3d.packets import Packet, PacketType
from tests.support.clocks import run_in_virtual_time, settle
from tests.support.examples import examples
from tests.unit.queries.fake_source import FakeConnection, FakeServer, FakeSource, parameters_xml

FRESH_S: Final = 5.0
TIMEOUT_S: Final = 2.0

FAILURES: Final[dict[str, bytes | Exception]] = {
    "refused": ServerError("err-what?"),
    "silence": ReplyTimeoutError("192.0.2.1:3020 did not answer"),
    "garbage": b"It is 3 o'clock.",
}


class Asked(FakeServer):
    """A server that answers when the test says so, each time with another XML.

    ``sent`` has, for each XML, the command, when it was sent, and the number of the connection.
    """

    def __init__(self) -> None:
        super().__init__()
        self.num_connections = 0
        self.waiting: list[tuple[str, asyncio.Future[Packet]]] = []
        self.sent: dict[bytes, tuple[str, float, int]] = {}

    async def send(self, command: Command) -> Packet:
        self.commands.append(str(command))
        answered: asyncio.Future[Packet] = asyncio.get_running_loop().create_future()
        self.waiting.append((str(command), answered))
        return await answered

    def reply(self, kind: str) -> str:
        """Answer the oldest command; return it, "" if there is none."""
        self.waiting = [each for each in self.waiting if not each[1].done()]
        if not self.waiting:
            return ""
        command, answered = self.waiting.pop(0)
        failure = FAILURES.get(kind)
        if isinstance(failure, Exception):
            answered.set_exception(failure)
            return command
        number = len(self.sent) + 1
        xml = parameters_xml(kind, number) if failure is None else b"%s %d" % (failure, number)
        self.sent[xml] = command, asyncio.get_running_loop().time(), self.num_connections
        answered.set_result(Packet(PacketType.XML, xml))
        return command

    def close(self) -> None:
        """Lose the connection: what waits for an answer gets none."""
        for _, answered in self.waiting:
            if not answered.done():
                answered.set_exception(ClosedError("closed"))
        self.waiting.clear()


class Connection(FakeConnection):
    """A connection on which nothing can be asked once it has ended."""

    async def ask(self, command: Command) -> Packet:
        if not self.is_open:
            raise ClosedError("closed")
        return await super().ask(command)


def unit_of(xml: bytes | None) -> str | None:
    """Return what the parameters mean: the statistics in them are no change."""
    return None if xml is None else xml.partition(b"<Unit>")[2][:2].decode()


class Inline:
    """Processes XML at once, after another turn of the event loop."""

    async def process(self, xml: bytes, call: Callable[[bytes], Any]) -> Any:
        await asyncio.sleep(0)
        return call(xml)


class Model:
    """A source with one stream, whose server, askers and connections do what a schedule says."""

    def __init__(self) -> None:
        self.source = FakeSource(fresh_interval_s=FRESH_S, query_timeout_s=TIMEOUT_S)
        self.server = self.source.server = Asked()
        self.source.connection.is_open = False
        self.cache = self.source.queries.parameters
        self.cache._xml_thread = Inline()  # type: ignore[assignment]  # threads have no virtual time
        self.tasks: list[asyncio.Task[None]] = []
        self.connection: FakeConnection | None = None  # also during its handshake
        self.is_in_handshake = False
        self.codes: set[str] = set()  # of the errors that askers got
        self.newest: str | None = None  # what the parameters mean

    async def do(self, step: str) -> None:
        """Do what a step says, and everything that follows from it at once."""
        step, _, reply = step.partition(" and ")
        if step == "lose":
            self.lose_connection()
        elif step.startswith("pause "):
            await asyncio.sleep(float(step.removeprefix("pause ")))
        elif step == "cancel" and self.tasks and not self.is_in_handshake:
            self.tasks[-1].cancel()
        elif step in {"mm", "cm", *FAILURES}:
            self.reply(step)
        elif step != "cancel":
            self.start(step)
        await settle()
        if reply:
            self.reply(reply)
            await settle()

    def start(self, step: str) -> None:
        starts: dict[str, Callable[[], Coroutine[Any, Any, None]]] = {
            "connect": self._connect,
            "refresh": self.cache.refresh,
            "ask": self._ask,
            "ask fresh": lambda: self._ask(fresh=True),
            "ask 6d": lambda: self._ask("6d"),
            "ask 6d fresh": lambda: self._ask("6d", fresh=True),
        }
        self.tasks.append(asyncio.create_task(starts[step]()))

    async def _connect(self) -> None:
        self.lose_connection()
        self.server.num_connections += 1
        self.source.status.connected("the server")
        self.connection = connection = Connection(self.server)
        self.is_in_handshake = True
        try:
            await self.cache.read_for_handshake(connection)
        except (ServerError, ReplyTimeoutError, ParametersError):
            pass
        except LinkError:
            return  # the connection was lost
        self.is_in_handshake = False
        self.source.connection = connection

    def lose_connection(self) -> None:
        if self.connection is not None:
            self.connection.is_open = False
        self.is_in_handshake = False
        self.server.close()

    async def _ask(self, *sections: str, fresh: bool = False) -> None:
        asked_s = asyncio.get_running_loop().time()
        connection = self.server.num_connections
        try:
            answer = await self.source.parameters(*sections, fresh=fresh)
        except QueryError as error:
            self.codes.add(error.code)
            return
        assert asyncio.get_running_loop().time() - asked_s <= 3 * TIMEOUT_S
        xml, received_s, of_connection = self._origin(answer.xml)
        assert of_connection >= connection, "an answer of an earlier connection"
        assert answer.version == self.cache.version, "an answer from before a change"
        if fresh:
            assert received_s >= asked_s - FRESH_S, "an old answer"
        assert sections or xml == "SendParameters"

    def _origin(self, xml: bytes) -> tuple[str, float, int]:
        """Return the command of an answer, or of a part of one, when it was sent, and the connection."""
        found = self.server.sent.get(xml)
        if found is None:  # some sections of one
            [found] = [origin for whole, origin in self.server.sent.items() if xml in whole]
        return found

    def reply(self, kind: str) -> None:
        """Let the server answer the oldest command, and note what that means for the parameters."""
        is_handshake = self.is_in_handshake
        command = self.server.reply(kind)
        if command == "SendParameters":
            if kind not in FAILURES:
                self.newest = kind
            elif is_handshake:
                self.newest = None

    def check(self) -> None:
        known = self.cache.newest
        assert unit_of(None if known is None else known.xml) == self.newest
        announced = self.source.announced
        assert self.cache.version == (announced[-1][1] if announced else 0)
        if announced:
            assert unit_of(announced[-1][0]) == self.newest
            assert announced[0][1] == 1
        for (before, version), (after, next_version) in pairwise(announced):
            assert next_version - version == (unit_of(before) != unit_of(after))
        assert self.codes <= {"refused", "timeout", "no-connection"}
        assert len([each for each in self.server.waiting if not each[1].done()]) <= 1


STEPS: Final = st.sampled_from(
    [
        *(
            "connect",
            "connect and mm",
            "connect and cm",
            "lose",
            "refresh",
            "refresh and mm",
            "refresh and cm",
        ),
        *("ask", "ask fresh", "ask 6d", "ask 6d fresh", "mm", "cm", "refused", "silence", "garbage"),
        *("connect and refused", "connect and garbage", "pause 0.5", "pause 6", "cancel"),
    ]
)


@settings(max_examples=examples(500), deadline=None)
@given(st.lists(STEPS, max_size=50))
def test_peers_and_frames_get_the_parameters_that_the_server_has(steps: list[str]) -> None:
    """No old answer, a version for each change and for nothing else, and nobody waits for ever."""

    async def run() -> None:
        model = Model()
        for each in ["connect", *steps]:
            await model.do(each)
            model.check()
        if model.is_in_handshake:
            model.reply("mm")
        await asyncio.sleep(10 * TIMEOUT_S)
        results: list[Any] = await asyncio.gather(*model.tasks, return_exceptions=True)
        assert [each for each in results if each and not isinstance(each, asyncio.CancelledError)] == []
        model.check()

    run_in_virtual_time(run())
