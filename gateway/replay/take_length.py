"""How long a take is, found without reading it."""

from pathlib import Path
from typing import Final

from gateway.errors import TakeError
from gateway.takes.event_log import EventLogReader
from gateway.takes.reader import TakeReader

_TAIL_BYTES: Final = 4 * 1024 * 1024


def take_length_us(reader: TakeReader) -> int | None:
    """Return the time from the first to the last event, in µs; None if the end of the take is damaged.

    It is wrong if somebody has set the clock meanwhile.
    """
    last_utime = _last_utime(reader.logs[-1].path)
    return None if last_utime is None else max(0, last_utime - reader.start_utime)


def _last_utime(log: Path) -> int | None:
    try:
        start = max(0, log.stat().st_size - _TAIL_BYTES)
        utime = None
        for event in EventLogReader(log).events(start):
            utime = event.utime
    except (OSError, TakeError):
        return None
    return utime
