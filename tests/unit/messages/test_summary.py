"""What a person reads of a message, and the server's XML as text in messages."""

import logging
import math

import pytest
import rtc3d

from gateway.messages.decode import decode
from gateway.messages.summary import summarise
from gateway.messages.texts import xml_bytes, xml_text
from gateway.outputs.contract import OutputHealth, OutputStatus
from gateway.runtime.losses import Losses, counts_text
from gateway.session.state import StreamState
from gateway.session.status import StreamStatus
from tests.support.errors import names
from tests.support.vectors import ANALOG, FORCE, LONG_EVENTS, MARKERS, TOOLS, ComponentVector
from tests.unit.messages.samples import (
    command_messages,
    component_message,
    status_of,
    tool_pose_messages,
    unknown_clock,
)

LAB = "#17 lab at 192.0.2.20:3020: [3d 6d] "
OUTPUTS = "; outputs: zenoh ok; lcm no multicast: ip route add"
STREAMING = StreamStatus("3d 6d", state=StreamState.STREAMING, frames_in=600, reconnects=1, last_error="gone")


@pytest.mark.parametrize(
    ("message", "line"),
    [
        (
            component_message(MARKERS),
            "16909060 at 4328.7194 s: 2 markers, 1 missing, first visible at (1, -2.5, 1000)",
        ),
        (component_message(TOOLS), "4 at 0.0075 s: 2 tools, 1 missing, first visible at (100, -200, 1600)"),
        (component_message(ANALOG), "2 at 0.0025 s: 3 channels, voltages 0.1, -15000, 0"),
        (component_message(FORCE), "3 at 0.0050 s: 2 plates, forces (1.5, -0.75, 800); (4, 5, 6)"),
        (
            component_message(LONG_EVENTS),
            "6 at 0.0125 s: 2 events: id 0x123456 (7, 1, -1); id 0x2 (1065353216, -1, -1)",
        ),
        (
            tool_pose_messages()[0],
            "4 at 0.0075 s: position (0.1, -0.2, 1.6) m, orientation xyzw (-0.4, 0.4, 0.2, 0.8)",
        ),
        (tool_pose_messages()[1], "#42 frame 4 at 0.0075 s: out of view"),
        (command_messages()[0], "command 7 from 'remote': take set=start name=walk-1"),
        (command_messages()[1], """reply 7 to 'remote': {"source":"lab","name":"walk-1"}"""),
        (unknown_clock(), "#17 the server's time stamps cannot be used as a clock (3d 6d)"),
        (
            status_of(STREAMING),
            f"{LAB}streaming 60.0 Hz, 600 frames, 1 reconnects, last error: gone{OUTPUTS}",
        ),
        (status_of(), f"{LAB}waiting to reconnect 60.0 Hz, 0 frames, 0 reconnects{OUTPUTS}"),
    ],
    ids=lambda each: each if isinstance(each, str) else "",  # messages have the time
)
def test_a_summary_shows_what_matters_first(message: bytes, line: str) -> None:
    assert summarise(decode(message)) == (f"#41 frame {line}" if line[0].isdigit() else line)


def test_the_summary_of_a_status_says_what_was_lost_and_why() -> None:
    status = StreamStatus("3d 6d")
    for _ in range(436):
        status.frame_skipped(2)
    status.file_lost("the disk is full")
    losses = Losses(logging.getLogger("tests"), "lab to zenoh")
    losses.lost("no router", "start it", messages=5, frames=1)
    message = status_of(status, (OutputStatus("zenoh", losses=losses.report()), OutputHealth(True), {}))
    assert summarise(decode(message)) == (
        "#17 lab at 192.0.2.20:3020: [3d 6d] waiting to reconnect 60.0 Hz, 0 frames, 0 reconnects, "
        f"lost {counts_text([('C3D file', 1, 0), ('skipped while behind', 872, 436)])}; "
        f"outputs: zenoh ok, lost {counts_text([('no router', 5, 1)])}"
    )


def test_an_item_with_any_missing_coordinate_is_not_shown_as_visible() -> None:
    """As in all other displays; "first visible at (1, nan, 2)" helps nobody."""
    marker, tool = rtc3d.marker_t(), rtc3d.tool_t()
    marker.y = tool.qz = math.nan
    markers, tools = rtc3d.markers_t(), rtc3d.tools_t()
    markers.num_markers, markers.markers = 2, [marker, rtc3d.marker_t()]
    tools.num_tools, tools.tools = 1, [tool]
    assert names(summarise(markers), "2 markers", "1 missing", "(0, 0, 0)")
    assert summarise(tools).endswith("1 tools, 1 missing")


def test_small_and_large_numbers_are_shown_without_rounding_errors() -> None:
    """A person compares the line with a ruler, and a robot's controller."""
    assert summarise(rtc3d.markers_t()).endswith("0 markers, 0 missing")
    pose = rtc3d.tool_pose_t()
    pose.visible = True
    pose.position_m = [2.15, -1.6e-17, 12345.678]
    pose.orientation_xyzw = [-3e-9, 1.6e-17, 0.70710678, -0.7071]
    assert names(summarise(pose), "(2.15, 0, 12346) m", "(0, 0, 0.7071, -0.7071)")
    message = rtc3d.analog_t()
    message.num_channels, message.voltages = 3, [1.6e-7, -0.00012345, 2e9]
    assert summarise(message).endswith("voltages 1.6e-07, -0.0001234, 2e+09")


@pytest.mark.parametrize(
    ("vector", "units", "end"),
    [
        (MARKERS, ("mm", "mm"), " (1, -2.5, 1000) mm"),
        (TOOLS, ("in", "in"), " (100, -200, 1600) in"),
        (ANALOG, ("mV", "mV", "mV"), "voltages 0.1, -15000, 0 mV"),
        (ANALOG, ("mV", "", "N"), "voltages 0.1 mV, -15000, 0 N"),
        (FORCE, ("N", "N"), "forces (1.5, -0.75, 800); (4, 5, 6) N"),
        (FORCE, ("", ""), "forces (1.5, -0.75, 800); (4, 5, 6)"),
    ],
    ids=range(6),
)
def test_a_summary_has_the_units_that_are_known(
    vector: ComponentVector, units: tuple[str, ...], end: str
) -> None:
    """A position of 1.5 in a line may be metres or millimetres; channels can differ."""
    assert summarise(decode(component_message(vector)), units).endswith(end)


@pytest.mark.parametrize(("num_channels", "shown"), [(4, "1, 2, 3, 4"), (5, "1, 2, 3, 4, …")])
def test_a_summary_shows_four_channels_at_most(num_channels: int, shown: str) -> None:
    """A line stays a line for a server with a thousand channels."""
    message = rtc3d.analog_t()
    message.num_channels, message.voltages = num_channels, [1.0, 2.0, 3.0, 4.0, 5.0][:num_channels]
    assert summarise(message).endswith(f"{num_channels} channels, voltages {shown}")


CONTENT = "<RT_Parameters><The_3D><Marker><Label>Fuß</Label></Marker></The_3D></RT_Parameters>"


@pytest.mark.parametrize("encoding", ["ISO-8859-1", "latin1", "windows-1252", "UTF-8", "utf8"])
def test_xml_returns_to_the_encoding_that_it_declares(encoding: str) -> None:
    """The summary gives the size of the XML as the server sent it."""
    xml = f"<?xml version='1.0' encoding='{encoding}'?>{CONTENT}".encode(encoding)
    assert xml_bytes(xml_text(xml)) == xml
    reply = rtc3d.parameters_reply_t()
    reply.xml = xml_text(xml + b"\0\0")  # some servers end it in NULs
    assert f"{len(xml)} bytes of XML" in summarise(reply)


def test_xml_without_a_declaration_or_that_does_not_fit_it_is_utf_8() -> None:
    for text in (CONTENT, f"<?xml version='1.0' encoding='ISO-8859-1'?>{CONTENT.replace('Fuß', '足')}"):
        assert xml_bytes(text) == text.encode()
