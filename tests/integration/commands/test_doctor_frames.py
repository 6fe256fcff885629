"""The doctor's findings about frames that stop, come too fast, in another byte order, or not at all."""

import struct

import pytest

from gateway.config.settings import StreamSettings
from gateway.findings import Result
from gateway.rtc3d.commands import Frequency, FrequencyDivisor, Rate
from gateway.rtc3d.components import ComponentType
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
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
from tests.servers import Client, ScriptedServer, markers_frame, packet

MARKERS, TOOLS = ComponentType.MARKERS, ComponentType.TOOLS
HIP = (1.0, 2.0, 3.0)
NO_DATA = packet(4)


def markers(number: int) -> bytes:
    return markers_frame(number, HIP)


def markers_and_tools(number: int) -> bytes:
    """Return a frame with both components. In a packet, they begin at byte 12."""
    bodies = [frame[12:] for frame in (markers(number), tools_frame(number, 1.0))]
    return packet(3, struct.pack(">I", 2) + b"".join(bodies))


async def test_frames_that_stop_while_the_doctor_watches_fail() -> None:
    script = streaming(parameters(MARKERS_XML.format(100)), markers, stops_after=30)
    async with ScriptedServer(script) as server:
        findings = await run_doctor(lab(server.port), seconds=1.5)
    assert findings.of("frames").result is Result.FAILING
    assert findings.of("frames").found.startswith(
        "the server stopped sending after 30 frames: none arrived for "
    )
    assert findings.of("frames").remedy.startswith("Check whether the server's own display has stopped, too")


async def test_a_measurement_that_ends_while_the_doctor_watches_fails() -> None:
    frames = [markers(number) for number in range(0, 100, 10)]
    findings = await diagnose(replying(parameters(MARKERS_XML.format(100)), *frames, NO_DATA))
    assert findings.of("frames").result is Result.FAILING
    assert findings.of("frames").found.startswith("the server stopped sending after 10 frames: ")
    assert findings.of("frames").found.endswith("reports that no measurement is running")


async def test_a_server_that_is_faster_than_announced_fails() -> None:
    findings = await diagnose(streaming(parameters(MARKERS_XML.format(50)), markers))
    assert findings.of("rate").result is Result.FAILING
    assert findings.of("rate").found == (
        "3d 100 of 50 Hz: the server sends more frames than its parameters announce"
    )


@pytest.mark.parametrize("xml", [parameters(MARKERS_XML.format(100)), parameters()])
async def test_a_server_that_ignores_the_requested_rate_fails(xml: bytes) -> None:
    """A requested frequency is compared even if the server announces no rate."""
    findings = await diagnose(streaming(xml, markers), StreamSettings(rate=Frequency(25)))
    assert findings.of("rate").result is Result.FAILING
    assert findings.of("rate").found == "3d 100 of 25 Hz: the server ignores the requested rate"


@pytest.mark.parametrize(
    ("rate", "result"), [(Frequency(100), Result.PASSING), (Frequency(200), Result.FAILING)]
)
async def test_a_requested_frequency_is_compared_if_the_server_gives_no_parameters(
    rate: Rate, result: Result
) -> None:
    script = streaming(b"", markers, refused="SendParameters")
    findings = await diagnose(script, StreamSettings(rate=rate))
    assert findings.of("rate").result is result


async def test_a_divisor_without_an_announced_rate_is_a_note() -> None:
    findings = await diagnose(streaming(parameters(), markers), StreamSettings(rate=FrequencyDivisor(2)))
    assert findings.of("rate").result is Result.NOTE
    assert findings.of("rate").found == (
        "3d 100 Hz; the server announces no rate, so the configured divisor 2 cannot be compared"
    )


@pytest.mark.parametrize("byte_order", ["big", "little"])
async def test_frames_in_another_byte_order_than_agreed_are_a_warning(byte_order: str) -> None:
    """The server acknowledges every command, and then sends the other order (field note 4)."""
    sent = {"big": "little", "little": "big"}[byte_order]
    order = {"big": ">", "little": "<"}[sent]
    script = streaming(
        parameters(MARKERS_XML.format(100)), lambda number: markers_frame(number, HIP, order=order)
    )
    findings = await diagnose(script, byte_order=byte_order)
    assert findings.of("byte order").result is Result.WARNING
    assert findings.of("byte order").found == (
        f"the server sends {sent}-endian frames, although the gateway requests {byte_order}-endian ones"
    )
    assert f"set byte_order: {sent} for this source" in findings.of("byte order").remedy
    assert findings.failing() == []


async def test_frames_in_the_requested_byte_order_pass() -> None:
    async with Simulator(SyntheticScene(markers=1)) as simulator:
        findings = await run_doctor(lab(simulator.port, StreamSettings(), byte_order="little"))
    assert findings.of("byte order").result is Result.PASSING
    assert findings.of("byte order").found == "the frames are little-endian, as requested"


@pytest.mark.parametrize("streams", ["auto", (StreamSettings(),)])
async def test_a_component_of_all_that_the_server_leaves_out_is_a_note(streams: object) -> None:
    xml = parameters(MARKERS_XML.format(100), TOOLS_XML)
    findings = await diagnose(streaming(xml, markers), streams=streams)
    assert findings.of("frames").result is Result.NOTE
    assert "the server's parameters list items of 6d, but no frame contains 6d" in findings.of("frames").found
    assert findings.of("frames").remedy == "If you need 6d, enable its real-time output on the server."
    assert findings.failing() == []


async def test_a_stream_of_auto_without_its_component_is_a_note() -> None:
    """With 100 and 200 Hz, ``auto`` opens a second connection for 6d. The server sends only 3d there, too."""
    xml = parameters(MARKERS_XML.format(100), TOOLS_XML.replace("100", "200"))
    findings = await diagnose(streaming(xml, markers), streams="auto")
    [with_markers, with_tools] = findings.all_of("frames")
    assert (with_markers.result, with_markers.stream) == (Result.PASSING, "3d analog force event")
    assert (with_tools.result, with_tools.stream) == (Result.NOTE, "6d")
    assert findings.failing() == []


async def test_frames_without_a_component_of_the_stream_fail() -> None:
    findings = await diagnose(streaming(parameters(), markers), StreamSettings(components=(TOOLS,)))
    assert findings.of("frames").result is Result.FAILING
    assert "frames arrived, but none has a component of stream 6d" in findings.of("frames").found


async def test_components_that_share_the_only_connection_are_a_warning() -> None:
    """``streams: auto`` cannot do better with a server that serves one client only (field note 21)."""
    xml = parameters(MARKERS_XML.format(100), TOOLS_XML.replace("100", "200"))
    script = streaming(xml, markers_and_tools)
    is_first = iter([True])

    async def serve_one(client: Client) -> None:
        if next(is_first, False):
            await script(client)
        else:
            client.cut()

    findings = await diagnose(serve_one, streams="auto")
    assert findings.of("rate").result is Result.WARNING
    assert findings.of("rate").found == (
        "3d 100 of 100, 6d 100 of 200 Hz, because the server accepts one connection only"
    )
    assert findings.of("rate").remedy == (
        "If the full rate of 6d matters more than the other components, request nothing else: "
        "streams: [{components: [6d]}]."
    )
