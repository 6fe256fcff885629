"""A whole gateway in virtual time: its life cycle, and what a reload changes and keeps."""

import asyncio
import dataclasses
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.config.settings import Settings, SourceSettings, SpoolSettings
from gateway.daemon.gateway import Gateway
from gateway.errors import ConfigError
from gateway.messages.decode import decode
from gateway.messages.descriptions.source_frame import source_frame
from gateway.outputs.contract import Output
from gateway.outputs.kind import SubscriptionRequest
from gateway.outputs.registry import OUTPUTS, settings_type
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.losses import counts_text
from tests.support.clocks import settle, until
from tests.support.errors import names
from tests.support.example_output import (
    EXAMPLE,
    UNREACHABLE,
    ExampleOutput,
    ExampleSettings,
    ExampleSubscription,
)
from tests.support.memory_output import MemoryOutput
from tests.support.servers import c3d_file, packet
from tests.unit.daemon.scripted_sources import Servers, SlowThreads
from tests.unit.session.scripted_server import XML, silent_to

pytestmark = pytest.mark.usefixtures("servers", "threads")
REFUSED = "refused"


class RecordingOutput(ExampleOutput):
    """Appends its start and its end to the ``events`` of its class."""

    events: list[tuple[str, str]] = []  # noqa: RUF012 - a fixture replaces it for each test

    def __init__(self, settings: ExampleSettings) -> None:
        if settings.address == REFUSED:
            raise ConfigError("example.address is refused")
        super().__init__(settings)

    def start(self) -> None:
        self.events.append(("start", self.settings.address))
        super().start()

    async def stop_queries(self) -> None:
        self.events.append(("stop queries", self.settings.address))
        await super().stop_queries()

    def close(self) -> None:
        self.events.append(("close", self.settings.address))
        super().close()


class OtherOutput(RecordingOutput):
    """A second output, with other commands."""

    name = "other"
    commands = {}  # noqa: RUF012 - it is never changed


@pytest.fixture(autouse=True)
def events(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Register the outputs; return what happens to them."""
    events: list[tuple[str, str]] = []
    monkeypatch.setattr(RecordingOutput, "events", events)
    monkeypatch.setitem(OUTPUTS, "example", dataclasses.replace(EXAMPLE, create=RecordingOutput))
    monkeypatch.setitem(OUTPUTS, "other", dataclasses.replace(EXAMPLE, name="other", create=OtherOutput))
    return events


def settings(*sources: str, example: str = "local", other: str | None = None, **sections: Any) -> Settings:
    """Return settings with these sources, each NAME or NAME@HOST, and the addresses of the outputs."""
    names = [source.partition("@") for source in sources or ("lab",)]
    section = ExampleSettings(enabled=True, address=example)
    off = {"enabled": False}
    values = {
        "sources": [SourceSettings(name=name, host=host or name) for name, _, host in names],
        "example": section,
        "other": section.model_copy(update={"enabled": other is not None, "address": other or ""}),
    }
    return settings_type().model_validate(dict.fromkeys(("zenoh", "lcm", "metrics"), off) | values | sections)


def with_source(whole_frames: bool = False, **keys: Any) -> Settings:
    """Return settings with the source lab, with further keys."""
    source = SourceSettings.model_validate({"name": "lab", "host": "lab", **keys})
    output = ExampleSettings(enabled=True, whole_frames=whole_frames)
    return settings().model_copy(update={"sources": (source,), "example": output})


def started(
    settings: Settings, outputs: list[Output] | None = None
) -> tuple[Gateway, asyncio.Event, asyncio.Task[None]]:
    """Return a gateway that starts, the event that stops it, and its task."""
    gateway, stop = Gateway(settings, outputs), asyncio.Event()
    return gateway, stop, asyncio.create_task(gateway.run(stop))


@asynccontextmanager
async def running(settings: Settings, outputs: list[Output] | None = None) -> AsyncIterator[Gateway]:
    """Run a gateway until the block ends."""
    gateway, stop, task = started(settings, outputs)
    await gateway.opened.wait()
    yield gateway
    stop.set()
    await task


@asynccontextmanager
async def streaming(settings: Settings) -> AsyncIterator[Gateway]:
    """Run a gateway, from when its sources are connected until the block ends."""
    async with running(settings) as gateway:
        await connected(gateway)
        yield gateway


async def connected(gateway: Gateway) -> None:
    await until(lambda: all(each.session for source in gateway.sources for each in source.streams))
    await settle()


def example(gateway: Gateway, index: int = 0) -> ExampleOutput:
    output = gateway.outputs[index].output
    assert isinstance(output, ExampleOutput)
    return output


def subscribe(address: str, *, component: str = "3d", source: str | None = None) -> list[Any]:
    """Return a list that collects the messages published at an address, by one source or by all."""
    messages: list[Any] = []
    request = SubscriptionRequest(component=component, source=source)
    ExampleSubscription(address, request, lambda _, message: messages.append(decode(message)))
    return messages


async def test_outputs_start_before_sources_connect_and_close_after_bye(
    servers: Servers, events: list[tuple[str, str]]
) -> None:
    async with running(settings(other="elsewhere")) as gateway:
        assert events == [("start", "local"), ("start", "elsewhere")]
        assert not servers["lab"].connections
        await connected(gateway)
    assert servers["lab"].connection.commands[-1] == "Bye"
    for address in ("local", "elsewhere"):
        ends = [event for event, name in events[2:] if name == address]
        assert ends == ["stop queries", "close"]


async def test_sources_start_although_an_output_does_not_open(servers: Servers) -> None:
    loop = asyncio.get_running_loop()
    begin_s = loop.time()
    async with running(settings(example=UNREACHABLE)) as gateway:
        assert loop.time() - begin_s == pytest.approx(2.0, abs=0.1)
        await connected(gateway)
        assert servers["lab"].connection.is_open


async def test_stopping_while_outputs_open_closes_them(
    servers: Servers, events: list[tuple[str, str]]
) -> None:
    _, stop, task = started(settings(example=UNREACHABLE))
    await settle()
    stop.set()
    await task
    assert events[-1] == ("close", UNREACHABLE)
    assert not servers["lab"].connections


async def test_what_an_output_was_losing_is_logged_when_the_gateway_stops(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO", "gateway.publish.routes")
    async with running(settings(example=UNREACHABLE)) as gateway:
        gateway.sources[0].fan_out.publish_status(b"status")
        num_before = len(caplog.messages)
    [end] = caplog.messages[num_before:]
    assert names(end, "lab to example", counts_text([("not open", 1, 0)]))


async def test_outputs_are_maintained_and_status_is_published_every_second() -> None:
    statuses = subscribe("local", component="status")
    async with running(settings()) as gateway:
        output = example(gateway)
        await asyncio.sleep(0.9)
        assert (output.num_maintained, len(statuses)) == (0, 0)
        await asyncio.sleep(3.0)
        assert (output.num_maintained, len(statuses)) == (3, 3)
    await asyncio.sleep(3.0)
    assert (output.num_maintained, len(statuses)) == (3, 3)


async def test_outputs_call_their_commands_and_queries_through_one_service() -> None:
    async with running(settings(other="elsewhere")) as gateway:
        for index in (0, 1):
            answer = await example(gateway, index).query("lab/greet", name="the operator")
            assert answer.payload == b"lab greets the operator"
            assert decode((await example(gateway, index).query("lab/status")).payload).source == "lab"


async def test_parameters_and_files_reach_every_output(servers: Servers, tmp_path: Path) -> None:
    spool = SpoolSettings(directory=str(tmp_path))
    async with streaming(settings(other="elsewhere", spool=spool)) as gateway:
        servers["lab"].connection.send(packet(5, c3d_file(b"a file")))
        await settle()
        for index in (0, 1):
            assert [(name, each.xml) for name, each in example(gateway, index).parameters] == [
                ("lab", XML[8:])
            ]
            assert [(name, each["bytes"]) for name, each in example(gateway, index).files] == [("lab", 1024)]


async def test_a_changed_output_is_replaced_and_its_numbers_continue(
    servers: Servers, events: list[tuple[str, str]]
) -> None:
    before, after = subscribe("local"), subscribe("new")
    async with streaming(settings(other="elsewhere")) as gateway:
        other = gateway.outputs[1]
        servers["lab"].connection.send_frames(1, 2)
        assert await gateway.reload(settings(example="new", other="elsewhere")) == ["output example changed"]
        servers["lab"].connection.send_frames(3)
        assert ([each.sequence for each in before], [each.sequence for each in after]) == ([0, 1], [2])
        [(output, status), (kept, _)] = gateway.sources[0].fan_out.outputs
        assert (output, kept) == (gateway.outputs[0], other)
        assert status.messages["3d"] == 3
        assert len(servers["lab"].connections) == 1
    assert events[2:5] == [("stop queries", "local"), ("close", "local"), ("start", "new")]


async def test_switching_tool_poses_keeps_the_output() -> None:
    async with running(settings()) as gateway:
        output = example(gateway)
        for is_on in (True, False, True):
            section = ExampleSettings(enabled=True, tool_poses=is_on)
            changed = settings().model_copy(update={"example": section})
            assert await gateway.reload(changed) == ["output example changed"]
            assert await gateway.reload(changed) == []
            assert (example(gateway), gateway.outputs[0].has_tool_poses) == (output, is_on)


async def test_a_new_output_gets_the_known_parameters_and_the_state_of_every_source(servers: Servers) -> None:
    async with streaming(settings("lab", "hall")) as gateway:
        servers["lab"].connection.send_frames(1)
        await gateway.reload(settings("lab", "hall", example="new"))
        output = example(gateway)
        found = [(name, each.xml, each.session) for name, each in output.parameters]
        assert found == [("lab", XML[8:], 1), ("hall", XML[8:], 1)]
        assert (output.announced, output.streaming) == ({"lab", "hall"}, {"lab"})
        assert decode((await output.query("hall/status")).payload).source == "hall"


async def test_outputs_can_be_added_and_removed(events: list[tuple[str, str]]) -> None:
    """A removed output takes its commands with it."""
    both = settings(other="elsewhere")
    async with running(settings()) as gateway:
        assert await gateway.reload(both) == ["output other added"]
        assert [output.name for output in gateway.outputs] == ["example", "other"]
        former, other = example(gateway), example(gateway, 1)
        assert (other.is_open, other.announced) == (True, {"lab"})
        assert await gateway.reload(settings()) == ["output other removed"]
        assert (other.is_open, other.announced) == (False, set())
        assert events[-1] == ("close", "elsewhere")
        await gateway.reload(both.model_copy(update={"example": ExampleSettings(enabled=False)}))
        assert not former.is_open
        with pytest.raises(Exception, match="unknown key 'greet'"):
            await example(gateway).query("lab/greet", name="the operator")


async def test_given_outputs_stay_at_a_reload(servers: Servers) -> None:
    output = MemoryOutput()
    async with running(settings("lab@first"), [output]) as gateway:
        assert await gateway.reload(settings("lab@second", example="new")) == ["source lab changed"]
        assert [each.output for each in gateway.outputs] == [output]
        assert output.is_open
        await connected(gateway)
        assert servers["second"].connection.is_open


async def test_a_configuration_that_an_output_refuses_changes_nothing(servers: Servers) -> None:
    async with streaming(settings()) as gateway:
        before, outputs = gateway.settings, list(gateway.outputs)
        with pytest.raises(ConfigError, match="is refused"):
            await gateway.reload(settings("hall", example=REFUSED))
        assert (gateway.settings, list(gateway.outputs)) == (before, outputs)
        assert [source.name for source in gateway.sources] == ["lab"]
        assert servers["lab"].connection.is_open


async def test_a_changed_source_connects_again_and_continues_its_numbers(servers: Servers) -> None:
    markers, statuses = subscribe("local"), subscribe("local", component="status")
    async with streaming(settings("lab@first", "hall")) as gateway:
        hall = gateway.sources[1]
        servers["first"].connection.send_frames(1, 2)
        await asyncio.sleep(1.5)
        assert await gateway.reload(settings("lab@second", "hall")) == ["source lab changed"]
        assert servers["first"].connection.commands[-1] == "Bye"
        await connected(gateway)
        servers["second"].connection.send_frames(1)
        assert [(each.session, each.sequence) for each in markers] == [(1, 0), (1, 1), (2, 2)]
        await asyncio.sleep(1.0)
        assert [each.sequence for each in statuses if each.source == "lab"] == [0, 1]
        assert gateway.sources[1] is hall
        assert len(servers["hall"].connections) == 1
        assert gateway.sources[0].fan_out.frames[ComponentType.MARKERS] == 3


async def test_a_changed_frame_reaches_every_output_and_the_source_stays_connected(servers: Servers) -> None:
    plain = with_source()
    turned = with_source(frame_id="world", transform={"units": "m", "up": "y"})
    markers = subscribe("local")
    async with streaming(plain) as gateway:
        output = example(gateway)
        servers["lab"].connection.send_frames(1)
        known = output.parameters.copy()
        assert await gateway.reload(turned) != []
        servers["lab"].connection.send_frames(2)
        [(name, parameters)] = output.parameters[len(known) :]
        assert (name, parameters.frame) == ("lab", source_frame(turned.sources[0], Parameters()))
        assert parameters._replace(frame=known[0][1].frame, version=1) == known[0][1]
        assert json.loads((await output.query("lab/frame")).payload)["frame_id"] == "world"
        await asyncio.sleep(1.0)
        assert decode((await output.query("lab/status")).payload).frame_id == "world"
        found = [(each.session, each.sequence, each.parameters_version) for each in markers]
        assert found == [(1, 0, 1), (1, 1, 2)]
        assert await gateway.reload(turned) == []
        [change] = await gateway.reload(plain)
        assert names(change, "lab")
        assert output.parameters[-1] == ("lab", known[0][1]._replace(version=3))
        assert len(servers["lab"].connections) == 1
        assert servers["lab"].connection.is_open


async def test_a_changed_frame_gets_a_version_of_its_own_if_the_source_connects_again(
    servers: Servers,
) -> None:
    async with streaming(with_source(frame_id="hall", reply_timeout_s=2.0)) as gateway:
        changed = with_source(frame_id="world", reply_timeout_s=3.0)
        assert await gateway.reload(changed) == ["source lab changed"]
        await connected(gateway)
        found = {(each.version, each.frame.frame_id) for _, each in example(gateway).parameters}
        assert found == {(1, "hall"), (2, "world")}
        assert len(servers["lab"].connections) == 2


async def test_a_changed_frame_reaches_outputs_although_the_server_gives_no_parameters(
    servers: Servers,
) -> None:
    servers["lab"].answer = silent_to("SendParameters")
    async with running(with_source(whole_frames=True, frame_id="hall")) as gateway:
        await settle()
        await gateway.reload(with_source(whole_frames=True, frame_id="world"))
        found = [(each.version, each.frame.frame_id) for _, each in example(gateway).parameters]
        assert found == [(0, "hall"), (0, "world")]


async def test_sources_can_be_added_and_removed(servers: Servers) -> None:
    async with streaming(settings("lab", "hall")) as gateway:
        output = example(gateway)
        servers["hall"].connection.send_frames(1)
        assert await gateway.reload(settings("new", "lab")) == ["source hall removed", "source new added"]
        assert [source.name for source in gateway.sources] == ["new", "lab"]
        assert servers["hall"].connection.commands[-1] == "Bye"
        assert (output.announced, output.streaming) == ({"lab", "new"}, set())
        await connected(gateway)
        assert servers["new"].connection.is_open
        with pytest.raises(KeyError):
            await output.query("hall/status")
        assert decode((await output.query("new/status")).payload).source == "new"
        assert len(servers["lab"].connections) == 1


async def test_a_source_that_is_removed_and_added_again_continues_its_numbers(servers: Servers) -> None:
    hall = subscribe("local", source="hall")
    statuses = subscribe("local", source="hall", component="status")
    async with running(settings("lab", "hall")) as gateway:
        for changed in (None, settings("lab"), settings("lab", "hall"), settings("lab"), settings("hall")):
            if changed is not None:
                await gateway.reload(changed)
            if any(source.name == "hall" for source in gateway.sources):
                await connected(gateway)
                servers["hall"].connection.send_frames(1, 2)
                await asyncio.sleep(1.5)
    assert [(each.session, each.sequence) for each in hall] == [
        (session, 2 * (session - 1) + index) for session in (1, 2, 3) for index in (0, 1)
    ]
    assert [each.sequence for each in statuses] == list(range(len(statuses)))
    assert sorted({each.session for each in statuses}) == [1, 2, 3]


@pytest.mark.parametrize("order", [(2, 1), (1, 2), (2, 3, 1, 2)])
async def test_sessions_never_go_back_when_a_reload_changes_the_number_of_streams(
    servers: Servers, order: tuple[int, ...]
) -> None:
    components = {1: [["3d", "6d", "analog"]], 2: [["3d"], ["6d", "analog"]], 3: [["3d"], ["6d"], ["analog"]]}
    streams = {
        number: with_source(streams=[{"components": keys} for keys in each])
        for number, each in components.items()
    }
    statuses = subscribe("local", component="status")
    markers = subscribe("local")
    async with running(streams[order[0]]) as gateway:
        for number in order:
            await gateway.reload(streams[number])
            await connected(gateway)
            for connection in servers["lab"].connections:
                connection.send_frames(1)
            await asyncio.sleep(2.1)
            servers["lab"].connection.end()
            await asyncio.sleep(2.1)
    for messages in (statuses, markers):
        sessions = [each.session for each in messages]
        assert sessions == sorted(sessions)
    assert len({each.session for each in statuses}) >= len(order) + 1


async def test_the_start_deletes_what_a_killed_gateway_left(tmp_path: Path) -> None:
    left = tmp_path / "tmpkilled.c3d.part"
    left.touch()
    async with running(settings(spool=SpoolSettings(directory=str(tmp_path)))):
        pass
    assert not left.exists()


async def test_a_changed_spool_is_used_by_running_sources(servers: Servers, tmp_path: Path) -> None:
    before, after = (SpoolSettings(directory=str(tmp_path / name)) for name in ("before", "after"))
    async with streaming(settings(spool=before)) as gateway:
        assert await gateway.reload(settings(spool=after)) == ["spool changed"]
        servers["lab"].connection.send(packet(5, c3d_file(b"a file")))
        await settle()
        assert gateway.sources[0].spool.newest("lab") is not None
        assert await gateway.reload(settings("lab", "new", spool=after)) == ["source new added"]
        assert gateway.sources[1].spool is gateway.sources[0].spool
    assert not (tmp_path / "before").exists()
    assert (tmp_path / "after").exists()


async def test_stopping_waits_for_a_reload_and_then_closes_everything(
    servers: Servers, events: list[tuple[str, str]], threads: SlowThreads
) -> None:
    gateway, stop, task = started(settings("lab@first"))
    await gateway.opened.wait()
    await connected(gateway)
    threads.is_slow = True  # closing the old output takes long
    reload = asyncio.create_task(gateway.reload(settings("lab@second", example="new")))
    await settle()
    stop.set()
    await settle()
    assert not task.done()
    assert servers["first"].connection.is_open
    threads.is_slow = False
    threads.finish()
    await task
    assert reload.result() == ["output example changed", "source lab changed"]
    assert events[-1] == ("close", "new")
    assert not any(each.is_open for host in ("first", "second") for each in servers[host].connections)


async def test_no_reload_begins_after_stopping(servers: Servers) -> None:
    async with running(settings("lab@first")) as gateway:
        pass
    reload = asyncio.create_task(gateway.reload(settings("lab@second")))
    await settle()
    assert not reload.done()
    assert not servers["second"].connections
    reload.cancel()


async def test_two_reloads_run_one_after_the_other(servers: Servers, threads: SlowThreads) -> None:
    async with running(settings("lab@first")) as gateway:
        threads.is_slow = True
        first = asyncio.create_task(gateway.reload(settings("lab@first", example="new")))
        second = asyncio.create_task(gateway.reload(settings("lab@second", example="new")))
        await settle()
        assert not second.done()
        threads.is_slow = False
        threads.finish()
        assert await first == ["output example changed"]
        assert await second == ["source lab changed"]
        await connected(gateway)
        assert servers["second"].connection.is_open
