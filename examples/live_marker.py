"""Print where a marker is, as the data arrive: python examples/live_marker.py [tcp/192.0.2.5:7447]"""

import sys

from gateway.client import live

endpoint = sys.argv[1] if len(sys.argv) > 1 else None  # None: find gateways by multicast

for frame in live("lab", components=["3d"], connect=endpoint):
    markers = frame.markers
    x, y, z = markers[markers.labels[0]]  # or markers["head"]; NaN while it is not visible
    lost = f", {frame.gap} missing before it" if frame.gap else ""
    label, age_ms = markers.labels[0], frame.age_s * 1000
    print(f"{label} at {x:.1f}, {y:.1f}, {z:.1f} {markers.unit}, {age_ms:.1f} ms ago{lost}")
