"""Prints what the real libvrpn receives, as lines of JSON: the pose of each tracker with a new one.

A pose is x, y, z, qx, qy, qz, qw. The argument is the server's address in libvrpn's form: HOST:PORT, which
asks by UDP to be called back, or tcp://HOST:PORT. Run it in a process of its own: libvrpn blocks and prints.
"""

import json
import sys

import motioncapture


def main() -> None:
    capture = motioncapture.connect("vrpn", {"hostname": sys.argv[1], "updateFrequency": "200"})
    while True:
        capture.waitForNextFrame()
        poses = {
            name: [*map(float, body.position), *(getattr(body.rotation, axis) for axis in "xyzw")]
            for name, body in capture.rigidBodies.items()
        }
        if poses:
            print(json.dumps(poses), flush=True)


if __name__ == "__main__":
    main()
