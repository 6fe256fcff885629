"""The output for RTC3D clients: its ports, what it hands to its thread, and what it says of itself."""

import asyncio
import logging
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import pytest

from gateway.errors import OutputError, PortError
from gateway.messages.decode import JSON
from gateway.messages.encode import Stamp
from gateway.outputs import frame_output
from gateway.outputs.adapters.rtc3d import output as output_module
from gateway.outputs.adapters.rtc3d.client_filter import SourceState
from gateway.outputs.adapters.rtc3d.output import QUEUE_FULL, Rtc3dOutput
from gateway.outputs.adapters.rtc3d.settings import Rtc3dSettings
from gateway.outputs.contract import CONTROL_OPTION, Answer, ServerFile, ServerParameters
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import split_frame
from gateway.runtime.losses import Losses
from tests.support.errors import names
from tests.unit.outputs.adapters.rtc3d.scripted_server import body, markers, settle

LAB, HALL = 3120, 3121
FRAME = split_frame(body(markers(1, 10_000)), "big")
COMPONENTS = frozenset({ComponentType.MARKERS})


class Thread:
    """A LoopThread that runs everything in the test's own event loop."""

    is_full = False

    def __init__(self, _name: str) -> None:
        self.num_bytes = 0

    def offer(self, call: Callable[[], None], num_bytes: int = 0) -> bool:
        if not self.is_full:
            self.num_bytes += num_bytes
            asyncio.get_running_loop().call_soon(call)
        return not self.is_full

    def run(self, coroutine: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        return asyncio.get_running_loop().create_task(coroutine)

    def close(self, last: Callable[[], Coroutine[Any, Any, None]], _timeout_s: float) -> None:
        self.run(last())


@dataclass(eq=False)
class Server:
    """A LiveServer that opens no port; ``events`` says when ports are opened and closed."""

    events: ClassVar[list[str]]
    busy: ClassVar[set[int]]
    attempts_s: ClassVar[list[float]]
    opened: ClassVar[dict[str, "Server"]]

    state: SourceState
    host: str
    port: int
    max_clients: int
    wanted_changed: Callable[[], None]
    control: Callable[[str, bool, str], Coroutine[Any, Any, str]]
    taken: list[tuple[int, frozenset[ComponentType]]] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    num_maintained: int = 0

    async def listen(self) -> None:
        self.attempts_s.append(asyncio.get_running_loop().time())
        if self.port in self.busy:
            raise PortError(f"port {self.port} is in use")
        self.events.append(f"open {self.host} {self.port}")
        self.opened[self.state.source] = self

    async def close(self) -> None:
        await asyncio.sleep(0.5)
        self.events.append(f"close {self.host} {self.port}")

    def set_max_clients(self, max_clients: int) -> None:
        self.max_clients = max_clients

    def maintain(self) -> None:
        self.num_maintained += 1

    def take(self, frame: object, stream: int, wanted: frozenset[ComponentType]) -> None:
        assert frame is FRAME
        self.taken.append((stream, wanted))

    def send_file(self, path: Path) -> None:
        self.files.append(path)


@pytest.fixture(autouse=True)
def _scripted(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("events", []), ("busy", set()), ("attempts_s", []), ("opened", {})):
        monkeypatch.setattr(Server, name, value, raising=False)
    monkeypatch.setattr(Thread, "is_full", False)
    monkeypatch.setattr(output_module, "LiveServer", Server)
    monkeypatch.setattr(frame_output, "LoopThread", Thread)


def settings(ports: Mapping[str, int], **values: Any) -> Rtc3dSettings:
    return Rtc3dSettings(enabled=True, ports=dict(ports), **values)


async def started(ports: Mapping[str, int], *sources: str, **values: Any) -> Rtc3dOutput:
    output = Rtc3dOutput(settings(ports, **values))
    for source in sources or ports:
        output.announce(source)
    output.start()
    await settle()
    return output


def take_over(output: Rtc3dOutput, ports: Mapping[str, int], **values: Any) -> bool:
    return output.take_over(Rtc3dOutput(settings(ports, **values)))


# Ports --------------------------------------------------------------------------------------


async def test_the_ports_of_announced_sources_are_open() -> None:
    """Clients must not reach a source that is not there yet."""
    output = Rtc3dOutput(settings({"lab": LAB, "hall": HALL}))
    output.announce("lab")
    assert not output.health().connected
    assert names(output.health().problem, "not open")
    output.start()
    assert names(output.health().problem, f"port {LAB}", "not open")
    await settle()
    assert (Server.events, output.health().connected) == ([f"open 127.0.0.1 {LAB}"], True)
    output.announce("hall")
    await settle()
    output.withdraw("lab")
    await asyncio.sleep(1)
    output.announce("lab")
    await settle()
    assert Server.events[1:] == [f"open 127.0.0.1 {HALL}", f"close 127.0.0.1 {LAB}", f"open 127.0.0.1 {LAB}"]


async def test_closing_closes_every_port_for_good() -> None:
    """An output that is closed cannot be started again."""
    output = await started({"lab": LAB, "hall": HALL})
    output.close()
    output.start()
    await asyncio.sleep(1)
    assert sorted(Server.events[2:]) == [f"close 127.0.0.1 {LAB}", f"close 127.0.0.1 {HALL}"]
    assert names(output.health().problem, "not open")
    never_started = Rtc3dOutput(settings({"lab": LAB}))
    never_started.close()
    never_started.start()
    assert never_started._thread is None


async def test_a_port_for_an_unknown_source_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    """Nobody could connect, and the name is probably mistyped."""
    await started({"lab": LAB, "lap": HALL}, "lab")
    assert [each.args for each in caplog.records if each.levelno == logging.WARNING] == [("lap",)]


async def test_a_port_in_use_is_tried_again_until_it_is_free() -> None:
    """The waits double from 0.2 s up to 1 s; meanwhile, the health says why."""
    Server.busy.add(LAB)
    output = await started({"lab": LAB, "hall": HALL})
    assert names(output.health().problem, f"port {LAB} is in use")
    await asyncio.sleep(4)
    times = [round(time_s - 1000, 1) for time_s in Server.attempts_s]
    assert times == [0.0, 0.0, 0.2, 0.6, 1.4, 2.4, 3.4]
    Server.busy.clear()
    await asyncio.sleep(1)
    assert (output.health().connected, output.health().problem) == (True, "")
    output.show_streaming("lab", is_streaming=True)
    await settle()
    assert Server.opened["lab"].num_maintained == 1


async def test_a_reload_touches_only_what_has_changed() -> None:
    """Clients of the other sources stay connected."""
    output = await started({"lab": LAB, "hall": HALL})
    assert not take_over(output, {"lab": LAB, "hall": HALL})
    assert take_over(output, {"lab": LAB, "hall": HALL}, max_clients=7)
    await settle()
    assert [server.max_clients for server in Server.opened.values()] == [7, 7]
    assert take_over(output, {"lab": LAB, "hall": 3122}, max_clients=7)
    await asyncio.sleep(1)
    assert take_over(output, {"lab": LAB})
    await asyncio.sleep(1)
    assert Server.events[2:] == [f"close 127.0.0.1 {HALL}", "open 127.0.0.1 3122", "close 127.0.0.1 3122"]
    assert output.is_configured_like(Rtc3dOutput(Rtc3dSettings()))


async def test_ports_that_are_exchanged_or_get_another_address_are_closed_before_they_are_opened() -> None:
    """Otherwise each source would find the other's port, or its own, in use."""
    output = await started({"lab": LAB, "hall": HALL})
    take_over(output, {"lab": HALL, "hall": LAB})
    await asyncio.sleep(2)
    take_over(output, {"lab": HALL, "hall": LAB}, host="::1")
    await asyncio.sleep(2)
    steps = ["close 127.0.0.1", "open 127.0.0.1", "close 127.0.0.1", "open ::1"]
    expected = [[f"{step} {LAB}", f"{step} {HALL}"] for step in steps]
    assert [sorted(Server.events[at : at + 2]) for at in (2, 4, 6, 8)] == expected


async def test_a_port_that_never_opened_is_given_up() -> None:
    """A source that is withdrawn must not be tried for ever."""
    Server.busy.add(LAB)
    output = await started({"lab": LAB})
    output.withdraw("lab")
    await asyncio.sleep(10)
    assert len(Server.attempts_s) == 1
    assert output.health().connected


# What the thread gets -----------------------------------------------------------------------


async def test_the_server_hears_of_every_change_of_its_source() -> None:
    """Clients get No Data and new parameters in time."""
    output = await started({"lab": LAB, "hall": HALL})
    server, state = Server.opened["lab"], Server.opened["lab"].state
    parameters, losses = ServerParameters(b"<Parameters/>", 1, 1), Losses(logging.getLogger(__name__), "lab")
    for number, change in enumerate(
        (
            lambda: output.show_streaming("lab", is_streaming=True),
            lambda: output.show_measurement("lab", is_running=False),
            lambda: output.publish_parameters("lab", parameters),
            output.maintain,
        ),
        start=1,
    ):
        change()
        await settle()
        assert server.num_maintained == number
    output.count_losses("lab", losses)
    assert (state.is_streaming, state.is_measuring, state.parameters) == (True, False, parameters)
    assert [server.state.losses is losses for server in Server.opened.values()] == [True, False]


async def test_files_reach_the_source_of_the_server_even_if_the_queue_is_full(tmp_path: Path) -> None:
    """A file is announced only once."""
    output = await started({"lab": LAB, "hall": HALL})
    Thread.is_full = True
    output.announce_file("lab", ServerFile(tmp_path, 1))
    output.announce_file("elsewhere", ServerFile(tmp_path, 1))
    await settle()
    assert (Server.opened["lab"].files, Server.opened["hall"].files) == ([tmp_path], [])


async def test_frames_are_handed_over_while_any_client_wants_some() -> None:
    """A frame that nobody wants costs the thread nothing; the stream is that of the session."""
    output = await started({"lab": LAB})
    publisher, server = output.frame_publisher("lab"), Server.opened["lab"]
    stamp = Stamp(0, 0, 5, 1)
    for wanted in (False, True):
        server.state.wanted = wanted
        assert publisher.wants(COMPONENTS) is publisher.prepare(FRAME.layout, COMPONENTS) is wanted
        publisher.publish(FRAME, stamp, COMPONENTS)
    await settle()
    assert server.taken == [(5, COMPONENTS)]
    assert output._thread is not None
    assert output._thread.num_bytes == len(FRAME.body)  # type: ignore[attr-defined]
    Thread.is_full = True
    for cause in (QUEUE_FULL, "closed"):
        with pytest.raises(OutputError) as caught:
            publisher.publish(FRAME, stamp, COMPONENTS)
        assert caught.value.cause == cause
        publisher.close()
    assert not publisher.wants(COMPONENTS)


async def test_frames_of_closed_ports_are_nothing() -> None:
    """Frames may still wait for the thread when a source is withdrawn."""
    output = await started({"lab": LAB})
    server = Server.opened["lab"]

    def take(source: str, stream: int) -> None:
        output._call(source, lambda server: server.take(FRAME, stream, COMPONENTS))

    take("lab", 1)
    take("elsewhere", 1)
    output.withdraw("lab")
    await asyncio.sleep(1)
    take("lab", 2)
    assert [stream for stream, _ in server.taken] == [1]


async def test_recordings_are_passed_on_to_the_source() -> None:
    """The options belong to the start only."""
    asked: list[object] = []
    changes: list[int] = []

    class Queries:
        async def answer(self, source: str, path: Sequence[str], options: Mapping[str, str]) -> Answer:
            asked.append((source, path, dict(options)))
            return Answer(b"{}", JSON, {"reply": "OK"} if "options" in options else {})

    output = Rtc3dOutput(settings({"lab": LAB}))
    output.serve_queries(Queries())  # type: ignore[arg-type]
    output.watch_wanted("lab", lambda: changes.append(1))
    output.announce("lab")
    output.start()
    await settle()
    controls = ((True, ",file=a,b=c"), (True, ""), (False, ",x"))
    replies = [await Server.opened["lab"].control("lab", *control) for control in controls]
    assert replies == ["OK", "", ""]
    start = {CONTROL_OPTION: "start"}
    options = (start | {"options": ",file=a,b=c"}, start, {CONTROL_OPTION: "stop"})
    assert asked == [("lab", ("recording",), each) for each in options]
    Server.opened["lab"].wanted_changed()
    await settle()
    assert changes == [1]
