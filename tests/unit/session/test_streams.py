"""``streams: auto`` with default time-outs, in virtual time."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from gateway.session.c3d_files.spool import Spool
from gateway.session.state import StreamState
from gateway.session.streams import ENDS_FIRST, NO_FRAMES
from tests.support.clocks import settle, until
from tests.support.errors import each_names, names
from tests.support.parameters import in_root
from tests.support.servers import error, ok, packet
from tests.unit.daemon.scripted_sources import Servers
from tests.unit.daemon.test_source import Lab
from tests.unit.session.scripted_server import Connection

pytestmark = pytest.mark.interpreted  # gateway.daemon.source gets another Supervisor

EVERYTHING = "3d 6d analog force event"
TWO = ["3d 6d force event", "analog"]
NO_DATA = packet(4)


def parameters(analog_hz: int = 2000, version: str = "1") -> bytes:
    return packet(
        2,
        in_root(
            f"<General><Server><Name>NDI</Name><Ver>{version}</Ver></Server></General>"
            "<The_3D><Frequency>200</Frequency><Markers><Marker id='1'><Label>A</Label></Marker></Markers>"
            "</The_3D>"
            "<Analog><Channels><Channel id='1'><Label>B</Label>"
            f"<Frequency>{analog_hz}</Frequency></Channel></Channels></Analog>"
        ),
    )


def answering(xml: bytes) -> Callable[[Connection, str], bytes | None]:
    """Return an answer to every command, with these parameters; frames are requested while none run."""

    def answer(_connection: Connection, command: str) -> bytes | None:
        if command.startswith("SendParameters"):
            return xml
        return ok(f"OK-{command}") + (NO_DATA if command.startswith("StreamFrames") else b"")

    return answer


class AutoLab(Lab):
    """A source with ``streams: auto``, checked every second, and its server."""

    def __init__(self, servers: Servers, tmp_path: Path) -> None:
        super().__init__(servers, Spool(tmp_path, max_files=10, max_bytes=1000))
        self.server.answer_on = answering(parameters())

    @property
    def num_open(self) -> int:
        return sum(each.is_open for each in self.server.connections)

    @property
    def components(self) -> list[str]:
        return [status.components for status in self.source.statuses]

    @property
    def states(self) -> list[StreamState]:
        return [status.state for status in self.source.statuses]

    @property
    def limitations(self) -> list[str]:
        return self.source.statuses[0].limitations

    def shares_one(self, reason: str, analog_hz: int = 2000) -> bool:
        """Whether the only limitation is that all components share a connection, because of ``reason``."""
        return each_names(self.limitations, ["analog", "200 Hz", f"{analog_hz} Hz", reason])

    async def uses_two(self) -> None:
        await until(lambda: self.components == TWO and set(self.states) == {StreamState.NO_MEASUREMENT})
        await settle()


@pytest.fixture
async def lab(servers: Servers, tmp_path: Path) -> AutoLab:
    return AutoLab(servers, tmp_path)


@asynccontextmanager
async def running(lab: AutoLab) -> AsyncIterator[None]:
    async def check() -> None:
        while True:
            await asyncio.sleep(1)
            lab.source.publish_status()

    tasks = [asyncio.create_task(lab.source.run()), asyncio.create_task(check())]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def test_two_connections_stay_although_the_second_one_breaks_at_times(lab: AutoLab) -> None:
    async with running(lab):
        await lab.uses_two()
        await asyncio.sleep(3600)
        assert (lab.num_open, len(lab.server.connections)) == (2, 2)
        for _ in range(10):
            await asyncio.sleep(20)
            await end(lab.server.connections[-1])
            await lab.uses_two()
        assert (lab.limitations, lab.server.connections[0].is_open) == ([], True)


@pytest.mark.parametrize(("accepts_commands", "most_connections"), [(False, 2), (True, 3)])
async def test_a_second_connection_without_frames_is_given_up(
    lab: AutoLab, accepts_commands: bool, most_connections: int
) -> None:
    """It may not even reply."""
    answer = lab.server.answer_on

    def without_frames(each: Connection, command: str) -> bytes | None:
        if each.number > 1 and not accepts_commands:
            return None
        if each.number > 1 and command.startswith("StreamFrames"):
            return ok(f"OK-{command}")
        return answer(each, command)

    lab.server.answer_on = without_frames
    async with running(lab):
        began_s = asyncio.get_running_loop().time()
        await until(lambda: lab.limitations)
        assert asyncio.get_running_loop().time() - began_s < 10 or accepts_commands
        assert lab.components == [EVERYTHING]
        assert lab.shares_one(NO_FRAMES) or accepts_commands
        await asyncio.sleep(3600)
        assert lab.num_open == 1
        assert len(lab.server.connections) <= most_connections


async def test_frames_on_the_second_connection_only(lab: AutoLab) -> None:
    answer = lab.server.answer_on

    def without_first(each: Connection, command: str) -> bytes | None:
        if each.number == 1 and command.startswith("StreamFrames") and "3D" in command:
            return ok(f"OK-{command}")
        return answer(each, command)

    lab.server.answer_on = without_first
    async with running(lab):
        await until(lambda: lab.num_open == 2)
        for _ in range(100):
            await asyncio.sleep(0.1)
            lab.server.connections[-1].send_frames(1)
            if lab.limitations:
                break
        assert lab.components == [EVERYTHING]
        assert lab.states == [StreamState.NO_MEASUREMENT]


@pytest.mark.parametrize("first_lasts_s", [3, 20])
async def test_a_second_connection_that_breaks_twice_in_a_row_is_given_up(
    lab: AutoLab, first_lasts_s: float
) -> None:
    """Two failures in a row are enough, also if the first one came after a while."""
    async with running(lab):
        for lasted_s in (first_lasts_s, 3):
            await lab.uses_two()
            await asyncio.sleep(lasted_s)
            await end(lab.server.connections[-1])
        await until(lambda: lab.limitations)
        assert lab.shares_one("accepts one")
        await asyncio.sleep(3600)
        assert len(lab.server.connections) == 3


async def test_the_further_connection_ends_with_the_first(lab: AutoLab) -> None:
    async with running(lab):
        await lab.uses_two()
        await asyncio.sleep(20)
        first, second = lab.server.connections
        lab.server.refuses = True
        first.end()
        await until(lambda: not second.is_open)
        assert "Bye" in second.commands
        await asyncio.sleep(60)
        lab.server.refuses = False
        await lab.uses_two()
        assert (len(lab.server.connections), lab.limitations) == (4, [])


async def end(*connections: Connection) -> None:
    for connection in connections:
        connection.end()
    await settle()


async def end_all(lab: AutoLab) -> None:
    await end(*lab.server.connections)


async def test_a_server_that_is_restarted_at_times_keeps_two_connections(lab: AutoLab) -> None:
    async with running(lab):
        for number in range(10):
            await lab.uses_two()
            await asyncio.sleep(0.5 if number % 3 else 20)
            await end_all(lab)
        await lab.uses_two()
        assert lab.limitations == []


async def test_a_server_that_ends_with_every_second_connection_is_remembered(lab: AutoLab) -> None:
    """Until it has another version."""
    async with running(lab):
        for _ in range(3):
            await lab.uses_two()
            await end_all(lab)
        await until(lambda: lab.shares_one(ENDS_FIRST) and lab.num_open == 1)
        for pause_s in (3600, 60, 60, 60, 60):
            await asyncio.sleep(pause_s)
            await end_all(lab)
            await until(lambda: lab.shares_one(ENDS_FIRST) and lab.num_open == 1)
            assert lab.components == [EVERYTHING]
        assert len(lab.server.connections) == 3 * 2 + 6
        lab.server.answer_on = answering(parameters(version="2"))
        await end_all(lab)
        await lab.uses_two()
        assert lab.limitations == []


async def test_a_server_stays_known_when_its_rates_change_on_an_open_connection(lab: AutoLab) -> None:
    """It is the same server: several connections would end the first one again."""
    async with running(lab):
        for _ in range(3):
            await lab.uses_two()
            await end_all(lab)
        await until(lambda: lab.shares_one(ENDS_FIRST) and lab.states == [StreamState.NO_MEASUREMENT])
        lab.server.answer_on = answering(parameters(1000))
        lab.server.connections[-1].send_frames(1)  # a new measurement
        lab.server.connections[-1].send(NO_DATA)
        await until(lambda: lab.shares_one(ENDS_FIRST, analog_hz=1000))
        await asyncio.sleep(60)
        assert (lab.components, lab.num_open) == ([EVERYTHING], 1)


async def test_a_server_that_refused_is_tried_again_after_ten_minutes(lab: AutoLab) -> None:
    answer = lab.server.answer_on
    lab.server.answer_on = lambda each, command: (
        answer(each, command) if each.number == 1 else error("err-busy")
    )
    async with running(lab):
        await until(lambda: lab.limitations)
        lab.server.answer_on = answer
        await asyncio.sleep(300)
        await end_all(lab)
        await until(lambda: lab.limitations)
        assert lab.components == [EVERYTHING]
        await asyncio.sleep(400)
        await end_all(lab)
        await lab.uses_two()
        assert lab.limitations == []


async def test_a_server_without_parameters_after_one_with_rates_gets_one_connection(lab: AutoLab) -> None:
    async with running(lab):
        await lab.uses_two()
        answer = lab.server.answer_on
        lab.server.answer_on = lambda each, command: (
            error("err-unknown") if command.startswith("SendParameters") else answer(each, command)
        )
        await asyncio.sleep(20)
        await end_all(lab)
        await until(lambda: lab.components == [EVERYTHING] and len(lab.limitations) > 1)
        assert names(lab.limitations[-1], "rates")
        await settle()
        assert lab.num_open == 1
