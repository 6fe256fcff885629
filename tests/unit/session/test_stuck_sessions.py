"""Whole streams with servers that ignore, refuse late, hang and change: frames flow, or there is a reason."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import product

import pytest

from gateway.session.state import StreamState
from tests.support.clocks import until
from tests.support.errors import names
from tests.support.servers import error, markers_frame, ok
from tests.unit.session.scripted_server import (
    XML,
    Answer,
    Connection,
    obliging,
    refusing_without_name,
    silent_to,
)
from tests.unit.session.test_supervisor import Lab, running

BARE = "StreamFrames"
FIRST_FORM = "StreamFrames AllFrames"


def is_streaming(lab: Lab) -> Callable[[], bool]:
    return lambda: lab.status.state is StreamState.STREAMING and len(lab.published) > 0


def more_frames(lab: Lab) -> Callable[[], bool]:
    published = len(lab.published)
    return lambda: is_streaming(lab)() and len(lab.published) > published + 10


class StreamingServer:
    """Answers with ``answer``, and streams at 20 Hz once it has accepted a request for frames.

    It accepts the requests that it acknowledges, unless ``accepts`` decides. While ``hangs`` is set it reads
    nothing; then it answers all that has arrived.
    """

    def __init__(
        self, lab: Lab, answer: Answer = obliging, *, accepts: Callable[[str], bool] | None = None
    ) -> None:
        self.answer = answer
        self._accepts = accepts
        self.hangs = False
        self.hangs_at: str | None = None  # the command, or "a frame", at which it begins to hang
        self._unread: list[tuple[Connection, str]] = []
        self._streaming: set[Connection] = set()
        self._lab = lab
        lab.server.answer = self._read

    def _read(self, command: str) -> bytes | None:
        connection = self._lab.server.connection
        self._hang_at(command)
        if self.hangs:
            self._unread.append((connection, command))
            return None
        return self._execute(connection, command)

    def _execute(self, connection: Connection, command: str) -> bytes | None:
        if command == "StreamFrames Stop":
            self._streaming.discard(connection)
        reply = self.answer(command)
        is_acknowledged = reply is not None and reply[4:8] == b"\0\0\0\1"
        is_accepted = is_acknowledged if self._accepts is None else self._accepts(command)
        if command.startswith("StreamFrames") and is_accepted:
            self._streaming.add(connection)
        return reply

    def is_hanging(self) -> bool:
        return self.hangs

    def _hang_at(self, event: str) -> None:
        if self.hangs_at is not None and event.startswith(self.hangs_at):
            self.hangs, self.hangs_at = True, None

    def recover(self) -> None:
        """Answer what has arrived, in order, on all connections that are still open."""
        self.hangs = False
        unread, self._unread = self._unread, []
        for connection, command in unread:
            reply = self._execute(connection, command)
            if reply is not None:
                connection.send(reply)

    async def run(self) -> None:
        number = 0
        while True:
            await asyncio.sleep(0.05)
            number += 1
            for connection in list(self._streaming):
                if connection.is_open and not self.hangs:
                    connection.send(markers_frame(number, (0.0, 0.0, 0.0)))
                    self._hang_at("a frame")


@asynccontextmanager
async def serving(lab: Lab, server: StreamingServer) -> AsyncIterator[None]:
    task = asyncio.create_task(server.run())
    try:
        async with running(lab):
            yield
    finally:
        task.cancel()


def now_s() -> float:
    return asyncio.get_running_loop().time()


# --- servers that ignore and refuse


async def test_frames_show_that_a_form_was_accepted() -> None:
    lab = Lab()
    server = StreamingServer(lab, silent_to(""), accepts=lambda _: True)
    async with serving(lab, server):
        await until(lambda: lab.supervisor.session)
    assert lab.server.connection.commands == ["Version 1.0", "SendParameters", FIRST_FORM, "Bye"]


async def test_a_server_that_answers_nothing_is_reconnected_with_a_reason() -> None:
    lab = Lab()
    lab.server.answer = silent_to("")
    async with running(lab):
        await until(lambda: len(lab.server.connections) == 2)
    assert names(lab.status.last_error, "no command")


# --- servers that hang


@pytest.mark.parametrize("reply", ["named", "verb", "bare"])
@pytest.mark.parametrize("known", [FIRST_FORM, "StreamFrames FrequencyDivisor:1", BARE])
@pytest.mark.parametrize("hang_at", ["Version", "SendParameters", FIRST_FORM, "a frame"])
async def test_a_server_that_hangs_streams_within_5_s_of_being_well(
    reply: str, known: str, hang_at: str
) -> None:
    def answer(command: str) -> bytes | None:
        text = {"named": command, "verb": command.split(maxsplit=1)[0].lower(), "bare": "that"}[reply]
        if command == "SendParameters" and known == FIRST_FORM:
            return XML
        return ok(f"OK-{text}") if known in {command, FIRST_FORM} else error(f"Error-{text}")

    for hang_s in (1.0, 5.5, 11.0, 33.0):
        lab = Lab()
        server = StreamingServer(lab, answer)
        server.hangs_at = hang_at
        async with serving(lab, server):
            await until(server.is_hanging)
            await asyncio.sleep(hang_s)
            server.recover()
            well_s = now_s()
            await until(more_frames(lab))
            assert now_s() - well_s < 5, hang_s
            await asyncio.sleep(20)
            assert is_streaming(lab)(), hang_s
            assert lab.supervisor.session is not None


# --- servers that come back as another program


SERVERS: dict[str, Answer] = {
    "obliging": obliging,
    "minimal": lambda command: ok("fine") if command == BARE else error("what?"),
    "silent to what it does not know": lambda command: ok("fine") if command == BARE else None,
    "ignoring": silent_to("Version", "SendParameters", by=refusing_without_name("StreamFrames AllFrames")),
}


@pytest.mark.parametrize(("first", "second"), list(product(SERVERS, SERVERS)))
async def test_a_server_that_comes_back_as_another_program_streams(first: str, second: str) -> None:
    for at_s in (0.0, 2.5, 20.0):
        lab = Lab()
        server = StreamingServer(lab, SERVERS[first])
        async with serving(lab, server):
            await asyncio.sleep(at_s + 0.005)
            server.answer = SERVERS[second]
            lab.server.connection.end()
            await until(more_frames(lab))
