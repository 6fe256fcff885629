"""Components as the gateway receives them, and a message of every type."""

from typing import Any

import rtc3d

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import Stamp, encode_message, tool_poses
from gateway.outputs.contract import OutputHealth, OutputStatus
from gateway.publish.status_messages import clock_message, status_message
from gateway.rtc3d.components import Component
from gateway.rtc3d.frames import split_frame
from gateway.session.status import StreamStatus
from tests.support.vectors import TOOLS, ByteOrder, ComponentVector

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


OUTPUTS: tuple[Any, ...] = (
    (OutputStatus("zenoh"), OutputHealth(True), {"ok": 3}),
    (OutputStatus("lcm"), OutputHealth(False, "no multicast: ip route add"), {}),
)


def status_of(stream: StreamStatus | None = None, *outputs: Any) -> bytes:
    """Return a status message of a stream, and of two outputs unless others are given."""
    message = status_message(
        source="lab",
        server="192.0.2.20:3020",
        sequence=17,
        streams=[(stream or StreamStatus("3d 6d"), 59.96)],
        outputs=outputs or OUTPUTS,
        stall_timeout_s=2.0,
        frame=CoordinateFrame("lab"),
    )
    return bytes(message.encode())


def unknown_clock() -> bytes:
    """Return the clock message of a server without a clock."""
    encoded: bytes = clock_message(3, 17, StreamStatus("3d 6d")).encode()
    return encoded


def command_messages() -> list[bytes]:
    """Return a command and its reply, as on LCM."""
    request, reply = rtc3d.command_request_t(), rtc3d.command_reply_t()
    request.request_id = reply.request_id = 7
    request.requester = reply.requester = "remote"
    request.command, request.options, request.num_options = "take", ["set=start", "name=walk-1"], 2
    reply.content = '{"source":"lab","name":"walk-1"}'
    return [request.encode(), reply.encode()]
