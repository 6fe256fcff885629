"""The rate of messages over the last seconds."""

from collections import deque
from typing import Final

_WINDOW_S: Final = 2.0


class MessageRate:
    """Messages per second, over two seconds."""

    def __init__(self) -> None:
        self._counts: deque[tuple[float, int]] = deque()  # time and number of messages so far

    def add(self, num_messages: int, now_s: float) -> None:
        """Take the number of all messages so far."""
        self._counts.append((now_s, num_messages))
        while len(self._counts) > 2 and now_s - self._counts[1][0] >= _WINDOW_S:
            self._counts.popleft()

    def shift(self, seconds: float) -> None:
        """Let everything so far have happened later: a pause does not count."""
        self._counts = deque((time_s + seconds, number) for time_s, number in self._counts)

    @property
    def rate_hz(self) -> float:
        """Messages per second; 0 before there are two counts."""
        if len(self._counts) < 2:
            return 0.0
        (first_s, first), (last_s, last) = self._counts[0], self._counts[-1]
        return (last - first) / max(last_s - first_s, 1e-3)
