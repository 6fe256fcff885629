"""Use the newest pose 100 times a second: python examples/live_control.py [tcp/192.0.2.5:7447]"""

import sys
import time

import numpy as np

from gateway.client import live

PERIOD_S = 0.01
MAX_AGE_S = 0.1
endpoint = sys.argv[1] if len(sys.argv) > 1 else None  # None: find gateways by multicast

with live("lab", components=["6d"], connect=endpoint) as data:
    while True:
        frame = data.latest("6d", max_age_s=MAX_AGE_S)
        if frame is None:
            print("stop: no pose is new enough", flush=True)
        else:
            tools = frame.tools
            position, quaternion = tools.positions[0], tools.quaternions_xyzw[0]
            if np.isnan(position).any():
                print(f"stop: {tools.labels[0]} is not visible", flush=True)
            else:
                print(
                    f"{tools.labels[0]} at {position}, turned by {quaternion}, {frame.age_s * 1e3:.1f} ms old"
                )
        time.sleep(PERIOD_S)
