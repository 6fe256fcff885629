"""The forms of the log: text for people, JSON lines for collectors, the journal with its fields."""

import json
import logging
import os
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from enum import StrEnum
from typing import Final

from gateway.errors import ConfigError
from gateway.log import FIELDS, FieldsFilter


class LogFormat(StrEnum):
    """How the log is written; auto is journal under systemd, else text."""

    AUTO = "auto"
    TEXT = "text"
    JSON = "json"
    JOURNAL = "journal"


class LogLevel(StrEnum):
    """What the log holds: this and what is graver; docs/operations.md tells what each level has."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


# The journal's priorities are syslog's.
_PRIORITIES: Final = {
    logging.DEBUG: 7,
    logging.INFO: 6,
    logging.WARNING: 4,
    logging.ERROR: 3,
    logging.CRITICAL: 2,
}
_IDENTIFIER: Final = "rtc3d-gateway"


def set_up_log(level: LogLevel, log_format: LogFormat = LogFormat.AUTO) -> None:
    """Write everything that is logged to stderr, or to the journal.

    Raises ConfigError if the journal is asked for and cannot be written to.
    """
    handler = _handler(log_format)
    handler.addFilter(FieldsFilter())
    logging.basicConfig(level=level.upper(), handlers=[handler])


def _handler(log_format: LogFormat) -> logging.Handler:
    if log_format is LogFormat.JOURNAL or (log_format is LogFormat.AUTO and _stderr_is_the_journal()):
        try:
            return JournalHandler()
        except ImportError as error:
            if log_format is LogFormat.JOURNAL:
                raise ConfigError(
                    f"no log to the journal: {error}; pip install 'rtc3d-gateway[systemd]', "
                    "or give another --log-format"
                ) from error
            # The journal takes text from stderr as well, without the fields.
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        JsonFormatter()
        if log_format is LogFormat.JSON
        else logging.Formatter("%(asctime)s %(levelname)s %(message)s")
    )
    return handler


def _stderr_is_the_journal() -> bool:
    """Return whether systemd connected stderr with the journal (systemd.exec(5), JOURNAL_STREAM)."""
    try:
        stderr = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):  # closed, or replaced by what is no file
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{stderr.st_dev}:{stderr.st_ino}"


def _fields(record: logging.LogRecord) -> dict[str, str]:
    return {name: value for name in FIELDS if (value := getattr(record, name, None))}


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time (UTC), level, message, logger; source, stream and peer where known."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as one line."""
        fields = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "message": record.getMessage(),
            "logger": record.name,
            **_fields(record),
        }
        if record.exc_info:
            fields["exception"] = self.formatException(record.exc_info)
        return json.dumps(fields, ensure_ascii=False)


class JournalHandler(logging.Handler):
    """Sends records to the journal with SOURCE, STREAM and PEER where known; raises ImportError."""

    def __init__(self) -> None:
        super().__init__()
        self.setFormatter(logging.Formatter())  # the message alone: the journal has the rest in fields
        # Needed under systemd only, and an extra of the package.
        from cysystemd import journal  # noqa: PLC0415

        self._send: Callable[..., None] = journal.send

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record."""
        try:
            self._send(
                message=self.format(record),
                priority=_PRIORITIES.get(record.levelno, 6),
                syslog_identifier=_IDENTIFIER,
                logger=record.name,
                **_fields(record),
            )
        except Exception:  # noqa: BLE001 - as logging's own handlers: the log must not stop the program
            self.handleError(record)
