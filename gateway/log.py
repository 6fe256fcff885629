"""Logging of persistent failures, once each, and of the context of log records."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from time import monotonic
from typing import Final

FIELDS: Final = ("source", "stream", "peer")
"""The context that a record can have besides its text: fields in the journal and in JSON."""

HOLD_S: Final = 5.0
"""A ``hold_s`` for FailureLog: intermittent failures are over after this time without a failure."""

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


class FailureLog:
    """Logs the first of several failures in a row as WARNING, repeats as DEBUG, and recovery as INFO.

    ``subject`` begins every message, for example "lab" or "lcm". It can be any object; its str may change.
    Successes within ``hold_s`` after a failure do not count as recovery, so intermittent failures are logged
    as one.
    """

    def __init__(self, logger: logging.Logger, subject: object, hold_s: float = 0.0) -> None:
        self._logger = logger
        self._subject = subject
        self._hold_s = hold_s
        self._failures = 0
        self._first_s = self._last_s = 0.0

    @property
    def failing(self) -> bool:
        """Whether a failure has been logged, and its recovery has not."""
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
        """After a failure, log the recovery with its duration, unless ``hold_s`` is not over yet.

        Cheap if nothing has failed, so it can be called after each success.
        """
        if not self._failures:
            return
        now_s = monotonic()
        if now_s - self._last_s >= self._hold_s:
            count = "1 failure" if self._failures == 1 else f"{self._failures} failures"
            self._logger.info(
                "%s: %s, after %.1f s and %s", self._subject, text, now_s - self._first_s, count
            )
            self._failures = 0

    def succeeded(self, text: str) -> None:
        """Log a success even if nothing has failed; after a failure, do the same as ``recovered``."""
        if self._failures:
            self.recovered(text)
        else:
            self._logger.info("%s: %s", self._subject, text)


class DefectLog:
    """Logs each defect in this program once as ERROR, with its traceback, and repeats as DEBUG."""

    def __init__(self, logger: logging.Logger, subject: object) -> None:
        self._logger = logger
        self._subject = subject
        self._places: set[tuple[str, str, int]] = set()  # of defects, in the source code: there are few

    def log(self, defect: BaseException, text: str = "") -> None:
        """Log a defect. One that is raised at the same place as an earlier one is a repeat."""
        text = text or f"defect in the gateway: {type(defect).__name__}: {defect}; report this with the log"
        place = _place(defect)
        if place in self._places:
            self._logger.debug("%s: %s (again)", self._subject, text)
            return
        self._places.add(place)
        self._logger.error("%s: %s", self._subject, text, exc_info=defect)


def _place(error: BaseException) -> tuple[str, str, int]:
    """Return the type of an exception, and the file and line that raised it."""
    trace = error.__traceback__
    if trace is None:
        return type(error).__name__, "", 0
    while trace.tb_next is not None:
        trace = trace.tb_next
    return type(error).__name__, trace.tb_frame.f_code.co_filename, trace.tb_lineno
