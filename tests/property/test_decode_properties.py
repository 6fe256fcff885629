import contextlib
import json

from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ProtocolError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.decode import decode, to_json
from gateway.messages.encode import encode_message
from gateway.messages.stamp import Stamp
from gateway.messages.summary import summarise
from gateway.messages.tool_pose import tool_poses
from gateway.outputs.status import OutputHealth, OutputStatus
from gateway.publish.status_messages import clock_message, status_message
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import split_frame
from gateway.stream.status import StreamStatus
from tests.strategies import damaged
from tests.vectors import FULL_FRAME

STAMP = Stamp(1, 2, 3, 4)
COMPONENTS = split_frame(FULL_FRAME["big"], "big").components
TOOLS = next(component for component in COMPONENTS if component.type is ComponentType.TOOLS)
STATUS = status_message(
    source="lab",
    server="192.0.2.20:3020",
    sequence=1,
    streams=[(StreamStatus("3d", limitations=["no parameters"]), 60.0)],
    outputs=[(OutputStatus("zenoh"), OutputHealth(True), {"ok": 1})],
    stall_timeout_s=2.0,
    frame=CoordinateFrame("lab"),
)
CLOCK = clock_message(1, 2, StreamStatus("3d"))
valid = st.sampled_from(
    [
        *(encode_message(each, STAMP, 1) for each in COMPONENTS),
        *tool_poses(TOOLS, STAMP, [1, 2], CoordinateFrame("lab")),
        STATUS.encode(),
        CLOCK.encode(),
    ]
)


@given(damaged(valid) | st.binary(max_size=100))
def test_damaged_messages_raise_only_protocol_errors_and_decoded_ones_can_be_shown(message: bytes) -> None:
    with contextlib.suppress(ProtocolError):
        decoded = decode(message)
        assert summarise(decoded)
        assert json.dumps(to_json(decoded), allow_nan=False)
