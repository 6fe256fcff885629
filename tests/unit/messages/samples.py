"""Components as the gateway receives them, and a message of every type."""

from typing import Any

import rtc3d

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import encode_message
from gateway.messages.stamp import Stamp
from gateway.messages.tool_pose import tool_poses
from gateway.outputs.status import OutputHealth, OutputStatus
from gateway.publish.status_messages import clock_message, status_message
from gateway.rtc3d.components import Component
from gateway.rtc3d.frames import split_frame
from gateway.stream.status import StreamStatus
from tests.vectors import TOOLS, ByteOrder, ComponentVector

STAMP = Stamp(utime=2_000, capture_utime=1_000, session=3, parameters_version=5)


def received(vector: ComponentVector, order: ByteOrder = "big") -> Component:
    """Return the vector's component, split from a frame in this byte order."""
    (component,) = split_frame((1).to_bytes(4, order) + vector.wire[order], order).components
    return component


def component_message(vector: ComponentVector) -> bytes:
    """Return the message of the vector's component, number 41."""
    return encode_message(received(vector), STAMP, 41)


def tool_pose_messages() -> list[bytes]:
    """Return the poses of a visible and a missing tool, numbers 41 and 42."""
    return tool_poses(received(TOOLS), STAMP, [41, 42], CoordinateFrame("lab"))


def status_of(**stream: Any) -> bytes:
    """Return a status message of one stream with these counters, and of two outputs."""
    outputs = [
        (OutputStatus("zenoh"), OutputHealth(True), {"ok": 3}),
        (OutputStatus("lcm"), OutputHealth(False, "no multicast: ip route add"), {}),
    ]
    streams = [(StreamStatus("3d 6d", **stream), 59.96)]
    message = status_message(
        source="lab",
        server="192.0.2.20:3020",
        sequence=17,
        streams=streams,
        outputs=outputs,
        stall_timeout_s=2.0,
        frame=CoordinateFrame("lab"),
    )
    return bytes(message.encode())


def unknown_clock() -> bytes:
    """Return the clock message of a server without a clock."""
    encoded: bytes = clock_message(3, 17, StreamStatus("3d 6d")).encode()
    return encoded


def parameter_messages() -> list[bytes]:
    """Return the parameters, a request and a reply, as on LCM."""
    parameters, request, reply = (
        rtc3d.parameters_t(),
        rtc3d.parameters_request_t(),
        rtc3d.parameters_reply_t(),
    )
    parameters.xml = reply.xml = "<RT_Parameters/>"
    request.requester = reply.requester = "viewer"
    return [parameters.encode(), request.encode(), reply.encode()]


def command_messages() -> list[bytes]:
    """Return a command and its reply, as on LCM."""
    request, reply = rtc3d.command_request_t(), rtc3d.command_reply_t()
    request.request_id = reply.request_id = 7
    request.requester = reply.requester = "remote"
    request.command, request.options, request.num_options = "take", ["set=start", "name=walk-1"], 2
    reply.content = '{"source":"lab","name":"walk-1"}'
    return [request.encode(), reply.encode()]


def take_message() -> bytes:
    """Return the description of a take."""
    message = rtc3d.take_t()
    message.utime = 1_700_000_000_000_000
    message.name, message.source, message.channels = "walk-1", "lab", "MOCAP_LAB"
    message.server, message.gateway_version = "192.0.2.20:3020", "1.0.0"
    message.recorder, message.host = "rtc3d-gateway 1.0.0", "analysis-pc"
    encoded: bytes = message.encode()
    return encoded


def take_details_message() -> bytes:
    """Return what a take is about."""
    message = rtc3d.take_details_t()
    message.utime, message.source = 1_700_000_000_000_000, "lab"
    message.subject, message.session, message.note = "S01", "baseline", "left knee"
    encoded: bytes = message.encode()
    return encoded


def take_end_message() -> bytes:
    """Return the end of a take."""
    message = rtc3d.take_end_t()
    message.utime, message.source, message.messages_lost = 1_700_000_000_000_000, "lab", 505
    encoded: bytes = message.encode()
    return encoded
