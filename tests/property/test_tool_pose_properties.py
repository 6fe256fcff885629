import math
import struct

import rtc3d
from hypothesis import given
from hypothesis import strategies as st

from gateway.messages.coordinate_frame import MAX_FLOAT, CoordinateFrame
from gateway.messages.stamp import Stamp
from gateway.messages.tool_pose import tool_poses
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import split_frame

int32s = st.integers(-(2**31), 2**31 - 1)
int64s = st.integers(-(2**63), 2**63 - 1)
stamps = st.builds(Stamp, int64s, int64s, int32s, int32s)
floats = st.floats(width=32) | st.sampled_from([math.nan, 0.0, -0.0])
tool_values = st.lists(st.tuples(*8 * [floats]), max_size=4)
units = st.sampled_from([1.0, 1e-2, 1e-3, 1e-6, 0.0254])


@given(tool_values, stamps, units)
def test_a_pose_is_whole_or_missing(tools: list[tuple[float, ...]], stamp: Stamp, metres: float) -> None:
    wire = struct.pack(">IIIiqI", 1, 24 + 32 * len(tools), ComponentType.TOOLS, 1, 2, len(tools))
    wire += b"".join(struct.pack(">8f", *tool) for tool in tools)
    (component,) = split_frame(wire, "big").components
    sequences = range(10, 10 + len(tools))
    messages = tool_poses(component, stamp, sequences, CoordinateFrame("lab", metres))
    for tool, sequence, message in zip(tools, sequences, messages, strict=True):
        pose = rtc3d.tool_pose_t.decode(message)
        assert pose.sequence == sequence
        numbers = (*pose.position_m, *pose.orientation_xyzw, pose.error_m)
        sent = (*tool[:4], *(value * metres for value in tool[4:]))
        assert pose.visible == all(abs(value) <= MAX_FLOAT for value in sent)
        if pose.visible:
            assert not any(map(math.isnan, numbers))
            assert pose.orientation_xyzw == (*tool[1:4], tool[0])
        else:
            assert all(map(math.isnan, numbers))
