"""The doctor's findings and remedies for healthy, unusual, wrong and missing servers."""

import asyncio
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.findings import Result
from gateway.rtc3d.commands import Frequency, FrequencyDivisor, Rate
from gateway.rtc3d.components import ComponentType
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests import networks
from tests.diagnosed_servers import (
    MARKERS_XML,
    TOOLS_XML,
    diagnose,
    parameters,
    replying,
    streaming,
    tools_frame,
)
from tests.findings import lab, run_doctor
from tests.servers import Client, ScriptedServer, markers_frame, ok, packet

MARKERS, TOOLS, ANALOG = ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.ANALOG
FORCE, EVENT = ComponentType.FORCE, ComponentType.EVENT
NAN = float("nan")


async def test_a_healthy_server_passes_every_check() -> None:
    scene = SyntheticScene(markers=3, tools=1, analog=4, plates=1, rate_hz=200, analog_rate_hz=1000)
    streams = (StreamSettings(components=(MARKERS, TOOLS, EVENT)), StreamSettings(components=(ANALOG, FORCE)))
    async with Simulator(scene) as simulator:
        findings = await run_doctor(lab(simulator.port, *streams))
    assert {each.result for each in findings.all if each.subject == "lab"} == {Result.PASSING}
    assert [each.stream for each in findings.all_of("frames")] == ["3d 6d event", "analog force"]
    assert {each.stream for each in findings.all_of("protocol")} == {""}
    texts = [(each.check, each.found) for each in findings.all if each.subject == "lab"]
    frames = [text for check, text in texts if check == "frames"]
    assert re.fullmatch(r"\d+ frames with 3d, 6d(, event)?; the largest message has \d+ bytes", frames[0])
    assert re.fullmatch(r"\d+ frames with analog, force; the largest message has \d+ bytes", frames[1])
    for text in (
        ("name", "127.0.0.1 is an IP address"),
        ("TCP", f"127.0.0.1:{simulator.port} accepts 2 connections, one per stream"),
        ("protocol", "the server accepts every command"),
        ("parameters", "3 markers, 1 tool, 4 analog channels, 1 force plate, 1 event type"),
        ("rate", "3d 200 of 200, 6d 200 of 200 Hz"),
        ("rate", "analog 1000 of 1000, force 1000 of 1000 Hz"),
        ("visibility", "in view: markers 100%, tools 100%"),
    ):
        assert text in texts
    assert findings.of("file", "configuration").found == "lab.yaml: lab to lcm"


async def test_a_host_name_is_resolved() -> None:
    async with Simulator(SyntheticScene(markers=1)) as simulator:
        findings = await run_doctor(lab(simulator.port, host="localhost"))
    assert findings.of("name").result is Result.PASSING
    assert "127.0.0.1" in findings.of("name").found


async def test_an_unknown_host_name_fails_and_ends_the_checks_of_its_source() -> None:
    scene = SyntheticScene(markers=1, tools=0, analog=0, plates=0)
    async with Simulator(scene) as simulator:
        other = SourceSettings(name="other", host="127.0.0.1", port=simulator.port)
        findings = await run_doctor(lab(3020, host="no-such-host.invalid"), other)
    finding = findings.of("name")
    assert finding.found.startswith("the host name 'no-such-host.invalid' cannot be resolved: ")
    assert finding.remedy == (
        "Correct the source's host, add the name to DNS or /etc/hosts, or use an IP address."
    )
    assert findings.failing() == ["name"]
    later = ("TCP", "protocol", "parameters", "frames", "rate", "buffer", "visibility")
    assert findings.not_tested(*later) == {"it needs name, which failed"}
    assert findings.failing("other") == []


async def test_a_refused_connection_fails() -> None:
    port = networks.free_port()
    findings = await run_doctor(lab(port))
    assert findings.of("TCP").found == f"connection refused by 127.0.0.1:{port}"
    assert findings.of("TCP").remedy == "Is the RT server running, and is this its port?"
    assert findings.failing() == ["TCP"]
    later = ("protocol", "parameters", "frames", "rate", "buffer", "visibility")
    assert findings.not_tested(*later) == {"it needs TCP, which failed"}


async def test_a_computer_that_does_not_respond_fails() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=0) as full:
        address = full.getsockname()
        with _full_queue(address):
            findings = await run_doctor(lab(address[1], connect_timeout_s=0.2))
    assert findings.of("TCP").found == f"no answer from 127.0.0.1:{address[1]} within 0.2 s"
    assert findings.of("TCP").remedy == (
        "Is the computer on and reachable, and its firewall open for this port?"
    )


@contextmanager
def _full_queue(address: tuple[str, int]) -> Iterator[None]:
    """Fill the queue of a listener, so that further connections get no answer."""
    waiting = [socket.socket() for _ in range(4)]
    for each in waiting:
        each.setblocking(False)
        each.connect_ex(address)
    try:
        yield
    finally:
        for each in waiting:
            each.close()


async def test_the_first_bytes_of_another_protocol_are_quoted() -> None:
    async def script(client: Client) -> None:
        client.send(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        await client.command()

    async with ScriptedServer(script) as server:
        findings = await run_doctor(lab(server.port))
    assert findings.of("protocol").found == (
        f"the program at 127.0.0.1:{server.port} is not an RT server; "
        r"its first bytes are 'HTTP/1.1 400 Bad Request\r\n\r\n'"
    )
    assert findings.of("protocol").remedy == (
        "Correct the source's host and port: 3020 is First Principles, 3030 WaveFront."
    )
    assert findings.failing() == ["protocol"]
    assert findings.not_tested("parameters", "frames", "rate") == {"it needs protocol, which failed"}


async def test_a_server_that_sends_nothing_fails() -> None:
    findings = await diagnose(lambda client: client.commands(lambda _command: None))
    assert findings.of("protocol").found.endswith("accepts a connection but sends nothing")
    assert findings.of("protocol").remedy == (
        "Correct the source's host and port (3020 is First Principles, 3030 WaveFront). "
        "If they are correct, restart the RT server."
    )


async def test_a_server_that_disconnects_fails() -> None:
    async def script(client: Client) -> None:
        await client.command()
        client.cut()

    findings = await diagnose(script)
    assert "the connection to 127.0.0.1:" in findings.of("protocol").found
    assert findings.of("protocol").remedy == (
        "Check that this is the RT server's port (3020 is First Principles, 3030 WaveFront) and that the "
        "server accepts one more client. Close other programs that are connected to it, and read the "
        "server's own messages."
    )


async def test_a_server_that_refuses_to_stream_fails() -> None:
    findings = await diagnose(replying(parameters(), refused="StreamFrames"))
    assert "refuses every form of the StreamFrames command" in findings.of("protocol").found
    assert findings.of("protocol").remedy == "Enable the real-time output in the server's settings."


async def test_commands_that_the_server_refuses_are_listed() -> None:
    frames = [markers_frame(number, (1.0, 2.0, 3.0)) for number in range(0, 100, 10)]
    script = replying(b"", *frames, refused="Version|SendParameters")
    findings = await diagnose(script)
    assert findings.of("protocol").result is Result.PASSING
    assert findings.of("protocol").found == (
        "the server is an RT server; the gateway works around this: the server refused Version 1.0: "
        "err-unknown command; the server refused SendParameters: err-unknown command"
    )
    assert findings.not_tested("parameters") == {
        "the server refused SendParameters: err-unknown command; names, units and configured rates are "
        "unknown"
    }
    assert findings.of("frames").result is Result.PASSING
    assert findings.not_tested("rate") == {"3d 100 Hz; the server's parameters have no rate to compare with"}


async def test_unreadable_parameters_fail() -> None:
    findings = await diagnose(replying(packet(2, "no xml"), markers_frame(1, (1.0, 2.0, 3.0))))
    assert findings.of("parameters").found.startswith("the server's XML cannot be read: ")
    assert findings.of("parameters").remedy == (
        "The gateway publishes data without names and units. Look for unusual characters in the names of "
        "markers and tools on the server, or update the server's software."
    )
    assert findings.of("frames").result is Result.PASSING


async def test_a_repair_of_the_parameters_is_reported() -> None:
    findings = await diagnose(replying(packet(2, "<RT_Parameters><The_3D></The_6D>"), markers_frame(1)))
    assert findings.of("parameters").result is Result.PASSING
    assert "(repaired: " in findings.of("parameters").found


async def test_an_unknown_unit_of_length_is_a_warning() -> None:
    markers = "<The_3D><Frequency>100</Frequency><Unit>furlong</Unit><Markers/></The_3D>"
    server = replying(parameters(markers), markers_frame(1))
    finding = (await diagnose(server)).of("parameters")
    assert (finding.result, finding.found) == (
        Result.WARNING,
        "0 markers; unit of length 'furlong' is unknown: no positions in metres are published",
    )
    assert finding.remedy == (
        "Set it to mm or m in the server, or set transform.units of the source in the configuration."
    )
    corrected = await diagnose(server, transform={"units": "mm"})
    assert corrected.of("parameters").result is Result.PASSING


async def test_no_measurement_fails() -> None:
    async with Simulator(SyntheticScene(markers=1)) as simulator:
        simulator.stop_measurement()
        findings = await run_doctor(lab(simulator.port))
    assert findings.of("frames").found == "the server reports that no measurement is running"
    assert findings.of("frames").remedy == (
        "Start a measurement on the server; the gateway then streams automatically."
    )
    assert findings.failing() == ["frames"]
    assert findings.not_tested("rate") == {"too few frames to measure the rate"}
    assert findings.not_tested("visibility") == {"no markers or tools arrived"}


async def test_no_frames_without_a_reason_fail() -> None:
    findings = await diagnose(replying(parameters()), StreamSettings(components=(MARKERS, TOOLS)))
    assert findings.of("frames").found == (
        "no frame of stream 3d 6d arrived, and the server did not report that no measurement is running"
    )
    assert findings.of("frames").remedy.startswith("Check that the server shows live data")


async def test_no_event_does_not_fail() -> None:
    findings = await diagnose(replying(parameters()), StreamSettings(components=(EVENT,)))
    assert findings.not_tested("frames") == {"no event occurred during the check"}
    assert findings.failing() == []


async def test_malformed_frames_fail() -> None:
    good = markers_frame(1, (1.0, 2.0, 3.0))
    findings = await diagnose(replying(parameters(), good, packet(3, good[8:-4])))
    assert findings.of("frames").found.startswith("1 of 2 frames are malformed: component 1 of 1")
    assert findings.of("frames").remedy == (
        "The gateway drops malformed frames. Update the server's software, or report this to its maker."
    )


async def test_a_component_in_the_parameters_but_not_in_the_frames_fails() -> None:
    xml = parameters(MARKERS_XML.format(100), TOOLS_XML)
    stream = StreamSettings(components=(MARKERS, TOOLS))
    findings = await diagnose(replying(xml, markers_frame(1, (1.0, 2.0, 3.0))), stream)
    assert findings.of("frames").found == (
        "the server's parameters list items of 6d, but no frame contains 6d"
    )
    assert findings.of("frames").remedy == (
        "Enable the real-time output of 6d on the server, or remove 6d from the stream's components."
    )


async def test_a_connection_that_ends_during_streaming_fails() -> None:
    async def script(client: Client) -> None:
        def answer(command: str) -> bytes:
            if command.startswith("StreamFrames"):
                asyncio.get_running_loop().call_later(0.05, client.cut)
            return ok(f"OK-{command}")

        await client.commands(answer)

    findings = await diagnose(script)
    assert (
        findings.of("frames").found == "the server closed the connection while the doctor waited for frames"
    )
    assert findings.of("frames").remedy == (
        "Check whether another program takes over the stream, and read the server's own messages."
    )


async def test_a_component_limited_by_a_slower_one_fails() -> None:
    scene = SyntheticScene(markers=1, tools=0, analog=2, plates=1, rate_hz=100, analog_rate_hz=1000)
    async with Simulator(scene) as simulator:
        findings = await run_doctor(lab(simulator.port))
    assert findings.of("rate").found == "3d 100 of 100, analog 100 of 1000, force 100 of 1000 Hz"
    assert findings.of("rate").remedy == (
        "A stream is as fast as its slowest component. Move analog and force to a stream of their own, or "
        "configure a lower rate for this stream."
    )


async def test_a_server_that_is_too_slow_fails() -> None:
    script = streaming(parameters(MARKERS_XML.format(500)), lambda number: markers_frame(number, (1, 2, 3)))
    findings = await diagnose(script)
    assert findings.of("rate").found == "3d 100 of 500 Hz"
    assert findings.of("rate").remedy == (
        "The server or the network is too slow. Check the server's real-time processing rate and load, the "
        "cable and the switch, or configure a lower rate for the stream."
    )


@pytest.mark.parametrize(
    ("rate", "text"), [(FrequencyDivisor(4), "3d 50 of 50 Hz"), (Frequency(20), "3d 20 of 20 Hz")]
)
async def test_a_configured_lower_rate_passes(rate: Rate, text: str) -> None:
    scene = SyntheticScene(markers=1, tools=0, analog=0, plates=0, rate_hz=200)
    async with Simulator(scene) as simulator:
        findings = await run_doctor(lab(simulator.port, StreamSettings(components=(MARKERS,), rate=rate)))
    assert (findings.of("rate").result, findings.of("rate").found) == (Result.PASSING, text)


async def test_constant_time_stamps_are_ignored() -> None:
    frame = markers_frame(7, (1.0, 2.0, 3.0))
    findings = await diagnose(streaming(parameters(MARKERS_XML.format(1)), lambda _number: frame))
    # The server announces 1 Hz; by arrival times, the rate is about 100 Hz.
    assert findings.of("rate").result is Result.FAILING
    assert "the server sends more frames than its parameters announce" in findings.of("rate").found


async def test_time_stamps_that_are_not_in_microseconds_are_ignored() -> None:
    # The server's clock advances 1 ms per frame, this computer's 10 ms.
    script = streaming(
        parameters(MARKERS_XML.format(900)), lambda number: markers_frame(number, (1, 2, 3)), step=1
    )
    findings = await diagnose(script)
    # The server announces 900 Hz; by arrival times, the rate is about 100 Hz.
    assert findings.of("rate").result is Result.FAILING


async def test_markers_out_of_view_fail() -> None:
    gone = markers_frame(1, (NAN, NAN, NAN), (NAN, NAN, NAN))
    findings = await diagnose(replying(parameters(MARKERS_XML.format(100)), gone))
    assert findings.of("visibility").found == "in view: markers 0%"
    assert findings.of("visibility").remedy == (
        "Check that the cameras see the volume, that the markers are inside it and not covered, and that the "
        "strobers are on and charged."
    )


async def test_markers_that_are_never_in_view_are_named() -> None:
    frames = [markers_frame(n, (NAN, NAN, NAN), (1.0, 2.0, 3.0), (NAN, NAN, NAN)) for n in (1, 2)]
    frames += [markers_frame(n, (1.0, 2.0, 3.0), (1.0, 2.0, 3.0), (NAN, NAN, NAN)) for n in (3, 4)]
    labels = MARKERS_XML.format(1000)
    findings = await diagnose(replying(parameters(labels), *frames))
    assert findings.of("visibility").found == "in view: markers 50% (never number 3)"
    findings = await diagnose(replying(parameters(labels), *frames[:2]))
    assert findings.of("visibility").found == "in view: markers 33% (never hip, number 3)"


async def test_tools_out_of_view_fail() -> None:
    findings = await diagnose(replying(parameters(TOOLS_XML), tools_frame(1, NAN), tools_frame(2, NAN)))
    assert findings.of("visibility").found == "in view: tools 0%"
    assert findings.of("visibility").result is Result.FAILING
