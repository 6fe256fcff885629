"""Prints the markers that a gateway publishes on Zenoh, with zenoh and numpy alone.

    python examples/subscriber_zenoh.py [--connect tcp/192.0.2.5:7447] [--source lab] [--count N]

A sample is the LCM message ``rtc3d.markers_t``, big-endian: 52 bytes of header (fingerprint, utime,
capture_utime, sequence, session, frame number, time stamp, count), then x, y, z, reliability per
marker. lcm-gen's own types (``rtc3d.markers_t.decode``) read it as well.
"""

import argparse
import json
import queue
import struct

import numpy as np
import zenoh

HEADER = struct.Struct(">8sqqqiiqi")
MARKER = np.dtype([("x", ">f4"), ("y", ">f4"), ("z", ">f4"), ("reliability", ">f4")])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--connect", help="endpoint of the gateway or of a router; else it is looked for")
    parser.add_argument("--source", default="*")
    parser.add_argument("--count", type=int, default=0, help="stop after so many frames; 0: never")
    options = parser.parse_args()

    config = zenoh.Config()
    if options.connect:
        config.insert_json5("mode", '"client"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("connect/endpoints", json.dumps([options.connect]))
    samples: queue.Queue[bytes] = queue.Queue()
    with zenoh.open(config) as session:
        session.declare_subscriber(
            f"mocap/{options.source}/3d", lambda sample: samples.put(sample.payload.to_bytes())
        )
        print("listening", flush=True)
        shown = 0
        while not options.count or shown < options.count:
            message = samples.get()
            _, _, _, sequence, _, frame_number, _, num_markers = HEADER.unpack_from(message)
            markers = np.frombuffer(message, MARKER, num_markers, HEADER.size)
            visible = ~np.isnan(markers["x"])
            print(f"#{sequence} frame {frame_number}: {visible.sum()} of {num_markers} markers in view")
            if visible.any():
                first = markers[visible][0]
                print(f"  the first at {first['x']:.3f}, {first['y']:.3f}, {first['z']:.3f} mm")
            shown += 1


if __name__ == "__main__":
    main()
