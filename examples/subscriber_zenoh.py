"""Print the markers that a gateway publishes on Zenoh. This program needs only zenoh and numpy.

    pip install eclipse-zenoh numpy
    python examples/subscriber_zenoh.py [--connect tcp/192.0.2.5:7447] [--source lab] [--count N]

A sample is an LCM message, big-endian: 56 bytes of header (fingerprint, utime, capture_utime, sequence,
session, parameters_version, frame number, time stamp, number of items), then the items, as
docs/reference/messages.md describes. The types of lcm-gen (``rtc3d.markers_t.decode``) can decode it, too.
With --vectors, the program decodes messages from standard input instead (lcm_types/vectors/README.md).
"""

import argparse
import contextlib
import itertools
import json
import math
import queue
import struct
import sys
import time
from collections.abc import Iterator

import numpy as np
import zenoh

FIELDS = ("utime", "capture_utime", "sequence", "session", "parameters_version", "frame_number", "timestamp")
HEADER = struct.Struct(">8sqqqiiiq")  # the fingerprint and these fields; then the number of items
POSE = struct.Struct(">?8f")  # of a tool_pose_t, after the header


def floats(*names: str) -> np.dtype:
    return np.dtype([(name, ">f4") for name in names])


EVENT = [("id", ">i4"), ("timestamp", ">i8"), ("param1", ">i4"), ("param2", ">i4"), ("param3", ">i4")]
# For each type: its fingerprint, the names of its two last fields, and one item.
TYPES = {
    "markers_t": ("e95d5a478ce229e4", "num_markers", "markers", floats("x", "y", "z", "reliability")),
    "tools_t": (
        "f922a353b61657b3", "num_tools", "tools", floats("q0", "qx", "qy", "qz", "x", "y", "z", "error")
    ),
    "analog_t": ("cd43a9dd46669bec", "num_channels", "voltages", np.dtype(">f4")),
    "forces_t": (
        "dc94defbb591810c", "num_plates", "plates", floats("fx", "fy", "fz", "mx", "my", "mz")
    ),
    "events_t": ("06a109c2ae7bf07c", "num_events", "events", np.dtype(EVENT)),
}  # fmt: skip
POSE_FINGERPRINT = "bf985441ca59ae7a"


def decode(type_name: str, message: bytes) -> dict:
    """Return the fields of a message of one of TYPES; the items are an array. Raises ValueError."""
    fingerprint, count_name, items_name, item = TYPES[type_name]
    fields, rest = decode_header(fingerprint, message)
    count = int.from_bytes(rest[:4], "big", signed=True)
    if len(rest) < 4 or len(rest) - 4 != count * item.itemsize:
        raise ValueError(f"{len(message)} bytes for {count} items")
    return {**fields, count_name: count, items_name: np.frombuffer(rest, item, count, offset=4)}


def decode_pose(message: bytes) -> dict:
    """Return the fields of a tool_pose_t. Raises ValueError."""
    fields, rest = decode_header(POSE_FINGERPRINT, message)
    if len(rest) != POSE.size:
        raise ValueError(f"{len(message)} bytes")
    visible, *pose, error_m = POSE.unpack(rest)
    return {
        **fields,
        "visible": visible,
        "position_m": pose[:3],
        "orientation_xyzw": pose[3:],
        "error_m": error_m,
    }


def decode_header(fingerprint: str, message: bytes) -> tuple[dict, bytes]:
    if len(message) < HEADER.size or message[:8].hex() != fingerprint:
        raise ValueError(f"{len(message)} bytes with the fingerprint {message[:8].hex()}")
    return dict(zip(FIELDS, HEADER.unpack_from(message)[1:], strict=True)), message[HEADER.size :]


def print_markers(message: dict) -> None:
    markers = message["markers"]
    visible = markers[~np.isnan(markers["x"])]
    first = ", the first at {x:.3f}, {y:.3f}, {z:.3f} mm".format_map(visible[0]) if len(visible) else ""
    print(
        f"#{message['sequence']} frame {message['frame_number']} at {message['timestamp'] / 1e6:.4f} s"
        f" with parameters {message['parameters_version']}:"
        f" {len(visible)} of {len(markers)} markers in view{first}"
    )


def refill(session: zenoh.Session, key: str, first: int, last: int) -> Iterator[bytes]:
    """Yield the messages with the numbers ``first`` to ``last`` that the gateway still has."""
    tries_left = 10
    while first <= last and tries_left:
        tries_left -= 1
        for reply in session.get(f"{key}?from={first};to={last}", timeout=2.0):
            if (
                reply.ok and reply.ok.attachment
            ):  # otherwise it is "rate" or "busy", or there is nothing any more
                payload, offset = reply.ok.payload.to_bytes(), 0
                while offset < len(payload):
                    size = int.from_bytes(payload[offset : offset + 4], "big")
                    yield payload[offset + 4 : offset + 4 + size]
                    offset += 4 + size
                first, tries_left = json.loads(reply.ok.attachment.to_bytes())["to"] + 1, 10
                break
        else:
            time.sleep(0.1)


def without_gaps(session: zenoh.Session, samples: "queue.Queue[tuple[str, bytes]]") -> Iterator[dict]:
    """Yield the messages of markers that arrive, each after those that were lost before it."""
    newest: dict[str, int] = {}  # by key
    while True:
        key, payload = samples.get()
        try:
            message = decode("markers_t", payload)
            sequence = message["sequence"]
            for missed in refill(session, key, newest.get(key, sequence) + 1, sequence - 1):
                yield decode("markers_t", missed)
        except ValueError as error:
            print(f"ignored a malformed message: {error}", file=sys.stderr)
            continue
        newest[key] = sequence
        yield message


def subscribe(endpoint: str | None, source: str, count: int) -> None:
    config = zenoh.Config()
    if endpoint:
        config.insert_json5("mode", '"client"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    # Zenoh waits while the queue is full, so even a program that is too slow does not fill the memory.
    samples: queue.Queue[tuple[str, bytes]] = queue.Queue(maxsize=10_000)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        sys.exit(f"Cannot open Zenoh; check that the gateway runs and --connect is its endpoint: {error}")
    with session:
        session.declare_subscriber(
            f"mocap/{source}/3d",
            lambda sample: samples.put((str(sample.key_expr), sample.payload.to_bytes())),
        )
        print("listening", flush=True)
        for message in itertools.islice(without_gaps(session, samples), count or None):
            print_markers(message)


def as_json(value):
    """Return the fields of a message, or a value in them, as what ``json`` writes."""
    if isinstance(value, np.ndarray | list):
        return [as_json(item) for item in value]
    if isinstance(value, np.void):
        return {name: as_json(value[name]) for name in value.dtype.names}
    if isinstance(value, np.generic):
        value = value.item()
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def print_vectors() -> None:
    """Read lines TYPE HEX, and print the values of each message, or what is wrong, as a line of JSON."""
    sys.stdin.reconfigure(errors="replace")  # or bytes that are no text would end the program
    for line in sys.stdin:
        type_name, _, digits = line.strip().partition(" ")
        try:
            message = bytes.fromhex(digits)
            found = decode_pose(message) if type_name == "tool_pose_t" else decode(type_name, message)
        except (KeyError, ValueError) as error:
            found = {"error": str(error)}
        print(json.dumps({name: as_json(value) for name, value in found.items()}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--connect", help="endpoint of the gateway or a router; default: find it by multicast"
    )
    parser.add_argument("--source", default="*")
    parser.add_argument("--count", type=int, default=0, help="stop after this many frames; 0: never")
    parser.add_argument("--vectors", action="store_true", help="decode lines TYPE HEX from standard input")
    options = parser.parse_args()
    if options.vectors:
        print_vectors()
    else:
        subscribe(options.connect, options.source, options.count)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
