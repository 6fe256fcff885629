"""The log: text for people, JSON lines for log collectors, or the systemd journal; and its last limit."""

import json
import logging
import math
import os
import sys
import threading
import traceback
from collections import Counter
from collections.abc import Callable
from datetime import UTC, datetime
from enum import StrEnum
from time import monotonic
from typing import Final

from gateway.errors import ConfigError
from gateway.runtime.failures import FIELDS, current_log_fields
from gateway.runtime.safe_text import safe_lines, safe_text
from gateway.runtime.token_bucket import TokenBucket

logger = logging.getLogger(__name__)


class LogFormat(StrEnum):
    """Where and how log records are written; auto is the journal under systemd, otherwise text."""

    AUTO = "auto"
    TEXT = "text"
    JSON = "json"
    JOURNAL = "journal"


class LogLevel(StrEnum):
    """The lowest level that is logged; docs/operations.md describes what each level contains."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


_JOURNAL_PRIORITIES: Final = {
    logging.DEBUG: 7,
    logging.INFO: 6,
    logging.WARNING: 4,
    logging.ERROR: 3,
    logging.CRITICAL: 2,
}
"""Priorities as in syslog(3)."""

_SYSLOG_IDENTIFIER: Final = "rtc3d-gateway"


class ContextFilter(logging.Filter):
    """Adds the fields set by ``log_fields`` to each record, as attributes.

    Attach it to handlers: a logger's own filters do not see the records of other loggers.
    """

    def filter(self, record: logging.LogRecord) -> bool:
        """Add the fields; every record passes."""
        record.__dict__.update(current_log_fields())
        return True


def set_up_log(
    level: LogLevel, log_format: LogFormat = LogFormat.AUTO, limit: logging.Filter | None = None
) -> None:
    """Send all log records that pass ``limit`` to stderr or to the journal.

    Raises ConfigError if ``log_format`` is JOURNAL and cysystemd is not installed.
    """
    is_json = log_format is LogFormat.JSON
    handler: logging.Handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        JsonFormatter() if is_json else _LineFormatter("%(asctime)s %(levelname)s %(message)s")
    )
    if log_format is LogFormat.JOURNAL or (log_format is LogFormat.AUTO and _stderr_is_journal()):
        try:
            handler = JournalHandler()
        except ImportError as error:
            if log_format is LogFormat.JOURNAL:
                raise ConfigError(
                    f"cannot log to the journal: {error}; pip install 'rtc3d-gateway[systemd]', "
                    "or choose another --log-format"
                ) from error
            # Otherwise use stderr: systemd forwards it to the journal, as text without fields.
    handler.addFilter(ContextFilter())
    if limit is not None:
        handler.addFilter(limit)
    logging.basicConfig(level=level.upper(), handlers=[handler])


def _stderr_is_journal() -> bool:
    """Return whether systemd connected stderr to the journal (systemd.exec(5), JOURNAL_STREAM)."""
    try:
        stderr = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):  # closed, or replaced by an object without a file
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{stderr.st_dev}:{stderr.st_ino}"


def _fields(record: logging.LogRecord) -> dict[str, str]:
    return {name: value for name in FIELDS if (value := getattr(record, name, None))}


class _LineFormatter(logging.Formatter):
    """Formats a record as text in which control characters are escaped.

    Further lines, of a traceback or of the problems in a configuration, are indented, so that no text from a
    network can pass for a record of its own.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return the text, without a line end."""
        return safe_lines(super().format(record)).replace("\n", "\n  ")


class JsonFormatter(logging.Formatter):
    """Formats a record as one line of JSON.

    The keys are time (UTC), level, message and logger; source, stream, peer and exception where present.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return the JSON object, without a line end."""
        fields = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "message": safe_lines(record.getMessage()),
            "logger": record.name,
            **_fields(record),
        }
        if record.exc_info:
            fields["exception"] = safe_lines(record.exc_text or self.formatException(record.exc_info))
        return json.dumps(fields, ensure_ascii=False)


class JournalHandler(logging.Handler):
    """Sends records to the journal with LOGGER, and with SOURCE, STREAM and PEER where known.

    Raises ImportError if cysystemd is not installed.
    """

    # Not cysystemd's own JournaldLogHandler: it calls the field LOGGER_NAME, gives each record a new
    # MESSAGE_ID (which should identify the kind of message), adds about twenty more fields, and lets its
    # errors, such as a KeyError for an unusual level, reach the code that logs.

    def __init__(self) -> None:
        super().__init__()
        self.setFormatter(logging.Formatter())  # message and traceback; the rest goes into fields
        from cysystemd import journal  # noqa: PLC0415 - an optional extra

        self._send: Callable[..., None] = journal.send

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record."""
        try:
            self._send(
                message=safe_lines(self.format(record)),
                priority=_JOURNAL_PRIORITIES.get(record.levelno, 6),
                syslog_identifier=_SYSLOG_IDENTIFIER,
                logger=record.name,
                **_fields(record),
            )
        except Exception:  # noqa: BLE001 - as in logging's own handlers: logging must not stop the program
            self.handleError(record)


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


class _Scope:
    """The messages of one source, or of everything else."""

    def __init__(self, monotonic: Callable[[], float]) -> None:
        self.bucket = TokenBucket(LINES_PER_MINUTE / 60, BURST_LINES, monotonic)
        self.own = TokenBucket(OWN_LINES_PER_MINUTE / 60, OWN_BURST_LINES, monotonic)
        self.suppressed: Counter[str] = Counter()  # by level
        self.newest = ""
        self.since_s = 0.0  # of the first suppressed message


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
            scope = self._scopes.setdefault(name, _Scope(self._monotonic))
            # A message passes if one line is left, and may use up more.
            if scope.bucket.left < 1 or max(scope.own.left, self._total.left) < 1:
                if not scope.suppressed:
                    scope.since_s = now_s
                scope.suppressed[record.levelname] += 1
                scope.newest = record.getMessage()[:200]
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
                self._scopes[name].suppressed = Counter()
        for name, suppressed, newest in due:
            logger.warning(
                "%s: %d further messages suppressed in the last minute (%s); the status has the counts; "
                "the newest: %s",
                name or "gateway",
                suppressed.total(),
                ", ".join(f"{count} {level}" for level, count in suppressed.items()),
                newest,
            )


def _shorten(record: logging.LogRecord) -> int:
    """Bound the length of a record's lines, and leave out the middle of a long traceback.

    Return how many lines it has. Its message is one line.
    """
    text = record.getMessage()
    if len(text) > MAX_LINE_LENGTH or not text.isprintable():
        record.msg, record.args = safe_text(text, MAX_LINE_LENGTH), ()
    if not record.exc_info:
        return 1
    error = record.exc_info[1]
    trace = "".join(traceback.format_exception(error)) if error is not None else ""
    lines = [safe_text(line, MAX_LINE_LENGTH) for line in trace.rstrip("\n").split("\n")]
    left_out = len(lines) - _MAX_TRACEBACK_LINES
    if left_out > 0:
        last = lines[_FIRST_TRACEBACK_LINES + left_out :]
        lines = [*lines[:_FIRST_TRACEBACK_LINES], f"  … {left_out} lines left out …", *last]
    record.exc_text = "\n".join(lines)
    return 1 + len(lines)
