"""The doctor's findings and remedies for healthy, unusual, wrong and missing servers."""

import asyncio
import re
import socket
import struct
from contextlib import ExitStack
from typing import Any, Final

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.outputs.findings import Result
from gateway.rtc3d.commands import Frequency, FrequencyDivisor, Rate
from gateway.rtc3d.components import ComponentType
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.support.errors import names
from tests.support.findings import (
    MARKERS_XML,
    TOOLS_XML,
    diagnose,
    lab,
    parameters,
    replying,
    run_doctor,
    streaming,
)
from tests.support.findings import tools_frame as tools
from tests.support.networks import free_port
from tests.support.servers import Client, Script, ScriptedServer, markers_frame, ok, packet

MARKERS, TOOLS, ANALOG = ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.ANALOG
FORCE, EVENT = ComponentType.FORCE, ComponentType.EVENT
PASSING, NOTE, WARNING, FAILING = Result.PASSING, Result.NOTE, Result.WARNING, Result.FAILING
CHECKS: Final = ("name", "TCP", "protocol", "parameters", "frames", "rate", "buffer", "visibility")
HIP: Final = (1.0, 2.0, 3.0)
GONE: Final = (float("nan"),) * 3
GOOD: Final = markers_frame(1, HIP)
NO_DATA: Final = packet(4)
XML: Final = {hz: parameters(MARKERS_XML.format(hz)) for hz in (1, 50, 100, 500, 900, 1000)}
WITH_TOOLS: Final = parameters(MARKERS_XML.format(100), TOOLS_XML)
FASTER_TOOLS: Final = parameters(MARKERS_XML.format(100), TOOLS_XML.replace("100", "200"))
FURLONGS: Final = parameters("<The_3D><Frequency>100</Frequency><Unit>furlong</Unit><Markers/></The_3D>")


def markers(number: int) -> bytes:
    return markers_frame(number, HIP)


def little_endian(number: int) -> bytes:
    return markers_frame(number, HIP, order="<")


def markers_and_tools(number: int) -> bytes:
    """Return a frame with both components. In a packet, they begin at byte 12."""
    return packet(3, struct.pack(">I", 2) + markers(number)[12:] + tools(number, 1.0)[12:])


FRAMES: Final = [markers(number) for number in range(0, 100, 10)]
NEVER_SEEN: Final = [markers_frame(number, GONE, HIP, GONE) for number in (1, 2)]
SEEN_LATER: Final = [markers_frame(number, HIP, HIP, GONE) for number in (3, 4)]


async def web_server(client: Client) -> None:
    client.send(b"HTTP/1.1 400 Bad Request\r\n\r\n")
    await client.command()


async def silent(client: Client) -> None:
    await client.commands(lambda _command: None)


async def disconnecting(client: Client) -> None:
    await client.command()
    client.cut()


async def ending_after_the_last_reply(client: Client) -> None:
    def answer(command: str) -> bytes:
        if command.startswith("StreamFrames"):
            asyncio.get_running_loop().call_soon(client.end)
        return XML[100] if command.startswith("SendParameters") else ok(f"OK-{command}")

    await client.commands(answer)


def of(*components: ComponentType, rate: Rate | None = None) -> tuple[StreamSettings, ...]:
    """Return a stream, of all components by default."""
    given: dict[str, Any] = {"components": components or None, "rate": rate}
    return (StreamSettings(**{key: value for key, value in given.items() if value}),)


def case(result: Result, server: Script, check: str, found: str, remedy: str = "", **keys: Any) -> Any:
    """Return a value that the doctor finds out about a server, and one in the remedy if there must be one.

    ``keys`` are settings of the source.
    """
    return pytest.param(result, server, check, found, remedy, keys, id=f"{check}: {found}")


@pytest.mark.parametrize(
    ("result", "server", "check", "found", "remedy", "keys"),
    [
        case(FAILING, web_server, "protocol", "'HTTP/1.1 4", "3020"),
        case(
            *(
                FAILING,
                silent,
                "protocol",
                "sends nothing",
                "restart",
            ),
            reply_timeout_s=0.1,
        ),
        case(FAILING, disconnecting, "protocol", "the connection to 127.0.0.1:", "client"),
        case(
            *(FAILING, replying(parameters(), refused="StreamFrames"), "protocol"),
            *("StreamFrames", "real-time output"),
        ),
        case(PASSING, replying(b"", *FRAMES, refused="Version|SendParameters"), "protocol", "SendParameters"),
        case(
            *(FAILING, replying(packet(2, "no xml"), GOOD), "parameters"),
            *("XML", "names and units"),
        ),
        case(
            PASSING, replying(packet(2, "<RT_Parameters><The_3D></The_6D>"), GOOD), "parameters", "(repaired"
        ),
        case(
            *(WARNING, replying(FURLONGS, GOOD), "parameters"),
            *("'furlong'", "transform.units"),
        ),
        case(PASSING, replying(FURLONGS, GOOD), "parameters", "0 markers", transform={"units": "mm"}),
        case(
            *(FAILING, replying(parameters(), NO_DATA), "frames"),
            *("no measurement", "Start a measurement"),
        ),
        case(
            *(FAILING, replying(parameters()), "frames"),
            *("3d 6d", "server"),
            streams=of(MARKERS, TOOLS),
        ),
        case(
            *(Result.NOT_TESTED, replying(parameters()), "frames", "no event"),
            streams=of(EVENT),
        ),
        case(
            *(FAILING, replying(parameters(), GOOD, packet(3, GOOD[8:-4])), "frames"),
            *("1 of 2 frames", "malformed"),
        ),
        case(
            *(FAILING, replying(WITH_TOOLS, GOOD), "frames", "6d", "components"),
            streams=of(MARKERS, TOOLS),
        ),
        *(
            case(
                *(NOTE, streaming(WITH_TOOLS, markers), "frames", "6d", "6d"),
                streams=streams,
            )
            for streams in ("auto", of())
        ),
        case(
            *(FAILING, streaming(parameters(), markers), "frames"),
            *("stream 6d", ""),
            streams=of(TOOLS),
        ),
        case(
            *(FAILING, ending_after_the_last_reply, "frames"),
            *("closed the connection", "takes over"),
        ),
        case(
            *(FAILING, replying(XML[100], *FRAMES, NO_DATA), "frames"),
            *("no measurement", ""),
        ),
        case(FAILING, streaming(XML[500], markers), "rate", "3d 100 of 500 Hz", "too slow"),
        case(FAILING, streaming(XML[50], markers), "rate", "50 Hz: the server sends more"),
        case(FAILING, streaming(XML[1], lambda _: GOOD), "rate", "of 1 Hz: the server sends more"),
        case(FAILING, streaming(XML[900], markers, step=1), "rate", " of 900 Hz"),
        *(
            case(
                *(FAILING, streaming(xml, markers), "rate"),
                *("3d 100 of 25 Hz", ""),
                streams=of(rate=Frequency(25)),
            )
            for xml in (XML[100], parameters())
        ),
        *(
            case(
                *(result, streaming(b"", markers, refused="SendParameters"), "rate", f"3d 100 of {hz:g} Hz"),
                streams=of(rate=Frequency(hz)),
            )
            for result, hz in ((PASSING, 100), (FAILING, 200))
        ),
        case(
            NOTE, streaming(parameters(), markers), "rate", "divisor 2", streams=of(rate=FrequencyDivisor(2))
        ),
        *(
            case(
                *(WARNING, streaming(XML[100], frame), "byte order"),
                *(f"{sent}-endian frames", f"byte_order: {sent}"),
                byte_order=wanted,
            )
            for wanted, sent, frame in (("big", "little", little_endian), ("little", "big", markers))
        ),
        case(
            *(PASSING, streaming(XML[100], little_endian), "byte order"),
            *("little-endian", ""),
            byte_order="little",
        ),
        case(
            *(FAILING, replying(XML[100], markers_frame(1, GONE, GONE)), "visibility"),
            *("in view: markers 0%", "cameras"),
        ),
        case(
            *(FAILING, replying(XML[1000], *NEVER_SEEN), "visibility"),
            *("markers 33% (never hip, number 3)",),
        ),
        case(
            *(PASSING, replying(XML[1000], *NEVER_SEEN, *SEEN_LATER), "visibility"),
            *("markers 50% (never number 3)",),
        ),
        case(
            *(FAILING, replying(parameters(TOOLS_XML), tools(1, GONE[0]), tools(2, GONE[0])), "visibility"),
            *("in view: tools 0%",),
        ),
    ],
)
async def test_what_is_found_about_a_server(
    result: Result, server: Script, check: str, found: str, remedy: str, keys: dict[str, Any]
) -> None:
    """Each fault has its check, result and values; without the protocol, nothing else is checked."""
    findings = await diagnose(server, **keys)
    finding = findings.of(check)
    assert (finding.result, found in finding.found, remedy in finding.remedy) == (result, True, True), finding
    assert (check in findings.failing()) is (result is FAILING)
    if check == "protocol" and result is FAILING:
        assert findings.failing() == [check]
        [reason] = findings.not_tested(*CHECKS[3:])
        assert names(reason, "protocol")


async def test_a_healthy_server_passes_every_check() -> None:
    scene = SyntheticScene(markers=3, tools=1, analog=4, plates=1, rate_hz=20, analog_rate_hz=100)
    async with Simulator(scene) as simulator:
        findings = await run_doctor(lab(simulator.port, *of(MARKERS, TOOLS, EVENT), *of(ANALOG, FORCE)))
    assert {each.result for each in findings.all if each.subject == "lab"} == {PASSING}
    assert [each.stream for each in findings.all_of("frames")] == ["3d 6d event", "analog force"]
    assert {each.stream for each in findings.all_of("protocol")} == {""}
    texts = [(each.check, each.found) for each in findings.all if each.subject == "lab"]
    frames = [text for check, text in texts if check == "frames"]
    assert re.match(r"\d+ frames with 3d, 6d(, event)?; .* \d+ bytes", frames[0])
    assert re.match(r"\d+ frames with analog, force; .* \d+ bytes", frames[1])
    assert names(dict(texts)["TCP"], f"127.0.0.1:{simulator.port}", "2 connections")
    assert set(texts) >= {
        ("parameters", "3 markers, 1 tool, 4 analog channels, 1 force plate, 1 event type"),
        ("rate", "3d 20 of 20, 6d 20 of 20 Hz"),
        ("rate", "analog 100 of 100, force 100 of 100 Hz"),
    }
    assert re.fullmatch(r"in view: markers \d+%, tools \d+%", dict(texts)["visibility"])
    assert findings.of("file", "configuration").found == "lab.yaml: lab to lcm"


async def test_an_unknown_host_name_ends_the_checks_of_its_source_only() -> None:
    async with Simulator(SyntheticScene(markers=1, tools=0, analog=0, plates=0)) as simulator:
        other = SourceSettings(name="other", host="localhost", port=simulator.port)
        findings = await run_doctor(lab(3020, host="no-such-host.invalid"), other)
    assert names(findings.of("name").found, "'no-such-host.invalid'")
    assert names(findings.of("name").remedy, "host", "DNS")
    assert findings.failing() == ["name"]
    [reason] = findings.not_tested(*CHECKS[1:])
    assert names(reason, "name")
    assert findings.failing("other") == []
    assert "127.0.0.1" in findings.of("name", "other").found


@pytest.mark.netns
@pytest.mark.parametrize(("configured", "answering"), [(3030, 3020), (3020, 3030), (3021, 3030)])
async def test_the_usual_port_that_answers_is_named(configured: int, answering: int) -> None:
    """A laboratory that changed from First Principles to WaveFront needs one number."""
    with socket.create_server(("127.0.0.1", answering)):
        findings = await run_doctor(lab(configured, connect_timeout_s=5.0))
    assert findings.failing() == ["TCP"]
    assert str(configured) in findings.of("TCP").found
    assert re.findall(r"Port (\d+)", findings.of("TCP").remedy) == [str(answering)]


@pytest.mark.netns
async def test_both_usual_ports_are_named_if_both_answer() -> None:
    with socket.create_server(("127.0.0.1", 3020)), socket.create_server(("127.0.0.1", 3030)):
        findings = await run_doctor(lab(3021, connect_timeout_s=5.0))
    assert re.findall(r"Ports (\d+) and (\d+)", findings.of("TCP").remedy) == [("3020", "3030")]


@pytest.mark.parametrize("is_full", [False, True], ids=["refused", "no answer"])
async def test_a_server_that_does_not_accept_connections_fails(is_full: bool) -> None:
    found, remedy, port = "refused", "RT server", free_port()
    with ExitStack() as stack:
        if is_full:  # the queue of a listener: further connections get no answer
            found, remedy = "no answer", "firewall"
            full = stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=0))
            port = full.getsockname()[1]
            for _ in range(4):
                waiting = stack.enter_context(socket.socket())
                waiting.setblocking(False)
                waiting.connect_ex(full.getsockname())
        findings = await run_doctor(lab(port, connect_timeout_s=0.2))
    assert names(findings.of("TCP").found, found, f"127.0.0.1:{port}")
    assert names(findings.of("TCP").remedy, remedy)
    assert findings.failing() == ["TCP"]
    [reason] = findings.not_tested(*CHECKS[2:])
    assert names(reason, "TCP")


async def test_what_needs_parameters_is_not_tested_without_them() -> None:
    findings = await diagnose(replying(b"", *FRAMES, refused="SendParameters"))
    [reason] = findings.not_tested("parameters")
    assert names(reason, "err-unknown command")
    assert findings.of("frames").result is PASSING
    [rate] = findings.not_tested("rate")
    assert names(rate, "3d 100 Hz")


async def test_what_needs_frames_is_not_tested_without_them() -> None:
    findings = await diagnose(replying(parameters(), NO_DATA))
    assert findings.failing() == ["frames"]
    assert len(findings.not_tested("rate", "visibility")) == 2


async def test_frames_that_stop_while_the_doctor_watches_fail() -> None:
    async with ScriptedServer(streaming(XML[100], markers, stops_after=30)) as server:
        finding = (await run_doctor(lab(server.port), seconds=1.5)).of("frames")
    assert finding.result is FAILING
    assert names(finding.found, "30 frames")
    assert finding.remedy


async def test_a_component_limited_by_a_slower_one_fails() -> None:
    scene = SyntheticScene(markers=1, tools=0, analog=2, plates=1, rate_hz=100, analog_rate_hz=1000)
    async with Simulator(scene) as simulator:
        finding = (await run_doctor(lab(simulator.port))).of("rate")
    assert finding.found == "3d 100 of 100, analog 100 of 1000, force 100 of 1000 Hz"
    assert names(finding.remedy, "analog and force", "stream")


@pytest.mark.parametrize(
    ("rate", "found"), [(FrequencyDivisor(4), "3d 50 of 50 Hz"), (Frequency(20), "3d 20 of 20 Hz")]
)
async def test_a_configured_lower_rate_passes(rate: Rate, found: str) -> None:
    scene = SyntheticScene(markers=1, tools=0, analog=0, plates=0, rate_hz=200)
    async with Simulator(scene) as simulator:
        finding = (await run_doctor(lab(simulator.port, *of(MARKERS, rate=rate)))).of("rate")
    assert (finding.result, finding.found) == (PASSING, found)


async def test_a_stream_of_auto_without_its_component_is_a_note() -> None:
    """With 100 and 200 Hz, ``auto`` opens a second connection for 6d. The server sends only 3d there, too."""
    findings = await diagnose(streaming(FASTER_TOOLS, markers), streams="auto")
    frames = [(each.result, each.stream) for each in findings.all_of("frames")]
    assert frames == [(PASSING, "3d analog force event"), (NOTE, "6d")]
    assert findings.failing() == []


async def test_components_that_share_the_only_connection_are_a_warning() -> None:
    """``streams: auto`` cannot do better with a server that serves one client only (field note 21)."""
    script = streaming(FASTER_TOOLS, markers_and_tools)
    is_first = iter([True])

    async def serve_one(client: Client) -> None:
        if next(is_first, False):
            await script(client)
        else:
            client.cut()

    finding = (await diagnose(serve_one, streams="auto", reply_timeout_s=1.0)).of("rate")
    assert finding.result is WARNING
    assert names(finding.found, "3d 100 of 100, 6d 100 of 200 Hz", "one connection")
    assert names(finding.remedy, "streams: [{components: [6d]}]")
