"""Finds frames that the server did not send, by the numbers and the time stamps of those that it sent."""

from typing import Final

_PROOF_FRAMES: Final = 200
"""After this many equal steps in a row, the numbering is regular. Odd numbering (field note 11) never is."""

_CONFIRMATION_FRAMES: Final = 20
_MAX_UNCONFIRMED_FRAMES: Final = 200
"""A gap counts when this many regular steps follow it in a row, within so many frames.

Otherwise the rate may have changed: a server that sends every other frame makes a gap with each of them.
"""

_MAX_GAPS_IN_A_ROW: Final = 2
"""With more gaps in a row, without a regular step between them, the rate has changed."""

_MAX_DEVIATION: Final = 0.5
"""How much the time stamps may deviate from the gap in the numbers, in periods."""


class MissingFrames:
    """Finds gaps in the numbers of one type of component in one session.

    It reports only gaps that it is sure of: in numbers that grew in equal steps for a long time, before and
    after the gap, where the time stamps have the same gap.
    """

    def __init__(self) -> None:
        self._number: int | None = None  # of the newest frame; None if the next one does not continue it
        self._timestamp_us = 0
        self._step = 0  # the newest step; once it is proven, the regular one
        self._run = 0  # how many regular steps came in a row
        self._run_start_us = 0
        self._period_us = 0.0  # of regular steps; 0 until they are proven
        self._missing = 0  # frames in gaps that are not confirmed
        self._unconfirmed = 0  # frames since the first of these gaps
        self._gaps_in_a_row = 0

    def interrupt(self) -> None:
        """Expect that the next frame does not continue the newest one, and learn the steps again."""
        self._number = None

    def observe(self, number: int, timestamp_us: int) -> int:
        """Take the number and the time stamp of the next frame; return how many frames are missing.

        They are counted when they are confirmed, so this is some frames later.
        """
        before, before_us = self._number, self._timestamp_us
        self._number = number
        self._timestamp_us = timestamp_us
        if before is None:
            self._learn(0, timestamp_us)
            return 0
        step = number - before
        if step != self._step:
            self._take_other_step(step, before_us, timestamp_us)
            return 0
        self._run += 1
        if self._run == _PROOF_FRAMES and not self._period_us and step > 0:
            self._period_us = (timestamp_us - self._run_start_us) / _PROOF_FRAMES
        if not self._missing or self._run < _CONFIRMATION_FRAMES:
            return 0
        missing = self._missing
        self._missing = self._unconfirmed = self._gaps_in_a_row = 0
        return missing

    def _learn(self, step: int, timestamp_us: int) -> None:
        """Begin to learn the steps, because they are not regular, or no longer."""
        self._step = step
        self._run = 0
        self._run_start_us = timestamp_us
        self._period_us = 0.0
        self._missing = self._unconfirmed = self._gaps_in_a_row = 0

    def _take_other_step(self, step: int, before_us: int, timestamp_us: int) -> None:
        if self._period_us > 0 and step > self._step and step % self._step == 0:
            num_steps = step // self._step
            periods = (timestamp_us - before_us) / self._period_us
            if abs(periods - num_steps) <= _MAX_DEVIATION:
                self._gaps_in_a_row = 1 if self._run else self._gaps_in_a_row + 1
                self._unconfirmed += self._run + 1 if self._missing else 0
                self._missing += num_steps - 1
                self._run = 0
                if self._gaps_in_a_row <= _MAX_GAPS_IN_A_ROW and self._unconfirmed <= _MAX_UNCONFIRMED_FRAMES:
                    return
        self._learn(step, timestamp_us)
