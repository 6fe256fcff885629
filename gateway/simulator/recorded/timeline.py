"""When the messages of a take are due: by the server's time stamps, or else by the time of capture."""

from typing import Final

from gateway.rtc3d.components import ComponentType

_TOLERANCE_US: Final = 250_000
"""Time stamps that differ by more than this from the time of capture are not followed any more."""

_MAX_STEP_US: Final = 1_000_000
"""If the clock of the recording computer was set, time stamps still advance by at most this much."""

_PROOF_US: Final = 1_000_000
"""After time stamps were not plausible, they must advance like the time of capture for this long."""

_MAX_PAUSE_US: Final = 86_400_000_000
"""A longer pause is no real one: the computer's clock was set, or a time is damaged."""

_DRIFT: Final = 1e-3
"""Two clocks may differ by this much of the elapsed time; a crystal is off by 1e-4 at most."""


class TakeTimeline:
    """Places the messages of one source on the time of its take, in µs from the first one.

    A server has one clock, which all its components share. Its time stamps are followed while they advance
    as the time of capture does. They do not if the server restarts, if they wrap around, or if they are no
    times at all. Then the time of capture counts until they have proved themselves for a second. If it is
    the time of capture that jumps, because somebody has set the recording computer's clock, the time stamps
    still count.
    """

    def __init__(self) -> None:
        self._server_offset_us: int | None = None  # the time in the take minus the time stamp
        self._capture_offset_us = 0  # the time in the take minus the time of capture
        self._capture_utime = 0  # of the newest message
        self._newest_us = 0
        self._trusted_from_utime: int | None = None  # when time stamps can be trusted again; None for now
        self._last: dict[ComponentType, tuple[int, int, int]] = {}

    def time_us(self, component: ComponentType, session: int, timestamp_us: int, capture_utime: int) -> int:
        """Return when a message is due. ``session`` is the number of its connection to the server."""
        time_us = self._place(component, session, timestamp_us, capture_utime)
        self._newest_us = max(self._newest_us, time_us)
        return time_us

    def _place(self, component: ComponentType, session: int, timestamp_us: int, capture_utime: int) -> int:
        if self._server_offset_us is None:
            self._server_offset_us = -timestamp_us
            self._capture_offset_us = -capture_utime
            self._capture_utime = capture_utime
        last = self._last.get(component)
        self._last[component] = (session, timestamp_us, capture_utime)
        server_us = timestamp_us + self._server_offset_us
        captured_us = capture_utime + self._capture_offset_us
        is_repeated = last is not None and last[0] == session and timestamp_us <= last[1]
        if not is_repeated and abs(server_us - captured_us) <= _TOLERANCE_US:
            if self._trusted_from_utime is not None and capture_utime >= self._trusted_from_utime:
                self._trusted_from_utime = None
            if self._trusted_from_utime is None:
                self._follow_drift(server_us - captured_us, capture_utime)
                return server_us
            return captured_us
        if self._trusted_from_utime is None and _has_clock_step(last, session, timestamp_us, capture_utime):
            self._capture_offset_us += server_us - captured_us
            self._capture_utime = capture_utime
            return server_us
        if not -_TOLERANCE_US <= captured_us - self._newest_us <= _MAX_PAUSE_US:
            self._capture_offset_us += self._newest_us - captured_us
            captured_us = self._newest_us
        self._server_offset_us = captured_us - timestamp_us
        self._trusted_from_utime = capture_utime + _PROOF_US
        self._capture_utime = capture_utime
        return captured_us

    def _follow_drift(self, error_us: int, capture_utime: int) -> None:
        limit_us = int(_DRIFT * max(0, capture_utime - self._capture_utime))
        if limit_us:  # otherwise too little time has passed
            self._capture_offset_us += max(-limit_us, min(error_us, limit_us))
            self._capture_utime = capture_utime


def _has_clock_step(
    last: tuple[int, int, int] | None, session: int, timestamp_us: int, capture_utime: int
) -> bool:
    """Return whether time stamps continue, while the time of capture jumps."""
    if last is None or last[0] != session:
        return False
    step_us = timestamp_us - last[1]
    return 0 < step_us <= _MAX_STEP_US and abs(capture_utime - last[2] - step_us) > _TOLERANCE_US
