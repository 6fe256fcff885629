"""Prints the markers that a gateway publishes on LCM, with the types that come with the gateway.

python examples/subscriber_lcm.py [SOURCE [COUNT]]        e.g.  subscriber_lcm.py LAB 100
"""

import math
import sys

import lcm
from rtc3d import markers_t


def main() -> None:
    source = sys.argv[1] if len(sys.argv) > 1 else "LAB"
    left = int(sys.argv[2]) if len(sys.argv) > 2 else math.inf

    def on_markers(_channel: str, data: bytes) -> None:
        nonlocal left
        message = markers_t.decode(data)
        seen = [marker for marker in message.markers if not math.isnan(marker.x)]
        where = f", the first at {seen[0].x:.3f}, {seen[0].y:.3f}, {seen[0].z:.3f} mm" if seen else ""
        print(
            f"#{message.sequence} frame {message.frame_number}: "
            f"{len(seen)} of {message.num_markers} markers in view{where}"
        )
        left -= 1

    connection = lcm.LCM()
    subscription = connection.subscribe(f"MOCAP_{source}_3D", on_markers)
    subscription.set_queue_capacity(1000)  # LCM's own 30 lose frames whenever this program pauses
    print("listening", flush=True)
    while left > 0:
        connection.handle()


if __name__ == "__main__":
    main()
