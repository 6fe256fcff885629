"""The RT server of a live source: when its measurement ends, who is served, and what is counted."""

import asyncio
import re
import weakref

import pytest

from gateway.outputs.adapters.rtc3d.client_filter import SLOW_CLIENT
from gateway.outputs.adapters.rtc3d.live_server import LiveScene
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.parameters import SECTIONS, General
from gateway.rtc3d.parameters_xml import parse_parameters
from tests.support.statuses import amounts
from tests.unit.outputs.adapters.rtc3d.scripted_server import (
    Client,
    ScriptedServer,
    body,
    frame_numbers,
    markers,
    parameters,
    settle,
)
from tests.unit.session.server.wire import COMMAND, ERROR, NO_DATA, XML

STREAM = "StreamFrames 3D"
OK_STREAM = (COMMAND, b"OK-StreamFrames 3D")
NO_FRAMES = (NO_DATA, b"")


async def streaming(server: ScriptedServer) -> Client:
    """Return a client that streams, after the first frame."""
    server.state.is_streaming = True
    client = server.client()
    await client.ask(STREAM)
    server.arrive(1)
    await settle()
    assert frame_numbers(client.receive()) == [1]
    return client


# Measurements -------------------------------------------------------------------------------


async def test_a_client_waits_two_seconds_for_a_new_source(server: ScriptedServer, client: Client) -> None:
    """The gateway may have to start its own stream first, so No Data at once would be wrong."""
    assert await client.ask(STREAM) == [OK_STREAM]
    await asyncio.sleep(0.5)
    server.state.parameters = parameters("m")
    server.apply_state()  # what is new of the source does not shorten the wait
    await asyncio.sleep(1.49)
    assert client.receive() == []
    await asyncio.sleep(0.02)
    assert client.receive() == [NO_FRAMES]
    assert not server.is_measuring
    await asyncio.sleep(5)
    assert client.receive() == []


async def test_without_a_measurement_no_data_comes_at_once_or_ends_the_wait(server: ScriptedServer) -> None:
    """As a server answers."""
    client = await server.greeted(STREAM)
    server.state.is_measuring = False
    server.apply_state()
    assert client.receive() == [NO_FRAMES]
    assert await server.client().ask(STREAM) == [OK_STREAM, NO_FRAMES]
    assert not server.is_measuring


async def test_a_frame_or_stream_of_the_source_ends_the_wait(server: ScriptedServer, client: Client) -> None:
    """The time-out of the request must not end the measurement, nor do gaps in a stream."""
    await client.ask(STREAM)
    server.arrive(1)
    await asyncio.sleep(10)
    assert (frame_numbers(client.receive()), server.is_measuring) == ([1], True)
    server = ScriptedServer()
    server.state.is_streaming = True
    client = await server.greeted(STREAM)
    client.receive()
    for _ in range(2):
        await asyncio.sleep(10)
        server.apply_state()
    assert (client.receive(), server.is_measuring) == ([], True)


async def test_a_measurement_ends_when_no_frame_has_come_for_a_moment(server: ScriptedServer) -> None:
    """Frames of a backlog come after the source has ended; each of them postpones No Data."""
    client = await streaming(server)
    server.state.is_streaming = False
    server.apply_state()
    await asyncio.sleep(0.06)
    server.arrive(2)
    await asyncio.sleep(0.06)
    server.arrive(3)
    await asyncio.sleep(0.09)
    assert frame_numbers(client.receive()) == [2, 3]
    await asyncio.sleep(0.2)
    assert client.receive() == [NO_FRAMES]
    server.arrive(4)
    await settle()
    assert frame_numbers(client.receive()) == [4]
    server.apply_state()
    await asyncio.sleep(0.2)
    assert client.receive() == [NO_FRAMES]


async def test_a_source_that_has_been_silent_ends_at_once(server: ScriptedServer) -> None:
    """Clients must not wait for what is known."""
    client = await streaming(server)
    await asyncio.sleep(0.11)
    server.state.is_streaming = False
    server.apply_state()
    assert client.receive() == [NO_FRAMES]


async def test_closing_ends_everything_and_nobody_wants_frames(server: ScriptedServer) -> None:
    """A source must not go on sending for clients that are gone."""
    await server.listen()
    client = await streaming(server)
    await server.close()
    assert client.receive() == [NO_FRAMES]
    assert client.line.is_closed
    assert server.changes == [True, False]


# Parameters ---------------------------------------------------------------------------------


async def test_a_request_waits_for_parameters(server: ScriptedServer, client: Client) -> None:
    """A client that comes with the gateway's start would otherwise get an error."""
    assert await client.ask("SendParameters 3D", "Version 1.0") == []
    await asyncio.sleep(0.9)
    server.state.parameters = parameters("heel")
    server.apply_state()
    await settle()
    (kind, xml), version = client.receive()
    assert (kind, version) == (XML, (COMMAND, b"OK-Version 1.0"))
    assert b"heel" in xml


async def test_a_request_for_parameters_waits_for_one_second(server: ScriptedServer, client: Client) -> None:
    """Anything that is known of the source ends the wait: it answers, and will give none later."""
    assert await client.ask("SendParameters") == []
    await asyncio.sleep(1)
    assert client.receive() == [(ERROR, b"Error-The server of source lab has given no parameters")]
    for known in ("is_streaming", "is_measuring"):
        server = ScriptedServer()
        setattr(server.state, known, known == "is_streaming")
        assert (await server.client().ask("SendParameters"))[0][0] == ERROR


async def test_the_newest_parameters_are_served_at_once(server: ScriptedServer, client: Client) -> None:
    """Parameters and frames of one moment belong together."""
    for label in ("heel", "toe"):
        server.state.parameters = parameters(label)
        [(_, xml)] = await client.ask("SendParameters 3D")
        assert label.encode() in xml
    await client.ask(STREAM)
    server.state.parameters = parameters("knee")
    server.arrive(1)
    assert server.scene.parameters is server.state.parameters.parsed


# Which frames are wanted --------------------------------------------------------------------


async def test_frames_are_wanted_while_any_client_asks_for_some(server: ScriptedServer) -> None:
    """The gateway's own stream depends on it; each change is reported once."""
    first, second = server.client(), server.client()
    await first.ask("Version 1.0")
    assert server.changes == []
    await first.ask(STREAM)
    await second.ask(STREAM)
    await first.ask("StreamFrames Stop")
    assert server.changes == [True]
    second.line.abort()
    await settle()
    assert server.changes == [True, False]


async def test_a_request_is_wanted_until_it_is_answered(server: ScriptedServer, client: Client) -> None:
    """Otherwise the source would send for nobody."""
    await client.ask("SendCurrentFrame 3D")
    assert server.changes == [True]
    server.arrive(1)
    assert server.changes == [True, False]
    server.arrive(2)  # in the queue when the last request ended
    await settle()
    assert frame_numbers(client.receive()) == [1]
    client = await server.greeted()
    assert await client.ask("SendCurrentFrame 3D") == [(COMMAND, b"OK-SendCurrentFrame 3D")]  # no old frame
    server.arrive(3)
    assert frame_numbers(client.receive()) == [3]


async def test_maintenance_corrects_what_another_server_of_the_source_said(server: ScriptedServer) -> None:
    """After a change of the port, the former server says last that nothing is wanted."""
    await streaming(server)
    server.state.wanted = False
    server.maintain()
    assert server.changes == [True, True]


async def test_a_frame_is_sent_when_it_arrives_even_if_others_came_in_the_same_moment() -> None:
    """The times of frames grow with each of them, so they can be ahead of the clock."""
    server = ScriptedServer()
    client = await streaming(server)
    server._live_scene._arrivals.newest_us = 10**12
    server.arrive(2)
    assert frame_numbers(client.receive()) == [2]


# Scenes -------------------------------------------------------------------------------------


def test_a_choice_of_components_stays_a_bit_longer_than_its_client() -> None:
    """A client that asks for one frame after the other must not begin anew each time."""
    scene = LiveScene("lab")
    kept = [weakref.ref(scene.frames([kind])) for kind in WIRE_ORDER[:3]]
    assert [each() is None for each in kept] == [True, False, False]
    scene.stop()
    assert [each() for each in kept] == [None] * 3
    held = scene.frames([])
    scene.stop()  # a new measurement begins with new frames
    assert scene.frames([]) is not held


def test_a_scene_says_when_the_first_of_several_frames_is_due_and_that_there_are_some() -> None:
    """Clients with several choices share one timer."""
    scene = LiveScene("lab")
    scene.start()
    scene._announced_hz = {ComponentType.TOOLS: 100.0}
    choices = [
        scene.frames([ComponentType.MARKERS]),
        scene.frames([ComponentType.MARKERS, ComponentType.TOOLS]),
    ]
    scene.add(split_frame(body(markers(1, 10)), "big"), 1, frozenset(WIRE_ORDER), 50)
    assert scene.advance(50) == 50 + 100_000
    assert scene.advance(100_050) == 50 + 300_000
    assert scene.has_new_frames
    scene.advance(100_051)
    assert scene.has_new_frames  # until somebody has taken them
    assert [each.next_frame for each in choices] == [1, 0]


def test_frames_wait_only_for_components_that_the_parameters_have() -> None:
    """A rate without any item announces nothing."""
    scene = LiveScene("lab")
    for num_markers, announced in ((1, {ComponentType.MARKERS: 100.0}), (0, {})):
        xml = parameters("heel").xml.replace(b"<Markers>1<", f"<Markers>{num_markers}<".encode())
        xml = xml if num_markers else re.sub(b"<Marker>.*</Marker>", b"", xml)
        scene.set_parameters(xml, parse_parameters(xml).parameters)
        assert scene._announced_hz == announced


def test_the_whole_parameters_are_the_servers_own_bytes() -> None:
    """Even if a client names all sections; changed parameters replace them."""
    scene = LiveScene("lab")
    for label in ("heel", "toe"):
        new = parameters(label)
        scene.set_parameters(new.xml, new.parsed)
        for sections in ((), tuple(SECTIONS)):
            assert scene.parameters_xml(sections, General()) is new.xml
        assert label.encode() in scene.parameters_xml(["3d"], General())


# Limits -------------------------------------------------------------------------------------


async def test_clients_that_are_too_many_are_turned_away() -> None:
    """The limit counts exactly, and those that are served notice nothing."""
    server = ScriptedServer(max_clients=2)
    first, second = await server.greeted(), await server.greeted()
    third = server.client()
    await settle()
    assert third.receive() == [(ERROR, b"Error-This gateway serves 2 clients at most; closing")]
    assert (first.line.is_closed, second.line.is_closed, third.line.is_closed) == (False, False, True)
    second.line.close()
    await settle()
    fourth = await server.greeted()
    assert not fourth.line.is_closed


async def test_the_oldest_silent_connection_makes_room_for_a_client() -> None:
    """Half-open connections must not lock clients out; each makes room only once."""
    server = ScriptedServer(max_clients=3)
    good = await server.greeted()
    silent = [server.client(), server.client()]
    newest = [server.client(), server.client()]
    assert [each.line.is_aborted for each in (good, *silent, *newest)] == [False, True, True, False, False]
    await settle()
    assert len(server.connections) == 3


@pytest.mark.parametrize(("max_clients", "most"), [(8, 4 * 2**20), (1000, 512 * 2**20 // 1000)])
async def test_what_waits_for_all_clients_together_has_a_limit(max_clients: int, most: int) -> None:
    """The gateway's memory is bounded however many clients do not read."""
    assert ScriptedServer(max_clients).client().line.high_water == most


# Losses -------------------------------------------------------------------------------------


async def test_each_lost_frame_of_a_client_is_counted_once(server: ScriptedServer) -> None:
    """Losses are per source: those of its clients add up, whether they are still there or not."""
    first, second = await server.greeted(), await server.greeted()
    first.connection.session.frames_dropped = 5
    server.maintain()
    server.maintain()
    assert amounts(server.losses.report()) == {SLOW_CLIENT: (5, 5)}
    second.connection.session.frames_dropped = 2
    second.line.close()
    await settle()
    assert amounts(server.losses.report()) == {SLOW_CLIENT: (7, 7)}
    first.connection.session.frames_dropped = 6
    server.reading_resumed(first.connection)
    server.maintain()
    assert amounts(server.losses.report()) == {SLOW_CLIENT: (8, 8)}
    for count in (3, 3, 4):
        first.connection.session.frames_without_events = count
        server.maintain()
    assert amounts(server.losses.report()) == {SLOW_CLIENT: (12, 12)}
