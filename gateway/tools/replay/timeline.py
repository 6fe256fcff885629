"""Where the messages of a take are in time, without steps of clocks and without long gaps."""

import math
from collections.abc import Callable
from typing import Final, NamedTuple, Self


def time_text(duration_us: int) -> str:
    """Return a time in a take as hours, minutes, seconds and tenths: "0:01:30.2", "-0:00:02.0"."""
    minutes, tenths = divmod(abs(duration_us) // 100_000, 600)
    sign = "-" if duration_us < 0 else ""
    return f"{sign}{minutes // 60}:{minutes % 60:02}:{tenths // 10:02}.{tenths % 10}"


SHOWN_GAP_US: Final = 2_000_000
"""Gaps longer than this are reported; a complete recording has a status message every second."""

MAX_GAP_S: Final = 10.0
"""By default, longer gaps are skipped."""

_BACK_US: Final = 250_000
"""Messages may be out of order by this much; by more, somebody has set the clock back."""


class Jump(NamedTuple):
    """A place where the time of the messages jumps: by ``jump_us``, at ``position_us`` of the replay.

    If it is skipped, the next message follows at once. Otherwise, the replay waits for that long.
    """

    position_us: int
    source: str
    jump_us: int
    is_skipped: bool


class ReplayTimeline:
    """Gives each message a position: µs since the first one, as if nobody had set a clock meanwhile.

    A message whose time is before the newest position, or more than ``max_gap_s`` after it, follows at once,
    and the time of its source goes on from there: either somebody has set the clock of the gateway that
    published it, or nothing was recorded for that long. A message that is only behind those of other keys was
    requested late by the recorder: it follows at once, and the time goes on as before. Each source has its
    own clock, because a take can have sources of several gateways. ``on_jump`` is called for each jump,
    before ``place`` returns.
    """

    def __init__(
        self, max_gap_s: float = MAX_GAP_S, on_jump: Callable[[Jump], None] = lambda _jump: None
    ) -> None:
        self.position_us = 0
        """The newest position; positions never decrease."""
        self._on_jump = on_jump
        self._max_gap_us = round(max_gap_s * 1e6)
        self._starts: dict[str, int] = {}  # by source: the time of the message that would be at position 0
        self._newest_start = 0  # the newest of these
        self._newest_utimes: dict[tuple[str, str], int] = {}  # by source and key

    def go_on(self, other: Self) -> Self:
        """Go on from where another one is."""
        self.position_us, self._newest_start = other.position_us, other._newest_start
        self._starts = dict(other._starts)
        self._newest_utimes = dict(other._newest_utimes)
        return self

    def place(self, source: str, key: str, utime: int) -> int:
        """Return the position of the next message; ``utime`` is its time in µs since the Unix epoch."""
        start = self._starts.get(source)
        if start is None:
            start = self._begin(source, utime)
        ahead_us = utime - start - self.position_us
        newest_utime = self._newest_utimes.get((source, key), math.inf)
        self._newest_utimes[source, key] = utime
        if ahead_us < -_BACK_US and utime >= newest_utime:
            return self.position_us
        if ahead_us > SHOWN_GAP_US or ahead_us < -_BACK_US:
            ahead_us = self._jump(source, utime, ahead_us)
        if ahead_us > 0:
            self.position_us += ahead_us
        return self.position_us

    def _begin(self, source: str, utime: int) -> int:
        """Return the start of a new source: that of the others, unless its clock is slower than theirs."""
        start = self._newest_start if self._starts else utime
        if utime - start - self.position_us < -_BACK_US:
            start = utime - self.position_us
        self._starts[source] = self._newest_start = start
        return start

    def _jump(self, source: str, utime: int, ahead_us: int) -> int:
        """Return how far ahead of the newest position the message is, once the jump is known."""
        is_gap = 0 < ahead_us <= self._max_gap_us
        if not is_gap:
            shared_us = utime - self._newest_start - self.position_us
            is_known = -_BACK_US <= shared_us <= SHOWN_GAP_US  # another source has had the same jump
            self._newest_start = self._newest_start if is_known else utime - self.position_us
            self._starts[source] = self._newest_start
            if is_known:
                return shared_us
        self._on_jump(Jump(self.position_us, source, ahead_us, not is_gap))
        return ahead_us if is_gap else 0
