"""The time by which takes count as too old: it follows the computer's clock as far as that is credible."""

import logging
import os
from pathlib import Path
from typing import Final

BELIEVED_AFTER_S: Final = 3600.0
"""How long the clock must go on without a step before a gap is believed. After the start of a computer, a
time server or a person corrects a wrong clock within this time."""

MAX_GAP_S: Final = 31 * 86_400.0
"""The longest time without a gateway that is believed; a longer one is more likely a wrong clock."""

FILE: Final = ".rtc3d-gateway.time"

STEP_S: Final = 60.0
"""Deviation from the monotonic clock between two checks that is a step; time servers slew by less."""

_STORE_S: Final = 60.0
"""How often the time is stored."""

logger = logging.getLogger(__name__)


class FolderClock:
    """The time of a folder, kept as that of the file FILE in it. Its methods block, and raise OSError.

    It goes on while a gateway runs. What the computer's clock says beyond that, such as a weekend without a
    gateway, counts after BELIEVED_AFTER_S without a step, up to MAX_GAP_S. A clock that is ahead therefore
    makes no take old; one that is behind does not set the time back, so nothing seems to be a gap afterwards.
    """

    def __init__(self, directory: Path) -> None:
        self._path = directory / FILE
        self.latest_s = 0.0
        """The latest time that was believed: a clock that shows less is behind."""
        self._is_read = False
        self._stored_s = 0.0
        self._wall_s = self._monotonic_s = 0.0  # at the newest check
        self._steady_since_s = 0.0  # on the monotonic clock
        self._is_gap_logged = False

    def check(self, wall_s: float, monotonic_s: float, newest_take_s: float) -> float:
        """Return the time, in s since the Unix epoch, if the clocks show these times.

        ``newest_take_s`` is when the newest take that is not in the future was written. The time begins with
        it in a folder that has none yet.
        """
        stored_s = self._stored()
        if not self._is_read or (stored_s is not None and stored_s != self._stored_s):
            # The first check, or somebody has set the time of the file: see the warning below.
            self.latest_s = self._stored_s = newest_take_s if stored_s is None else stored_s
            self._is_read = True
            self._steady_since_s = monotonic_s
        else:
            elapsed_s = monotonic_s - self._monotonic_s
            if abs(wall_s - self._wall_s - elapsed_s) > STEP_S:
                self._steady_since_s = monotonic_s
            self.latest_s += elapsed_s
        self._wall_s, self._monotonic_s = wall_s, monotonic_s
        if monotonic_s - self._steady_since_s >= BELIEVED_AFTER_S:
            self._believe(wall_s)
        if stored_s is None or self.latest_s - self._stored_s >= _STORE_S:
            self._store(self.latest_s)
        return min(self.latest_s, wall_s)

    def _believe(self, wall_s: float) -> None:
        gap_s = wall_s - self.latest_s
        if -STEP_S <= gap_s <= MAX_GAP_S:
            self.latest_s = wall_s
        elif gap_s > 0 and not self._is_gap_logged:
            self._is_gap_logged = True
            logger.warning(
                "takes: no gateway has used %s for %.0f days, or the clock is wrong; takes.max_age_days does "
                "not count these days; if the clock is right, run: touch %s",
                *(self._path.parent, gap_s / 86_400.0, self._path),
            )

    def _stored(self) -> float | None:
        try:
            return self._path.stat().st_mtime
        except FileNotFoundError:
            return None

    def _store(self, time_s: float) -> None:
        self._path.touch()
        os.utime(self._path, (time_s, time_s))
        self._stored_s = self._path.stat().st_mtime  # as the file system rounds it
