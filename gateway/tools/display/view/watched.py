"""What the view receives from gateways: all while a page is open, and nothing soon after the last is gone."""

import sys
import time
from collections.abc import Callable
from typing import Final

from gateway.client.transport import GatewaySubscriber, close_in_time
from gateway.errors import GatewayError
from gateway.runtime.safe_text import safe_text
from gateway.tools.display.live import LiveData

LINGER_S: Final = 10.0
"""How long the view goes on receiving without a page: a page that is loaded again finds everything there."""

_RETRY_S: Final = 1.0


class WatchedSubscriber:
    """Subscribes with ``subscribe`` while ``is_watched`` returns that a page is open, and LINGER_S longer.

    Receiving what nobody sees would take a tenth of a core. It begins at once, so that the first page has
    something to show; ``subscribe`` should begin with the last seconds, so that later pages have, too. Raises
    what ``subscribe`` raises; later, that is printed and tried again.
    """

    def __init__(
        self,
        live: LiveData,
        subscribe: Callable[[], GatewaySubscriber],
        is_watched: Callable[[], object],
        monotonic: Callable[[], float] = time.monotonic,
        takes_period_s: float = 2.0,
    ) -> None:
        self.subscriber: GatewaySubscriber | None = subscribe()
        """None while nothing is received."""
        self._live = live
        self._subscribe = subscribe
        self._is_watched = is_watched
        self._monotonic = monotonic
        self._watched_s = monotonic()
        self._retry_s = 0.0
        self._takes_period_s = takes_period_s  # how often the running takes are queried
        self._takes_due_s = 0.0

    def tick(self) -> None:
        """Do what is due. Call it often."""
        now_s = self._monotonic()
        is_watched = bool(self._is_watched())
        if is_watched:
            self._watched_s = now_s
            if self.subscriber is None and now_s >= self._retry_s:
                self._open(now_s)
        elif now_s - self._watched_s > LINGER_S:
            self.close()
        if self.subscriber is None:
            return
        self.subscriber.tick()
        if is_watched and now_s >= self._takes_due_s:
            self._takes_due_s = now_s + self._takes_period_s
            self._query_takes(self.subscriber)

    def _open(self, now_s: float) -> None:
        # What was received before is old, and the numbers of its series do not go on.
        self._live.begin_again()
        try:
            self.subscriber = self._subscribe()
        except GatewayError as error:
            if not self._retry_s:
                print(safe_text(str(error)), file=sys.stderr, flush=True)
            self._retry_s = now_s + _RETRY_S
        else:
            self._retry_s = 0.0

    def _query_takes(self, subscriber: GatewaySubscriber) -> None:
        """Query the gateways that have the output takes."""
        for source in self._live.sources_now:
            outputs = source.report.outputs if source.report else ()
            if any(output.output == "takes" for output in outputs):
                subscriber.query_takes(source)

    def close(self) -> None:
        """Receive nothing more."""
        subscriber, self.subscriber = self.subscriber, None
        if subscriber is not None:
            close_in_time(subscriber)
