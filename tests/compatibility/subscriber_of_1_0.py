"""A subscriber as somebody may have written it for version 1.0: Python's standard library, and the documents.

Run with the multicast port of LCM, it prints a line of JSON for each message that it can decode. It stands
for the programs of others, which must go on working with every 1.x, so it is never changed. It imports
nothing of the gateway.
"""

import json
import socket
import struct
import sys
from typing import Any

GROUP = "239.255.76.67"

# The layouts of docs/reference/messages.md: name and fingerprint, the name of the list, and its items.
COMPONENTS = {
    "e95d5a478ce229e4": ("markers_t", "markers", ">ffff", ("x", "y", "z", "reliability")),
    "f922a353b61657b3": ("tools_t", "tools", ">ffffffff", ("q0", "qx", "qy", "qz", "x", "y", "z", "error")),
    "cd43a9dd46669bec": ("analog_t", "voltages", ">f", ("voltage",)),
    "dc94defbb591810c": ("forces_t", "plates", ">ffffff", ("fx", "fy", "fz", "mx", "my", "mz")),
    "06a109c2ae7bf07c": ("events_t", "events", ">iqiii", ("id", "timestamp", "param1", "param2", "param3")),
}
TOOL_POSE = "bf985441ca59ae7a"
PARAMETERS = "b887caaa43d8318b"


def decode(message: bytes) -> dict[str, Any] | None:
    """Return the values of a message; None if it has a type that this program does not know."""
    fingerprint = message[:8].hex()
    if fingerprint not in {*COMPONENTS, TOOL_POSE, PARAMETERS}:
        return None
    utime, capture_utime, sequence, session, parameters_version = struct.unpack_from(">qqqii", message, 8)
    values: dict[str, Any] = {"utime": utime, "capture_utime": capture_utime, "sequence": sequence}
    values |= {"session": session, "parameters_version": parameters_version}
    if fingerprint in COMPONENTS:
        values["type"], items, layout, names = COMPONENTS[fingerprint]
        values["frame_number"], values["timestamp"], count = struct.unpack_from(">iqi", message, 40)
        size = struct.calcsize(layout)
        if len(message) != 56 + count * size:
            raise ValueError(f"{values['type']}: {len(message)} bytes for {count} items")
        values[items] = [
            dict(zip(names, struct.unpack_from(layout, message, 56 + place * size), strict=True))
            for place in range(count)
        ]
        return values
    if fingerprint == TOOL_POSE:
        values["type"] = "tool_pose_t"
        values["frame_number"], values["timestamp"], visible = struct.unpack_from(">iq?", message, 40)
        numbers = struct.unpack_from(">8f", message, 53)
        return values | {
            "visible": visible,
            "position_m": numbers[:3],
            "orientation_xyzw": numbers[3:7],
            "error_m": numbers[7],
        }
    (length,) = struct.unpack_from(">i", message, 40)
    return values | {"type": "parameters_t", "xml": message[44 : 44 + length - 1].decode()}


def main() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        receiver.bind((GROUP, int(sys.argv[1])))
        receiver.setsockopt(
            socket.IPPROTO_IP,
            socket.IP_ADD_MEMBERSHIP,
            socket.inet_aton(GROUP) + socket.inet_aton("0.0.0.0"),  # noqa: S104 - any interface
        )
        while True:
            packet = receiver.recv(65536)
            if packet[:4] == b"LC02":
                channel, _, message = packet[8:].partition(b"\0")
                values = decode(message)
                if values is not None:
                    print(json.dumps({"channel": channel.decode()} | values), flush=True)


if __name__ == "__main__":
    main()
