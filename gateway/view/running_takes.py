"""Whether gateways record takes: a query now and then, while somebody looks."""

import time
from collections.abc import Callable
from typing import Final

from gateway.live.live_data import LiveData
from gateway.subscriber.subscribe import GatewaySubscriber

PERIOD_S: Final = 2.0


class RunningTakes:
    """Queries the gateways that have the output takes; ``is_watched`` says whether a page is open."""

    def __init__(
        self,
        live: LiveData,
        subscriber: GatewaySubscriber,
        is_watched: Callable[[], object],
        period_s: float = PERIOD_S,
    ) -> None:
        self._live = live
        self._subscriber = subscriber
        self._is_watched = is_watched
        self._period_s = period_s
        self._due_s = 0.0

    def tick(self) -> None:
        """Query if it is time. Call it often."""
        now_s = time.monotonic()
        if now_s < self._due_s or not self._is_watched():
            return
        self._due_s = now_s + self._period_s
        for source in self._live.sources_now:
            outputs = source.newest_status.outputs if source.newest_status else ()
            if any(output.name == "takes" for output in outputs):
                self._subscriber.query_takes(source)
