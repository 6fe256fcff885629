"""A limit of a rate that allows bursts, for what peers, servers or logging may use up."""

import time
from collections.abc import Callable


class TokenBucket:
    """Allows ``per_s`` a second on average, and ``capacity`` at once.

    The default of ``capacity`` is the amount of one second, and at least 1. An amount may be larger than what
    is left: then nothing more is allowed until it has been made up for. Not safe for threads.
    """

    def __init__(
        self, per_s: float, capacity: float | None = None, monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        self._per_s = per_s
        self._capacity = max(per_s, 1.0) if capacity is None else capacity
        self._monotonic = monotonic
        self._left = self._capacity
        self._updated_s = monotonic()

    @property
    def left(self) -> float:
        """How much is allowed now; negative while an amount is being made up for."""
        return min(self._left + (self._monotonic() - self._updated_s) * self._per_s, self._capacity)

    def take(self, amount: float = 1.0, least: float | None = None) -> None:
        """Use ``amount``, but leave at least ``least``, by default ``-capacity``."""
        self._left = max(self.left - amount, -self._capacity if least is None else least)
        self._updated_s = self._monotonic()

    def try_take(self, amount: float = 1.0) -> bool:
        """Use ``amount`` if anything is left; return whether it is."""
        if self.left <= 0:
            return False
        self.take(amount)
        return True
