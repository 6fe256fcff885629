"""Print the markers that a gateway publishes on LCM, with the message types from the gateway's package.

    python examples/subscriber_lcm.py [SOURCE [COUNT]]        for example: subscriber_lcm.py LAB 100

It needs the gateway's Python package, which has the module ``rtc3d`` and brings ``lcm``.
SOURCE is the name of the source in upper case. The program stops after COUNT frames. With --vectors, it
decodes messages from standard input instead (lcm_types/vectors/README.md).
"""

import argparse
import io
import json
import math
import signal
import struct
import sys

import lcm
import rtc3d


def decode(lcm_type, data):
    """Return the message, or raise ValueError."""
    buffer = io.BytesIO(data)
    try:
        message = lcm_type.decode(buffer)
        # lcm-gen's decoder reads a string that is cut off as a shorter one.
        is_whole = not buffer.read(1) and ("string" not in lcm_type.__typenames__ or message.encode() == data)
    except (struct.error, ValueError) as error:
        raise ValueError(f"not a whole {lcm_type.__name__}: {error}") from error
    if not is_whole:
        raise ValueError(f"not a whole {lcm_type.__name__}")
    for name in lcm_type.__slots__:
        if name.startswith("num_") and getattr(message, name) < 0:
            raise ValueError(f"{name} is {getattr(message, name)}")
    return message


def print_markers(message) -> None:
    visible = [marker for marker in message.markers if not math.isnan(marker.x)]
    first = ", the first at {0.x:.3f}, {0.y:.3f}, {0.z:.3f} mm".format(visible[0]) if visible else ""
    print(
        f"#{message.sequence} frame {message.frame_number} at {message.timestamp / 1e6:.4f} s"
        f" with parameters {message.parameters_version}:"
        f" {len(visible)} of {message.num_markers} markers in view{first}"
    )


def subscribe(source: str, count: float) -> None:
    frames_left = count

    def on_markers(_channel: str, data: bytes) -> None:
        nonlocal frames_left
        try:
            print_markers(decode(rtc3d.markers_t, data))
        except ValueError as error:
            print(f"ignored a malformed message: {error}", file=sys.stderr)
            return
        frames_left -= 1

    signal.signal(signal.SIGINT, signal.SIG_DFL)  # LCM's handle() would turn Ctrl-C into an OSError
    try:
        connection = lcm.LCM()
    except RuntimeError:
        sys.exit("Cannot open LCM; check $LCM_DEFAULT_URL and the multicast route")
    subscription = connection.subscribe(f"MOCAP_{source}_3D", on_markers)
    subscription.set_queue_capacity(1000)  # the default of 30 loses frames whenever this program pauses
    print("listening", flush=True)
    while frames_left > 0:
        connection.handle()


def as_json(value):
    """Return a message, or a value in one, as what ``json`` writes."""
    if hasattr(value, "__slots__"):
        return {name: as_json(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, list | tuple):
        return [as_json(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def print_vectors() -> None:
    """Read lines TYPE HEX, and print the values of each message, or what is wrong, as a line of JSON."""
    for line in sys.stdin:
        type_name, _, digits = line.strip().partition(" ")
        try:
            found = as_json(decode(getattr(rtc3d, type_name), bytes.fromhex(digits)))
        except (AttributeError, ValueError) as error:
            found = {"error": str(error)}
        print(json.dumps(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", nargs="?", default="LAB", help="the source's name in upper case")
    parser.add_argument("count", nargs="?", type=int, default=math.inf, help="stop after this many frames")
    parser.add_argument("--vectors", action="store_true", help="decode lines TYPE HEX from standard input")
    options = parser.parse_args()
    if options.vectors:
        print_vectors()
    else:
        subscribe(options.source, options.count)


if __name__ == "__main__":
    main()
