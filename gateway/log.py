"""Logging for long-running work: persistent failures are logged once, and records carry their context."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from time import monotonic
from typing import Final

FIELDS: Final = ("source", "stream", "peer")
"""The context that a record can carry besides its text: fields in the journal and in JSON."""

HOLD_S: Final = 5.0
"""For FailureLog: how long all messages must succeed before intermittent failures count as over."""

_fields: ContextVar[Mapping[str, str]] = ContextVar("log fields")


@contextmanager
def log_fields(**fields: str) -> Iterator[None]:
    """Add these of FIELDS to every record of the block, and of the tasks and callbacks that it starts.

    The event loop runs a callback in the context in which it was registered. So all records of a
    connection carry the fields, and no call has to name them.
    """
    token = _fields.set({**current_log_fields(), **fields})
    try:
        yield
    finally:
        _fields.reset(token)


def current_log_fields() -> Mapping[str, str]:
    """Return the fields that records get here."""
    return _fields.get({})


class FailureLog:
    """Logs whether one thing works: the first failure as WARNING, repeats as DEBUG, recovery as INFO.

    ``subject`` begins every line: "lab", "lcm". With ``hold_s``, an intermittent failure is over only after
    ``hold_s`` without a failure: until then each failure counts as a repeat.
    """

    def __init__(self, logger: logging.Logger, subject: str, hold_s: float = 0.0) -> None:
        self._logger = logger
        self._subject = subject
        self._hold_s = hold_s
        self._failures = 0
        self._first_s = self._last_s = 0.0

    @property
    def failing(self) -> bool:
        """Whether a failure was logged and its recovery was not."""
        return self._failures > 0

    def failed(self, text: str) -> None:
        """Log a failure; ``text`` says what happened and what to do."""
        self._failures += 1
        self._last_s = monotonic()
        if self._failures == 1:
            self._first_s = self._last_s
            self._logger.warning("%s: %s", self._subject, text)
        else:
            self._logger.debug("%s: %s (failure %d in a row)", self._subject, text, self._failures)

    def recovered(self, text: str) -> None:
        """If it was failing, log that it works again, with the duration; within ``hold_s`` do nothing.

        Cheap while nothing fails, so it can be called after each success.
        """
        if not self._failures:
            return
        now_s = monotonic()
        if now_s - self._last_s >= self._hold_s:
            duration_s = now_s - self._first_s
            self._logger.info(
                "%s: %s, after %.1f s and %d failures", self._subject, text, duration_s, self._failures
            )
            self._failures = 0

    def succeeded(self, text: str) -> None:
        """Log that it works, in any case; if it was failing, do as ``recovered`` does."""
        if self._failures:
            self.recovered(text)
        else:
            self._logger.info("%s: %s", self._subject, text)
