"""The doctor against servers that are well, odd, wrong and absent; each remedy is what it should be."""

import asyncio
import re
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.doctor.finding import Result
from gateway.rtc3d.commands import Frequency, FrequencyDivisor, Rate
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d_server.server import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests import networks, servers
from tests.findings import Findings, found, lab
from tests.servers import Client, ScriptedServer, markers_frame, ok, packet

MARKERS, TOOLS, ANALOG = ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.ANALOG
FORCE, EVENT = ComponentType.FORCE, ComponentType.EVENT
NAN = float("nan")

MARKERS_XML = (
    "<The_3D><Frequency>{}</Frequency><Markers><Marker id='1'><Label>hip</Label></Marker>"
    "<Marker id='2'><Label>knee</Label></Marker></Markers></The_3D>"
)
TOOLS_XML = (
    "<The_6D><Frequency>100</Frequency><Tools><Tool id='1'><Label>probe</Label></Tool></Tools></The_6D>"
)


def parameters(*sections: str) -> bytes:
    return packet(2, f"<RT_Parameters Ver='1.00'>{''.join(sections)}</RT_Parameters>")


async def examined(script: servers.Script, *streams: StreamSettings, **keys: Any) -> Findings:
    """Return what is found of a scripted server."""
    async with ScriptedServer(script) as server:
        return await found(lab(server.port, *streams, **keys))


def answering(xml: bytes, *frames: bytes, refused: str = "-") -> servers.Script:
    """Return a server that knows every command but those that match, and sends frames once."""

    async def script(client: Client) -> None:
        def answer(command: str) -> bytes:
            if re.match(refused, command):
                return servers.error("err-unknown command")
            if command.startswith("SendParameters"):
                return xml
            return ok(f"OK-{command}") + (b"".join(frames) if command.startswith("StreamFrames") else b"")

        await client.commands(answer)

    return script


def streaming(xml: bytes, frame: Callable[[int], bytes], step: int = 10) -> servers.Script:
    """Return a server that sends a frame every 10 ms, numbered in steps: so many ms by its own clock."""

    async def script(client: Client) -> None:
        while not (command := await client.command()).startswith("StreamFrames"):
            client.send(xml if command.startswith("SendParameters") else ok(f"OK-{command}"))
        client.send(ok(f"OK-{command}"))
        number = 0
        while not client._writer.is_closing():
            client.send(frame(number))
            number += step
            await asyncio.sleep(0.01)

    return script


def tools_frame(number: int, *xs: float) -> bytes:
    items = b"".join(struct.pack(">8f", 1, 0, 0, 0, x, 0, 0, 0.1) for x in xs)
    component = struct.pack(">IIiqI", 24 + len(items), 4, number, 1000 * number, len(xs)) + items
    return packet(3, struct.pack(">I", 1) + component)


async def test_a_healthy_server_is_green_in_every_layer() -> None:
    scene = SyntheticScene(markers=3, tools=1, analog=4, plates=1, rate_hz=200, analog_rate_hz=1000)
    streams = (StreamSettings(components=(MARKERS, TOOLS, EVENT)), StreamSettings(components=(ANALOG, FORCE)))
    async with Simulator(scene) as simulator:
        findings = await found(lab(simulator.port, *streams))
    assert {each.result for each in findings.all if each.subject == "lab"} == {Result.GREEN}
    texts = [(each.check, each.found) for each in findings.all if each.subject == "lab"]
    frames = [text for check, text in texts if check == "frames"]
    assert re.fullmatch(r"\d+ frames with 3d, 6d(, event)?; messages of \d+ bytes at most", frames[0])
    assert re.fullmatch(r"\d+ frames with analog, force; messages of \d+ bytes at most", frames[1])
    for text in (
        ("name", "127.0.0.1 is an address"),
        ("TCP", f"127.0.0.1:{simulator.port} accepts 2 connections, one per stream"),
        ("protocol", "the server answers every command"),
        ("parameters", "3 markers, 1 tool, 4 analog channels, 1 force plate, 1 kind of events"),
        ("rate", "3d 200 of 200, 6d 200 of 200 Hz"),
        ("rate", "analog 1000 of 1000, force 1000 of 1000 Hz"),
        ("visibility", "in view: markers 100%, tools 100%"),
    ):
        assert text in texts
    assert findings.of("file", "configuration").found == "lab.yaml: lab to LCM"


async def test_a_name_is_resolved() -> None:
    async with Simulator(SyntheticScene(markers=1)) as simulator:
        findings = await found(lab(simulator.port, host="localhost"))
    assert findings.of("name").result is Result.GREEN
    assert "127.0.0.1" in findings.of("name").found


async def test_an_unknown_name_is_red_and_ends_the_examination_of_its_source() -> None:
    scene = SyntheticScene(markers=1, tools=0, analog=0, plates=0)
    async with Simulator(scene) as simulator:
        other = SourceSettings(name="other", host="127.0.0.1", port=simulator.port)
        findings = await found(lab(3020, host="no-such-host.invalid"), other)
    finding = findings.of("name")
    assert finding.found.startswith("the host name 'no-such-host.invalid' is not known: ")
    assert finding.remedy == (
        "Correct the source's host, or add the name to DNS or /etc/hosts; an address needs neither."
    )
    assert findings.red() == ["name"]
    later = ("TCP", "protocol", "parameters", "frames", "rate", "visibility")
    assert findings.reasons(*later) == {"it needs name, which failed"}
    assert findings.red("other") == []


async def test_nobody_listening_is_red() -> None:
    port = networks.free_port()
    findings = await found(lab(port))
    assert findings.of("TCP").found == f"connection refused by 127.0.0.1:{port}"
    assert findings.of("TCP").remedy == "Is the RT server running, and is this its port?"
    assert findings.red() == ["TCP"]
    later = ("protocol", "parameters", "frames", "rate", "visibility")
    assert findings.reasons(*later) == {"it needs TCP, which failed"}


async def test_a_computer_that_does_not_answer_is_red() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=0) as full:
        address = full.getsockname()
        with contextmanager(_filled)(address):
            findings = await found(lab(address[1], connect_timeout_s=0.2))
    assert findings.of("TCP").found == f"no answer from 127.0.0.1:{address[1]} within 0.2 s"
    assert findings.of("TCP").remedy == (
        "Is the computer on and reachable, and its firewall open for this port?"
    )


def _filled(address: tuple[str, int]) -> Iterator[None]:
    """Fill a listener's queue: further connections get no answer."""
    waiting = [socket.socket() for _ in range(4)]
    for each in waiting:
        each.setblocking(False)
        each.connect_ex(address)
    try:
        yield
    finally:
        for each in waiting:
            each.close()


async def test_a_web_server_is_told_by_its_words() -> None:
    async def script(client: Client) -> None:
        client.send(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        await client.command()

    async with ScriptedServer(script) as server:
        findings = await found(lab(server.port))
    assert findings.of("protocol").found == (
        f"what answers at 127.0.0.1:{server.port} is no RT server; "
        "it begins with 'HTTP/1.1 400 Bad Request····'"
    )
    assert findings.of("protocol").remedy == (
        "Point host and port at the RT server: 3020 is First Principles, 3030 WaveFront."
    )
    assert findings.red() == ["protocol"]
    assert findings.reasons("parameters", "frames", "rate") == {"it needs protocol, which failed"}


async def test_a_server_that_says_nothing_is_red() -> None:
    findings = await examined(lambda client: client.commands(lambda _command: None))
    assert findings.of("protocol").found.endswith("accepts a connection and then says nothing")
    assert findings.of("protocol").remedy == (
        "Point host and port at the RT server (3020 is First Principles, 3030 WaveFront); "
        "if they are right, restart it."
    )


async def test_a_server_that_hangs_up_is_red() -> None:
    async def script(client: Client) -> None:
        await client.command()
        client.cut()

    findings = await examined(script)
    assert "the connection to 127.0.0.1:" in findings.of("protocol").found
    assert findings.of("protocol").remedy == (
        "Is this the RT server's port, and does it take one more client? End other programs that are "
        "connected, and look into the server's own messages (3020 is First Principles, 3030 WaveFront)."
    )


async def test_a_server_that_refuses_to_stream_is_red() -> None:
    findings = await examined(answering(parameters(), refused="StreamFrames"))
    assert "refuses to stream in every form" in findings.of("protocol").found
    assert findings.of("protocol").remedy == "Switch on the real-time output in the server's settings."


async def test_what_a_server_refuses_is_told_and_done_without() -> None:
    frames = [markers_frame(number, (1.0, 2.0, 3.0)) for number in range(0, 100, 10)]
    script = answering(b"", *frames, refused="Version|SendParameters")
    findings = await examined(script)
    assert findings.of("protocol").result is Result.GREEN
    assert findings.of("protocol").found == (
        "the server is an RT server; the gateway does without this: the server refused Version 1.0: "
        "err-unknown command; the server refused SendParameters: err-unknown command"
    )
    assert findings.reasons("parameters") == {
        "the server refused SendParameters: err-unknown command; names, units and announced rates are unknown"
    }
    assert findings.of("frames").result is Result.GREEN
    assert findings.reasons("rate") == {"3d 100 Hz; the server announces none to compare with"}


async def test_parameters_that_cannot_be_read_are_red() -> None:
    findings = await examined(answering(packet(2, "no xml"), markers_frame(1, (1.0, 2.0, 3.0))))
    assert findings.of("parameters").found.startswith("the server's XML cannot be read: ")
    assert findings.of("parameters").remedy == (
        "The gateway streams without names and units. Look for odd characters in the names of markers "
        "and tools on the server, or update its software."
    )
    assert findings.of("frames").result is Result.GREEN


async def test_parameters_that_had_to_be_repaired_are_told() -> None:
    findings = await examined(answering(packet(2, "<RT_Parameters><The_3D></The_6D>"), markers_frame(1)))
    assert findings.of("parameters").result is Result.GREEN
    assert "(repaired: " in findings.of("parameters").found


async def test_no_measurement_is_red() -> None:
    async with Simulator(SyntheticScene(markers=1)) as simulator:
        simulator.stop_measurement()
        findings = await found(lab(simulator.port))
    assert findings.of("frames").found == "the server says that no measurement runs"
    assert findings.of("frames").remedy == (
        "Start one on the server; the gateway waits for it and then streams by itself."
    )
    assert findings.red() == ["frames"]
    assert findings.reasons("rate") == {"too few frames to tell it"}
    assert findings.reasons("visibility") == {"no markers or tools came"}


async def test_no_frames_without_a_reason_are_red() -> None:
    findings = await examined(answering(parameters()), StreamSettings(components=(MARKERS, TOOLS)))
    assert findings.of("frames").found == ("no frame of 3d 6d came, and no word that no measurement runs")
    assert findings.of("frames").remedy.startswith("Look whether the server shows live data")


async def test_no_event_is_no_fault() -> None:
    findings = await examined(answering(parameters()), StreamSettings(components=(EVENT,)))
    assert findings.reasons("frames") == {"events come when they come, and none came meanwhile"}
    assert findings.red() == []


async def test_frames_that_contradict_themselves_are_red() -> None:
    good = markers_frame(1, (1.0, 2.0, 3.0))
    findings = await examined(answering(parameters(), good, packet(3, good[8:-4])))
    assert findings.of("frames").found.startswith("1 of 2 frames contradict themselves: component 1 of 1")
    assert findings.of("frames").remedy == (
        "The gateway drops such frames. Update the server's software, or tell its maker of this."
    )


async def test_what_is_announced_and_does_not_come_is_red() -> None:
    xml = parameters(MARKERS_XML.format(100), TOOLS_XML)
    findings = await examined(answering(xml, markers_frame(1, (1.0, 2.0, 3.0))))
    assert findings.of("frames").found == ("the server announces 6d, was asked for it, and does not send it")
    assert findings.of("frames").remedy == (
        "Switch on the real-time output of 6d on the server, or take it out of the stream's components."
    )


async def test_a_connection_that_ends_while_frames_come_is_red() -> None:
    async def script(client: Client) -> None:
        def answer(command: str) -> bytes:
            if command.startswith("StreamFrames"):
                asyncio.get_running_loop().call_later(0.05, client.cut)
            return ok(f"OK-{command}")

        await client.commands(answer)

    findings = await examined(script)
    assert findings.of("frames").found == "the server ended the connection while frames were awaited"
    assert findings.of("frames").remedy == (
        "Is another program taking the stream over? Look into the server's own messages."
    )


async def test_a_component_held_back_by_a_slower_one_is_red() -> None:
    scene = SyntheticScene(markers=1, tools=0, analog=2, plates=1, rate_hz=100, analog_rate_hz=1000)
    async with Simulator(scene) as simulator:
        findings = await found(lab(simulator.port))
    assert findings.of("rate").found == "3d 100 of 100, analog 100 of 1000, force 100 of 1000 Hz"
    assert findings.of("rate").remedy == (
        "A stream is as fast as its slowest component: put analog and force into another one in the "
        "source's streams, or ask for a lower rate."
    )


async def test_a_server_that_does_not_keep_up_is_red() -> None:
    script = streaming(parameters(MARKERS_XML.format(500)), lambda number: markers_frame(number, (1, 2, 3)))
    findings = await examined(script)
    assert findings.of("rate").found == "3d 100 of 500 Hz"
    assert findings.of("rate").remedy == (
        "The server does not keep up, or the network: look at its real-time processing rate and load, "
        "at the cable and switch; or ask for less with the stream's rate."
    )


@pytest.mark.parametrize(
    ("rate", "text"), [(FrequencyDivisor(4), "3d 50 of 50 Hz"), (Frequency(20), "3d 20 of 20 Hz")]
)
async def test_a_lower_rate_on_purpose_is_no_fault(rate: Rate, text: str) -> None:
    scene = SyntheticScene(markers=1, tools=0, analog=0, plates=0, rate_hz=200)
    async with Simulator(scene) as simulator:
        findings = await found(lab(simulator.port, StreamSettings(components=(MARKERS,), rate=rate)))
    assert (findings.of("rate").result, findings.of("rate").found) == (Result.GREEN, text)


async def test_time_stamps_that_stand_still_do_not_count() -> None:
    frame = markers_frame(7, (1.0, 2.0, 3.0))
    findings = await examined(streaming(parameters(MARKERS_XML.format(1)), lambda _number: frame))
    assert findings.of("rate").result is Result.GREEN  # some 100 Hz as they came, of 1 Hz


async def test_time_stamps_that_are_no_microseconds_do_not_count() -> None:
    # 1 ms from frame to frame by its own clock, 10 ms by this computer's.
    script = streaming(
        parameters(MARKERS_XML.format(900)), lambda number: markers_frame(number, (1, 2, 3)), step=1
    )
    findings = await examined(script)
    assert findings.of("rate").result is Result.RED  # some 100 Hz as they came, of 900 Hz


async def test_markers_out_of_view_are_red() -> None:
    gone = markers_frame(1, (NAN, NAN, NAN), (NAN, NAN, NAN))
    findings = await examined(answering(parameters(MARKERS_XML.format(100)), gone))
    assert findings.of("visibility").found == "in view: markers 0%"
    assert findings.of("visibility").remedy == (
        "Look whether the cameras see the volume, markers are in it and not covered, and strobers are "
        "on and charged."
    )


async def test_who_is_never_in_view_is_named() -> None:
    frames = [markers_frame(n, (NAN, NAN, NAN), (1.0, 2.0, 3.0), (NAN, NAN, NAN)) for n in (1, 2)]
    frames += [markers_frame(n, (1.0, 2.0, 3.0), (1.0, 2.0, 3.0), (NAN, NAN, NAN)) for n in (3, 4)]
    labels = MARKERS_XML.format(1000)
    findings = await examined(answering(parameters(labels), *frames))
    assert findings.of("visibility").found == "in view: markers 50% (never number 3)"
    findings = await examined(answering(parameters(labels), *frames[:2]))
    assert findings.of("visibility").found == "in view: markers 33% (never hip, number 3)"


async def test_tools_out_of_view_are_red() -> None:
    findings = await examined(answering(parameters(TOOLS_XML), tools_frame(1, NAN), tools_frame(2, NAN)))
    assert findings.of("visibility").found == "in view: tools 0%"
    assert findings.of("visibility").result is Result.RED
