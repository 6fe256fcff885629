"""Logging of failures, defects and repeated events, and of the context of log records.

Servers, peers and failing disks can cause messages without end. EventLog logs the first few events of each
kind, and says how many it left out (``Repeats``). FailureLog, and Losses (``losses``), join what comes and
goes into one period, with a message at its beginning and one at its end (``Hold``). DefectLog logs each
defect once, by its place in the source code. LogLimit (``log_format``) is for what nobody expected.
"""

import logging
import math
import re
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from time import monotonic
from typing import Final, TypeVar

from gateway.errors import raise_unless_defect
from gateway.runtime.safe_text import safe_text

MAX_REPEATS: Final = 5
REPEATS_WINDOW_S: Final = 300.0
"""How many messages of one kind are logged in this time."""

HOLD_S: Final = 5.0
MAX_HOLD_S: Final = 60.0
"""A period of failure or loss is over when nothing has failed for HOLD_S.

If the next one begins soon after that, the wait doubles, up to MAX_HOLD_S. So failures that come and go do
not fill the log.
"""

REMINDER_S: Final = 3600.0
"""How often a failure that goes on is logged again. In this time, its reason is logged MAX_REPEATS times."""

STEADY_REASON_S: Final = 300.0
"""A changed reason that has stayed the same for so long is logged in any case."""

_NUMBERS: Final = re.compile(r"\d+")
"""Durations, sizes and counts in a text vary while the reason is the same."""

FIELDS: Final = ("source", "stream", "peer")
"""The context that a record can have besides its text: fields in the journal and in JSON."""

_Result = TypeVar("_Result")

_fields: ContextVar[Mapping[str, str]] = ContextVar("log fields")


@contextmanager
def log_fields(**fields: str) -> Iterator[dict[str, str]]:
    """Add ``fields`` (names from FIELDS) to the records of the block and of tasks and callbacks it starts.

    The event loop runs a callback in the context in which it was registered. So all records of a
    connection have the fields, without naming them in each call. The block gets all fields as a dict. If it
    changes them, the records of its tasks and callbacks change too.
    """
    all_fields = {**current_log_fields(), **fields}
    token = _fields.set(all_fields)
    try:
        yield all_fields
    finally:
        _fields.reset(token)


def current_log_fields() -> Mapping[str, str]:
    """Return the fields of records that are logged here."""
    return _fields.get({})


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


class EventLog:
    """Logs events that a server or a peer can cause as often as it likes.

    Of each kind, it logs some events in a few minutes as ``log`` says and further ones as DEBUG, and the next
    loud message says how many these were. ``subject`` is the same as for FailureLog.
    """

    def __init__(self, logger: logging.Logger, subject: object) -> None:
        self._logger = logger
        self._subject = subject
        self._repeats: dict[str, Repeats] = {}

    def log(self, level: int, text: str, kind: str, most: int = MAX_REPEATS) -> None:
        """Log an event. There must be few kinds, so they never come from a network.

        ``most`` is how many of this kind are logged in a few minutes.
        """
        addition = self._repeats.setdefault(kind, Repeats(most)).count(monotonic())
        if addition is None:
            self._logger.debug("%s: %s", self._subject, text, extra={"kind": kind})
        else:
            self._logger.log(level, "%s: %s%s", self._subject, text, addition, extra={"kind": kind})


class FailureLog:
    """Logs the first of several failures in a row as WARNING, repeats as DEBUG, and recovery as INFO.

    A failure with another reason than the last one logged, and one failure per hour, are WARNING as well:
    what somebody reads in the morning must be what is wrong now.

    ``subject`` begins every message, for example "lab" or "lcm". It can be any object; its str may change.
    Successes within ``hold_s`` (see Hold) after a failure do not count as recovery, so intermittent failures
    are logged as one. If failures come and go nevertheless, these messages are limited as by EventLog.
    """

    def __init__(self, logger: logging.Logger, subject: object, hold_s: float = 0.0) -> None:
        self._logger = logger
        self._subject = subject
        self._hold = Hold(hold_s)
        self._failures = 0
        self._first_s = self._last_s = 0.0
        self._repeats = Repeats()
        self._is_hidden = False  # this period of failure, because there were too many before
        self._changes = Repeats(MAX_REPEATS, REMINDER_S)
        self._reason = ""  # of the newest failure that was logged as WARNING, and when that was
        self._logged_s = -math.inf
        self._newest_reason = ""  # of the newest failure, and since when it is the same
        self._newest_since_s = 0.0

    @property
    def failing(self) -> bool:
        """Whether there was a failure, and it is not over yet."""
        return self._failures > 0

    def failed(self, text: str, reason: str = "") -> None:
        """Log a failure; ``text`` says what happened and what to do.

        ``reason`` is what stays the same in it, if more than numbers varies.
        """
        self._failures += 1
        self._last_s = monotonic()
        reason = _NUMBERS.sub("0", reason or text)
        if reason != self._newest_reason:
            self._newest_reason, self._newest_since_s = reason, self._last_s
        if self._failures > 1:
            self._failed_again(text, reason)
            return
        self._first_s = self._logged_s = self._last_s
        self._reason = reason
        self._hold.begin(self._first_s)
        addition = self._repeats.count(self._first_s)
        self._is_hidden = addition is None
        self._logger.log(
            logging.DEBUG if addition is None else logging.WARNING,
            "%s: %s%s",
            *(self._subject, text, addition or ""),
        )

    def _failed_again(self, text: str, reason: str) -> None:
        """Log a further failure: as WARNING once an hour, and if the reason has changed.

        Reasons that change all the time would fill the log, so there is a limit. But the last line must not
        name a reason that is over: beyond the limit, a changed one is logged when it has stayed for a while.
        """
        now_s = self._last_s
        addition: str | None = None
        if now_s - self._logged_s >= REMINDER_S:
            addition = ""
        elif reason != self._reason:
            addition = self._changes.count(now_s)
            if addition is None and now_s - self._newest_since_s >= STEADY_REASON_S:
                addition = ""
        if addition is None:
            self._logger.debug("%s: %s (failure %d in a row)", self._subject, text, self._failures)
            return
        self._reason, self._logged_s = reason, now_s
        self._is_hidden = False
        since = f"failure {self._failures} in a row, since {now_s - self._first_s:.0f} s"
        self._logger.warning("%s: %s (%s)%s", self._subject, text, since, addition)

    def recovered(self, text: str) -> None:
        """After a failure, log the recovery with its duration, unless ``hold_s`` is not over yet.

        Cheap if nothing has failed, so it can be called after each success.
        """
        if not self._failures:
            return
        now_s = monotonic()
        if now_s - self._last_s >= self._hold.seconds:
            count = "" if self._failures == 1 else f" and {self._failures} failures"
            self._logger.log(
                logging.DEBUG if self._is_hidden else logging.INFO,
                "%s: %s, after %.1f s%s",
                *(self._subject, text, now_s - self._first_s, count),
            )
            self._failures = 0
            self._hold.end(now_s)

    def succeeded(self, text: str) -> None:
        """Log a success even if nothing has failed; after a failure, do the same as ``recovered``."""
        if self._failures:
            self.recovered(text)
        else:
            self._logger.info("%s: %s", self._subject, text)


class DefectTotal:
    """How often there was a defect since the program started, wherever it was logged."""

    def __init__(self) -> None:
        self.count = 0


defect_total: Final = DefectTotal()


class DefectLog:
    """Logs each defect in this program once as ERROR, with its traceback, and repeats as DEBUG.

    ``former`` is a log whose defects count as logged here, too.
    """

    def __init__(self, logger: logging.Logger, subject: object, former: "DefectLog | None" = None) -> None:
        self._logger = logger
        self._subject = subject
        # Of defects, in the source code: there are few.
        self._counts: dict[tuple[str, str, int], int] = {}
        if former is not None:
            self._counts = former._counts  # noqa: SLF001 - of the same class

    @property
    def count(self) -> int:
        """How often there was a defect, repeats included."""
        return sum(self._counts.values())

    def attempt(self, call: Callable[[], _Result], otherwise: _Result) -> _Result:
        """Return what ``call`` returns. If it raises, log that and return ``otherwise``: others continue."""
        try:
            return call()
        except BaseException as defect:  # noqa: BLE001 - see above
            raise_unless_defect(defect)
            self.log(defect)
            return otherwise

    def log(self, defect: BaseException, text: str = "") -> None:
        """Log a defect. One that is raised at the same place as an earlier one is a repeat."""
        text = text or f"{defect_text(defect)}; report this with the log"
        place = _place(single(defect))
        repeats = self._counts.get(place, 0)
        defect_total.count += 1
        self._counts[place] = repeats + 1
        if repeats:
            self._logger.debug("%s: %s (again)", self._subject, text)
        else:
            self._logger.error("%s: %s", self._subject, text, exc_info=defect)


def single(defect: BaseException) -> BaseException:
    """Return the first exception in a group of them; any other exception as it is."""
    while isinstance(defect, BaseExceptionGroup):
        defect = defect.exceptions[0]
    return defect


def defect_text(defect: BaseException) -> str:
    """Return what happened, for messages about a defect: "defect in the gateway: KeyError: 'lab'"."""
    error = single(defect)
    return safe_text(f"defect in the gateway: {type(error).__name__}: {error}")


def _place(error: BaseException) -> tuple[str, str, int]:
    """Return the type of an exception, and the file and line that raised it."""
    trace = error.__traceback__
    if trace is None:
        return type(error).__name__, "", 0
    while trace.tb_next is not None:
        trace = trace.tb_next
    return type(error).__name__, trace.tb_frame.f_code.co_filename, trace.tb_lineno
