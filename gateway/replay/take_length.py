"""How long a take is, found without reading it."""

from pathlib import Path
from typing import Final

from gateway.errors import TakeError
from gateway.takes.event_log import EventLogReader
from gateway.takes.reader import TakeReader

_TAIL_BYTES: Final = 4 * 1024 * 1024


def take_length_us(reader: TakeReader, stop_us: int | None = None) -> int | None:
    """Return the time from the first to the last event, in µs; None if the end of the take is damaged.

    If the replay stops earlier, at ``stop_us``, that is the end.
    It is wrong if somebody has set the clock during the recording.
    """
    last_utime = _last_utime(reader.logs[-1].path)
    if last_utime is None:
        return stop_us
    length_us = max(0, last_utime - reader.start_utime)
    return length_us if stop_us is None else min(length_us, stop_us)


def _last_utime(log: Path) -> int | None:
    try:
        start = max(0, log.stat().st_size - _TAIL_BYTES)
        utime = None
        for event in EventLogReader(log).events(start):
            utime = event.utime
    except (OSError, TakeError):
        return None
    return utime
