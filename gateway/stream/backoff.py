"""How long to wait between attempts to connect."""

import random
from typing import Final

from gateway.config.settings import ReconnectSettings

STEADY_S: Final = 10.0
"""A connection with data that lasted this long has succeeded: the delays start again."""

_MAX_DOUBLINGS: Final = 30


class Backoff:
    """The delays between attempts: doubling up to a maximum, each shortened at random by up to half.

    The randomness prevents many gateways from reconnecting to a restarted server at the same moment.

    A connection that brings data and lasts for STEADY_S starts the delays again. One that breaks earlier
    counts as a failure. So a server that sends a few good frames and breaks, again and again, is tried as
    rarely as one that is off. There is one exception: the delays that have grown while a server was off start
    again with the first data. So a server that comes back and is restarted once more is not kept waiting.
    """

    def __init__(self, reconnect: ReconnectSettings) -> None:
        self._first_s = reconnect.first_delay_s
        self._max_s = reconnect.max_delay_s
        self._num_failures = 0  # attempts in a row without data
        self._num_breaks = 0  # connections in a row with data, but not for STEADY_S

    @property
    def shortest_s(self) -> float:
        """A first delay, shortened at random."""
        return self._shortened(self._first_s)

    def delay_after(self, lasted_s: float, *, had_data: bool) -> float:
        """Return the delay after an attempt that lasted so long, and brought data or not."""
        if not had_data:
            self._num_failures += 1
        elif lasted_s < STEADY_S:
            self._num_failures = 0
            self._num_breaks += 1
        else:
            self._num_failures = 1
            self._num_breaks = 0
        doublings = min(self._num_failures + self._num_breaks - 1, _MAX_DOUBLINGS)
        return self._shortened(min(self._first_s * 2.0**doublings, self._max_s))

    @staticmethod
    def _shortened(delay_s: float) -> float:
        return delay_s * random.uniform(0.5, 1.0)  # noqa: S311 - spreads load, hides nothing
