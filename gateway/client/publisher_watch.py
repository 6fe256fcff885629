"""Whether two gateways publish one key, as the numbers of what arrives show."""

from typing import Final

from gateway.messages.sequence_check import SequenceCheck

TWO_GATEWAYS_S: Final = 2.0
"""Two gateways publish while their numbers alternate this often. Each has a status every second."""

_MANY_ALTERNATIONS: Final = 10


class PublisherWatch:
    """Follows the numbers of a key in the order of their arrival. What is over is over."""

    def __init__(self) -> None:
        self._arrivals = SequenceCheck()
        self._num_alternations = 0  # without a pause
        self._alternated_s = -TWO_GATEWAYS_S

    def add(self, sequence: int, utime: int, session: int, now_s: float) -> None:
        """Take the next message."""
        former = self._arrivals.num_alternations
        self._arrivals.add(sequence, utime, session)
        if self._arrivals.num_alternations > former:
            self._num_alternations = self._num_alternations + 1 if self._has_alternated(now_s) else 1
            self._alternated_s = now_s

    def sees_two(self, now_s: float) -> bool:
        """Whether two gateways publish now."""
        return self._num_alternations >= _MANY_ALTERNATIONS and self._has_alternated(now_s)

    def _has_alternated(self, now_s: float) -> bool:
        return now_s - self._alternated_s < TWO_GATEWAYS_S
