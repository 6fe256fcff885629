"""Print the markers that a gateway publishes on LCM, with the message types from the gateway's package.

    python examples/subscriber_lcm.py [SOURCE [COUNT]]        for example: subscriber_lcm.py LAB 100

SOURCE is the name of the source in upper case. The program stops after COUNT frames.
"""

import argparse
import math
import signal
import struct
import sys

import lcm
from rtc3d import markers_t


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", nargs="?", default="LAB", help="the source's name in upper case")
    parser.add_argument("count", nargs="?", type=int, default=math.inf, help="stop after this many frames")
    options = parser.parse_args()
    source, frames_left = options.source, options.count

    def on_markers(_channel: str, data: bytes) -> None:
        nonlocal frames_left
        try:
            message = markers_t.decode(data)
        except (struct.error, ValueError) as error:
            print(f"ignored a malformed message: {error}", file=sys.stderr)
            return
        visible = [marker for marker in message.markers if not math.isnan(marker.x)]
        position = ""
        if visible:
            first = visible[0]
            position = f", the first at {first.x:.3f}, {first.y:.3f}, {first.z:.3f} mm"
        print(
            f"#{message.sequence} frame {message.frame_number} with parameters {message.parameters_version}: "
            f"{len(visible)} of {message.num_markers} markers in view{position}"
        )
        frames_left -= 1

    signal.signal(signal.SIGINT, signal.SIG_DFL)  # LCM's handle() would turn Ctrl-C into an OSError
    connection = lcm.LCM()
    subscription = connection.subscribe(f"MOCAP_{source}_3D", on_markers)
    subscription.set_queue_capacity(1000)  # the default of 30 loses frames whenever this program pauses
    print("listening", flush=True)
    while frames_left > 0:
        connection.handle()


if __name__ == "__main__":
    main()
