"""How long data wait in this program before they are sent to the browsers."""

from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from gateway.live.latency import Percentiles
from gateway.live.live_data import LiveSource
from gateway.messages.host_time import now_utime

_NUM_SAMPLES: Final = 300
"""10 s at 30 pictures per second."""


class ShownLatency:
    """The time from the arrival of what is shown to its sending, by source and component."""

    def __init__(self) -> None:
        self._samples_ms: dict[str, dict[str, deque[float]]] = {}

    def add(self, sources: Sequence[LiveSource]) -> None:
        """Take the newest messages, which are sent to the browsers now."""
        now = now_utime()
        for source in sources:
            samples_ms = self._samples_ms.setdefault(source.name, {})
            for key, component in [*source.components.items()]:
                arrived_utime = component.newest_arrived_utime
                if len(component.batch.heads) and arrived_utime is not None:
                    of_component = samples_ms.setdefault(key, deque(maxlen=_NUM_SAMPLES))
                    of_component.append((now - arrived_utime) / 1000)

    def percentiles(self, source: str) -> dict[str, Percentiles]:
        """Return the percentiles of the newest samples, by component."""
        found = {}
        for key, samples_ms in self._samples_ms.get(source, {}).items():
            p50, p99 = np.percentile([*samples_ms], (50, 99))
            found[key] = Percentiles(float(p50), float(p99))
        return found
