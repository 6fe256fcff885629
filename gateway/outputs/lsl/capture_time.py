"""When a frame was captured, on the monotonic clock of this computer, which is LSL's clock."""

import time
from typing import Final

from gateway.messages.host_time import HostClock, host_clock, now_steady_us
from gateway.messages.stamp import Stamp

_READINGS: Final = 5
"""How many pairs of readings are compared: the process may be interrupted between two clocks."""

_MEASURE_S: Final = 1.0
_CHANGE_US: Final = 1_000
"""The two clocks differ only while the computer is suspended, so a smaller change is an error of reading."""


class CaptureTimes:
    """Finds the capture time of frames on the steady clock (host_time), whatever happens to the wall clock.

    The times in a stamp are the steady clock plus the offset of the wall clock when the frame arrived. If
    somebody has set the wall clock since then, the former offset counts. The stamp does not say which one
    that was, but the frame has arrived a moment ago: the other offset gives another time.
    """

    def __init__(self, clock: HostClock = host_clock) -> None:
        self._clock = clock
        self._offset_us = self._former_offset_us = clock.offset_us
        self._changed_us = 0  # when the change was noticed, on the steady clock

    def steady_us(self, stamp: Stamp) -> int:
        """Return when the frame of ``stamp``, which has just arrived, was captured."""
        now_us = now_steady_us()
        offset_us = self._clock.offset_us
        if offset_us != self._offset_us:
            self._former_offset_us, self._offset_us, self._changed_us = self._offset_us, offset_us, now_us
        if not self._changed_us <= stamp.utime - offset_us <= now_us:
            ages_us = [
                (now_us + offset - stamp.utime, offset) for offset in (offset_us, self._former_offset_us)
            ]
            offset_us = min((each for each in ages_us if each[0] >= 0), default=ages_us[0])[1]
        return stamp.capture_utime - offset_us


class SuspendedTime:
    """How much the steady clock is ahead of the monotonic one: it also counts while the computer sleeps."""

    def __init__(self) -> None:
        self._us = _measured_difference_us()
        self._measured_s = time.monotonic()

    def read_us(self) -> int:
        """Return the difference in µs. It is the same in every call until the computer is suspended."""
        now_s = time.monotonic()
        if now_s - self._measured_s >= _MEASURE_S:
            self._measured_s = now_s
            difference_us = _measured_difference_us()
            if abs(difference_us - self._us) >= _CHANGE_US:
                self._us = difference_us
        return self._us


def _measured_difference_us() -> int:
    """Return steady clock minus monotonic clock, from the reading that was interrupted least."""
    best_us, difference_us = -1, 0
    for _ in range(_READINGS):
        before_us = time.monotonic_ns() // 1000
        steady_us = now_steady_us()
        duration_us = time.monotonic_ns() // 1000 - before_us
        if best_us < 0 or duration_us < best_us:
            best_us, difference_us = duration_us, steady_us - before_us
    return difference_us
