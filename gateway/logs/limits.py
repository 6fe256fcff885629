"""Decides what is logged how often. Servers, peers and failing disks can cause messages without end.

- ``Repeats`` limits one kind of event: the log has the first few, and says how many were left out.
- ``Hold`` joins failures or losses that come and go into one period, with a message at its beginning and one
  at its end.
- ``LogLimit`` is for what nobody expected, such as defects, and for many messages that come together: it
  limits the lines of each source and of all of them, whatever they say.

EventLog and FailureLog (``failures``) use the first two, and Losses (``losses``) the second. DefectLog logs
each defect once, by its place in the source code.
"""

import logging
import math
import threading
import traceback
from collections import deque
from collections.abc import Callable
from time import monotonic
from typing import Final

from gateway.logs.safe_text import safe_text
from gateway.token_bucket import TokenBucket

MAX_REPEATS: Final = 5
REPEATS_WINDOW_S: Final = 300.0
"""How many messages of one kind are logged in this time."""

HOLD_S: Final = 5.0
MAX_HOLD_S: Final = 60.0
"""A period of failure or loss is over when nothing has failed for HOLD_S.

If the next one begins soon after that, the wait doubles, up to MAX_HOLD_S. So failures that come and go do
not fill the log.
"""


class Repeats:
    """The times of the newest messages of one kind, and how many others were not logged since then."""

    def __init__(self, most: int = MAX_REPEATS, window_s: float = REPEATS_WINDOW_S) -> None:
        self._window_s = window_s
        self._times_s: deque[float] = deque(maxlen=most)
        self._num_hidden = 0

    def count(self, now_s: float) -> str | None:
        """Count a message. Return what to add to its text, None if it is one too many."""
        times_s = self._times_s
        if len(times_s) == times_s.maxlen and now_s - times_s[0] < self._window_s:
            self._num_hidden += 1
            return None
        times_s.append(now_s)
        num_hidden, self._num_hidden = self._num_hidden, 0
        return f" ({num_hidden} more like this since the last one)" if num_hidden else ""


class Hold:
    """How long nothing must fail until a period of failure or loss is over: ``first_s``, or longer."""

    def __init__(self, first_s: float) -> None:
        self.seconds = first_s
        """For the current period."""
        self._first_s = first_s
        self._ended_s = -math.inf

    def begin(self, now_s: float) -> None:
        """Begin a period: wait twice as long as in the last one if that has just ended."""
        is_soon = now_s - self._ended_s < MAX_HOLD_S
        self.seconds = min(2 * self.seconds, MAX_HOLD_S) if is_soon else self._first_s

    def end(self, now_s: float) -> None:
        """End the period."""
        self._ended_s = now_s


BURST_LINES: Final = 25
LINES_PER_MINUTE: Final = 20
"""How many lines at once, and how many a minute, for each source and for everything without a source."""

TOTAL_BURST_LINES: Final = 30
TOTAL_LINES_PER_MINUTE: Final = 30
"""The same for everything together."""

OWN_BURST_LINES: Final = 6
OWN_LINES_PER_MINUTE: Final = 2
"""What each source may log even if others have used up what there is for everything together."""

MAX_LINE_LENGTH: Final = 1500
"""Longer lines are cut, in characters."""

_MAX_TRACEBACK_LINES: Final = 30
_FIRST_TRACEBACK_LINES: Final = 6
"""Of longer tracebacks, the first lines and the last ones are logged."""

_REPORT_S: Final = 60.0
"""After this time, the number of suppressed messages is logged."""

logger = logging.getLogger(__name__)


class _Scope:
    """The messages of one source, or of everything else."""

    def __init__(self, monotonic: Callable[[], float]) -> None:
        self.bucket = TokenBucket(LINES_PER_MINUTE / 60, BURST_LINES, monotonic)
        self.own = TokenBucket(OWN_LINES_PER_MINUTE / 60, OWN_BURST_LINES, monotonic)
        self.suppressed: dict[str, int] = {}  # by level
        self.newest = ""
        self.since_s = 0.0  # of the first suppressed message

    def suppress(self, record: logging.LogRecord, now_s: float) -> None:
        if not self.suppressed:
            self.since_s = now_s
        self.suppressed[record.levelname] = self.suppressed.get(record.levelname, 0) + 1
        self.newest = record.getMessage()[:200]


class LogLimit(logging.Filter):
    """Limits how many lines pass a handler, and how long they are; see the constants of this module.

    Attach it after ContextFilter, which knows the source. DEBUG is not limited. ``report`` logs how many
    messages were suppressed.
    """

    def __init__(self, monotonic: Callable[[], float] = monotonic) -> None:
        super().__init__()
        self._monotonic = monotonic
        self._lock = threading.Lock()  # any thread may log
        self._total = TokenBucket(TOTAL_LINES_PER_MINUTE / 60, TOTAL_BURST_LINES, monotonic)
        self._scopes: dict[str, _Scope] = {}  # by the source's name, from the configuration; "" for the rest

    def filter(self, record: logging.LogRecord) -> bool:
        """Shorten the record; return whether it is within the limit."""
        lines = _shorten(record)
        if record.levelno <= logging.DEBUG or record.name == __name__:
            return True
        now_s = self._monotonic()
        with self._lock:
            name = str(getattr(record, "source", ""))
            scope = self._scopes.get(name)
            if scope is None:
                scope = self._scopes[name] = _Scope(self._monotonic)
            # A message passes if one line is left, and may use up more.
            if scope.bucket.left < 1 or max(scope.own.left, self._total.left) < 1:
                scope.suppress(record, now_s)
                return False
            scope.bucket.take(lines, least=-math.inf)
            scope.own.take(lines, least=0.0)
            self._total.take(lines, least=-math.inf)
            return True

    def report(self, *, at_once: bool = False) -> None:
        """Log what was suppressed, a minute after it began unless ``at_once``. Call it once a second."""
        now_s = self._monotonic()
        with self._lock:
            due = [
                (name, scope.suppressed, scope.newest)
                for name, scope in self._scopes.items()
                if scope.suppressed and (at_once or now_s - scope.since_s >= _REPORT_S)
            ]
            for name, _, _ in due:
                self._scopes[name].suppressed = {}
        for name, suppressed, newest in due:
            logger.warning(
                "%s: %d further messages suppressed in the last minute (%s); the status has the counts; "
                "the newest: %s",
                name or "gateway",
                sum(suppressed.values()),
                ", ".join(f"{count} {level}" for level, count in suppressed.items()),
                newest,
            )


def _shorten(record: logging.LogRecord) -> int:
    """Bound the length of a record's lines; return how many it has. Its message is one line."""
    text = record.getMessage()
    if len(text) > MAX_LINE_LENGTH or not text.isprintable():
        record.msg, record.args = safe_text(text, MAX_LINE_LENGTH), ()
    if not record.exc_info:
        return 1
    record.exc_text = _traceback_text(record.exc_info[1])
    return 1 + record.exc_text.count("\n") + 1


def _traceback_text(error: BaseException | None) -> str:
    """Return a traceback without the lines in the middle of a long one."""
    text = "".join(traceback.format_exception(error)) if error is not None else ""
    lines = [safe_text(line, MAX_LINE_LENGTH) for line in text.rstrip("\n").split("\n")]
    left_out = len(lines) - _MAX_TRACEBACK_LINES
    if left_out > 0:
        first, last = lines[:_FIRST_TRACEBACK_LINES], lines[_FIRST_TRACEBACK_LINES + left_out :]
        lines = [*first, f"  … {left_out} lines left out …", *last]
    return "\n".join(lines)
