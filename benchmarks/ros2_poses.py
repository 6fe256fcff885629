"""The own code of the output ros2 for a frame of 6 tools: six poses and /tf, without Zenoh's part.

It prints the CPU time per frame in µs: handing the frame over, encoding, and the attachments.
"""

import statistics
import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import Stamp
from gateway.outputs.contract import ServerParameters
from gateway.outputs.ros2.messages import TF_MESSAGE
from gateway.outputs.ros2.source import RosSource
from gateway.outputs.ros2.topic import Declared, RosTopic
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType, encode_component
from gateway.rtc3d.frames import encode_frame, split_frame
from gateway.rtc3d.parameters import Parameters, Parameters6D, Tool

_TOOLS: Final = 6
_ROUNDS: Final = 9
_FRAMES: Final = 3000


class _Network:
    """Stands for Zenoh: everybody subscribes to everything, and nothing is sent."""

    is_cut_off = False

    def declare(self, _topic: RosTopic, on_matching: Callable[[bool], None]) -> Declared:
        on_matching(True)
        publisher: Any = self
        return Declared(publisher, publisher, bytes(16))

    def put(self, message: bytes, *, attachment: bytes) -> None:
        """Send nothing."""

    def offer(self, call: Callable[[], None], _num_bytes: int = 0) -> bool:
        """Make the call at once, not in another thread."""
        call()
        return True


def main() -> None:
    """Print the CPU time per frame in µs."""
    network: Any = _Network()
    tf = RosTopic("/tf", TF_MESSAGE, lambda: None)
    tf.declare(network)
    source = RosSource("lab", "/mocap/lab", tf, network, network)
    tools = Parameters6D(tools=tuple(Tool(str(number), f"Tool {number}") for number in range(_TOOLS)))
    frame = CoordinateFrame("lab", 1e-3, (0.0, 0.0, 0.6, 0.8), (1.0, 2.0, 3.0))
    source.set_parameters(ServerParameters(b"", 1, 1, parsed=Parameters(tools=tools), frame=frame))
    source.declare(network)
    items = np.array(
        [(1.0, 0.0, 0.0, 0.0, 100.0, 200.0, 300.0, 0.1)] * _TOOLS, ITEM_DTYPES[ComponentType.TOOLS]
    )
    data = split_frame(encode_frame([encode_component(ComponentType.TOOLS, 1, 1000, items)]), "big")
    stamp = Stamp(1_800_000_000_000_000, 1_800_000_000_000_000, 1, 1)
    components = frozenset({ComponentType.TOOLS})
    costs_us = []
    for _ in range(_ROUNDS):
        begun_s = time.thread_time()
        for _ in range(_FRAMES):
            source.publish(data, stamp, components)
        costs_us.append((time.thread_time() - begun_s) / _FRAMES * 1e6)
    print(f"{statistics.median(costs_us):.1f}")


if __name__ == "__main__":
    main()
