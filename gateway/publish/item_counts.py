"""The numbers of markers, tools, channels and plates in the frames of one source: logs their changes."""

import logging
import time
from collections.abc import Callable, Mapping
from typing import Final

from gateway.rtc3d.components import ComponentType

_HOLD_S: Final = 30.0
"""After a change was logged, further ones of the same component are logged together after this time."""

logger = logging.getLogger(__name__)


class _Count:
    """The number of items of one component, with the session in which it arrived."""

    def __init__(self, num_items: int, session: int) -> None:
        self.num_items = num_items
        self.session = session
        self.logged_s = float("-inf")  # when a change was last logged
        self.logged_items = num_items  # the number that this log message named
        self.num_changes = 0  # since then


class ItemCounts:
    """Logs each change in a number of items, unless a server changes it again and again."""

    def __init__(self, source: str, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._source = source
        self._monotonic = monotonic
        self._counts: dict[ComponentType, _Count] = {}

    def update(self, num_items: Mapping[ComponentType, int], session: int) -> bool:
        """Take the numbers of one frame; return whether one has changed within the session."""
        is_changed = False
        for component, number in num_items.items():
            count = self._counts.get(component)
            if count is None:
                self._counts[component] = _Count(number, session)
                continue
            if count.num_items != number:
                count.num_items = number
                count.num_changes += 1
                self._log(component, count)
                is_changed = is_changed or session == count.session
            count.session = session
        return is_changed

    def check(self) -> None:
        """Log changes that have not been logged yet, if it is time. Call it every second."""
        for component, count in self._counts.items():
            if count.num_changes:
                self._log(component, count)

    def _log(self, component: ComponentType, count: _Count) -> None:
        now_s = self._monotonic()
        if now_s - count.logged_s < _HOLD_S:
            return
        times = f", after {count.num_changes} changes" if count.num_changes > 1 else ""
        logger.info(
            "%s: number of items in %s changed from %d to %d%s",
            *(self._source, component.key, count.logged_items, count.num_items, times),
        )
        count.logged_s = now_s
        count.logged_items = count.num_items
        count.num_changes = 0
