"""Log formats: text for people, JSON lines for log collectors, the systemd journal with fields."""

import json
import logging
import os
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from enum import StrEnum
from typing import Final

from gateway.errors import ConfigError
from gateway.logs.failures import FIELDS, current_log_fields
from gateway.logs.safe_text import safe_lines


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
    handler = _handler_for(log_format)
    handler.addFilter(ContextFilter())
    if limit is not None:
        handler.addFilter(limit)
    logging.basicConfig(level=level.upper(), handlers=[handler])


def _handler_for(log_format: LogFormat) -> logging.Handler:
    if log_format is LogFormat.JOURNAL or (log_format is LogFormat.AUTO and _stderr_is_journal()):
        try:
            return JournalHandler()
        except ImportError as error:
            if log_format is LogFormat.JOURNAL:
                raise ConfigError(
                    f"cannot log to the journal: {error}; pip install 'rtc3d-gateway[systemd]', "
                    "or choose another --log-format"
                ) from error
            # Otherwise use stderr: systemd forwards it to the journal, as text without fields.
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        JsonFormatter()
        if log_format is LogFormat.JSON
        else _LineFormatter("%(asctime)s %(levelname)s %(message)s")
    )
    return handler


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
