"""Record 5 s into a file of numpy: python examples/live_record.py lab.npz [tcp/192.0.2.5:7447]"""

import sys
from typing import Any

import numpy as np

from gateway.client import live
from gateway.takes import Take


def arrays(take: Take) -> dict[str, Any]:
    """Return what to save of a take, which was received or comes from open_take."""
    found = {}
    for name, source in take.sources.items():
        for key, series in source.series.items():
            found[f"{name}_{key}_seconds"] = series.seconds
            found[f"{name}_{key}_items"] = series.items
            found[f"{name}_{key}_labels"] = np.array(series.labels)
            print(f"{name} {key}: {len(series)} frames, {len(series.labels)} labels")
    return found


endpoint = sys.argv[2] if len(sys.argv) > 2 else None  # None: find gateways by multicast

with live("lab", connect=endpoint) as data:
    for _frame in data:
        break  # wait for the first message
    np.savez(sys.argv[1], **arrays(data.collect(5.0)))
    print(f"{data.num_dropped} messages were dropped")
