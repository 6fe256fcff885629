"""Two sources in one frame: python examples/live_two_sources.py [tcp/192.0.2.5:7447]"""

import sys

import numpy as np

from gateway.client import live

endpoint = sys.argv[1] if len(sys.argv) > 1 else None  # None: find gateways by multicast

# Each frame of markers of lab has what stage and the analog channels have had since the frame before.
for frame in live("lab", "stage", components=["3d", "analog"], join=True, connect=endpoint):
    stage = frame.sources.get("stage")
    if stage is None or "3d" not in stage.rows:
        continue  # stage has a lower rate, or has stopped
    distance = np.linalg.norm(frame.markers.positions[0] - stage.markers.positions[0])
    samples = len(frame.series["analog"]) if "analog" in frame.rows else 0
    apart_ms = (frame.capture_utime - stage.capture_utime) / 1000
    print(f"{distance:.1f} {frame.markers.unit} apart, {apart_ms:.1f} ms between, {samples} analog samples")
