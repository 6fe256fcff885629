"""Plot the vertical force of a plate, live: python examples/live_plot.py [tcp/192.0.2.5:7447]"""

import sys

import matplotlib.pyplot as plt
import numpy as np

from gateway.client import live

SHOWN_S = 5.0
endpoint = sys.argv[1] if len(sys.argv) > 1 else None  # None: find gateways by multicast

figure, axes = plt.subplots()
[line] = axes.plot([], [])
axes.set_xlabel("s since the first message")
plt.pause(0.01)  # shows the window
seconds, loads = np.empty(0), np.empty(0)
with live("lab", components=["force"], connect=endpoint) as data:
    while plt.fignum_exists(figure.number):
        source = data.collect(0.05).sources.get("lab")  # what has arrived in 0.05 s, as in a take
        if source is not None and source.forces is not None:
            forces = source.forces
            if not len(seconds):
                axes.set_ylabel(f"{forces.labels[0]}, fz in {forces.unit}")
                print(f"plotting {forces.labels[0]}", flush=True)
            seconds = np.concatenate([seconds, forces.seconds])
            loads = np.concatenate([loads, forces.items["fz"][:, 0]])
            is_shown = seconds > seconds[-1] - SHOWN_S
            seconds, loads = seconds[is_shown], loads[is_shown]
            line.set_data(seconds, loads)
            axes.relim()
            axes.autoscale_view()
        plt.pause(0.01)
