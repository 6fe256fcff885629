"""Print the markers that a gateway publishes on LCM, with the message types from the gateway's package.

    python examples/subscriber_lcm.py [SOURCE [COUNT]]        for example: subscriber_lcm.py LAB 100

It needs the gateway's Python package, which has the module ``rtc3d`` and brings ``lcm``.
SOURCE is the name of the source in upper case. The program stops after COUNT frames. With --vectors, it
decodes messages from standard input instead (lcm_types/vectors/README.md).
"""

import argparse
import contextlib
import io
import json
import math
import os
import re
import signal
import struct
import sys
import uuid

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


class Subscriber:
    """Prints ``count`` frames in order. Those that are lost, the gateway sends again while it has them."""

    def __init__(self, source: str, count: float) -> None:
        url = os.environ.get("LCM_DEFAULT_URL") or "udpm://239.255.76.67:7667"
        self.connection = lcm.LCM(url)
        # Requests, and what the gateway sends again, go to the next port.
        self.queries = lcm.LCM(re.sub(r":(\d+)", lambda port: f":{int(port[1]) + 1}", url, count=1))
        self.channel = f"MOCAP_{source}"
        self.request = rtc3d.command_request_t()
        self.request.requester, self.request.command = f"subscriber {uuid.uuid4()}", "history"
        self.frames_left = count
        self.newest = -1  # the number of the newest frame; -1 before the first
        # The default of 30 loses frames whenever this program pauses.
        self.connection.subscribe(f"{self.channel}_3D", self.on_markers).set_queue_capacity(1000)
        self.queries.subscribe(f"{self.channel}_3D_REFILL", self.on_refill).set_queue_capacity(5000)

    def on_markers(self, _channel: str, data: bytes) -> None:
        try:
            message = decode(rtc3d.markers_t, data)
        except ValueError as error:
            print(f"ignored a malformed message: {error}", file=sys.stderr)
            return
        if self.newest >= 0:
            self.refill(message.sequence - 1)
        self.show(message)

    def refill(self, last: int) -> None:
        """Ask for the frames after the newest one, up to ``last``, as long as any come."""
        tries_left = 5
        while self.newest < last and tries_left:
            before = self.newest
            self.request.request_id += 1
            self.request.options = ["key=3d", f"from={self.newest + 1}", f"to={last}"]
            self.request.num_options = len(self.request.options)
            self.queries.publish(f"{self.channel}_COMMAND_REQUEST", self.request.encode())
            while self.newest < last and self.queries.handle_timeout(200):
                pass
            tries_left = tries_left - 1 if self.newest == before else 5

    def on_refill(self, _channel: str, data: bytes) -> None:
        with contextlib.suppress(ValueError):
            message = decode(rtc3d.markers_t, data)
            if message.sequence == self.newest + 1:
                self.show(message)

    def show(self, message) -> None:
        self.newest = message.sequence
        if self.frames_left > 0:
            print_markers(message)
        self.frames_left -= 1


def subscribe(source: str, count: float) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # LCM's handle() would turn Ctrl-C into an OSError
    try:
        subscriber = Subscriber(source, count)
    except RuntimeError:
        sys.exit("Cannot open LCM; check $LCM_DEFAULT_URL and the multicast route")
    print("listening", flush=True)
    while subscriber.frames_left > 0:
        subscriber.connection.handle()


def as_json(value):
    """Return a message, or a value in one, as what ``json`` writes."""
    if hasattr(value, "__slots__"):
        return {name: as_json(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, list | tuple):
        return [as_json(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def print_vectors() -> None:
    """Read lines TYPE HEX, and print the values of each message, or what is wrong, as a line of JSON."""
    sys.stdin.reconfigure(errors="replace")  # or bytes that are no text would end the program
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
